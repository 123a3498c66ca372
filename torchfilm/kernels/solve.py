"""The contact problem of one colony, minimised: semismooth Newton, each round solved by CG.

E(y) = ½ Σ min(g − J y, 0)² + ½ Σ α y² over moves whose lengths are at least `low`, where y is the
scaled move of n cells, (n, D): see `physics.problem`. Newton steps are projected: lengths that are
at their bound and pushed further are held; others that would pass it stop at it. Where these
keep all from going far, they take steps of their own, down their slope.

The loops over rows and cells are in `solve_parts`. In a large colony the threads of a team share
them: see `team` and `solve_pieces`.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.memory import copied, room, zeros
from torchfilm.kernels.rows import degrees, rows_of_cells
from torchfilm.kernels.scheme import (
    CREEP,
    EASY_ROUNDS,
    FLAT,
    FORCING,
    FORCING_LATE,
    LEVEL,
    MOST_LOOKS,
    MOST_ROUNDS,
)
from torchfilm.kernels.solve_parts import (
    add_curvature,
    add_forces,
    add_product,
    advance,
    advance_rows,
    first_direction,
    go_along,
    keep_pushing,
    next_direction,
    of_drag,
    overlaps,
    precondition,
    put_forces,
    put_scaled,
    put_slopes,
    refresh_blocks,
    second_cells,
    stop_at_bounds,
    times_rows,
)
from torchfilm.kernels.solve_pieces import (
    ADVANCE,
    ALONG,
    BOUNDS,
    CELLS,
    CHANGES,
    CREEPS,
    DIRECTION,
    GAPS,
    PRODUCT,
    least_of,
    put_on_board,
    rows_of_pieces,
    total_of,
)
from torchfilm.kernels.team import BLOCK, pieces_for, share_out


@lean(any_order=True)
def _slope(e, q, t):
    """The slope of the rows' energy after a share t of a step that changes them by −q, and its
    derivative."""
    slope, curvature = 0.0, 0.0
    for r in range(e.shape[0]):
        left = e[r] - t * q[r]
        push = q[r] if left < 0 else 0.0 * q[r]
        slope -= left * push
        curvature += push * push
    return slope, curvature


@lean
def search_line(e, q, c0, c1, most):
    """How far to go along a step, at most `most`: until the slope is at most LEVEL of that at 0.
    And how far E falls."""
    slope0, curvature = _slope(e, q, 0.0)
    slope0 += c0
    if not (slope0 < 0 and curvature + c1 > 0):
        return 0.0, 0.0
    t = min(-slope0 / (curvature + c1), most)
    least, end = 0.0, np.inf
    for _ in range(MOST_LOOKS):
        slope, curvature = _slope(e, q, t)
        slope += c0 + c1 * t
        if abs(slope) <= -LEVEL * slope0 or (slope < 0 and t == most):
            break
        if slope < 0:
            least = t
        else:
            end = t
        new = t - slope / (curvature + c1)
        if not (new > least and new < end):
            new = 0.5 * (least + end) if end < np.inf else 2.0 * t
        t = min(new, most)
    return t, -0.5 * slope0 * t


@lean(any_order=True)
def _squared_overlap(e, cap):
    """The sum of squared overlaps, each counted up to `cap`."""
    overlap = 0.0
    for r in range(e.shape[0]):
        depth = max(-e[r], 0 * e[r])
        overlap += min(depth * depth, cap * cap)
    return overlap


@lean(any_order=True)
def _work_of(pushed, q):
    """Σ pushed · q."""
    total = 0.0
    for r in range(pushed.shape[0]):
        total += pushed[r] * q[r]
    return total


@lean
def _step_length(rz, curvature):
    """How far to go along a direction; 0 where rounding leaves no curvature, as at the end of a
    solve that is nearly exact."""
    return rz / curvature if curvature > FLAT * rz else 0.0


@lean
def cg_step(H, one, two, on, alpha, inverse, g, z, p, d, rz, t, dof):
    """Go along the direction p: d += t p, and g becomes the gradient there and z = P⁻¹ g. z is 0
    before; rz: g · P⁻¹ g before. Returns g · z."""
    n, curvature, new = g.shape[0], 0.0, 0.0
    add_product(H, one, two, on, p, z, dof)
    for a in range(0, n, BLOCK):
        curvature += add_curvature(alpha, z, p, a, min(a + BLOCK, n), dof)
    t[0] = _step_length(rz, curvature)
    for a in range(0, n, BLOCK):
        new += go_along(d, g, z, p, inverse, t[0], a, min(a + BLOCK, n), dof)
    return new


@lean
def _shared_cg_step(team, rz, t):
    """As `cg_step`, by a team."""
    share_out(team, PRODUCT)
    t[0] = _step_length(rz, total_of(team, 0))
    share_out(team, ALONG)
    return total_of(team, 0)


@lean
def _conjugate_gradients(
    H, one, two, on, alpha, inverse, g, z, p, d, gz, share, limit, t, team, dof
):
    """d = −(JᵀAJ + α)⁻¹ g, to a share of the residual, from `first_direction`; g becomes the
    residual. t: (1,). Returns iterations."""
    rz, count = gz, 0
    while count < limit and rz > 0:
        if team.shape[0]:
            new = _shared_cg_step(team, rz, t)
        else:
            new = cg_step(H, one, two, on, alpha, inverse, g, z, p, d, rz, t, dof)
        count += 1
        if not (new > share * share * gz and new < np.inf) or t[0] == 0:
            break
        t[0], rz = new / rz, new
        if team.shape[0]:
            share_out(team, DIRECTION)
        else:
            next_direction(p, z, t[0], 0, p.shape[0])
    return count


@lean(inline=True)
def _put_gaps(H, one, two, e, q, v, pushed, act, stale, y, t, team, dof):
    """The gaps after the move y, and the rows' forces."""
    t[0] = 1.0
    if team.shape[0]:
        share_out(team, GAPS)
        return
    times_rows(H, one, two, y, q, 0, e.shape[0], dof)
    advance_rows(e, q, t, 0, e.shape[0])
    put_forces(e, pushed, v, one, two, act, stale, 0, e.shape[0])


@lean(inline=True)
def _put_gradient(H, one, two, v, pushed, act, stale, alpha, low, y, g, z, d, p, inverse, slope,
                  own, begin, halves, lengths, on, counts, team, dof):  # fmt: skip
    """The gradient, the blocks and the first direction of CG. Returns g · P⁻¹ g, and the same of
    the lengths that step alone."""
    if team.shape[0]:
        share_out(team, CELLS)
        return total_of(team, 0), total_of(team, 1)
    n, gz, of_alone = g.shape[0], 0.0, 0.0
    counts[0] = keep_pushing(act, range(act.shape[0]), on)
    put_scaled(g, alpha, y, 0, n, dof)
    if pushed.shape[0]:
        add_forces(H, one, two, range(act.shape[0]), v, g, dof)
    else:
        add_forces(H, one, two, on[: counts[0]], v, g, dof)
    refresh_blocks(H, begin, halves, act, alpha, y, low, g, lengths, own, inverse, stale, 0, n, dof)
    for a in range(0, n, BLOCK):
        b = min(a + BLOCK, n)
        gz += precondition(inverse, g, z, a, b, dof)
        of_alone += put_slopes(g, lengths, slope, own, a, b, dof)
    first_direction(d, p, z, 0, n)
    return gz, of_alone


@lean(inline=True)
def _bounded(H, one, two, q, alpha, low, y, d, slope, own, lengths, team, dof):
    """Bound the step d, and put its change of gaps into q. Returns how far all may go along it, and
    the slope and curvature that drags give."""
    n, c0, c1 = y.shape[0], 0.0, 0.0
    if team.shape[0]:
        share_out(team, BOUNDS)
        most, c0, c1 = least_of(team), total_of(team, 0), total_of(team, 1)
        share_out(team, CHANGES)
        return most, c0, c1
    most = stop_at_bounds(y, d, low, lengths, slope, own, 0, n, dof)
    for a in range(0, n, BLOCK):
        slope0, curvature = of_drag(alpha, y, d, a, min(a + BLOCK, n), dof)
        c0, c1 = c0 + slope0, c1 + curvature
    times_rows(H, one, two, d, q, 0, q.shape[0], dof)
    return most, c0, c1


@lean(inline=True)
def _advance(one, two, e, q, v, pushed, act, stale, low, y, d, lengths, share, t, team, dof):
    """Go `share` of the step d, and put the rows' forces."""
    t[0] = share
    if team.shape[0]:
        team[CREEPS] = share < CREEP
        share_out(team, ADVANCE)
        return
    advance(y, d, low, lengths, share < CREEP, t, 0, y.shape[0], dof)
    advance_rows(e, q, t, 0, e.shape[0])
    put_forces(e, pushed, v, one, two, act, stale, 0, e.shape[0])


@kernel(inline=True)
def _work(memory, H, one, two, rows, gaps, pushed, alpha, low, y, pieces, dof):
    """The arrays of a solve: see `solve_pieces.put_on_board`."""
    n, kind = y.shape[0], y.dtype
    begin, halves = rows_of_cells(memory, one, two, rows, n)
    two = second_cells(memory, H, one, two, rows)
    mine_begin, mine = rows_of_pieces(memory, one, two, rows, n, pieces if pieces > 1 else 0)
    stale = room(memory, (n,), np.uint8)
    for i in range(n):
        stale[i] = 1
    of_rows, of_cells, moves = (rows,), (n,), (n, len(dof))
    return (
        H, one, two, copied(memory, gaps, rows), room(memory, of_rows, kind),
        room(memory, of_rows, kind), pushed, zeros(memory, of_rows, np.uint8), stale, alpha, low, y,
        room(memory, moves, kind), room(memory, moves, kind), room(memory, moves, kind),
        room(memory, moves, kind), room(memory, (n, len(dof), len(dof)), kind),
        room(memory, of_cells, kind), room(memory, of_cells, kind), begin, halves,
        zeros(memory, (3, n), np.uint8), mine_begin, mine,
        room(memory, (max(rows, mine.shape[0]),), np.int32), zeros(memory, (pieces,), np.int64),
        room(memory, (3, (n + BLOCK - 1) // BLOCK), np.float64), room(memory, (1,), kind),
    )  # fmt: skip


@lean
def _error(fall, left, overlap, cap):
    """The relative error that is left."""
    if left == 0.0:  # solved exactly
        return 0.0
    if not left < np.inf:  # also where it is no number
        return np.inf
    # where nothing overlaps any more, relative to contacts as deep as counted
    return math.sqrt(max(fall, left, 0.0) / (overlap if overlap > 0 else cap * cap))


@lean
def _rounds(work, tolerance, cap, limit, team, dof):
    """The rounds of `minimise`. Returns iterations and the relative error that is left."""
    (H, one, two, e, q, v, pushed, act, stale, alpha, low, y, g, z, d, p, inverse, slope, own,
     begin, halves, lengths, _, _, on, counts, _, t) = work  # fmt: skip
    n, D = y.shape[0], degrees(dof)
    for i in range(n):
        y[i, D - 1] = max(y[i, D - 1], low[i])
    total, fall, error, stuck = 0, np.inf, 0.0, 0
    _put_gaps(H, one, two, e, q, v, pushed, act, stale, y, t, team, dof)
    for round_ in range(MOST_ROUNDS + 1):
        overlap = _squared_overlap(e, cap)
        gz, of_alone = _put_gradient(
            H, one, two, v, pushed, act, stale, alpha, low, y, g, z, d, p, inverse, slope, own,
            begin, halves, lengths, on, counts, team, dof,
        )  # fmt: skip
        left = gz + of_alone
        error = _error(fall, left, overlap, cap)
        done = error <= tolerance or not left < np.inf or stuck > 1
        if done or total >= limit or round_ == MOST_ROUNDS:
            break
        forcing = FORCING if round_ < EASY_ROUNDS else FORCING_LATE
        total += _conjugate_gradients(
            H, one, two, on[: counts[0]], alpha, inverse, g, z, p, d, gz, forcing, limit - total, t,
            team, dof,
        )  # fmt: skip
        most, c0, c1 = _bounded(
            H, one, two, q, alpha, low, y, d, slope, own, lengths, team, dof
        )  # fmt: skip
        share, fall = search_line(e, q, c0 - _work_of(pushed, q), c1, most)
        stuck = stuck + 1 if share == 0 else 0
        _advance(
            one, two, e, q, v, pushed, act, stale, low, y, d, lengths, share, t, team, dof
        )  # fmt: skip
    return total, error


@lean
def minimise(
    memory, H, one, two, rows, gaps, pushed, alpha, low, y, tolerance, cap, limit, team, dof
):
    """Minimise E from y, in place.

    pushed: what soft rows have already exerted in this step, (rows,); or (0,) for nothing. low:
    (n,) least scaled Δl, at most 0. team: a board, or (0,) where this thread is alone. Stops when
    the error that is left, estimated by the fall of E in the last round and by the residual, is at
    most `tolerance` of the contacts' overlap: root mean square, overlaps counted up to `cap` (µm),
    so that what has not converged does not loosen the rule. Returns iterations, that relative
    error, and each row's gap after the move.
    """
    n = y.shape[0]
    if not overlaps(gaps, rows):  # nothing pushes: such a colony does not move at all
        y[:] = 0
        return 0, 0.0, copied(memory, gaps, rows)
    pieces = pieces_for(team, n)
    team = team[: 0 if pieces == 1 else team.shape[0]]
    work = _work(memory, H, one, two, rows, gaps, pushed, alpha, low, y, pieces, dof)
    if pieces > 1:
        put_on_board(team, work, n, rows)
    total, error = _rounds(work, tolerance, cap, limit, team, dof)
    return total, error, work[3]

"""The contact problem of bilateral rows of one colony, minimised: projected Newton, by CG.

E(y) = ½ ‖g − J y‖² + ½ Σ α y² over moves whose lengths are at least `low`, where y is the scaled
move of n cells, (n, D): as in `physics.newton` and `physics.line_search`.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.batch import put
from torchfilm.kernels.bilateral_scheme import (
    BEYOND_BOUND,
    BLOCK_FLOOR,
    DOWNHILL,
    FINISH,
    MAX_HALVINGS,
    NEWTON_LIMIT,
    ROUNDING_UNITS,
    STALLED,
    STEEP,
)
from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.lanes import add_scaled, dot, keep_greatest, put_inverse
from torchfilm.kernels.rows import degrees, rows_of_cells
from torchfilm.kernels.scheme import CONVERGED, ITERATION_LIMIT, NOT_FINITE
from torchfilm.kernels.solve import cg_step
from torchfilm.kernels.solve_parts import (
    add_forces,
    next_direction,
    precondition,
    second_cells,
    times_rows,
)


@kernel
def _worst(z, dof):
    """The greatest |entry| of z (n, len(dof)); NaN where there is one."""
    lanes, most = np.zeros((1, len(dof)), z.dtype), 0.0
    for i in range(z.shape[0]):
        keep_greatest(lanes, z, i, dof)
    for k in range(lanes.shape[1]):
        if not lanes[0, k] <= most and most < np.inf:
            most = lanes[0, k]
    return most


@kernel
def _floor(y):
    """By which share the diagonal of blocks is raised."""
    return BLOCK_FLOOR * np.finfo(y.dtype).eps


@kernel
def _put_gradient(H, one, two, alpha, y, e, pushed, g, dof):
    """g = α y − Jᵀ(e + pushed), for gaps e after the move y."""
    g[:] = 0
    for i in range(y.shape[0]):
        add_scaled(g, i, alpha[i], y, i, dof)
    add_forces(H, one, two, range(e.shape[0]), -(e + pushed), g, dof)


@kernel
def _hold_lengths(H, begin, halves, act, alpha, y, low, rigid, g, held, inverse, dof):
    """Hold the lengths of rigid cells, and those at their bound that are pushed further; invert
    the blocks of the cells where that has changed."""
    end, floor = degrees(dof) - 1, _floor(y)
    for i in range(y.shape[0]):
        hold = rigid[i] or (y[i, end] <= low[i] and g[i, end] > 0)
        if hold != held[i]:
            held[i] = hold
            put_inverse(
                inverse, i, H, halves, act, begin[i], begin[i + 1], alpha[i], floor, hold > 0, dof
            )


@kernel
def _conjugate_gradients(H, one, two, on, alpha, inverse, g, z, p, d, target, limit, dof):
    """d = −(JᵀJ + α)⁻¹ g, until the greatest entry of P⁻¹ times the residual is at most `target`.
    z: P⁻¹ g. g becomes the residual. Iterations."""
    t, rz = np.zeros(1, g.dtype), 0.0
    for i in range(g.shape[0]):
        rz += dot(g, i, z, i, dof)
    d[:], p[:] = 0, 0
    next_direction(p, z, t[0], 0, z.shape[0])
    count = 0
    while count < limit:
        new = cg_step(H, one, two, on, alpha, inverse, g, z, p, d, rz, t, dof)
        count += 1
        worst = _worst(z, dof)
        if not (worst > target and worst < np.inf and new > 0 and t[0] > 0):
            break
        t[0], rz = new / rz, new
        next_direction(p, z, t[0], 0, z.shape[0])
    return count


@kernel
def _share_of_least_energy(e, then, alpha, step, slope, dof):
    """The share of a step at which the energy is least; e, then: gaps before and after. Every row
    acts, so the slope grows with the share by terms that are never negative: no digits are lost."""
    drag, grown, curvature = 0.0, 0.0, 0.0
    for i in range(step.shape[0]):
        drag += alpha[i] * dot(step, i, step, i, dof)
    for r in range(e.shape[0]):
        change = e[r] - then[r]
        end = e[r] - change  # `then`, as rounding leaves it
        grown += (e[r] - end) * change
        curvature += change * change
    return 1.0 - (slope + drag + grown) / (curvature + drag)


@kernel
def _share_to_bound(y, d, low, end):
    """The share of a direction at which the first length above its bound reaches it."""
    share = np.inf
    for i in range(y.shape[0]):
        room, way = y[i, end] - low[i], d[i, end]
        if room > 0 and way < 0:
            share = min(share, room / -way * (1 + BEYOND_BOUND))
    return share


@kernel
def _search_line(H, one, two, gaps, pushed, alpha, low, y, e, g, d, dof):
    """Take the full step d with lengths stopped at their bounds, or a shorter one if the energy
    rises: see `physics.line_search`. g: the gradient at y. Returns y, e and g at the end."""
    end, length = degrees(dof) - 1, np.ones(1, y.dtype)
    step, then, ahead = np.empty_like(y), np.empty_like(e), np.empty_like(y)
    new = np.empty_like(y)
    for _ in range(MAX_HALVINGS):
        stopped = False
        put(y, new)
        for i in range(y.shape[0]):
            add_scaled(new, i, length[0], d, i, dof)
            if new[i, end] < low[i]:
                new[i, end], stopped = low[i], True
        times_rows(H, one, two, new, then, 0, then.shape[0], dof)
        for r in range(then.shape[0]):
            then[r] = gaps[r] - then[r]
        _put_gradient(H, one, two, alpha, new, then, pushed, ahead, dof)
        if not stopped:
            break
        slope, whole, rising = 0.0, 0.0, 0.0
        for i in range(y.shape[0]):
            for k in range(y.shape[1]):
                step[i, k] = new[i, k] - y[i, k]
            slope += dot(g, i, step, i, dof)
            whole += dot(g, i, d, i, dof)
            rising += dot(ahead, i, step, i, dof)
        steep = slope > DOWNHILL * length[0] * whole
        if not (steep or rising > STEEP * abs(slope)):
            break
        share = 0.5
        if not steep:
            share = _share_of_least_energy(e, then, alpha, step, slope, dof)
        # A step with stopped lengths does not follow the straight line to its end. On that line it
        # must at least be long enough for the first length to reach its bound.
        run = _share_to_bound(y, d, low, end)
        length[0] = max(share * length[0], run if run < length[0] else 0.0)
    return new, then, ahead


@kernel
def _rounding_residual(H, one, two, gaps, alpha, y, inverse, z, dof):
    """The residual that rounding alone may leave: see `physics.newton`."""
    sizes, forces = np.abs(H), np.empty_like(y)
    e, ones = np.empty_like(gaps), np.abs(y)
    times_rows(sizes, one, two, ones, e, 0, e.shape[0], dof)
    none = np.zeros_like(gaps)
    _put_gradient(sizes, one, two, alpha, ones, -np.abs(gaps) - e, none, forces, dof)
    precondition(inverse, forces, z, 0, z.shape[0], dof)
    return ROUNDING_UNITS * np.finfo(y.dtype).eps * _worst(z, dof)


@kernel
def minimise(memory, H, one, two, rows, gaps, pushed, alpha, low, rigid, y, tolerance, limit, dof):
    """Minimise E from y, in place, until the worst entry of the preconditioned residual is at most
    `tolerance` of that at rest.

    pushed: (rows,) what soft rows have already exerted in this step. low: (n,) least scaled Δl.
    rigid: (n,) cells whose length cannot move. Returns iterations, that residual and the status.
    """
    n, end = y.shape[0], degrees(dof) - 1
    gaps, act, on = gaps[:rows], np.ones(rows, np.uint8), np.arange(rows).astype(np.int32)
    g, z, d, p = np.empty_like(y), np.empty_like(y), np.zeros_like(y), np.empty_like(y)
    inverse, floor = np.empty((n, len(dof), len(dof)), y.dtype), _floor(y)
    begin, halves = rows_of_cells(memory, one, two, rows, n)
    one, two = one[:rows], second_cells(memory, H, one, two, rows)
    held = np.zeros(n, np.uint8)
    for i in range(n):
        put_inverse(inverse, i, H, halves, act, begin[i], begin[i + 1], alpha[i], floor, False, dof)
    _put_gradient(H, one, two, alpha, d, gaps, pushed, g, dof)
    precondition(inverse, g, z, 0, z.shape[0], dof)
    scale = _worst(z, dof)
    still = scale == 0.0  # no row exerts a force: such a colony does not move at all
    for i in range(n):
        y[i, end] = 0.0 if rigid[i] else max(y[i, end], low[i])
    if still:
        y[:] = 0
    e = np.empty_like(gaps)
    times_rows(H, one, two, y, e, 0, e.shape[0], dof)
    for r in range(e.shape[0]):
        e[r] = gaps[r] - e[r]
    _put_gradient(H, one, two, alpha, y, e, pushed, g, dof)
    total, previous, worst = 0, np.inf, np.inf
    for round_ in range(NEWTON_LIMIT + 1):
        _hold_lengths(H, begin, halves, act, alpha, y, low, rigid, g, held, inverse, dof)
        precondition(inverse, g, z, 0, z.shape[0], dof)
        worst = _worst(z, dof)
        going = worst > tolerance * scale and worst < np.inf and total < limit
        if going and worst > STALLED * previous:
            # where opposing forces on a cell cancel, rounding limits the residual
            least = _rounding_residual(H, one, two, gaps, alpha, y, inverse, p, dof)
            scale = max(scale, least / tolerance)
            going = worst > tolerance * scale
        if not going or round_ == NEWTON_LIMIT:
            break
        previous, before = worst, g.copy()
        total += _conjugate_gradients(
            H, one, two, on, alpha, inverse, g, z, p, d, FINISH * tolerance * scale, limit, dof
        )
        new, e, g = _search_line(
            H, one, two, gaps, pushed, alpha, low, y, e, before, d, dof
        )  # fmt: skip
        put(new, y)
    status = CONVERGED if worst <= tolerance * scale else ITERATION_LIMIT
    return total, worst / (1.0 if still else scale), status if worst < np.inf else NOT_FINITE

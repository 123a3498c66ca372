"""The contact problem of one colony, minimised: semismooth Newton, each round solved by CG.

E(y) = ½ Σ min(g − J y, 0)² + ½ Σ α y² over moves whose lengths are at least `low`, where y is the
scaled move of n cells, (n, D): see `physics.problem`. Newton steps are projected: lengths that are
at their bound and pushed further are held; others that would pass it stop at it. Where these
keep all from going far, they take steps of their own, down their slope.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.lanes import add_scaled, add_square, dot, invert, put_product
from torchfilm.kernels.rows import degrees, rows_of_cells
from torchfilm.kernels.scheme import (
    CREEP,
    FORCING,
    LEVEL,
    MOST_LOOKS,
    MOST_ROUNDS,
    RAISED,
    ROUNDING,
)


@kernel
def times_rows(H, one, two, p, q, dof):
    """q = J p. Here and below two[r] is one[r] for rows of one cell, whose second half is 0."""
    for r in range(q.shape[0]):
        q[r] = dot(H, 2 * r, p, one[r], dof) + dot(H, 2 * r + 1, p, two[r], dof)


@kernel
def add_forces(H, one, two, v, out, dof):
    """out += Jᵀ v."""
    for r in range(v.shape[0]):
        add_scaled(out, one[r], v[r], H, 2 * r, dof)
        add_scaled(out, two[r], v[r], H, 2 * r + 1, dof)


@kernel
def add_product(H, one, two, on, p, out, dof):
    """out += Jᵀ J p of the rows `on`."""
    for r in on:
        i, j, h = one[r], two[r], 2 * r
        t = dot(H, h, p, i, dof) + dot(H, h + 1, p, j, dof)
        add_scaled(out, i, t, H, h, dof)
        add_scaled(out, j, t, H, h + 1, dof)


@kernel(inline=True)
def put_inverse(H, begin, halves, act, i, alpha, held, inverse, B, floor, dof):
    """The inverse of cell i's own block of JᵀAJ + α, worked out in B in float64; 0 in its last row
    and column where the length is held. The diagonal is raised by its share `floor`: rounding must
    leave it positive definite. Returns the entry of the length."""
    end = degrees(dof) - 1
    for k in range(len(dof)):
        for m in range(len(dof)):
            B[k, m] = 0.0
    for q in range(begin[i], begin[i + 1]):
        h = halves[q]
        if act[h >> 1]:
            add_square(B, H, h, dof)
    for k in range(end + 1):
        B[k, k] = B[k, k] * (1 + floor) + alpha
    own = B[end, end]
    if held:
        for k in range(end):
            B[end, k] = B[k, end] = 0.0
        B[end, end] = 1.0
    invert(B, dof)
    if held:
        B[end, end] = 0.0
    for k in range(len(dof)):
        for m in range(len(dof)):
            inverse[i, k, m] = B[k, m]
    return own


@kernel
def precondition(inverse, g, z, dof):
    """z = P⁻¹ g; returns g · z."""
    total = 0.0
    for i in range(g.shape[0]):
        put_product(z, i, inverse, g, dof)
        total += dot(g, i, z, i, dof)
    return total


@kernel(any_order=True)
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


@kernel
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


@kernel
def _stop_at_bounds(y, d, low, lengths, slope, own, dof):
    """Shorten the step d (n, D) of the lengths that would pass their bound; those that step alone
    follow their slope. Returns how far all may go along the step."""
    alone, stopped = lengths[1], lengths[2]
    last, most = degrees(dof) - 1, np.inf
    for i in range(y.shape[0]):
        room = low[i] - y[i, last]
        if alone[i]:
            d[i, last] = -slope[i] / own[i]
        stopped[i] = d[i, last] < room
        if stopped[i]:
            d[i, last] = room
        if d[i, last] < 0:
            most = min(most, room / d[i, last])
    return most


@kernel
def cg_step(H, one, two, on, alpha, inverse, g, z, p, d, rz, t, dof):
    """Go along the direction p: d += t p, and g becomes the gradient there and z = P⁻¹ g. z is 0
    before; rz: g · P⁻¹ g before. Returns g · z."""
    n = g.shape[0]
    add_product(H, one, two, on, p, z, dof)
    curvature = 0.0
    for i in range(n):
        add_scaled(z, i, alpha[i], p, i, dof)
        curvature += dot(p, i, z, i, dof)
    t[0], new = rz / curvature, 0.0
    for i in range(n):
        add_scaled(d, i, t[0], p, i, dof)
        add_scaled(g, i, t[0], z, i, dof)
        put_product(z, i, inverse, g, dof)
        new += dot(g, i, z, i, dof)
    return new


@kernel
def _conjugate_gradients(H, one, two, on, alpha, inverse, g, z, p, d, gz, limit, dof):
    """d = −(JᵀAJ + α)⁻¹ g, to FORCING of the residual; g becomes the residual. Iterations."""
    t = np.zeros(1, g.dtype)  # a scalar of the same precision
    d[:], p[:] = 0, 0
    next_direction(p, z, t[0])
    rz, count = gz, 0
    while count < limit and rz > 0:
        new = cg_step(H, one, two, on, alpha, inverse, g, z, p, d, rz, t, dof)
        count += 1
        if not (new > FORCING * FORCING * gz and new < np.inf):
            break
        t[0], rz = new / rz, new
        next_direction(p, z, t[0])
    return count


@kernel
def next_direction(p, z, t):
    """p = t p − z, and z = 0."""
    p, z = p.reshape(-1), z.reshape(-1)
    for k in range(p.shape[0]):
        p[k] = t * p[k] - z[k]
        z[k] = 0


@kernel(any_order=True)
def _squared_overlap(e, cap):
    """The sum of squared overlaps, each counted up to `cap`."""
    overlap = 0.0
    for r in range(e.shape[0]):
        depth = max(-e[r], 0 * e[r])
        overlap += min(depth * depth, cap * cap)
    return overlap


@kernel
def _put_forces(e, pushed, cap, v):
    """v = the force of each row. Returns the sum of squared overlaps."""
    for r in range(e.shape[0]):
        v[r] = max(-e[r], 0 * e[r]) - pushed[r]
    return _squared_overlap(e, cap)


@kernel
def _switch_rows(e, one, two, act, on, stale):
    """Mark which rows push; cells whose rows change are stale. Puts the rows that push into `on`;
    returns how many."""
    count = 0
    for r in range(act.shape[0]):
        push = e[r] < 0
        on[count] = r
        count += push
        if push != act[r]:
            act[r] = push
            stale[one[r]] = stale[two[r]] = 1
    return count


@kernel
def _refresh_blocks(H, begin, halves, act, alpha, y, low, g, lengths, own, inverse, stale, dof):
    """Hold the lengths at their bound that are pushed further, and those that step alone; invert
    the blocks of the cells that changed. own: (n,) of lengths, their diagonal."""
    held, alone = lengths[0], lengths[1]
    D, B = degrees(dof), np.empty((len(dof), len(dof)))
    for i in range(y.shape[0]):
        at_bound = y[i, D - 1] <= low[i] and g[i, D - 1] >= 0
        alone[i] = alone[i] and not at_bound
        if (at_bound or alone[i]) != held[i]:
            held[i] = at_bound or alone[i]
            stale[i] = 1
        if stale[i]:
            own[i] = put_inverse(
                H, begin, halves, act, i, alpha[i], held[i], inverse, B, RAISED, dof
            )
            stale[i] = 0


@kernel
def _advance(y, d, low, e, q, share, dof):
    """Go `share` of the step d; lengths at their bound are put on it."""
    box = np.zeros(1, y.dtype)
    box[0] = share
    last = degrees(dof) - 1
    for i in range(y.shape[0]):
        add_scaled(y, i, box[0], d, i, dof)
        if y[i, last] <= low[i] + ROUNDING * (abs(low[i]) + abs(d[i, last])):
            y[i, last] = low[i]
    for r in range(e.shape[0]):
        e[r] -= box[0] * q[r]


@kernel
def minimise(H, one, two, rows, gaps, pushed, alpha, low, y, tolerance, cap, limit, dof):
    """Minimise E from y, in place.

    pushed: (rows,) what soft rows have already exerted in this step. low: (n,) least scaled Δl, at
    most 0. Stops when the error that is left, estimated by the fall of E in the last round and by
    the residual, is at most `tolerance` of the contacts' overlap: root mean square, overlaps
    counted up to `cap` (µm), so that what has not converged does not loosen the rule. Returns
    iterations, that relative error, and each row's gap after the move.
    """
    n, D = y.shape[0], degrees(dof)
    if not np.any(gaps[:rows] < 0):  # nothing pushes: such a colony does not move at all
        y[:] = 0
        return 0, 0.0, gaps[:rows].copy()
    v, q = np.empty(rows, y.dtype), np.empty(rows, y.dtype)
    act, stale, on = np.zeros(rows, np.uint8), np.ones(n, np.uint8), np.empty(rows, np.int32)
    lengths = np.zeros((3, n), np.uint8)  # held, alone, stopped
    slope, own = np.empty(n, y.dtype), np.empty(n, y.dtype)  # of lengths
    g, z, d, p = np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y)
    inverse = np.empty((n, len(dof), len(dof)), y.dtype)
    begin, halves = rows_of_cells(one, two, rows, n)
    one, two = one[:rows], second_cells(H, one, two, rows)
    for i in range(n):
        y[i, D - 1] = max(y[i, D - 1], low[i])
    times_rows(H, one, two, y, q, dof)
    e = gaps[:rows] - q
    total, fall, error, stuck = 0, np.inf, 0.0, 0
    for round_ in range(MOST_ROUNDS + 1):
        overlap = _put_forces(e, pushed, cap, v)
        pushing = _switch_rows(e, one, two, act, on, stale)
        g[:] = 0
        for i in range(n):
            add_scaled(g, i, alpha[i], y, i, dof)
        add_forces(H, one, two, v, g, dof)
        _refresh_blocks(H, begin, halves, act, alpha, y, low, g, lengths, own, inverse, stale, dof)
        gz, of_alone = precondition(inverse, g, z, dof), 0.0
        for i in range(n):
            slope[i] = g[i, D - 1]
            if lengths[1, i]:
                of_alone += slope[i] * slope[i] / own[i]
        left = gz + of_alone
        # where nothing overlaps any more, relative to contacts as deep as counted
        error = math.sqrt(max(fall, left, 0.0) / (overlap if overlap > 0 else cap * cap))
        if left == 0.0:  # solved exactly
            error = 0.0
        elif not left < np.inf:  # also where it is no number
            error = np.inf
        done = error <= tolerance or not left < np.inf or stuck > 1
        if done or total >= limit or round_ == MOST_ROUNDS:
            break
        total += _conjugate_gradients(
            H, one, two, on[:pushing], alpha, inverse, g, z, p, d, gz, limit - total, dof
        )
        most = _stop_at_bounds(y, d, low, lengths, slope, own, dof)
        times_rows(H, one, two, d, q, dof)
        c0, c1 = 0.0, 0.0
        for i in range(n):
            c0 += alpha[i] * dot(y, i, d, i, dof)
            c1 += alpha[i] * dot(d, i, d, i, dof)
        for r in range(rows):
            c0 -= pushed[r] * q[r]
        share, fall = search_line(e, q, c0, c1, most)
        stuck = stuck + 1 if share == 0 else 0
        for i in range(n):
            lengths[1, i] = share < CREEP and (lengths[1, i] or lengths[2, i])
        _advance(y, d, low, e, q, share, dof)
    return total, error, e


@kernel
def second_cells(H, one, two, rows):
    """The second cell of each row; the first where there is no second, whose half of the row is
    made 0. So all rows are alike."""
    other = two[:rows].copy()
    for r in range(rows):
        if two[r] < 0:
            other[r] = one[r]
            H[2 * r + 1] = 0.0
    return other

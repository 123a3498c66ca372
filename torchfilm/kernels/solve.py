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
from torchfilm.kernels.rows import rows_of_cells
from torchfilm.kernels.scheme import CREEP, FORCING, LEVEL, MOST_LOOKS, MOST_ROUNDS, ROUNDING


@kernel
def times_rows(H, one, two, rows, p, q, dof):
    """q = J p."""
    D = len(dof)
    for r in range(rows):
        i, j, h = one[r], two[r], 2 * r
        if D == 4:
            t = H[h, 0] * p[i, 0] + H[h, 1] * p[i, 1] + H[h, 2] * p[i, 2] + H[h, 3] * p[i, 3]
        else:
            t = H[h, 0] * p[i, 0]
            for k in range(1, 7):
                t += H[h, k] * p[i, k]
        if j >= 0:
            for k in range(D):
                t += H[h + 1, k] * p[j, k]
        q[r] = t


@kernel
def add_forces(H, one, two, rows, v, out, dof):
    """out += Jᵀ v."""
    D = len(dof)
    for r in range(rows):
        f = v[r]
        if f == 0:
            continue
        i, j, h = one[r], two[r], 2 * r
        for k in range(D):
            out[i, k] += H[h, k] * f
        if j >= 0:
            for k in range(D):
                out[j, k] += H[h + 1, k] * f


@kernel
def add_product(H, one, two, rows, act, p, out, dof):
    """out += Jᵀ A J p, in one pass over the rows, which are sorted by their first cell."""
    D = len(dof)
    if D == 4:
        last = -1
        a = b = c = d = pa = pb = pc = pd = p[0, 0] * 0
        for r in range(rows):
            if not act[r]:
                continue
            i, j, h = one[r], two[r], 2 * r
            if i != last:
                if last >= 0:
                    out[last, 0], out[last, 1], out[last, 2], out[last, 3] = a, b, c, d
                a, b, c, d = out[i, 0], out[i, 1], out[i, 2], out[i, 3]
                pa, pb, pc, pd = p[i, 0], p[i, 1], p[i, 2], p[i, 3]
                last = i
            t = H[h, 0] * pa + H[h, 1] * pb + H[h, 2] * pc + H[h, 3] * pd
            if j >= 0:
                g = h + 1
                t += H[g, 0] * p[j, 0] + H[g, 1] * p[j, 1] + H[g, 2] * p[j, 2] + H[g, 3] * p[j, 3]
                out[j, 0] += H[g, 0] * t
                out[j, 1] += H[g, 1] * t
                out[j, 2] += H[g, 2] * t
                out[j, 3] += H[g, 3] * t
            a += H[h, 0] * t
            b += H[h, 1] * t
            c += H[h, 2] * t
            d += H[h, 3] * t
        if last >= 0:
            out[last, 0], out[last, 1], out[last, 2], out[last, 3] = a, b, c, d
        return
    for r in range(rows):
        if not act[r]:
            continue
        i, j, h = one[r], two[r], 2 * r
        t = H[h, 0] * p[i, 0]
        for k in range(1, 7):
            t += H[h, k] * p[i, k]
        if j >= 0:
            for k in range(7):
                t += H[h + 1, k] * p[j, k]
            for k in range(7):
                out[j, k] += H[h + 1, k] * t
        for k in range(7):
            out[i, k] += H[h, k] * t


@kernel
def put_inverse(H, begin, halves, act, i, alpha, held, inverse, B, L, dof):
    """The inverse of cell i's own block of JᵀAJ + α, by Cholesky in float64; without its last row
    and column where the length is held. Returns the entry of the length."""
    D = len(dof)
    inverse[i, D - 1] = 0.0
    inverse[i, :, D - 1] = 0.0
    for k in range(D):
        for m in range(k + 1):
            B[k, m] = 0.0
    for q in range(begin[i], begin[i + 1]):
        h = halves[q]
        if act[h >> 1]:
            for k in range(D):
                for m in range(k + 1):
                    B[k, m] += H[h, k] * H[h, m]
    for k in range(D):
        B[k, k] = B[k, k] * (1 + 1e-9) + alpha
    own = B[D - 1, D - 1]
    if held:
        D -= 1
    for k in range(D):
        for m in range(k + 1):
            t = B[k, m]
            for u in range(m):
                t -= L[k, u] * L[m, u]
            L[k, m] = math.sqrt(t) if k == m else t / L[m, m]
    for k in range(D):
        L[k, k] = 1.0 / L[k, k]
        for m in range(k):
            t = 0.0
            for u in range(m, k):
                t -= L[k, u] * L[u, m]
            L[k, m] = t * L[k, k]
    for k in range(D):
        for m in range(k + 1):
            t = 0.0
            for u in range(k, D):
                t += L[u, k] * L[u, m]
            inverse[i, k, m] = t
            inverse[i, m, k] = t
    return own


@kernel
def precondition(inverse, g, z, dof):
    """z = P⁻¹ g; returns g · z."""
    D = len(dof)
    total = 0.0
    for i in range(g.shape[0]):
        for k in range(D):
            t = inverse[i, k, 0] * g[i, 0]
            for m in range(1, D):
                t += inverse[i, k, m] * g[i, m]
            z[i, k] = t
            total += t * g[i, k]
    return total


@kernel
def _slope(e, q, rows, t):
    """The slope of the rows' energy after a share t of a step that changes them by −q, and its
    derivative."""
    slope, curvature = 0.0, 0.0
    for r in range(rows):
        left = e[r] - t * q[r]
        if left < 0:
            slope -= left * q[r]
            curvature += q[r] * q[r]
    return slope, curvature


@kernel
def search_line(e, q, rows, c0, c1, most):
    """How far to go along a step, at most `most`: until the slope is at most LEVEL of that at 0.
    And how far E falls."""
    slope0, curvature = _slope(e, q, rows, 0.0)
    slope0 += c0
    if not (slope0 < 0 and curvature + c1 > 0):
        return 0.0, 0.0
    t = min(-slope0 / (curvature + c1), most)
    least, end = 0.0, np.inf
    for _ in range(MOST_LOOKS):
        slope, curvature = _slope(e, q, rows, t)
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
def _stop_at_bounds(y, d, low, lengths, slope, own):
    """Shorten the step d (n, D) of the lengths that would pass their bound; those that step alone
    follow their slope. Returns how far all may go along the step."""
    alone, stopped = lengths[1], lengths[2]
    last, most = y.shape[1] - 1, np.inf
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
def _conjugate_gradients(H, one, two, rows, act, alpha, inverse, g, z, p, d, gz, limit, dof):
    """d = −(JᵀAJ + α)⁻¹ g, to FORCING of the residual; g becomes the residual. Iterations."""
    n, D = g.shape[0], len(dof)
    box = np.zeros(1, g.dtype)  # a scalar of the same precision
    for i in range(n):
        for k in range(D):
            d[i, k] = 0
            p[i, k] = -z[i, k]
    rz, count = gz, 0
    while count < limit and rz > 0:
        for i in range(n):
            for k in range(D):
                z[i, k] = alpha[i] * p[i, k]
        add_product(H, one, two, rows, act, p, z, dof)
        curvature = 0.0
        for i in range(n):
            for k in range(D):
                curvature += p[i, k] * z[i, k]
        box[0] = rz / curvature
        t = box[0]
        for i in range(n):
            for k in range(D):
                d[i, k] += t * p[i, k]
                g[i, k] += t * z[i, k]
        new = precondition(inverse, g, z, dof)
        count += 1
        if not (new > FORCING * FORCING * gz and new < np.inf):
            break
        box[0] = new / rz
        t, rz = box[0], new
        for i in range(n):
            for k in range(D):
                p[i, k] = t * p[i, k] - z[i, k]
    return count


@kernel
def _switch_rows(e, pushed, cap, one, two, act, v, stale):
    """Which rows push, and with what force; cells whose rows change are stale. Returns the sum of
    squared overlaps, each counted up to `cap`."""
    overlap = 0.0
    for r in range(act.shape[0]):
        on = e[r] < 0
        v[r] = -e[r] - pushed[r] if on else -pushed[r]
        if on:
            overlap += min(e[r] * e[r], cap * cap)
        if on != act[r]:
            act[r] = on
            stale[one[r]] = 1
            if two[r] >= 0:
                stale[two[r]] = 1
    return overlap


@kernel
def _refresh_blocks(H, begin, halves, act, alpha, y, low, g, lengths, own, inverse, stale, dof):
    """Hold the lengths at their bound that are pushed further, and those that step alone; invert
    the blocks of the cells that changed. own: (n,) of lengths, their diagonal."""
    held, alone = lengths[0], lengths[1]
    D = len(dof)
    B, L = np.empty((D, D)), np.empty((D, D))
    for i in range(y.shape[0]):
        at_bound = y[i, D - 1] <= low[i] and g[i, D - 1] >= 0
        alone[i] = alone[i] and not at_bound
        if (at_bound or alone[i]) != held[i]:
            held[i] = at_bound or alone[i]
            stale[i] = 1
        if stale[i]:
            own[i] = put_inverse(H, begin, halves, act, i, alpha[i], held[i], inverse, B, L, dof)
            stale[i] = 0


@kernel
def _advance(y, d, low, e, q, share):
    """Go `share` of the step d; lengths at their bound are put on it."""
    box = np.zeros(1, y.dtype)
    box[0] = share
    last = y.shape[1] - 1
    for i in range(y.shape[0]):
        for k in range(last + 1):
            y[i, k] += box[0] * d[i, k]
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
    n, D = y.shape[0], len(dof)
    if not np.any(gaps[:rows] < 0):  # nothing pushes: such a colony does not move at all
        y[:] = 0
        return 0, 0.0, gaps[:rows].copy()
    v, q = np.empty(rows, y.dtype), np.empty(rows, y.dtype)
    act, stale = np.zeros(rows, np.uint8), np.ones(n, np.uint8)
    lengths = np.zeros((3, n), np.uint8)  # held, alone, stopped
    slope, own = np.empty(n, y.dtype), np.empty(n, y.dtype)  # of lengths
    g, z, d, p = np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y)
    inverse = np.empty((n, D, D), y.dtype)
    begin, halves = rows_of_cells(one, two, rows, n)
    for i in range(n):
        y[i, D - 1] = max(y[i, D - 1], low[i])
    times_rows(H, one, two, rows, y, q, dof)
    e = gaps[:rows] - q
    total, fall, error, stuck = 0, np.inf, 0.0, 0
    for round_ in range(MOST_ROUNDS + 1):
        overlap = _switch_rows(e, pushed, cap, one, two, act, v, stale)
        for i in range(n):
            for k in range(D):
                g[i, k] = alpha[i] * y[i, k]
        add_forces(H, one, two, rows, v, g, dof)
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
            H, one, two, rows, act, alpha, inverse, g, z, p, d, gz, limit - total, dof
        )
        most = _stop_at_bounds(y, d, low, lengths, slope, own)
        times_rows(H, one, two, rows, d, q, dof)
        c0, c1 = 0.0, 0.0
        for i in range(n):
            for k in range(D):
                c0 += alpha[i] * y[i, k] * d[i, k]
                c1 += alpha[i] * d[i, k] * d[i, k]
        for r in range(rows):
            c0 -= pushed[r] * q[r]
        share, fall = search_line(e, q, rows, c0, c1, most)
        stuck = stuck + 1 if share == 0 else 0
        for i in range(n):
            lengths[1, i] = share < CREEP and (lengths[1, i] or lengths[2, i])
        _advance(y, d, low, e, q, share)
    return total, error, e

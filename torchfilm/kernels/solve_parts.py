"""Loops of the contact solve, over rows and over cells.

Loops over some of the cells take the first, and one more than the last. Those that add up return
the share of a block of cells: see `team`.
"""

from __future__ import annotations

from torchfilm.kernels.compiling import index, kernel, lean
from torchfilm.kernels.lanes import add_scaled, dot, dot_row, put_inverse, put_product
from torchfilm.kernels.memory import copied, shaped
from torchfilm.kernels.rows import degrees
from torchfilm.kernels.scheme import RAISED, ROUNDING


@lean
def times_rows(H, one, two, p, q, first, end, dof):
    """q = J p of the rows first … end − 1. Here and below two[r] is one[r] for rows of one cell,
    whose second half is 0."""
    one, two, q = one[first:end], two[first:end], q[first:end]
    for r in range(q.shape[0]):
        q[r] = dot_row(H, first + r, p, one[r], two[r], dof)


@lean
def add_forces(H, one, two, of, v, out, dof):
    """out += Jᵀ v of the rows `of`."""
    for h in of:
        r = index(h)
        add_scaled(out, one[r], v[r], H, 2 * h, dof)
        add_scaled(out, two[r], v[r], H, 2 * h + 1, dof)


@lean
def add_own_forces(H, one, two, of, v, out, first, end, dof):
    """As `add_forces`, to the cells first … end − 1 alone."""
    for h in of:
        r = index(h)
        if one[r] >= first and one[r] < end:
            add_scaled(out, one[r], v[r], H, 2 * h, dof)
        if two[r] >= first and two[r] < end:
            add_scaled(out, two[r], v[r], H, 2 * h + 1, dof)


@lean
def add_product(H, one, two, on, p, out, dof):
    """out += Jᵀ J p of the rows `on`."""
    for r in on:
        i, j, h = one[index(r)], two[index(r)], 2 * r
        t = dot_row(H, r, p, i, j, dof)
        add_scaled(out, i, t, H, h, dof)
        add_scaled(out, j, t, H, h + 1, dof)


@lean
def add_own_product(H, one, two, on, p, out, first, end, dof):
    """As `add_product`, to the cells first … end − 1 alone."""
    for r in on:
        i, j, h = one[index(r)], two[index(r)], 2 * r
        t = dot_row(H, r, p, i, j, dof)
        if i >= first and i < end:
            add_scaled(out, i, t, H, h, dof)
        if j >= first and j < end:
            add_scaled(out, j, t, H, h + 1, dof)


@lean
def refresh_blocks(H, begin, halves, act, alpha, y, low, g, lengths, own, inverse, stale, first,
                   end, dof):  # fmt: skip
    """Hold the lengths at their bound that are pushed further, and those that step alone; invert
    the blocks of JᵀAJ + α of the cells that changed. own: (n,) of lengths, their diagonal."""
    held, alone = lengths[0], lengths[1]
    D = degrees(dof)
    for i in range(first, end):
        at_bound = y[i, D - 1] <= low[i] and g[i, D - 1] >= 0
        alone[i] = alone[i] and not at_bound
        if (at_bound or alone[i]) != held[i]:
            held[i] = at_bound or alone[i]
            stale[i] = 1
        if stale[i]:
            own[i] = put_inverse(
                inverse, i, H, halves, act, begin[i], begin[i + 1], alpha[i], RAISED, held[i] > 0,
                dof,
            )  # fmt: skip
            stale[i] = 0


@lean(inline=True)
def put_scaled(g, alpha, y, first, end, dof):
    """g = α y."""
    for i in range(first, end):
        for k in range(len(dof)):
            g[i, k] = 0
        add_scaled(g, i, alpha[i], y, i, dof)


@lean(inline=True)
def precondition(inverse, g, z, first, end, dof):
    """z = P⁻¹ g; returns g · z."""
    total = 0.0
    for i in range(first, end):
        put_product(z, i, inverse, g, dof)
        total += dot(g, i, z, i, dof)
    return total


@lean(inline=True)
def add_curvature(alpha, z, p, first, end, dof):
    """z += α p; returns p · z."""
    total = 0.0
    for i in range(first, end):
        add_scaled(z, i, alpha[i], p, i, dof)
        total += dot(p, i, z, i, dof)
    return total


@lean(inline=True)
def go_along(d, g, z, p, inverse, t, first, end, dof):
    """d += t p, g += t z and z = P⁻¹ g; returns g · z."""
    total = 0.0
    for i in range(first, end):
        add_scaled(d, i, t, p, i, dof)
        add_scaled(g, i, t, z, i, dof)
        put_product(z, i, inverse, g, dof)
        total += dot(g, i, z, i, dof)
    return total


@lean
def next_direction(p, z, t, first, end):
    """p = t p − z, and z = 0."""
    shape = ((end - first) * p.shape[1],)
    p, z = shaped(p[first:end], shape), shaped(z[first:end], shape)
    for k in range(p.shape[0]):
        p[k] = t * p[k] - z[k]
        z[k] = 0


@lean(inline=True)
def first_direction(d, p, z, first, end):
    """d = 0, p = −z, and z = 0."""
    shape = ((end - first) * p.shape[1],)
    d, p, z = shaped(d[first:end], shape), shaped(p[first:end], shape), shaped(z[first:end], shape)
    for k in range(p.shape[0]):
        d[k], p[k], z[k] = 0, -z[k], 0


@lean(inline=True)
def put_slopes(g, lengths, slope, own, first, end, dof):
    """The slopes of lengths; returns how far E may fall by the steps of those that step alone."""
    last, total = degrees(dof) - 1, 0.0
    for i in range(first, end):
        slope[i] = g[i, last]
        if lengths[1, i]:
            total += slope[i] * slope[i] / own[i]
    return total


@lean(inline=True)
def stop_at_bounds(y, d, low, lengths, slope, own, first, end, dof):
    """Shorten the step d (n, D) of the lengths that would pass their bound; those that step alone
    follow their slope. Returns how far all may go along the step."""
    alone, stopped = lengths[1], lengths[2]
    last, most = degrees(dof) - 1, float("inf")
    for i in range(first, end):
        room = low[i] - y[i, last]
        if alone[i]:
            d[i, last] = -slope[i] / own[i]
        stopped[i] = d[i, last] < room
        if stopped[i]:
            d[i, last] = room
        if d[i, last] < 0:
            most = min(most, room / d[i, last])
    return most


@lean(inline=True)
def of_drag(alpha, y, d, first, end, dof):
    """α y · d and α d · d."""
    slope, curvature = 0.0, 0.0
    for i in range(first, end):
        slope += alpha[i] * dot(y, i, d, i, dof)
        curvature += alpha[i] * dot(d, i, d, i, dof)
    return slope, curvature


@lean(inline=True)
def advance(y, d, low, lengths, creeps, share, first, end, dof):
    """Go `share` (1,) of the step d; lengths at their bound are put on it. creeps: those that were
    stopped step alone next."""
    last = degrees(dof) - 1
    for i in range(first, end):
        lengths[1, i] = creeps and (lengths[1, i] or lengths[2, i])
        add_scaled(y, i, share[0], d, i, dof)
        if y[i, last] <= low[i] + ROUNDING * (abs(low[i]) + abs(d[i, last])):
            y[i, last] = low[i]


@lean(inline=True)
def advance_rows(e, q, share, first, end):
    """What rows leave, e, after `share` (1,) of a step that changes them by −q."""
    e, q, t = e[first:end], q[first:end], share[0]
    for r in range(e.shape[0]):
        e[r] -= t * q[r]


@lean(inline=True)
def put_forces(e, pushed, v, one, two, act, stale, first, end):
    """v = the force of each row, less what it has exerted before: `pushed`, or (0,) for nothing.
    Marks which rows push, or are no number; cells whose rows change are stale."""
    e, v, act = e[first:end], v[first:end], act[first:end]
    one, two, pushed = one[first:end], two[first:end], pushed[first:end]
    for r in range(e.shape[0]):
        v[r] = max(-e[r], 0 * e[r])
    for r in range(e.shape[0]):
        push = v[r] != 0
        if push != act[r]:
            act[r] = push
            stale[index(one[r])] = stale[index(two[r])] = 1
    for r in range(pushed.shape[0]):
        v[r] -= pushed[r]


@lean(inline=True)
def keep_pushing(act, rows, on):
    """Puts those of the rows that push into `on`; returns how many."""
    count = 0
    for r in rows:
        on[count] = r
        count += act[r]
    return count


@kernel
def second_cells(memory, H, one, two, rows):
    """The second cell of each row; the first where there is no second, whose half of the row is
    made 0. So all rows are alike."""
    other = copied(memory, two, rows)
    for r in range(rows):
        if two[r] < 0:
            other[r] = one[r]
            H[2 * r + 1] = 0.0
    return other


@lean
def overlaps(gaps, rows):
    """Whether one of the rows is of an overlap, or no number."""
    some = False
    for r in range(rows):
        some |= not (gaps[r] >= 0)
    return some

"""Rows of the contact problem of one colony: pairs of cells, and cells at walls.

A row r of two cells has two halves, H[2 r] and H[2 r + 1]; a row of one cell has two[r] < 0, at a
wall w −1 − w, and only the first. Halves are scaled by the row's weight and by M^(−½), as in
`physics.problem`.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import index, lean
from torchfilm.kernels.memory import copied, room, zeros

FLAT, INSIDE, OUTSIDE = 0, 1, 2
# Rows: of rigid contacts; of walls with a stiffness, and of cells that stick together; of walls
# with a weight below 1; and of two cells at an end of the stretch along which they lie side by
# side.
HARD, STIFF, LIGHT, FAR = 0, 1, 2, 3


@lean
def degrees(dof):
    """The degrees of freedom of a cell, of which the last is its length: 4 in the plane, 7 in
    space. `dof` is a tuple of as many entries as rows have columns, 4 or 8: see `lanes`."""
    return 4 if len(dof) == 4 else 7


@lean
def deeply_overlapping(memory, found, radius):
    """How many cells lie deeper in another than a radius."""
    first, second, keep, _, gap = found
    deeply = zeros(memory, (radius.shape[0],), np.int64)
    for k in range(keep.shape[0]):
        i, j = first[keep[k]], second[keep[k]]
        if gap[k] < -0.5 * (radius[i] + radius[j]):
            deeply[i] = deeply[j] = 1
    return deeply.sum()


@lean(inline=True)
def half_of(weight, s, end, nx, ny, nz, ax, ay, az, dof):
    """One half of a row before it is scaled: weight · (n, q × n, ∂) for a point at arc length s. Of
    numbers, or of vectors."""
    along = nx * ax + ny * ay
    if len(dof) == 4:
        turn = weight * s * (ax * ny - ay * nx)
        return weight * nx, weight * ny, turn, weight * 0.5 * end * along
    along = along + nz * az
    return (
        weight * nx, weight * ny, weight * nz, weight * s * (ay * nz - az * ny),
        weight * s * (az * nx - ax * nz), weight * s * (ax * ny - ay * nx),
        weight * 0.5 * end * along,
    )  # fmt: skip


@lean(inline=True)
def _put_half(H, h, i, weight, s, end, nx, ny, nz, axis, scale, dof):
    """One half of a row, at a wall."""
    az = axis[i, 2] if len(dof) == 8 else 0.0
    half = half_of(weight, s, end, nx, ny, nz, axis[i, 0], axis[i, 1], az, dof)
    for k in range(len(half)):
        H[h, k] = half[k] * scale[i, k]
    if len(dof) == 8:
        H[h, 7] = 0.0


@lean(inline=True)
def wall_gap(kind, place, size, px, py, pz):
    """Distance of a point to a wall, µm, and the direction to the wall.

    place: normal and `size` its offset, or centre and `size` the radius.
    """
    if kind == FLAT:
        distance = px * place[0] + py * place[1] + pz * place[2] - size
        return distance, -place[0], -place[1], -place[2]
    ox, oy, oz = px - place[0], py - place[1], pz - place[2]
    distance = math.sqrt(ox * ox + oy * oy + oz * oz)
    wx, wy, wz = 1.0, 0.0, 0.0
    if distance > 1e-9:
        wx, wy, wz = ox / distance, oy / distance, oz / distance
    if kind == INSIDE:
        return size - distance, wx, wy, wz
    return distance - size, -wx, -wy, -wz


@lean
def wall_rows(x, axis, half, radius, scale, kinds, places, sizes, roots, reach, rows, is_soft, hold,
              dof):  # fmt: skip
    """Rows (H, gaps, one, two, soft) of cells nearer to a wall than reach (n,).

    roots: (S, n) D of each wall and cell. A plane, or a sphere from inside, has a row for each end
    of a cell; a sphere met from outside one for the nearest point, and one that its ends share.
    soft: HARD, STIFF where the wall has a stiffness, LIGHT where its weight is below 1. hold: cells
    that are apart are held there, by rows of a weight that falls to 0 at their reach, instead of
    let come. Returns the number of rows and the deepest gap.
    """
    d = 2 if len(dof) == 4 else 3
    H, gaps, one, two, soft = rows
    r, deepest = 0, 0.0
    for w in range(kinds.shape[0]):
        for i in range(x.shape[0]):
            ax, ay, h = axis[i, 0], axis[i, 1], half[i]
            az = axis[i, 2] if d == 3 else 0.0
            z = x[i, 2] if d == 3 else 0.0
            at = 0.0
            if kinds[w] == OUTSIDE:
                cx, cy, cz = places[w, 0] - x[i, 0], places[w, 1] - x[i, 1], places[w, 2] - z
                at = min(max((cx * ax + cy * ay + cz * az) / max(h, 1e-9), -1.0), 1.0)
            for k in range(3 if kinds[w] == OUTSIDE else 2):
                if k < 2:
                    end = 1.0 if k == 0 else -1.0
                    s, share = end * h, 1.0
                    if kinds[w] == OUTSIDE:
                        share = math.sqrt(max(0.5 * (1.0 - at * end), 0.0))
                else:
                    s, end, share = at * h, math.trunc(at), 1.0
                distance, nx, ny, nz = wall_gap(
                    kinds[w], places[w], sizes[w], x[i, 0] + s * ax, x[i, 1] + s * ay, z + s * az
                )
                gap = distance - radius[i]
                if gap >= reach[i] or share <= 0.0:
                    continue
                kind = STIFF if is_soft[w] else HARD if roots[w, i] >= 1.0 else LIGHT
                if kind == HARD:
                    deepest = min(deepest, gap)
                weight = share * roots[w, i]
                if hold and gap > 0.0:
                    weight, gap = weight * (1.0 - gap / reach[i]), 0.0
                _put_half(H, 2 * r, i, weight, s, end, nx, ny, nz, axis, scale, dof)
                gaps[r], one[r], two[r], soft[r] = weight * gap, i, -1 - w, kind
                r += 1
    return r, deepest


@lean
def rows_among(H, gaps, one, two, soft, rows, number):
    """Keep the rows of the numbered cells, in place; the others are at rest. Returns how many."""
    new = 0
    for r in range(rows):
        i = number[one[r]]
        j = number[two[r]] if two[r] >= 0 else -1
        if i < 0 and j < 0:
            continue
        p, q = (2 * r, 2 * r + 1) if i >= 0 else (2 * r + 1, 2 * r)
        for k in range(H.shape[1]):
            u, w = H[p, k], H[q, k]
            H[2 * new, k], H[2 * new + 1, k] = u, w
        gaps[new], soft[new] = gaps[r], soft[r]
        one[new], two[new] = (i, j) if i >= 0 else (j, -1)
        new += 1
    return new


@lean
def room_for_rows(memory, most, like, dof):
    """Arrays for so many rows: H, gaps of the type of `like`, one, two, and their kinds."""
    H, gaps = room(memory, (2 * most, len(dof)), like.dtype), room(memory, (most,), like.dtype)
    one, two = room(memory, (most,), np.int32), room(memory, (most,), np.int32)
    return H, gaps, one, two, room(memory, (most,), np.uint8)


@lean
def rows_of_cells(memory, one, two, rows, n):
    """The halves of each cell, in the order of rows: where each cell's begin, and the halves."""
    begin = zeros(memory, (n + 1,), np.int64)
    for r in range(rows):
        begin[index(one[r]) + index(1)] += 1
        if two[r] >= 0:
            begin[index(two[r]) + index(1)] += 1
    for i in range(n):
        begin[i + 1] += begin[i]
    half, fill = room(memory, (begin[n],), np.int32), copied(memory, begin, n)
    for r in range(rows):
        i = index(one[r])
        half[index(fill[i])] = 2 * r
        fill[i] += 1
        if two[r] >= 0:
            j = index(two[r])
            half[index(fill[j])] = 2 * r + 1
            fill[j] += 1
    return begin, half

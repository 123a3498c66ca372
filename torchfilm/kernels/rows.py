"""Rows of the contact problem of one colony: pairs of cells, and cells at walls.

A row r of two cells has two halves, H[2 r] and H[2 r + 1]; a row of one cell has two[r] = −1 and
only the first. Halves are scaled by the row's weight and by M^(−½), as in `physics.problem`.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.capsules import (
    clamp,
    closest_points,
    end_of,
    end_while_sliding,
    squared_distance,
    squared_sine,
)
from torchfilm.kernels.compiling import index, kernel

LINE_CONTACT_SINE = 0.4  # as in `physics.contacts`
FLAT, INSIDE, OUTSIDE = 0, 1, 2
HARD, STIFF, LIGHT = 0, 1, 2  # walls: rigid, with a stiffness, with a weight below 1


@kernel
def degrees(dof):
    """The degrees of freedom of a cell, of which the last is its length: 4 in the plane, 7 in
    space. `dof` is a tuple of as many entries as rows have columns, 4 or 8: see `lanes`."""
    return 4 if len(dof) == 4 else 7


@kernel
def near_contacts(x, axis, half, radius, first, second, margin, dof):
    """The pairs nearer than margin: their number, closest points and gap, µm."""
    m, d = first.shape[0], 2 if len(dof) == 4 else 3
    keep, points, gap = np.empty(m, np.int32), np.empty((m, 2)), np.empty(m)
    found = index(0)
    for k in range(m):
        i, j = index(first[k]), index(second[k])
        bz = x[j, 2] - x[i, 2] if d == 3 else 0.0
        az = axis[i, 2] if d == 3 else 0.0
        cz = axis[j, 2] if d == 3 else 0.0
        s, t, d2 = closest_points(
            x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], bz,
            axis[i, 0], axis[i, 1], az, axis[j, 0], axis[j, 1], cz, half[i], half[j], dof,
        )  # fmt: skip
        touching = radius[i] + radius[j]
        if d2 < (touching + margin) * (touching + margin):
            keep[found], points[found, 0], points[found, 1] = k, s, t
            gap[found] = math.sqrt(d2) - touching
            found += index(1)
    return keep[:found], points[:found], gap[:found]


@kernel
def deeply_overlapping(found, radius):
    """How many cells lie deeper in another than a radius."""
    first, second, keep, _, gap = found
    deeply = np.zeros(radius.shape[0], np.int64)
    for k in range(keep.shape[0]):
        i, j = first[keep[k]], second[keep[k]]
        if gap[k] < -0.5 * (radius[i] + radius[j]):
            deeply[i] = deeply[j] = 1
    return deeply.sum()


@kernel
def _apart(ax, ay, az, cx, cy, cz, d):
    """A direction that separates two cells whose centrelines cross."""
    sign = -1.0 if ax * cx + ay * cy < 0 else 1.0
    mx, my = ax + sign * cx, ay + sign * cy
    size = math.sqrt(mx * mx + my * my)
    nx, ny, nz = -my / size, mx / size, 0.0
    if d == 3:
        mx, my, mz = ay * cz - az * cy, az * cx - ax * cz, ax * cy - ay * cx
        size = math.sqrt(mx * mx + my * my + mz * mz)
        if size >= 1e-6:
            nx, ny, nz = mx / size, my / size, mz / size
        elif abs(ax) < 0.5:
            size = math.sqrt(ay * ay + az * az)
            nx, ny, nz = 0.0, -az / size, ay / size
        else:
            size = math.sqrt(ax * ax + ay * ay)
            nx, ny, nz = -ay / size, ax / size, 0.0
    return nx, ny, nz


@kernel(inline=True)
def _put_half(H, h, i, weight, s, end, nx, ny, nz, axis, scale, dof):
    """One half of a row: weight · (n, q × n, ∂) · M^(−½) for a point at arc length s."""
    D = degrees(dof)
    ax, ay = axis[i, 0], axis[i, 1]
    H[h, 0], H[h, 1] = weight * nx * scale[i, 0], weight * ny * scale[i, 1]
    if D == 4:
        H[h, 2] = weight * s * (ax * ny - ay * nx) * scale[i, 2]
        along = nx * ax + ny * ay
    else:
        az = axis[i, 2]
        H[h, 2] = weight * nz * scale[i, 2]
        H[h, 3] = weight * s * (ay * nz - az * ny) * scale[i, 3]
        H[h, 4] = weight * s * (az * nx - ax * nz) * scale[i, 4]
        H[h, 5] = weight * s * (ax * ny - ay * nx) * scale[i, 5]
        along = nx * ax + ny * ay + nz * az
        H[h, 7] = 0.0
    H[h, D - 1] = weight * 0.5 * end * along * scale[i, D - 1]


@kernel(inline=True)
def _put_pair(H, gaps, r, i, j, x, axis, half, radius, scale, s, t, end_a, end_b, weight, dof):
    """The row of two cells at the points s and t of their centrelines."""
    d = 2 if len(dof) == 4 else 3
    ax, ay, cx, cy = axis[i, 0], axis[i, 1], axis[j, 0], axis[j, 1]
    bx, by = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1]
    az = cz = bz = 0.0
    if d == 3:
        az, cz, bz = axis[i, 2], axis[j, 2], x[j, 2] - x[i, 2]
    dx, dy, dz = bx + t * cx - s * ax, by + t * cy - s * ay, bz + t * cz - s * az
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    touching = radius[i] + radius[j]
    if distance > 1e-5 * touching:
        nx, ny, nz = dx / distance, dy / distance, dz / distance
    else:
        nx, ny, nz = _apart(ax, ay, az, cx, cy, cz, d)
        if nx * bx + ny * by + nz * bz < 0:
            nx, ny, nz = -nx, -ny, -nz
    # a sphere grows at both ends at once: the end nearer to the contact counts
    if half[i] <= 1e-9:
        end_a = np.sign(nx * ax + ny * ay + nz * az)
    if half[j] <= 1e-9:
        end_b = -np.sign(nx * cx + ny * cy + nz * cz)
    _put_half(H, index(2) * r, i, weight, s, end_a, nx, ny, nz, axis, scale, dof)
    _put_half(H, index(2) * r + index(1), j, -weight, t, end_b, nx, ny, nz, axis, scale, dof)
    gaps[r] = weight * (distance - touching)


@kernel
def pair_rows(x, axis, half, radius, scale, found, walls, rows, dof):
    """Rows of the contacts `found`, after `walls` others; a line of contact has two rows of weight
    ½. Returns how many there are in all.

    found: pairs (first, second), and of their contacts the place among these, the closest points
    and the gap, µm: see `near_contacts`.
    """
    first, second, keep, points, _ = found
    H, gaps, one, two, _ = rows
    d, r = 2 if len(dof) == 4 else 3, index(walls)
    for k in range(keep.shape[0]):
        i, j = index(first[index(keep[k])]), index(second[index(keep[k])])
        s0, t0 = points[k, 0], points[k, 1]
        bx, by = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1]
        ax, ay, cx, cy = axis[i, 0], axis[i, 1], axis[j, 0], axis[j, 1]
        az = cz = bz = 0.0
        if d == 3:
            az, cz, bz = axis[i, 2], axis[j, 2], x[j, 2] - x[i, 2]
        sine2 = squared_sine(ax, ay, az, cx, cy, cz, dof)
        slide = 1.0 - sine2 / (LINE_CONTACT_SINE * LINE_CONTACT_SINE)
        ha, hb, ra, rb = half[i], half[j], radius[i], radius[j]
        low = high = project = offset = sign = cosine = 0.0
        if slide > 0:
            cosine = ax * cx + ay * cy + az * cz
            sign = -1.0 if cosine < 0 else 1.0
            mx, my, mz = ax + sign * cx, ay + sign * cy, az + sign * cz
            size = math.sqrt(mx * mx + my * my + mz * mz)
            project = (ax * mx + ay * my + az * mz) / size
            offset = (bx * mx + by * my + bz * mz) / size
            low = max(-ha * project, offset - hb * project)
            high = min(ha * project, offset + hb * project)
        if slide <= 0 or high <= low:
            _put_pair(
                H, gaps, r, i, j, x, axis, half, radius, scale, s0, t0,
                end_of(s0, ha), end_of(t0, hb), 1.0, dof,
            )  # fmt: skip
            one[r], two[r] = i, j
            r += index(1)
            continue
        share = min((high - low) / (0.5 * (ra + rb)), 1.0)
        swing = 0.5 * (high - low) * math.sqrt(sine2)
        if swing > 1e-6 * ra:
            apart = math.sqrt(squared_distance(bx, by, bz, ax, ay, az, cx, cy, cz, s0, t0, dof))
            share *= min(apart / swing, 1.0)
        slide = slide * slide * share
        end_a0 = end_while_sliding(s0, cosine * t0 + bx * ax + by * ay + bz * az, ha, ra, slide)
        end_b0 = end_while_sliding(t0, cosine * s0 - bx * cx - by * cy - bz * cz, hb, rb, slide)
        for side in (-1.0, 1.0):
            at = low if side < 0 else high
            s1 = clamp(at / project, ha)
            t1 = clamp(sign * (at - offset) / project, hb)
            mark_a = max(1.0 + side * (at - ha * project * side) / (0.5 * (ra + rb)), 0.0)
            mark_b = max(1.0 + side * (at - offset - hb * project * side) / (0.5 * (ra + rb)), 0.0)
            _put_pair(
                H, gaps, r, i, j, x, axis, half, radius, scale,
                s0 + slide * (s1 - s0), t0 + slide * (t1 - t0),
                end_a0 + slide * (side * mark_a - end_a0),
                end_b0 + slide * (sign * side * mark_b - end_b0), math.sqrt(0.5), dof,
            )  # fmt: skip
            one[r], two[r] = i, j
            r += index(1)
    return np.int64(r)


@kernel(inline=True)
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


@kernel
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
                gaps[r], one[r], two[r], soft[r] = weight * gap, i, -1, kind
                r += 1
    return r, deepest


@kernel
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


@kernel
def rows_of_cells(one, two, rows, n):
    """The halves of each cell, in the order of rows: where each cell's begin, and the halves."""
    begin = np.zeros(n + 1, np.int64)
    for r in range(rows):
        begin[index(one[r]) + index(1)] += 1
        if two[r] >= 0:
            begin[index(two[r]) + index(1)] += 1
    for i in range(n):
        begin[i + 1] += begin[i]
    half = np.empty(begin[n], np.int32)
    fill = begin[:-1].copy()
    for r in range(rows):
        i = index(one[r])
        half[index(fill[i])] = 2 * r
        fill[i] += 1
        if two[r] >= 0:
            j = index(two[r])
            half[index(fill[j])] = 2 * r + 1
            fill[j] += 1
    return begin, half

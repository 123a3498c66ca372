"""Contacts of near cells and their rows, a block of pairs at a time.

A block has the numbers of its pairs in columns, (COLUMNS, PAIRS), or as vectors, (…, WIDTH): what
is worked out for a pair is worked out for WIDTH pairs at once, with the bits that one would have
alone. Lanes beyond the last pair hold those of an earlier block, and nobody reads them.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.capsules import (
    clamp,
    closest_points,
    dot_of,
    end_of,
    end_while_sliding,
    squared_distance,
    squared_sine,
)
from torchfilm.kernels.compiling import index, kernel, lean
from torchfilm.kernels.images import nearest
from torchfilm.kernels.lanes import put_scaled_row, put_turned
from torchfilm.kernels.memory import room, shaped
from torchfilm.kernels.rows import FAR, HARD, half_of
from torchfilm.kernels.scheme import BEYOND
from torchfilm.kernels.vectors import WIDTH, any_of, load, store, where

LINE_CONTACT_SINE, CROSSED = 0.4, 0.2  # as in `physics.contacts`
# Centrelines nearer than this share of the distance at which cells touch cross.
CROSSING = 1e-5
# Pairs of a block: as many as leave its numbers in the nearest memory.
PAIRS = 32
VECTORS = PAIRS // WIDTH
# Columns: from centre to centre, axes, half lengths, radii, arc lengths of the closest points, gap,
# whether it is below the margin, and which of its rows a pair has: one at the contact, or two where
# it is a line; and in space one at each end of the stretch along which its cells lie side by
# side.
B, A, C = 0, 3, 6
HALF_A, HALF_B, RADIUS_A, RADIUS_B, S0, T0, GAP, NEAR, HAS = range(9, 18)
ROWS = 4
# Then, of each row: arc lengths, ends, weight, distance, gap times weight; and room for the halves,
# of up to eight numbers, those of one pair after those of the other.
FIRST_ROW = HAS + ROWS
S, T, END_A, END_B, WEIGHT, DISTANCE, WEIGHTED, OWN, OTHER = (0, 1, 2, 3, 4, 5, 6, 7, 15)
OF_ROW = 23
COLUMNS = FIRST_ROW + ROWS * OF_ROW


@lean(inline=True)
def most_rows(dof):
    """Of a pair."""
    return ROWS if len(dof) == 8 else 2


@lean(inline=True)
def _put_cells(block, k, i, j, x, axis, half, radius, dof):
    """Puts the cells i and j into column k."""
    for c in range(2 if len(dof) == 4 else 3):
        block[B + c, k] = x[j, c] - x[i, c]
        block[A + c, k], block[C + c, k] = axis[i, c], axis[j, c]
    block[HALF_A, k], block[HALF_B, k] = half[i], half[j]
    block[RADIUS_A, k], block[RADIUS_B, k] = radius[i], radius[j]


@lean(inline=True)
def _take_nearest(block, count, periods, dof):
    """Of the first `count` columns, the way to the nearest image of the other cell."""
    for c in range(2 if len(dof) == 4 else 3):
        if periods[c] > 0.0:
            for k in range(count):
                block[B + c, k] = nearest(block[B + c, k], periods[c])


@lean(inline=True)
def _half_at(column, k, dof):
    """The place of the half of pair k among the numbers of a block."""
    return index(column) * index(PAIRS) + index(k) * index(len(dof))


@lean(inline=True)
def _vector(rows, column, g):
    return load(rows, column * VECTORS + g)


@lean(inline=True)
def _put(rows, column, g, x):
    store(rows, column * VECTORS + g, x)


@lean(inline=True)
def _three(rows, column, g):
    return _vector(rows, column, g), _vector(rows, column + 1, g), _vector(rows, column + 2, g)


@lean
def _measure(rows, vectors, margin, dof):
    """The closest points of pairs, their gap, and whether it is below the margin."""
    for g in range(vectors):
        bx, by, bz = _three(rows, B, g)
        ax, ay, az = _three(rows, A, g)
        cx, cy, cz = _three(rows, C, g)
        half_a, half_b = _vector(rows, HALF_A, g), _vector(rows, HALF_B, g)
        s, t, d2 = closest_points(bx, by, bz, ax, ay, az, cx, cy, cz, half_a, half_b, dof)
        touching = _vector(rows, RADIUS_A, g) + _vector(rows, RADIUS_B, g)
        _put(rows, S0, g, s)
        _put(rows, T0, g, t)
        _put(rows, GAP, g, np.sqrt(d2) - touching)
        near = d2 < (touching + margin) * (touching + margin)
        _put(rows, NEAR, g, where(near, 1.0, 0.0))


@kernel(inline=True)
def new_block(memory, columns):
    """A block of so many columns. Those from FIRST_ROW on are written before they are read."""
    block = room(memory, (columns, PAIRS), np.float64)
    clear_block(block)
    return block


@lean(inline=True)
def clear_block(block):
    for column in range(FIRST_ROW):
        for k in range(PAIRS):
            block[column, k] = 0.0


@lean
def room_for_contacts(memory, most):
    """Arrays for so many contacts: their places among the pairs, closest points and gaps."""
    keep, points = room(memory, (most,), np.int32), room(memory, (most, 2), np.float64)
    return keep, points, room(memory, (most,), np.float64)


@lean
def near_contacts(memory, x, axis, half, radius, periods, first, second, margin, dof):
    """The pairs nearer than margin: their number, closest points and gap, µm. periods: see
    `kernels.images`."""
    m = first.shape[0]
    keep, points, gap = room_for_contacts(memory, m)
    block = new_block(memory, FIRST_ROW)
    found = near_contacts_of(
        x, axis, half, radius, periods, first, second, margin, 0, m, keep, points, gap, block, dof
    )
    return keep[:found], points[:found], gap[:found]


@lean
def near_contacts_of(x, axis, half, radius, periods, first, second, margin, begin, end, keep,
                     points, gap, block, dof):  # fmt: skip
    """Those of the pairs begin … end − 1, from the place `begin` on. block: see
    `new_block`. Returns how many."""
    found = index(begin)
    for start in range(begin, end, PAIRS):
        count = min(PAIRS, end - start)
        for k in range(count):
            i, j = index(first[start + k]), index(second[start + k])
            _put_cells(block, k, i, j, x, axis, half, radius, dof)
        _take_nearest(block, count, periods, dof)
        vectors = (count + WIDTH - 1) // WIDTH
        _measure(shaped(block, (FIRST_ROW * VECTORS, WIDTH)), vectors, margin, dof)
        for k in range(count):  # without branches: their outcome is not foreseen
            keep[found], gap[found] = start + k, block[GAP, k]
            points[found, 0], points[found, 1] = block[S0, k], block[T0, k]
            found += index(block[NEAR, k])
    return np.int64(found) - begin


@lean
def deepest_of(memory, x, axis, half, radius, periods, found, dof):
    """The least gap of the contacts `found` where cells are now, µm, or 0. found: as in
    `pair_rows`."""
    first, second, keep = found[:3]
    block, deepest = new_block(memory, FIRST_ROW), 0.0
    for start in range(0, keep.shape[0], PAIRS):
        some = keep[start : start + PAIRS]
        for k in range(some.shape[0]):
            i, j = index(first[index(some[k])]), index(second[index(some[k])])
            _put_cells(block, k, i, j, x, axis, half, radius, dof)
        _take_nearest(block, some.shape[0], periods, dof)
        vectors = (some.shape[0] + WIDTH - 1) // WIDTH
        _measure(shaped(block, (FIRST_ROW * VECTORS, WIDTH)), vectors, 0.0, dof)
        for k in range(some.shape[0]):
            deepest = min(deepest, block[GAP, k])
    return deepest


@lean
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


@lean(inline=True)
def _end_of_sphere(nx, ny, nz, ax, ay, az, half, end, dof):
    """A sphere grows at both ends at once: the end nearer to the contact counts."""
    along = dot_of(nx, ny, nz, ax, ay, az, dof)
    sign = where(along > 0, 1.0, 0.0) - where(along < 0, 1.0, 0.0)
    return where(half <= 1e-9, sign, end)


@lean(inline=True)
def _put_row(rows, row, g, s, t, end_a, end_b, weight, dof):
    """A row of each pair, before it is scaled, at the points s and t of the centrelines. Returns
    whether centrelines cross."""
    bx, by, bz = _three(rows, B, g)
    ax, ay, az = _three(rows, A, g)
    cx, cy, cz = _three(rows, C, g)
    dx, dy, dz = bx + t * cx - s * ax, by + t * cy - s * ay, bz + t * cz - s * az
    distance = np.sqrt(dot_of(dx, dy, dz, dx, dy, dz, dof))
    touching = _vector(rows, RADIUS_A, g) + _vector(rows, RADIUS_B, g)
    inverse = 1.0 / distance
    nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
    end_a = _end_of_sphere(nx, ny, nz, ax, ay, az, _vector(rows, HALF_A, g), end_a, dof)
    end_b = _end_of_sphere(-nx, -ny, -nz, cx, cy, cz, _vector(rows, HALF_B, g), end_b, dof)
    own = half_of(weight, s, end_a, nx, ny, nz, ax, ay, az, dof)
    other = half_of(-weight, t, end_b, nx, ny, nz, cx, cy, cz, dof)
    put_turned(rows, _half_at(row + OWN, index(g) * index(WIDTH), dof), own, dof)
    put_turned(rows, _half_at(row + OTHER, index(g) * index(WIDTH), dof), other, dof)
    given = s, t, end_a, end_b, weight, distance, weight * (distance - touching)
    for k in range(len(given)):
        _put(rows, row + S + k, g, given[k])
    return any_of(distance <= CROSSING * touching)


@lean
def _part(block, row, k, dof):
    """The row of column k again, if its centrelines cross: along a direction that parts them."""
    if block[row + DISTANCE, k] > CROSSING * (block[RADIUS_A, k] + block[RADIUS_B, k]):
        return
    bx, by, bz = block[B, k], block[B + 1, k], block[B + 2, k]
    ax, ay, az = block[A, k], block[A + 1, k], block[A + 2, k]
    cx, cy, cz = block[C, k], block[C + 1, k], block[C + 2, k]
    nx, ny, nz = _apart(ax, ay, az, cx, cy, cz, 2 if len(dof) == 4 else 3)
    if nx * bx + ny * by + nz * bz < 0:
        nx, ny, nz = -nx, -ny, -nz
    end_a, end_b = block[row + END_A, k], block[row + END_B, k]
    end_a = _end_of_sphere(nx, ny, nz, ax, ay, az, block[HALF_A, k], end_a, dof)
    end_b = _end_of_sphere(-nx, -ny, -nz, cx, cy, cz, block[HALF_B, k], end_b, dof)
    weight = block[row + WEIGHT, k]
    own = half_of(weight, block[row + S, k], end_a, nx, ny, nz, ax, ay, az, dof)
    other = half_of(-weight, block[row + T, k], end_b, nx, ny, nz, cx, cy, cz, dof)
    flat = shaped(block, (COLUMNS * PAIRS,))
    for c in range(len(own)):
        flat[_half_at(row + OWN, k, dof) + index(c)] = own[c]
        flat[_half_at(row + OTHER, k, dof) + index(c)] = other[c]


@lean(inline=True)
def _put_far_row(rows, k, g, far, s, t, end_a, end_b, margin, dof):
    """A row of weight ½ at an end of the stretch, for pairs `far` that are near there, too."""
    row, has = FIRST_ROW + (2 + k) * OF_ROW, where(far, 1.0, 0.0)
    if margin > 0 and any_of(far):
        _put_row(rows, row, g, s, t, end_a, end_b, math.sqrt(0.5) * has, dof)
        distance = _vector(rows, row + DISTANCE, g)
        touching = _vector(rows, RADIUS_A, g) + _vector(rows, RADIUS_B, g)
        near = (distance < touching + margin) & (distance > CROSSING * touching)
        _put(rows, HAS + 2 + k, g, where(near, has, 0.0))
    else:
        _put(rows, HAS + 2 + k, g, 0.0 * has)


@lean(inline=True)
def _inner(s0, t0, low, high, offset, unproject, sign, ha, hb):
    """How far the closest points are from the nearer end of the stretch."""
    inner = ha + hb
    for side, at in ((-1.0, low), (1.0, high)):
        s1, t1 = clamp(at * unproject, ha), clamp(sign * (at - offset) * unproject, hb)
        own, other = side * (s1 - s0), side * sign * (t1 - t0)
        inner = where(own < inner, own, inner)
        inner = where(other < inner, other, inner)
    return inner


@lean
def _put_rows(rows, vectors, margin, dof):
    """The rows of pairs, before they are scaled: one at the closest points, or where the contact is
    a line two of weight ½, towards its ends; and in space, where the stretch along which cells lie
    side by side goes on, one at its end, if that is nearer than margin. Returns whether centrelines
    cross.
    """
    crossing = False
    for g in range(vectors):
        bx, by, bz = _three(rows, B, g)
        ax, ay, az = _three(rows, A, g)
        cx, cy, cz = _three(rows, C, g)
        ha, hb = _vector(rows, HALF_A, g), _vector(rows, HALF_B, g)
        ra, rb = _vector(rows, RADIUS_A, g), _vector(rows, RADIUS_B, g)
        s0, t0 = _vector(rows, S0, g), _vector(rows, T0, g)
        sine2 = squared_sine(ax, ay, az, cx, cy, cz, dof)
        slide = 1.0 - sine2 / (LINE_CONTACT_SINE * LINE_CONTACT_SINE)
        # the part of the line between the cells along which they lie side by side
        cosine = dot_of(ax, ay, az, cx, cy, cz, dof)
        sign = where(cosine < 0, -1.0, 1.0)
        mx, my, mz = ax + sign * cx, ay + sign * cy, az + sign * cz
        # a division costs more than anything else here
        size = 1.0 / np.sqrt(dot_of(mx, my, mz, mx, my, mz, dof))
        project = dot_of(ax, ay, az, mx, my, mz, dof) * size
        offset = dot_of(bx, by, bz, mx, my, mz, dof) * size
        unproject, width = 1.0 / project, 2.0 / (ra + rb)
        low, high = _side_by_side(ha * project, hb * project, offset)
        line = (slide > 0) & (high > low)
        share = (high - low) * width
        share = where(share > 1.0, 1.0, share)
        swing = 0.5 * (high - low) * np.sqrt(sine2)
        apart = np.sqrt(squared_distance(bx, by, bz, ax, ay, az, cx, cy, cz, s0, t0, dof))
        most = where(apart > swing, 1.0, apart / swing)
        share = where(swing > 1e-6 * ra, share * most, share)
        if len(dof) == 8:
            inner = _inner(s0, t0, low, high, offset, unproject, sign, ha, hb)
            aside = where(inner > 0, inner, 0.0) * np.sqrt(sine2)
            most = where(CROSSED * apart > aside, 1.0, CROSSED * apart / aside)
            share = where(aside > 1e-6 * ra, share * most, share)
        slide = slide * slide * share
        free_a = cosine * t0 + dot_of(bx, by, bz, ax, ay, az, dof)
        free_b = cosine * s0 - dot_of(bx, by, bz, cx, cy, cz, dof)
        end_a0 = end_while_sliding(s0, free_a, ha, ra, slide)
        end_b0 = end_while_sliding(t0, free_b, hb, rb, slide)
        weight = where(line, math.sqrt(0.5), 1.0)
        for k in range(2):
            side, at = (1.0, high) if k else (-1.0, low)
            s1 = clamp(at * unproject, ha)
            t1 = clamp(sign * (at - offset) * unproject, hb)
            end_a = _mark(side, at - ha * project * side, width)
            end_b = _mark(side, at - offset - hb * project * side, width)
            s2 = where(line, s0 + slide * (s1 - s0), s0)
            t2 = where(line, t0 + slide * (t1 - t0), t0)
            crossing |= _put_row(
                rows, FIRST_ROW + k * OF_ROW, g, s2, t2,
                where(line, end_a0 + slide * (end_a - end_a0), end_of(s0, ha)),
                where(line, end_b0 + slide * (sign * end_b - end_b0), end_of(t0, hb)),
                weight, dof,
            )  # fmt: skip
            if len(dof) == 8:
                far = (high > low) & ((abs(s1 - s2) + abs(t1 - t2)) * width > 2.0 * BEYOND)
                _put_far_row(rows, k, g, far, s1, t1, end_a, sign * end_b, margin, dof)
        _put(rows, HAS, g, where(line, 1.0, 1.0))
        _put(rows, HAS + 1, g, where(line, 1.0, 0.0))
    return crossing


@lean(inline=True)
def _side_by_side(ha, hb, offset):
    """Where two parallel segments lie side by side: from max(−ha, offset − hb) to min(ha, offset +
    hb)."""
    low, high = offset - hb, offset + hb
    return where(low > -ha, low, -ha), where(high < ha, high, ha)


@lean(inline=True)
def _mark(side, beyond, width):
    """How far the end of a line of contact counts as an end of a cell."""
    mark = 1.0 + side * beyond * width
    return side * where(mark < 0.0, 0.0, mark)


@lean
def pair_rows(memory, x, axis, half, radius, periods, scale, found, walls, rows, margin, dof):
    """Rows of the contacts `found`, after `walls` others; a line of contact has two rows of weight
    ½, and in space a pair has more where a turn would bring it together: where it is nearer than
    margin. Returns how many there are in all.

    found: pairs (first, second), and of their contacts the place among these, the closest points
    and the gap, µm: see `near_contacts`.
    """
    block, m = new_block(memory, COLUMNS), found[2].shape[0]
    return pair_rows_of(
        x, axis, half, radius, periods, scale, found, 0, m, walls, rows, margin, block, dof
    )


@lean
def pair_rows_of(x, axis, half, radius, periods, scale, found, begin, end, place, rows, margin,
                 block, dof):  # fmt: skip
    """Those of the contacts begin … end − 1, from this place on. block: as in `near_contacts_of`.
    Returns the place after them."""
    first, second, keep, points, _ = found
    H, gaps, one, two, kind = rows
    r, most = index(place), most_rows(dof)
    for start in range(begin, end, PAIRS):
        some = keep[start : min(start + PAIRS, end)]
        for k in range(some.shape[0]):
            i, j = index(first[index(some[k])]), index(second[index(some[k])])
            _put_cells(block, k, i, j, x, axis, half, radius, dof)
            block[S0, k], block[T0, k] = points[start + k, 0], points[start + k, 1]
        _take_nearest(block, some.shape[0], periods, dof)
        vectors = (some.shape[0] + WIDTH - 1) // WIDTH
        if _put_rows(shaped(block, (COLUMNS * VECTORS, WIDTH)), vectors, margin, dof):
            for k in range(some.shape[0]):
                _part(block, FIRST_ROW, k, dof)
                _part(block, FIRST_ROW + OF_ROW, k, dof)
        for k in range(some.shape[0]):
            i, j = first[index(some[k])], second[index(some[k])]
            for c in range(most):
                if block[HAS + c, k] == 0.0:
                    continue
                row = FIRST_ROW + c * OF_ROW
                own, other = _half_at(row + OWN, k, dof), _half_at(row + OTHER, k, dof)
                put_scaled_row(H, index(2) * r, block, own, scale, index(i), dof)
                put_scaled_row(H, index(2) * r + index(1), block, other, scale, index(j), dof)
                gaps[r], one[r], two[r] = block[row + WEIGHTED, k], i, j
                kind[r] = HARD if c < 2 else FAR
                r += index(1)
    return np.int64(r)

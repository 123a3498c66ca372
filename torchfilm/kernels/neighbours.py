"""Pairs of cells of one colony that may touch, by a hashed grid of their boxes."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import index, kernel, lean
from torchfilm.kernels.images import (
    axes_of_images,
    is_periodic,
    of_images,
    pairs_of_cells,
    with_images,
)
from torchfilm.kernels.lanes import boxes_meet, copy_row
from torchfilm.kernels.memory import copied, room, zeros

# By how much boxes are enlarged, of their distance from the colony's corner: as single numbers they
# are rounded by less.
ROUNDED = 4e-7
# In colonies of so many cells or fewer each box is compared with each other one: a grid would take
# longer.
FEW = 64


@kernel
def _boxes(memory, x, axis, half, radius, margin, box, low, high, dof):
    """Each cell's box (n, len(dof)), from the colony's corner, with half of margin around it, as
    `boxes_meet` takes it, and the first and last bin of it along each axis; returns the number of
    bins."""
    n, d, other = x.shape[0], 2 if len(dof) == 4 else 3, len(dof) // 2
    size, ends = 0.0, room(memory, (n, d), np.float64)
    least, top = room(memory, (d,), np.float64), zeros(memory, (3,), np.int64)
    for k in range(d):
        least[k] = np.inf
    for i in range(n):
        for k in range(d):
            ends[i, k] = e = abs(axis[i, k]) * half[i] + radius[i] + 0.5 * margin
            size += e
            least[k] = min(least[k], x[i, k] - e)
    width = 3.2 * size / (n * d)  # wider: fewer bins a cell, but more cells a bin
    for i in range(n):
        for k in range(d):
            start, end = x[i, k] - ends[i, k] - least[k], x[i, k] + ends[i, k] - least[k]
            box[i, k], box[i, other + k] = start - ROUNDED * end, -end - ROUNDED * end
            low[i, k], high[i, k] = math.floor(start / width), math.floor(end / width)
            top[k] = max(top[k], high[i, k] + 1)
    return top


@kernel
def _slots_of(memory, low, high, top, slots, some):
    """Which slots have to be filled, (slots,): those of the cells marked in `some`, (n,)."""
    n, d = low.shape
    used = zeros(memory, (slots,), np.uint8)
    for i in range(n):
        if some[i]:
            z0, z1 = (low[i, 2], high[i, 2]) if d == 3 else (np.int64(0), np.int64(0))
            for bz in range(z0, z1 + 1):
                for by in range(low[i, 1], high[i, 1] + 1):
                    for bx in range(low[i, 0], high[i, 0] + 1):
                        own = bx + by * top[0] + bz * top[0] * top[1]
                        used[index(own & (slots - 1))] = 1
    return used


@lean
def _fill_table(memory, low, high, top, used, boxes, dof):
    """Members sorted by slot, of the slots that are used, and where each slot begins. Each has 8
    times the number of its bin, and a bit for each axis along which this is the first bin of its
    box; and its box."""
    slots = used.shape[0]
    n, d = low.shape
    rows, layers = top[0], top[0] * top[1]
    begin = zeros(memory, (slots + 1,), np.int64)
    for turn in range(2):
        if turn == 1:
            for s in range(slots):
                begin[s + 1] += begin[s]
            members = begin[slots]
            member, key = room(memory, (members,), np.int32), room(memory, (members,), np.int64)
            box = room(memory, (members, len(dof)), np.float32)
            fill = copied(memory, begin, slots)
        for i in range(n):
            z0, z1 = (low[i, 2], high[i, 2]) if d == 3 else (np.int64(0), np.int64(0))
            for bz in range(z0, z1 + 1):
                for by in range(low[i, 1], high[i, 1] + 1):
                    for bx in range(low[i, 0], high[i, 0] + 1):
                        own = bx + by * rows + bz * layers
                        s = index(own & (slots - 1))
                        if not used[s]:
                            continue
                        if turn == 0:
                            begin[s + index(1)] += 1
                        else:
                            firsts = (bx == low[i, 0]) + 2 * (by == low[i, 1]) + 4 * (bz == z0)
                            place = index(fill[s])
                            member[place], key[place] = i, 8 * own + firsts
                            copy_row(box, fill[s], boxes, i, dof)
                            fill[s] += 1
    return begin, member, key, box


@lean
def near_pairs(memory, x, axis, half, radius, periods, margin, dof):
    """Pairs (i < j) whose boxes come nearer than margin, and a few more, each once, sorted by i;
    those of their nearest images where space is periodic, see `kernels.images`."""
    every = room(memory, (0,), np.uint8)
    return near_pairs_of(memory, x, axis, half, radius, periods, margin, every, dof)


@lean
def near_pairs_of(memory, x, axis, half, radius, periods, margin, some, dof):
    """Those of `near_pairs` of which a cell is marked in `some`, (n,) uint8; (0,) for all."""
    if not is_periodic(periods):
        return _pairs_between(memory, x, axis, half, radius, margin, some, dof)
    y, cell, way = with_images(memory, x, axis, half, radius, periods, margin, dof)
    marks = of_images(memory, some, cell) if some.shape[0] else some
    first, second = _pairs_between(
        memory, y, axes_of_images(memory, axis, cell, dof), of_images(memory, half, cell),
        of_images(memory, radius, cell), margin, marks, dof,
    )  # fmt: skip
    first, second = pairs_of_cells(first, second, y, cell, way, periods, dof)
    return _by_first(memory, first, second, x.shape[0])


@lean
def _pairs_between(memory, x, axis, half, radius, margin, some, dof):
    """As `near_pairs_of`, without images.

    Cells of any size: a long cell lies in many bins. A pair is found in the first bin that both
    cover: along each axis it is the first of one of them.
    """
    n, d = x.shape[0], 2 if len(dof) == 4 else 3
    low, high = room(memory, (n, d), np.int64), room(memory, (n, d), np.int64)
    boxes = zeros(memory, (n, len(dof)), np.float32)
    top = _boxes(memory, x, axis, half, radius, margin, boxes, low, high, dof)
    if n <= FEW:
        first, second = _among_few(memory, boxes, dof)
        return _with_some(first, second, some)
    slots = 16
    while slots < 2 * n:
        slots *= 2
    if some.shape[0]:
        used = _slots_of(memory, low, high, top, slots, some)
    else:
        used = room(memory, (slots,), np.uint8)
        for s in range(slots):
            used[s] = 1
    begin, member, key, box = _fill_table(memory, low, high, top, used, boxes, dof)
    most = 0
    for s in range(slots):
        most = max(most, begin[s + 1] - begin[s])
    size = most + min(8 * n, 8 * member.shape[0])
    first, second = room(memory, (size,), np.int32), room(memory, (size,), np.int32)
    table, slot, place, found = (begin, member, key, box), 0, 0, 0
    while place < member.shape[0]:
        if found + most > first.shape[0]:
            first, second = _longer(memory, first), _longer(memory, second)
        slot, place, found = _search(table, slot, place, found, most, first, second, dof)
    first, second = _with_some(first[:found], second[:found], some)
    return _by_first(memory, first, second, n)


@lean
def _with_some(first, second, some):
    """The pairs of which a cell is marked in `some`, in place; all where it is (0,)."""
    if some.shape[0] == 0:
        return first, second
    new = 0
    for k in range(first.shape[0]):
        first[new], second[new] = first[k], second[k]
        new += (some[first[k]] | some[second[k]]) > 0
    return first[:new], second[:new]


@lean
def _among_few(memory, boxes, dof):
    """The pairs of boxes that meet, each compared with each."""
    n, found = boxes.shape[0], index(0)
    first, second = room(memory, (n * n,), np.int32), room(memory, (n * n,), np.int32)
    for i in range(n):
        for j in range(i + 1, n):
            first[found], second[found] = i, j
            found += index(boxes_meet(boxes, i, j, dof))
    return first[:found], second[:found]


@lean
def _search(table, slot, place, found, most, first, second, dof):
    """Puts pairs of the members from `place` on, in this slot and the next ones, after the first
    `found`, as long as there is room for `most` more. Returns slot and place to go on from, and how
    many pairs there are."""
    begin, member, key, box = table
    found, one, p = index(found), index(1), index(place)
    full = index(first.shape[0] - most)
    for s in range(slot, begin.shape[0] - 1):
        end = index(begin[s + 1])
        while p < end:
            if found > full:
                return s, np.int64(p), np.int64(found)
            i, own = member[p], key[p]
            for q in range(p + one, end):  # without branches: their outcome is not foreseen
                apart = ((own ^ key[q]) >> 3) | (((own | key[q]) & 7) ^ 7)
                first[found], second[found] = i, member[q]
                found += index((apart == 0) & boxes_meet(box, np.int64(p), np.int64(q), dof))
            p += one
    return begin.shape[0] - 1, np.int64(p), np.int64(found)


@kernel
def _longer(memory, a):
    out = room(memory, (2 * a.shape[0],), a.dtype)
    for i in range(a.shape[0]):  # an assigned slice takes Numba seconds
        out[i] = a[i]
    return out


@lean
def _by_first(memory, first, second, n):
    """The pairs sorted by their first cell, otherwise in order."""
    m = first.shape[0]
    place = zeros(memory, (n + 1,), np.int64)
    for k in range(m):
        place[index(first[k]) + index(1)] += 1
    for i in range(n):
        place[i + 1] += place[i]
    one, other = room(memory, (m,), np.int32), room(memory, (m,), np.int32)
    for k in range(m):
        i = index(first[k])
        p = index(place[i])
        one[p], other[p] = first[k], second[k]
        place[i] += 1
    return one, other


@kernel
def spatial_order(memory, x, width):
    """An order of cells in which neighbours in space are near each other: strips along x, of this
    width, and bins a quarter as long, with those of a bin in the order given. A colony that is
    spread thinly has larger ones."""
    n = x.shape[0]
    low0, low1, high0, high1 = x[0, 0], x[0, 1], x[0, 0], x[0, 1]
    for i in range(n):
        low0, high0 = min(low0, x[i, 0]), max(high0, x[i, 0])
        low1, high1 = min(low1, x[i, 1]), max(high1, x[i, 1])
    width = max(width, (high1 - low1) / n)
    strips = int((high1 - low1) / width) + 1
    long = max(0.25 * width, (high0 - low0) * strips / (8.0 * n))
    bins = int((high0 - low0) / long) + 1
    own = room(memory, (n,), np.int64)
    begin = zeros(memory, (strips * bins + 1,), np.int64)
    for i in range(n):
        own[i] = int((x[i, 1] - low1) / width) * bins + int((x[i, 0] - low0) / long)
        begin[own[i] + 1] += 1
    for b in range(strips * bins):
        begin[b + 1] += begin[b]
    order = room(memory, (n,), np.int64)
    for i in range(n):
        order[begin[own[i]]] = i
        begin[own[i]] += 1
    return order

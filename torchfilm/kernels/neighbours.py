"""Pairs of cells of one colony that may touch, by a hashed grid of their boxes."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel


@kernel
def _boxes(x, axis, half, radius, margin, box, low, high, dof):
    """Each cell's box (n, 2 d), from the colony's corner, with half of margin around it, and the
    first and last bin of it along each axis; returns the number of bins."""
    n, d = x.shape[0], 2 if len(dof) == 4 else 3
    size = 0.0
    least = np.full(d, np.inf)
    for i in range(n):
        for k in range(d):
            e = abs(axis[i, k]) * half[i] + radius[i] + 0.5 * margin
            size += e
            box[i, k], box[i, d + k] = x[i, k] - e, x[i, k] + e
            least[k] = min(least[k], box[i, k])
    width = 3.2 * size / (n * d)  # wider: fewer bins a cell, but more cells a bin
    top = np.zeros(3, np.int64)
    for i in range(n):
        for k in range(d):
            box[i, k] -= least[k]
            box[i, d + k] -= least[k]
            low[i, k], high[i, k] = math.floor(box[i, k] / width), math.floor(box[i, d + k] / width)
            top[k] = max(top[k], high[i, k] + 1)
    return top


@kernel
def _fill_table(low, high, top, slots):
    """Members sorted by slot, and where each slot begins. Each has 8 times the number of its bin,
    and a bit for each axis along which this is the first bin of its box."""
    n, d = low.shape
    rows, layers = top[0], top[0] * top[1]
    begin = np.zeros(slots + 1, np.int64)
    for turn in range(2):
        if turn == 1:
            for s in range(slots):
                begin[s + 1] += begin[s]
            member, key = np.empty(begin[slots], np.int32), np.empty(begin[slots], np.int64)
            fill = begin[:-1].copy()
        for i in range(n):
            z0, z1 = (low[i, 2], high[i, 2]) if d == 3 else (np.int64(0), np.int64(0))
            for bz in range(z0, z1 + 1):
                for by in range(low[i, 1], high[i, 1] + 1):
                    for bx in range(low[i, 0], high[i, 0] + 1):
                        own = bx + by * rows + bz * layers
                        s = own & (slots - 1)
                        if turn == 0:
                            begin[s + 1] += 1
                        else:
                            firsts = (bx == low[i, 0]) + 2 * (by == low[i, 1]) + 4 * (bz == z0)
                            member[fill[s]], key[fill[s]] = i, 8 * own + firsts
                            fill[s] += 1
    return begin, member, key


@kernel
def near_pairs(x, axis, half, radius, margin, dof):
    """Pairs (i < j) whose boxes come nearer than margin, each once, sorted by i.

    Cells of any size: a long cell lies in many bins. A pair is found in the first bin that both
    cover: along each axis it is the first of one of them.
    """
    n, d = x.shape[0], 2 if len(dof) == 4 else 3
    low, high = np.empty((n, d), np.int64), np.empty((n, d), np.int64)
    box = np.empty((n, 2 * d))
    top = _boxes(x, axis, half, radius, margin, box, low, high, dof)
    slots = 16
    while slots < 2 * n:
        slots *= 2
    begin, member, key = _fill_table(low, high, top, slots)
    found, most = 0, 0
    for s in range(slots):
        most = max(most, begin[s + 1] - begin[s])
    first, second = np.empty(8 * n + most, np.int32), np.empty(8 * n + most, np.int32)
    for s in range(slots):
        for p in range(begin[s], begin[s + 1]):
            if found + most > first.shape[0]:
                first, second = _longer(first), _longer(second)
            i, own = np.uint64(member[p]), key[p]
            for q in range(p + 1, begin[s + 1]):  # without branches: their outcome is not foreseen
                j = np.uint64(member[q])
                apart = ((own ^ key[q]) >> 3) | (((own | key[q]) & 7) ^ 7)
                near = apart == 0
                for k in range(d):
                    near &= (box[i, k] <= box[j, d + k]) & (box[j, k] <= box[i, d + k])
                first[found], second[found] = member[p], member[q]
                found += near
    return _by_first(first[:found], second[:found], n)


@kernel
def _longer(a):
    out = np.empty(2 * a.shape[0], a.dtype)
    for i in range(a.shape[0]):  # an assigned slice takes Numba seconds
        out[i] = a[i]
    return out


@kernel
def _by_first(first, second, n):
    """The pairs sorted by their first cell, otherwise in order."""
    m = first.shape[0]
    place = np.zeros(n + 1, np.int64)
    for k in range(m):
        place[first[k] + 1] += 1
    for i in range(n):
        place[i + 1] += place[i]
    one, other = np.empty(m, np.int32), np.empty(m, np.int32)
    for k in range(m):
        p = place[first[k]]
        one[p], other[p] = first[k], second[k]
        place[first[k]] += 1
    return one, other


@kernel
def spatial_order(x, width):
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
    own, begin = np.empty(n, np.int64), np.zeros(strips * bins + 1, np.int64)
    for i in range(n):
        own[i] = int((x[i, 1] - low1) / width) * bins + int((x[i, 0] - low0) / long)
        begin[own[i] + 1] += 1
    for b in range(strips * bins):
        begin[b + 1] += begin[b]
    order = np.empty(n, np.int64)
    for i in range(n):
        order[begin[own[i]]] = i
        begin[own[i]] += 1
    return order

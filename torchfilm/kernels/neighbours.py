"""Pairs of cells of one colony that may touch, by a hashed grid of their boxes."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel


@kernel
def _bins(x, axis, half, radius, margin, low, high):
    """The first and last bin of each cell's box, along each axis; returns the number of bins."""
    n, d = x.shape
    size = 0.0
    least = np.full(d, np.inf)
    for i in range(n):
        for k in range(d):
            e = abs(axis[i, k]) * half[i] + radius[i] + 0.5 * margin
            size += e
            least[k] = min(least[k], x[i, k] - e)
    width = 2.0 * size / (n * d)
    top = np.zeros(3, np.int64)
    for i in range(n):
        for k in range(d):
            e = abs(axis[i, k]) * half[i] + radius[i] + 0.5 * margin
            low[i, k] = math.floor((x[i, k] - e - least[k]) / width)
            high[i, k] = math.floor((x[i, k] + e - least[k]) / width)
            top[k] = max(top[k], high[i, k] + 1)
    return top


@kernel
def _fill_table(low, high, top, slots):
    """Members and their bins' numbers, sorted by slot; where each slot begins."""
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
                            member[fill[s]], key[fill[s]] = i, own
                            fill[s] += 1
    return begin, member, key


@kernel
def near_pairs(x, axis, half, radius, margin):
    """Pairs (i < j) whose boxes come nearer than margin, each once, sorted by i.

    Cells of any size: a long cell lies in many bins. A pair is found in the first bin that both
    cover.
    """
    n, d = x.shape
    low, high = np.empty((n, d), np.int64), np.empty((n, d), np.int64)
    top = _bins(x, axis, half, radius, margin, low, high)
    rows, layers = top[0], top[0] * top[1]
    slots = 16
    while slots < 2 * n:
        slots *= 2
    begin, member, key = _fill_table(low, high, top, slots)
    room, found = 8 * n + 16, 0
    first, second = np.empty(room, np.int32), np.empty(room, np.int32)
    for s in range(slots):
        for p in range(begin[s], begin[s + 1]):
            i, own = member[p], key[p]
            for q in range(p + 1, begin[s + 1]):
                j = member[q]
                if key[q] != own:
                    continue
                home = max(low[i, 0], low[j, 0]) + max(low[i, 1], low[j, 1]) * rows
                if d == 3:
                    home += max(low[i, 2], low[j, 2]) * layers
                apart = home != own
                for k in range(d):
                    reach = abs(axis[i, k]) * half[i] + abs(axis[j, k]) * half[j]
                    if abs(x[j, k] - x[i, k]) > reach + radius[i] + radius[j] + margin:
                        apart = True
                if apart:
                    continue
                if found == room:
                    first, second = _longer(first), _longer(second)
                    room *= 2
                first[found], second[found] = i, j
                found += 1
    return _by_first(first[:found], second[:found], n)


@kernel
def _longer(a):
    out = np.empty(2 * a.shape[0], a.dtype)
    out[: a.shape[0]] = a
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
    """An order of cells in which neighbours in space are near each other: strips along x."""
    n = x.shape[0]
    low0, low1 = np.inf, np.inf
    for i in range(n):
        low0, low1 = min(low0, x[i, 0]), min(low1, x[i, 1])
    key = np.empty(n)
    for i in range(n):
        key[i] = math.floor((x[i, 1] - low1) / width) * 1e7 + (x[i, 0] - low0)
    return np.argsort(key, kind="mergesort")

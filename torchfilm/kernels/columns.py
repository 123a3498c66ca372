"""Columns of cells: gathered from where they lie in memory, and what has become of them stored.

A table of places takes the place of arguments, whose number and types differ from circuit to
circuit: so these loops are compiled once.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import index, kernel
from torchfilm.kernels.team import array_at

# What a place says: the column's address, from one of its numbers to the next, their type, the
# address of factors or 0; the address of each cell's place in the column, int64, or 0 where it has
# one number for each cell.
ADDRESS, STRIDE, TYPE, FACTOR, INDEX = range(5)
WORDS = 5
ZERO, FLOAT32, FLOAT64, INT64, INT32, BOOL = range(6)  # types; ZERO: there is no column


@kernel
def _copy(first, last, rows, place, like, begin, step, out):
    """One column, to out[begin], out[begin + step] …; the product with a factor is one of its
    type."""
    by = place[STRIDE]
    x = array_at(place, ADDRESS, like, 1)
    if place[INDEX] != 0:
        own = array_at(place, INDEX, np.int64, 1)
        for m in range(first, last):
            out[index(begin + m * step)] = x[index(own[index(rows[m])] * by)]
        return
    if place[FACTOR] == 0:
        for m in range(first, last):
            out[index(begin + m * step)] = x[index(rows[m] * by)]
        return
    factor = array_at(place, FACTOR, like, 1)
    for m in range(first, last):
        out[index(begin + m * step)] = x[index(rows[m] * by)] * factor[index(rows[m])]


@kernel(entry=True)
def gather(first, last, rows, places, columns, out):
    """Put the columns of the cells rows[first … last − 1] into out, float64: of so many the numbers
    of all M rows side by side, then of the others those of one row. places (K, WORDS)."""
    count, size = rows.shape[0], places.shape[0] - columns
    for k in range(places.shape[0]):
        begin, step = k * count, 1
        if k >= columns:
            begin, step = columns * count + k - columns, size
        place = places[k]
        kind = place[TYPE]
        if kind == FLOAT32:
            _copy(first, last, rows, place, np.float32, begin, step, out)
        elif kind == FLOAT64:
            _copy(first, last, rows, place, np.float64, begin, step, out)
        elif kind == INT64:
            _copy(first, last, rows, place, np.int64, begin, step, out)
        elif kind == INT32:
            _copy(first, last, rows, place, np.int32, begin, step, out)
        elif kind == BOOL:
            _copy(first, last, rows, place, np.uint8, begin, step, out)
        else:
            for m in range(first, last):
                out[begin + m * step] = 0.0


@kernel(entry=True)
def store(first, last, rows, at, start, pool, thinner, diluted, signals, report, species, given,
          back, steps):  # fmt: skip
    """Store what the cells rows[first … last − 1] have become, at (M, V): their species (S, N), and
    what they give to the signals, of which there are E here: start (E, M). given, back: (signals,
    N), to pools and to a reservoir, if back has rows. report: (3, M)."""
    size, count = diluted.shape[0], signals.shape[0]
    number = species.dtype.type
    for m in range(first, last):
        n = index(rows[m])
        for k in range(size):
            x = number(at[m, k])
            species[k, n] = x * thinner[n] if diluted[k] else x
        for e in range(count):
            gain = number(at[m, size + e]) - number(start[e, m])
            given[signals[e], n] = gain * pool[n]
            if back.shape[0]:
                back[signals[e], n] = number(at[m, size + count + e])
        steps[n] = report[0, m] + report[1, m]


@kernel
def _volume(length, radius, number):
    return number(math.pi) * radius * radius * (length + radius * number(4.0 / 3.0))


@kernel(entry=True)
def half_way(length, radius, before, out):
    """Put into out (6, N) the lengths, volumes and areas of cells half way, in time, between the
    volume `before` and their own; the ratios of the volumes before, half way and in the end; and
    the volumes in the end."""
    number = length.dtype.type
    for i in range(length.shape[0]):
        r, end = radius[i], _volume(length[i], radius[i], number)
        middle = length[i]
        if before[i] != end:
            volume = np.sqrt(before[i] * end)
            longer = volume / (number(math.pi) * r * r) - r * number(4.0 / 3.0)
            middle = max(longer, number(0.0)) if longer == longer else longer
        volume = _volume(middle, r, number)
        out[0, i], out[1, i] = middle, volume
        out[2, i] = number(2.0 * math.pi) * r * (middle + number(2.0) * r)
        out[3, i], out[4, i], out[5, i] = before[i] / volume, volume / end, end

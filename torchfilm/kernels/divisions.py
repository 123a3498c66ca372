"""Divisions: which cells divide, which cells there are then, what they are called, and where they
lie."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.columns import BOOL, FLOAT32, FLOAT64, INT32
from torchfilm.kernels.compiling import index, kernel
from torchfilm.kernels.random import box_muller, uniform_of, words_of
from torchfilm.kernels.team import array_at

# What a place says of a column: its address, and that of the new one, both row after row; numbers
# in a row, their type, with what it begins in daughters; and the words of its draws.
FROM, TO, WIDTH, TYPE, FRESH, STEP, K0, K1 = range(8)
# As their parents have it, one number, or drawn evenly between two numbers.
COPY, NUMBER, UNIFORM = range(3)


@kernel(entry=True)
def due_rows(flag, size, threshold, length, radius, need):
    """The rows (M,) of those of N cells that divide: those that are flagged, and those whose size
    (N,), or (0,) for none, is not below its threshold. And how many of them are shorter than `need`
    radii."""
    rows, many, short = np.empty(flag.shape[0], np.int64), 0, 0
    for i in range(flag.shape[0]):
        due = flag[i]
        if size.shape[0] > 0:
            due |= size[i] >= threshold[i]
        if due:
            rows[many] = i
            many += 1
            short += length[i] < need * radius[i]
    return rows[:many].copy(), short


@kernel(entry=True)
def divide(rows, cells, ids, share, sd, caps, key, columns, numbers):
    """Makes two cells, side by side, of each of the M cells `rows` of N.

    cells: position (N, d) float64, axis (N, d), length and radius (N,) of one type. ids: colony,
    uid and parent (N,), next uid and stream of each colony. share of what is conserved that first
    daughters get, and sd of the noise of axes: (M,), or (1,) for all. caps: what they hold of it,
    as radii of length. key (3,): the words of the noise. columns (K, 8): places of all others, with
    `numbers` (K, 2) from which daughters begin.
    Returns the rows of the daughters (2 M,), first daughters first; uid, parent and the next uid of
    each colony, numbered on; and position, axis and length of N + M cells.
    """
    daughters, source, of_ids = _split(rows, ids)
    made = _placed(rows, daughters, source, cells, share, caps)
    colony, stream, uid = ids[0], ids[4], of_ids[0]
    own = np.empty((daughters.shape[0], 2), np.int64)
    for k in range(daughters.shape[0]):
        own[k, 0], own[k, 1] = uid[daughters[k]], stream[colony[source[daughters[k]]]]
    _turn(daughters, own, sd, key, made[1])
    for k in range(columns.shape[0]):
        _take_column(columns[k], source)
        _begin_column(columns[k], numbers[k], daughters, own, cells[2], source.size)
    return daughters, of_ids, made


@kernel
def _split(rows, ids):
    """The rows of the daughters, for each new cell the row that it comes from, its uid and its
    parent, and the next uids."""
    colony, uid, parent, next_uid, _ = ids
    n, m, k = uid.shape[0], rows.shape[0], 0
    daughters, source = np.empty(2 * m, np.int64), np.empty(n + m, np.int64)
    new_uid, new_parent, following = np.empty_like(source), np.empty_like(source), next_uid.copy()
    for i in range(n):
        source[i + k], new_uid[i + k], new_parent[i + k] = i, uid[i], parent[i]
        if k < m and rows[k] == i:
            daughters[k], daughters[m + k], source[i + k + 1] = i + k, i + k + 1, i
            for end in range(2):
                new_uid[i + k + end], new_parent[i + k + end] = following[colony[i]], uid[i]
                following[colony[i]] += 1
            k += 1
    return daughters, source, (new_uid, new_parent, following)


@kernel
def _placed(rows, daughters, source, cells, share, caps):
    """Position, axis and length of the new cells; daughters have their parents' axes. All but the
    position is of one type, as torch would compute."""
    position, axis, length, radius = cells
    m, d = rows.shape[0], axis.shape[1]
    half, one, two = length.dtype.type(0.5), length.dtype.type(1), length.dtype.type(2)
    of_caps, apart = length.dtype.type(caps), length.dtype.type(1 - 0.5 * caps)
    new_position, new_axis = np.empty((source.size, d)), np.empty((source.size, d), axis.dtype)
    new_length = np.empty(source.size, length.dtype)
    for r in range(source.size):
        i = index(source[r])
        new_length[r] = length[i]
        for c in range(d):
            new_position[r, c], new_axis[r, c] = position[i, c], axis[i, c]
    for k in range(2 * m):
        parent, cell = rows[k % m], daughters[k]
        part = share[k % m] if share.shape[0] > 1 else share[0]
        own = of_caps * radius[parent]
        rest, more = length[parent] - own, (two * part - one) * own
        found = rest * part + more if k < m else rest * (one - part) - more
        new_length[cell] = max(found, one - one)
        shift = half * (new_length[cell] - length[parent]) - apart * radius[parent]
        for c in range(d):
            moved = shift * axis[parent, c]
            new_position[cell, c] += moved if k < m else -moved
    return new_position, new_axis, new_length


@kernel(inline=True)
def _words(own, step, k0, k1):
    """The words of a cell (uid, stream)."""
    return words_of(own[0], own[1], np.uint64(step), np.uint64(k0), np.uint64(k1))


@kernel
def _turn(daughters, own, sd, key, axis):
    """Turns the daughters' axes by noise. own (2 M, 2): uid and stream."""
    m, d, one = daughters.shape[0] // 2, axis.shape[1], axis.dtype.type(1)
    draws = np.empty(4, axis.dtype)
    for k in range(daughters.shape[0]):
        noise = sd[k % m] if sd.shape[0] > 1 else sd[0]
        if not noise > 0:
            continue
        words = _words(own[k], key[0], key[1], key[2])
        draws[0], draws[1] = box_muller(words[0], words[1])
        draws[2], draws[3] = box_muller(words[2], words[3])
        cell, total = daughters[k], one - one
        for c in range(d):
            axis[cell, c] += noise * draws[c]
            total += axis[cell, c] * axis[cell, c]
        for c in range(d):
            axis[cell, c] *= one / np.sqrt(total)


@kernel
def _take_column(place, source):
    """The new column, in which daughters have what their parents have."""
    kind = place[TYPE]
    if kind == BOOL:
        _take(place, source, np.uint8)
    elif kind in (FLOAT32, INT32):
        _take(place, source, np.int32)
    else:
        _take(place, source, np.int64)


@kernel
def _take(place, source, like):
    width = place[WIDTH]
    old, new = array_at(place, FROM, like, 1), array_at(place, TO, like, source.size * width)
    for r in range(source.size):
        i = source[r] * width
        for c in range(width):
            new[index(r * width + c)] = old[index(i + c)]


@kernel
def _begin_column(place, number, daughters, own, like, count):
    """What daughters begin with in a new column of `count` rows, if not with what their parents
    have. Draws are of the type of `like`."""
    kind = place[TYPE]
    if place[FRESH] == UNIFORM:
        new = array_at(place, TO, like, count)
        low, high = like.dtype.type(number[0]), like.dtype.type(number[1])
        for k in range(daughters.shape[0]):
            words = _words(own[k], place[STEP], place[K0], place[K1])
            drawn = like.dtype.type(uniform_of(words[0]))
            new[daughters[k]] = low + (high - low) * drawn
    elif place[FRESH] == NUMBER:
        if kind == FLOAT32:
            _fill(place, number, daughters, np.float32, count)
        elif kind == FLOAT64:
            _fill(place, number, daughters, np.float64, count)
        elif kind == INT32:
            _fill(place, number, daughters, np.int32, count)
        elif kind == BOOL:
            _fill(place, number, daughters, np.uint8, count)
        else:
            _fill(place, number, daughters, np.int64, count)


@kernel
def _fill(place, number, daughters, like, count):
    width = place[WIDTH]
    new = array_at(place, TO, like, count * width)
    for r in daughters:
        for c in range(width):
            new[r * width + c] = like(number[0])

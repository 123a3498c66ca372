"""Transport of signals over the grids of all colonies: a matrix of each axis times the field.

A colony's grid is carried through all its axes before the next colony's, so that it stays in the
processor's cache.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.tiles import put_tile

# Numbers of rows and columns of a tile, as lengths.
ONE, FOUR = (0,), (0,) * 4
EIGHT, SIXTEEN = (0,) * 8, (0,) * 16
WIDEST = len(SIXTEEN)
# Rows of as many columns are so far apart in memory that they would displace each other from the
# first cache; a panel is copied together first.
FAR_APART = 128
# Voxels whose exchange along all axes is summed while they are in the first cache.
BLOCK = 1024


@kernel
def put_rows(out, factor, u, above, n, k, first, last, over, left, lanes):
    """Columns of factor · u, for as many as `lanes`: to out from row `above` and column k, with u's
    from row `over` and column `left`. Row i of the factor counts from first[i] to last[i]."""
    i = 0
    while i + 4 <= n:
        begin = min(first[i], first[i + 1], first[i + 2], first[i + 3])
        end = max(last[i], last[i + 1], last[i + 2], last[i + 3])
        put_tile(out, above, i, k, factor, u, over, left, begin, end, FOUR, lanes)
        i += 4
    while i < n:
        put_tile(out, above, i, k, factor, u, over, left, first[i], last[i], ONE, lanes)
        i += 1


@kernel
def along_other(n, factor, first, last, panel, u, out):
    """As `along_last`, for another axis of n voxels: u, out (… · n, voxels of the axes after it),
    and the factor transposed."""
    rows, columns = u.shape
    for above in range(0, rows, n):
        k = 0
        while k + WIDEST <= columns:
            if columns > FAR_APART:
                for j in range(n):
                    for c in range(WIDEST):
                        panel[j, c] = u[above + j, k + c]
                put_rows(out, factor, panel, above, n, k, first, last, 0, 0, SIXTEEN)
            else:
                put_rows(out, factor, u, above, n, k, first, last, above, k, SIXTEEN)
            k += WIDEST
        if k + 8 <= columns:
            put_rows(out, factor, u, above, n, k, first, last, above, k, EIGHT)
            k += 8
        if k + 4 <= columns:
            put_rows(out, factor, u, above, n, k, first, last, above, k, FOUR)
            k += 4
        while k < columns:
            put_rows(out, factor, u, above, n, k, first, last, above, k, ONE)
            k += 1


@kernel
def put_columns(out, u, factor, k, first, last, lanes):
    """Columns k … of u · factor, for as many as `lanes`."""
    begin, end = first[k], last[k]
    for c in range(1, len(lanes)):
        begin, end = min(begin, first[k + c]), max(end, last[k + c])
    rows = out.shape[0]
    i = 0
    while i + 4 <= rows:
        put_tile(out, 0, i, k, u, factor, 0, k, begin, end, FOUR, lanes)
        i += 4
    while i < rows:
        put_tile(out, 0, i, k, u, factor, 0, k, begin, end, ONE, lanes)
        i += 1


@kernel
def along_last(factor, first, last, u, out):
    """out = u · factor along the last axis, (…, voxels of the axis): voxel k of it gets something
    only from the voxels first[k] to last[k]."""
    columns, k = u.shape[1], 0
    while k + WIDEST <= columns:
        put_columns(out, u, factor, k, first, last, SIXTEEN)
        k += WIDEST
    if k + 8 <= columns:
        put_columns(out, u, factor, k, first, last, EIGHT)
        k += 8
    if k + 4 <= columns:
        put_columns(out, u, factor, k, first, last, FOUR)
        k += 4
    while k < columns:
        put_columns(out, u, factor, k, first, last, ONE)
        k += 1


@kernel
def along(axis, shape, factor, first, last, panel, u, out):
    """One grid times the factor of one axis; u, out: (voxels,). The factor is transposed unless its
    axis is the last with more than one voxel."""
    n, inner = shape[axis], 1
    for k in range(axis + 1, 3):
        inner *= shape[k]
    if inner == 1:
        rows = u.size // n
        along_last(factor, first, last, u.reshape((rows, n)), out.reshape((rows, n)))
    else:
        rows = u.size // inner
        given, made = u.reshape((rows, inner)), out.reshape((rows, inner))
        along_other(n, factor, first, last, panel, given, made)


@kernel(entry=True)
def carry(begin, end, starts, shape, axes, factors, firsts, lasts, gained, values, out):
    """The grids begin … end of one shape one step later, from values to out, (voxels,) of all
    colonies.

    starts: the first voxel of each grid. axes: those with a factor. factors: for each axis (b or 1,
    n, n), oriented as `along` asks; firsts, lasts: (b or 1, n). gained: (b or 1 or 0, voxels).
    """
    size = shape[0] * shape[1] * shape[2]
    panel = np.empty((max(shape), WIDEST), values.dtype)
    buffers = np.empty((2, size), values.dtype)
    for c in range(begin, end):
        u = values[starts[c] : starts[c] + size]
        result = out[starts[c] : starts[c] + size]
        for k in range(axes.size):
            axis = axes[k]
            target = result if k == axes.size - 1 else buffers[k % 2]
            own = c if factors[axis].shape[0] > 1 else 0
            along(
                axis, shape, factors[axis][own], firsts[axis][own], lasts[axis][own], panel, u,
                target,
            )  # fmt: skip
            u = target
        if gained.shape[0] > 0:
            own = c if gained.shape[0] > 1 else 0
            for i in range(size):
                result[i] += gained[own, i]


@kernel
def padding_of(strides):
    """How far a voxel's neighbours are from it, in a row of all voxels."""
    pad = 0
    for stride in strides:
        pad = max(pad, stride)
    return pad


@kernel
def exchanged(v, new, pad, strides, stay, ups, downs):
    """new = P v for one grid, but for what passes between opposite faces; v, new: (pad + voxels +
    pad,), 0 in the padding; stay: (voxels,), ups, downs: (axes, voxels), 0 at the faces."""
    size = stay.size
    for first in range(0, size, BLOCK):
        last = min(size, first + BLOCK)
        here, out, kept = (
            v[pad + first : pad + last],
            new[pad + first : pad + last],
            stay[first:last],
        )
        for i in range(last - first):
            out[i] = kept[i] * here[i]
        for a in range(strides.size):
            below = v[pad + first - strides[a] : pad + last - strides[a]]
            above = v[pad + first + strides[a] : pad + last + strides[a]]
            up, down = ups[a, first:last], downs[a, first:last]
            for i in range(last - first):
                out[i] = out[i] + up[i] * below[i] + down[i] * above[i]


@kernel(entry=True)
def mix(
    begin, end, starts, strides, stay, ups, downs, wrap_to, wrap_from, wraps, weights, terms,
    gained, values, out,
):  # fmt: skip
    """The grids begin … end of one shape after a step by the series, from values to out, (voxels,)
    of all colonies, each number in float64.

    starts: the first voxel of each grid. stay: (b or 1, voxels), ups, downs: (b or 1, axes, voxels)
    as `exchanged` takes them; wraps: (b or 1, W), the parts that pass from voxel wrap_from to
    wrap_to through periodic faces. weights: (b or 1, terms), of which a colony has `terms`, none
    where it is carried by another method. gained: (b or 1 or 0, voxels).
    """
    size, pad = stay.shape[1], padding_of(strides)
    buffers, total = np.zeros((2, size + 2 * pad)), np.empty(size)
    for c in range(begin, end):
        own = c if stay.shape[0] > 1 else 0
        weight = weights[own]
        if terms[own] == 0:
            continue
        v, new = buffers[0], buffers[1]
        for i in range(size):
            v[pad + i] = values[starts[c] + i]
            total[i] = weight[0] * v[pad + i]
        for k in range(1, terms[own]):
            exchanged(v, new, pad, strides, stay[own], ups[own], downs[own])
            for w in range(wrap_to.size):
                new[pad + wrap_to[w]] += wraps[own, w] * v[pad + wrap_from[w]]
            for i in range(size):
                total[i] += weight[k] * new[pad + i]
            v, new = new, v
        if gained.shape[0] > 0:
            more = gained[c if gained.shape[0] > 1 else 0]
            for i in range(size):
                total[i] += more[i]
        for i in range(size):
            out[starts[c] + i] = total[i]

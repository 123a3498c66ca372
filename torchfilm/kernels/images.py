"""Cells in a space that is periodic along some axes, see `physics.space`: images beyond the faces.

periods: (3,) µm, 0 along an axis that is not periodic.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.memory import room
from torchfilm.kernels.scheme import ENLARGED


@lean(inline=True)
def nearest(between, period):
    """The component of the way from one cell to the image of another that is nearest to it."""
    if period > 0.0:
        between -= period * math.floor(between / period + 0.5)
    return between


@kernel
def is_periodic(periods):
    return periods[0] > 0.0 or periods[1] > 0.0 or periods[2] > 0.0


@lean
def with_images(memory, x, axis, half, radius, periods, margin, dof):
    """The cells in a period about the first one, and those images above it that a cell in it may
    come nearer than margin: positions (m, d), which cell each is, and a bit for each axis along
    which it is moved by a period, (m,). The cells come first, as in the batch."""
    n, d = x.shape[0], 2 if len(dof) == 4 else 3
    base, side = room(memory, (n, d), np.float64), room(memory, (n, d), np.float64)
    most, many = room(memory, (d,), np.float64), 1
    for k in range(d):
        most[k] = 0.0
        for i in range(n):
            side[i, k] = abs(axis[i, k]) * half[i] + radius[i] + 0.5 * margin
            most[k] = max(most[k], side[i, k])
            base[i, k] = x[i, k]
            if periods[k] > 0.0:
                base[i, k] -= periods[k] * math.floor((x[i, k] - x[0, k]) / periods[k] + 0.5)
        many *= 2 if periods[k] > 0.0 else 1
    size = many * n
    y, cell = room(memory, (size, d), np.float64), room(memory, (size,), np.int32)
    way, count = room(memory, (size,), np.int64), 0
    for moved in range(1 << d):
        for i in range(n):
            meets = True
            for k in range(d):
                if moved >> k & 1:
                    reach = (side[i, k] + most[k]) * (1 + ENLARGED)
                    above = base[i, k] - x[0, k] + 0.5 * periods[k]
                    meets &= periods[k] > 0.0 and above <= reach
            if meets:
                for k in range(d):
                    y[count, k] = base[i, k] + periods[k] * (moved >> k & 1)
                cell[count], way[count] = i, moved
                count += 1
    return y[:count], cell[:count], way[:count]


@kernel
def of_images(memory, values, cell):
    """The numbers of the cells of images, (m,)."""
    out = room(memory, cell.shape, values.dtype)
    for p in range(cell.shape[0]):
        out[p] = values[cell[p]]
    return out


@kernel
def axes_of_images(memory, axis, cell, dof):
    """The axes of the cells of images, (m, d)."""
    d = 2 if len(dof) == 4 else 3
    out = room(memory, (cell.shape[0], d), np.float64)
    for p in range(cell.shape[0]):
        for k in range(d):
            out[p, k] = axis[cell[p], k]
    return out


@lean
def pairs_of_cells(first, second, y, cell, way, periods, dof):
    """The pairs of cells whose nearest images are these pairs, in place, each once and the lower
    cell first: of the pairs that differ by the same moves, that in which no two are moved along the
    same axis."""
    new = 0
    for r in range(first.shape[0]):
        p, q = first[r], second[r]
        if cell[p] > cell[q]:
            p, q = q, p
        i, j = cell[p], cell[q]
        keep = (way[p] & way[q]) == 0 and i != j
        for k in range(2 if len(dof) == 4 else 3):
            if periods[k] > 0.0:  # of the cells themselves, so that one of two images counts
                wanted = -math.floor((y[j, k] - y[i, k]) / periods[k] + 0.5)
                keep &= (way[q] >> k & 1) - (way[p] >> k & 1) == wanted
        first[new], second[new] = i, j
        new += keep
    return first[:new], second[:new]

"""The moves of cells: what resists them, how they are carried out, how near they bring others."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.rows import degrees
from torchfilm.kernels.scheme import MAX_TURN


@kernel
def drags(length, radius, viscosity, length_drag, growth, scale, dof):
    """M^(−½) of each cell, (n, D). A cell that does not grow is rigid: its length cannot move."""
    D = degrees(dof)
    d = 2 if D == 4 else 3
    for i in range(length.shape[0]):
        whole = length[i] + 2 * radius[i]
        across = 1.0 / math.sqrt(viscosity[i] * whole)
        turn = 1.0 / math.sqrt(viscosity[i] * whole * whole * whole / 12.0)
        for k in range(D - 1):
            scale[i, k] = across if k < d else turn
        scale[i, D - 1] = 1.0 / math.sqrt(length_drag[i]) if growth[i] > 0 else 0.0


@kernel
def rotate(axis, turn, angle):
    """Rotate a unit axis (d,) in place by a rotation vector, (3,), or (1,) in the plane, of this
    size."""
    sinc, versine = 1.0, 0.5
    if angle > 1e-4:
        sinc, versine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    ax, ay = axis[0], axis[1]
    if axis.shape[0] == 2:
        t = turn[0]
        bx, by = (
            ax - sinc * t * ay - versine * t * t * ax,
            ay + sinc * t * ax - versine * t * t * ay,
        )
        size = math.sqrt(bx * bx + by * by)
        axis[0], axis[1] = bx / size, by / size
    else:
        az = axis[2]
        tx, ty, tz = turn[0], turn[1], turn[2]
        ux, uy, uz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
        wx, wy, wz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
        bx = ax + sinc * ux + versine * wx
        by = ay + sinc * uy + versine * wy
        bz = az + sinc * uz + versine * wz
        size = math.sqrt(bx * bx + by * by + bz * bz)
        axis[0], axis[1], axis[2] = bx / size, by / size, bz / size


@kernel
def move_cells(x, axis, length, y, scale, about, bound, least, dof):
    """Carry out the move y, its translation at most `bound` from `about` (n, D), and its rotation
    at most `bound` at the ends. Returns how many were cut short."""
    D = degrees(dof)
    d = 2 if D == 4 else 3
    clipped = 0
    for i in range(x.shape[0]):
        way = 0.0
        for k in range(d):
            way += (y[i, k] * scale[i, k] - about[i, k]) ** 2
        part = bound / math.sqrt(way) if way > bound * bound else 1.0
        angle = 0.0
        for k in range(d, D - 1):
            angle += (y[i, k] * scale[i, k]) ** 2
        angle = math.sqrt(angle)
        most = min(2.0 * bound / max(length[i], 1e-9), MAX_TURN)
        turn = most / angle if angle > most else 1.0
        if part < 1.0 or turn < 1.0:
            clipped += 1
        for k in range(d):
            step = about[i, k] + part * (y[i, k] * scale[i, k] - about[i, k])
            y[i, k] = step
            x[i, k] += step
        for k in range(d, D - 1):
            y[i, k] *= turn * scale[i, k]
        y[i, D - 1] *= scale[i, D - 1]
        rotate(axis[i], y[i, d : D - 1], angle * turn)
        length[i] = max(length[i] + y[i, D - 1], least[i])
    return clipped


@kernel
def approach(x, length, radius, y, dof):
    """How much nearer, at most, any two cells can have come by the move y of `move_cells`, µm.

    Cells of a growing colony move far, but neighbours almost alike: they part in proportion to
    their distance, and the rest is what each moves by itself.
    """
    n, d, end = x.shape[0], 2 if len(dof) == 4 else 3, degrees(dof) - 1
    centre, mean, longest = np.zeros(d), np.zeros(d), 0.0
    for i in range(n):
        longest = max(longest, length[i] + 2 * radius[i])
        for k in range(d):
            centre[k] += x[i, k] / n
            mean[k] += y[i, k] / n
    along, square = 0.0, 1e-30
    for i in range(n):
        for k in range(d):
            away = x[i, k] - centre[k]
            along += away * (y[i, k] - mean[k])
            square += away * away
    stretch, own = along / square, 0.0
    for i in range(n):
        rest, turn = 0.0, 0.0
        for k in range(d):
            rest += (y[i, k] - mean[k] - stretch * (x[i, k] - centre[k])) ** 2
        for k in range(d, end):
            turn += y[i, k] ** 2
        half = 0.5 * (length[i] + abs(y[i, end]))
        own = max(own, math.sqrt(rest) + half * math.sqrt(turn) + 0.5 * abs(y[i, end]))
    return abs(stretch) * (longest + 2 * own) + 2 * own

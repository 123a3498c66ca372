"""The moves of cells: what resists them, how they are carried out, how near they bring others."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import lean
from torchfilm.kernels.memory import room, zeros
from torchfilm.kernels.rows import degrees
from torchfilm.kernels.scheme import MAX_TURN

# Rows of the scratch of a move: the move itself, and the position and axis on the way.
MOVE, AT, WAY = range(3)


@lean
def drags(length, radius, viscosity, length_drag, growth, slower, scale, dof):
    """M^(−½) of each cell, (n, D). A cell that does not grow is rigid: its length cannot move.
    slower: by this factor cells move and turn less easily."""
    D = degrees(dof)
    d = 2 if D == 4 else 3
    for i in range(length.shape[0]):
        whole = length[i] + 2 * radius[i]
        drag = slower * viscosity[i] * whole
        across = 1.0 / math.sqrt(drag)
        turn = 1.0 / math.sqrt(drag * whole * whole / 12.0)
        for k in range(D - 1):
            scale[i, k] = across if k < d else turn
        scale[i, D - 1] = 1.0 / math.sqrt(length_drag[i]) if growth[i] > 0 else 0.0


@lean(inline=True)
def rotate(axis, i, tx, ty, tz, angle, dof):
    """Rotate the unit axis of cell i, in place, by a rotation vector of this size; in the plane by
    the angle tx."""
    sinc, versine = 1.0, 0.5
    if angle > 1e-4:
        sinc, versine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    ax, ay = axis[i, 0], axis[i, 1]
    if len(dof) == 4:
        bx = ax - sinc * tx * ay - versine * tx * tx * ax
        by = ay + sinc * tx * ax - versine * tx * tx * ay
        size = math.sqrt(bx * bx + by * by)
        axis[i, 0], axis[i, 1] = bx / size, by / size
    else:
        az = axis[i, 2]
        ux, uy, uz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
        wx, wy, wz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
        bx = ax + sinc * ux + versine * wx
        by = ay + sinc * uy + versine * wy
        bz = az + sinc * uz + versine * wz
        size = math.sqrt(bx * bx + by * by + bz * bz)
        axis[i, 0], axis[i, 1], axis[i, 2] = bx / size, by / size, bz / size


@lean(inline=True)
def carry_out(x, axis, length, y, i, scratch, angle, least, dof):
    """Carry out the move of cell i, scratch[MOVE], in which it turns by `angle`; then y[i] is that
    move."""
    D = degrees(dof)
    d = 2 if D == 4 else 3
    for k in range(D):
        y[i, k] = scratch[MOVE, k]
    for k in range(d):
        x[i, k] += scratch[MOVE, k]
    ty, tz = (y[i, d + 1], y[i, d + 2]) if d == 3 else (0.0, 0.0)
    rotate(axis, i, y[i, d], ty, tz, angle, dof)
    length[i] = max(length[i] + y[i, D - 1], least)


@lean
def still_moving(about, i, last, y, scale, pushed, dof):
    """Put into about[i] the part of the last move of cell i that it still makes: the point between
    rest and that move that is nearest to its move y · scale. 0 where nothing was pushed."""
    d = 2 if len(dof) == 4 else 3
    along, square = 0.0, 0.0
    for k in range(d):
        along += y[i, k] * scale[i, k] * last[i, k]
        square += last[i, k] ** 2
    share = min(max(along / square, 0.0), 1.0) if pushed and square > 0 else 0.0
    for k in range(d):
        about[i, k] = share * last[i, k]


@lean
def bounded(y, i, scale, about, bound, length, scratch, dof):
    """Puts the move of cell i into scratch[MOVE]: its translation at most `bound` from `about`
    (n, D), and its rotation at most `bound` at the ends. Returns the angle, and whether it was cut
    short."""
    D = degrees(dof)
    d = 2 if D == 4 else 3
    way, angle = 0.0, 0.0
    for k in range(d):
        way += (y[i, k] * scale[i, k] - about[i, k]) ** 2
    part = bound / math.sqrt(way) if way > bound * bound else 1.0
    for k in range(d, D - 1):
        angle += (y[i, k] * scale[i, k]) ** 2
    angle = math.sqrt(angle)
    most = min(2.0 * bound / max(length, 1e-9), MAX_TURN)
    turn = most / angle if angle > most else 1.0
    for k in range(d):
        scratch[MOVE, k] = about[i, k] + part * (y[i, k] * scale[i, k] - about[i, k])
    for k in range(d, D - 1):
        scratch[MOVE, k] = y[i, k] * (turn * scale[i, k])
    scratch[MOVE, D - 1] = y[i, D - 1] * scale[i, D - 1]
    return angle * turn, part < 1.0 or turn < 1.0


@lean
def approach(memory, x, length, radius, periods, y, dof):
    """How much nearer, at most, cells can have come by the move y (n, D), µm: any two that
    are near, and what each adds to that, (n,).

    Cells of a growing colony move far, but neighbours almost alike: they part in proportion to
    their distance, and the rest is what each moves by itself. Not along an axis that is periodic,
    where neighbours may lie at opposite faces.
    """
    n, d, end = x.shape[0], 2 if len(dof) == 4 else 3, degrees(dof) - 1
    centre, mean = zeros(memory, (d,), np.float64), zeros(memory, (d,), np.float64)
    longest = 0.0
    for i in range(n):
        longest = max(longest, length[i] + 2 * radius[i])
        for k in range(d):
            centre[k] += x[i, k] / n
            mean[k] += y[i, k] / n
    along, square = 0.0, 1e-30
    for i in range(n):
        for k in range(d):
            away = x[i, k] - centre[k] if periods[k] == 0.0 else 0.0
            along += away * (y[i, k] - mean[k])
            square += away * away
    stretch, own, most = along / square, room(memory, (n,), np.float64), 0.0
    for i in range(n):
        rest, turn = 0.0, 0.0
        for k in range(d):
            away = x[i, k] - centre[k] if periods[k] == 0.0 else 0.0
            rest += (y[i, k] - mean[k] - stretch * away) ** 2
        for k in range(d, end):
            turn += y[i, k] ** 2
        half = 0.5 * (length[i] + abs(y[i, end]))
        own[i] = math.sqrt(rest) + half * math.sqrt(turn) + 0.5 * abs(y[i, end])
        most = max(most, own[i])
    return abs(stretch) * (longest + 2 * most), own

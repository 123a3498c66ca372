"""Cells that move by themselves, and rows that pull: of cells that stick together, or to walls,
see `physics.adhesion`.

given: levels (N, 2 K), reaches (K,), how far the cells have moved and turned by themselves in this
step, (N, d + turns), and what holds, (K, 1 + S) bool; of no cells where there is none of it.
bonds: levels (n, 2 K) and reaches (K,), where the cells are as the step begins: position (n, d),
axis (n, d) and half length (n,), all float64; and what holds.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.batch import put
from torchfilm.kernels.capsules import closest_points
from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.images import nearest
from torchfilm.kernels.memory import room
from torchfilm.kernels.moves import rotate
from torchfilm.kernels.rows import HARD, STIFF, degrees


@kernel
def drift_of(memory, of, given):
    """What the cells `of` have moved and turned by themselves, (n, d + turns), or (0, ·)."""
    drift = given[2]
    own = room(memory, (of.shape[0] if drift.shape[0] else 0, drift.shape[1]), np.float64)
    for i in range(own.shape[0]):
        for k in range(own.shape[1]):
            own[i, k] = drift[of[i], k]
    return own


@lean
def move_along(x, axis, drift, share, dof):
    """Carry out this share of the drift, in place."""
    d = 2 if len(dof) == 4 else 3
    for i in range(drift.shape[0]):
        for k in range(d):
            x[i, k] += share * drift[i, k]
        tx, ty, tz = share * drift[i, d], 0.0, 0.0
        if d == 3:
            ty, tz = share * drift[i, d + 1], share * drift[i, d + 2]
        rotate(axis, i, tx, ty, tz, math.sqrt(tx * tx + ty * ty + tz * tz), dof)


@lean
def bonds_of(memory, of, dt, given, x, axis, length, drift, dof):
    """The bonds of the cells `of`, with levels of stiffness · dt. x, axis: after the drift. length:
    (n,) before growth."""
    levels, reaches, _, holds = given
    n = of.shape[0] if reaches.shape[0] else 0
    own, half = room(memory, (n, levels.shape[1]), np.float64), room(memory, (n,), np.float64)
    for i in range(n):
        half[i] = 0.5 * length[i]
        for k in range(levels.shape[1]):
            own[i, k] = levels[of[i], k] * math.sqrt(dt)
    begin_x = room(memory, (n, x.shape[1]), np.float64)
    begin_axis = room(memory, (n, x.shape[1]), np.float64)
    if n:
        put(x, begin_x)
        put(axis, begin_axis)
        move_along(begin_x, begin_axis, drift, -1.0, dof)
    return own, reaches, begin_x, begin_axis, half, holds


@lean
def reach_of(bonds, drift, dof):
    """The gaps, µm, up to which cells may hold each other, and walls may hold cells, also where
    they have drifted apart."""
    reaches, half, holds, cells, walls, way = bonds[1], bonds[4], bonds[5], 0.0, 0.0, 0.0
    d = 2 if len(dof) == 4 else 3
    for k in range(reaches.shape[0]):
        if holds[k, 0]:
            cells = max(cells, reaches[k])
        if holds[k, 1:].any():
            walls = max(walls, reaches[k])
    for i in range(drift.shape[0] if reaches.shape[0] else 0):
        move, turn = 0.0, 0.0
        for k in range(drift.shape[1]):
            move += drift[i, k] * drift[i, k] if k < d else 0.0
            turn += drift[i, k] * drift[i, k] if k >= d else 0.0
        way = max(way, math.sqrt(move) + half[i] * math.sqrt(turn))
    return cells + 2.0 * way * (cells > 0), walls + way * (walls > 0)


@lean
def add_bonds(rows, first, end, x, axis, half, radius, periods, scale, bonds, alpha, dof):
    """Adds rows that pull, after the `end` rows of which those of pairs begin at `first`: one for
    each row at a contact whose cells stick together. Returns how many rows there are. alpha,
    radius: (n,)."""
    H, gaps, one, two, kind = rows
    new = end
    for r in range(first, end):
        if kind[r] != HARD:
            continue
        i, j = one[r], two[r]
        gap = _gap_at_begin(H, gaps, r, i, j, x, axis, half, scale, bonds, dof)
        stiffness = _stiffness(bonds, i, j, radius[i] + radius[j], periods, gap, dof)
        if stiffness == 0.0:
            continue
        root = math.sqrt(stiffness * 0.5 * (alpha[i] + alpha[j]))
        for k in range(len(dof)):
            H[2 * new, k], H[2 * new + 1, k] = -root * H[2 * r, k], -root * H[2 * r + 1, k]
        gaps[new], one[new], two[new], kind[new] = -root * gaps[r], i, j, STIFF
        new += 1
    return new


@lean
def _gap_at_begin(H, gaps, r, i, j, x, axis, half, scale, bonds, dof):
    """The gap of row r as the step began, µm, to first order in what has moved since."""
    gap = gaps[r]
    gap += _opened(H, 2 * r, i, x, axis, half, scale, bonds, dof)
    gap += _opened(H, 2 * r + 1, j, x, axis, half, scale, bonds, dof)
    return gap / _weight(H, 2 * r, i, scale, dof)


@lean
def _opened(H, h, i, x, axis, half, scale, bonds, dof):
    """How much one half of a row has closed its gap since the step began."""
    _, _, begin_x, begin_axis, begin_half, _ = bonds
    d, last = 2 if len(dof) == 4 else 3, degrees(dof) - 1
    ax, ay, bx, by = begin_axis[i, 0], begin_axis[i, 1], axis[i, 0], axis[i, 1]
    change = H[h, d + (0 if d == 2 else 2)] / scale[i, d] * (ax * by - ay * bx)
    if d == 3:
        az, bz = begin_axis[i, 2], axis[i, 2]
        change += H[h, d] / scale[i, d] * (ay * bz - az * by)
        change += H[h, d + 1] / scale[i, d] * (az * bx - ax * bz)
    for k in range(d):
        change += H[h, k] / scale[i, k] * (x[i, k] - begin_x[i, k])
    if scale[i, last] > 0:
        change += H[h, last] / scale[i, last] * 2.0 * (half[i] - begin_half[i])
    return change


@lean
def _stiffness(bonds, i, j, touching, periods, gap, dof):
    """Of the pair of cells i and j, whose radii are `touching`, in a row with this gap; both gaps
    as the step began."""
    levels, reaches, x, axis, half, holds = bonds
    bz, az, cz = 0.0, 0.0, 0.0
    if len(dof) == 8:
        bz, az, cz = nearest(x[j, 2] - x[i, 2], periods[2]), axis[i, 2], axis[j, 2]
    _, _, square = closest_points(
        nearest(x[j, 0] - x[i, 0], periods[0]), nearest(x[j, 1] - x[i, 1], periods[1]), bz,
        axis[i, 0], axis[i, 1], az, axis[j, 0], axis[j, 1], cz, half[i], half[j], dof,
    )  # fmt: skip
    widest, stiffness = max(gap, math.sqrt(square) - touching), 0.0
    for k in range(reaches.shape[0]):
        if holds[k, 0] and widest < reaches[k]:
            a, b = 2 * k, 2 * k + 1
            stiffness += levels[i, a] * levels[j, b] + levels[i, b] * levels[j, a]
    return stiffness


@lean
def add_wall_bonds(rows, first, end, x, axis, half, roots, scale, bonds, alpha, dof):
    """Adds rows that pull, after the `end` rows of which the `first` are of walls: one for each of
    these whose wall holds the cell. Returns how many rows there are. alpha: (n,). roots: (S, n) D
    of walls and cells."""
    H, gaps, one, two, kind = rows
    levels, reaches, _, _, _, holds = bonds
    new = end
    for r in range(first):
        i, w, stiffness = one[r], -1 - two[r], 0.0
        weight = _weight(H, 2 * r, i, scale, dof)
        gap = (gaps[r] + _opened(H, 2 * r, i, x, axis, half, scale, bonds, dof)) / weight
        for k in range(reaches.shape[0]):
            if holds[k, 1 + w] and gap < reaches[k]:
                stiffness += levels[i, 2 * k] * levels[i, 2 * k + 1]
        if stiffness == 0.0:
            continue
        root = math.sqrt(stiffness * alpha[i]) / roots[w, i]
        for k in range(len(dof)):
            H[2 * new, k], H[2 * new + 1, k] = -root * H[2 * r, k], 0.0
        gaps[new], one[new], two[new], kind[new] = -root * gaps[r], i, two[r], STIFF
        new += 1
    return new


@lean
def _weight(H, h, i, scale, dof):
    """D of a half of a row of cell i."""
    square = 0.0
    for k in range(2 if len(dof) == 4 else 3):
        square += (H[h, k] / scale[i, k]) ** 2
    return math.sqrt(square)


@lean
def room_of_bonds(reach, pairs, walls):
    """How many rows there may be of so many rows of pairs and of walls, with those that pull.
    reach: as `reach_of` says, above 0 where something holds."""
    return pairs * (2 if reach[0] > 0 else 1) + walls * (2 if reach[1] > 0 else 1)

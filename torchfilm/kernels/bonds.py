"""Rows that pull: of cells that stick together, see `physics.adhesion`.

bonds: levels (n, 2 K), reaches (K,), and where the cells are as the step begins: position (n, d),
axis (n, d) and half length (n,). All are float64.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.capsules import closest_points
from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.memory import room
from torchfilm.kernels.rows import HARD, STIFF


@kernel
def bonds_of(memory, of, dt, bonds, dof):
    """Of the cells `of`, in sub-steps of dt hours: with levels of stiffness · dt."""
    levels, reaches, x, axis, half = bonds
    n, d = of.shape[0], 2 if len(dof) == 4 else 3
    n = n if reaches.shape[0] else 0
    own, own_half = room(memory, (n, levels.shape[1]), np.float64), room(memory, (n,), np.float64)
    own_x, own_axis = room(memory, (n, d), np.float64), room(memory, (n, d), np.float64)
    for i in range(n):
        own_half[i] = half[of[i]]
        for k in range(d):
            own_x[i, k], own_axis[i, k] = x[of[i], k], axis[of[i], k]
        for k in range(levels.shape[1]):
            own[i, k] = levels[of[i], k] * math.sqrt(dt)
    return own, reaches, own_x, own_axis, own_half


@lean
def add_bonds(rows, first, end, radius, bonds, alpha, dof):
    """Adds rows that pull, after the `end` rows of which those of pairs begin at `first`: one for
    each row at a contact whose cells stick together. Returns how many rows there are. alpha,
    radius: (n,)."""
    H, gaps, one, two, kind = rows
    new = end
    for r in range(first, end):
        if kind[r] != HARD:
            continue
        i, j = one[r], two[r]
        stiffness = _stiffness(bonds, i, j, radius[i] + radius[j], dof)
        if stiffness == 0.0:
            continue
        root = math.sqrt(stiffness * 0.5 * (alpha[i] + alpha[j]))
        for k in range(len(dof)):
            H[2 * new, k], H[2 * new + 1, k] = -root * H[2 * r, k], -root * H[2 * r + 1, k]
        gaps[new], one[new], two[new], kind[new] = -root * gaps[r], i, j, STIFF
        new += 1
    return new


@lean
def _stiffness(bonds, i, j, touching, dof):
    """Of the pair of cells i and j, whose radii are `touching`."""
    levels, reaches, x, axis, half = bonds
    bz, az, cz = 0.0, 0.0, 0.0
    if len(dof) == 8:
        bz, az, cz = x[j, 2] - x[i, 2], axis[i, 2], axis[j, 2]
    _, _, square = closest_points(
        x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], bz, axis[i, 0], axis[i, 1], az,
        axis[j, 0], axis[j, 1], cz, half[i], half[j], dof,
    )  # fmt: skip
    gap, stiffness = math.sqrt(square) - touching, 0.0
    for k in range(reaches.shape[0]):
        if gap < reaches[k]:
            a, b = 2 * k, 2 * k + 1
            stiffness += levels[i, a] * levels[j, b] + levels[i, b] * levels[j, a]
    return stiffness

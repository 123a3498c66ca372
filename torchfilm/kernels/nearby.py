"""Pairs of cells whose surfaces are near each other, for rules."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.capsules import closest_points
from torchfilm.kernels.compiling import lean
from torchfilm.kernels.memory import TOP, give_back, zeros
from torchfilm.kernels.neighbours import near_pairs


@lean
def _gap(x, axis, half, radius, i, j, dof):
    """Between the surfaces of two cells, negative where they overlap."""
    bz, az, cz = 0.0, 0.0, 0.0
    if len(dof) != 4:
        bz, az, cz = x[j, 2] - x[i, 2], axis[i, 2], axis[j, 2]
    _, _, apart = closest_points(
        x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], bz, axis[i, 0], axis[i, 1], az,
        axis[j, 0], axis[j, 1], cz, half[i], half[j], dof,
    )  # fmt: skip
    return math.sqrt(apart) - radius[i] - radius[j]


@lean
def _are_finite(x, axis, half, radius):
    total = 0.0
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            total += 0.0 * (x[i, k] + axis[i, k])
        total += 0.0 * (half[i] + radius[i])
    return total == 0.0


@lean(entry=True)
def close_pairs(memory, begin, x, axis, half, radius, within, first, second, found, dof):
    """The pairs of cells of one colony whose surfaces are at most `within` apart, colony by colony,
    as many as there is room for, and in `found` (1,) how many there are. All float64."""
    none, count = zeros(memory, (3,), np.float64), 0
    top = memory[1][TOP]
    for b in range(begin.shape[0] - 1):
        low, high = begin[b], begin[b + 1]
        own = x[low:high], axis[low:high], half[low:high], radius[low:high]
        if high - low < 2 or not _are_finite(own[0], own[1], own[2], own[3]):
            continue
        give_back(memory, top)
        i, j = near_pairs(memory, own[0], own[1], own[2], own[3], none, within, dof)
        for k in range(i.shape[0]):
            one, other = low + i[k], low + j[k]
            if _gap(x, axis, half, radius, one, other, dof) <= within:
                if count < first.shape[0]:
                    first[count], second[count] = one, other
                count += 1
    found[0] = count

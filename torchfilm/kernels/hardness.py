"""How hard the contacts of a colony are, and what it takes from its settings."""

from __future__ import annotations

import math

from torchfilm.kernels.compiling import lean
from torchfilm.kernels.rows import HARD, degrees
from torchfilm.kernels.scheme import (
    HARDEST,
    MARGIN,
    MOST_FORCE,
    OVERLAP,
    PEAK,
    PEAKED,
    SOFTEST,
    UNMOVED,
)

# Places in the settings. DEEP: µm, or if below 0 in radii. YIELD: mean overlap, radii. PERIODS:
# the first of three, see `kernels.images`.
DEEP, TOLERANCE, MOST_PASSES, LIMIT, SOFT, YIELD, PERIODS = range(7)


@lean
def of_colony(base, growth, radius, drag, hardness, settings):
    """The margin, the overlap that is wanted, how deep is too deep, all µm, the α of the softest
    and of the hardest contacts with the most overlap that peaks may have, and the most passes. A
    colony without an α in `hardness` gets that of the softest."""
    viscosity, length_drag = drag
    wide, across, held, n = 0.0, 0.0, 0.0, base.shape[0]
    for i in range(n):
        wide += radius[i] / n
        across += viscosity[i] * (base[i] + growth[i] + 2 * radius[i]) / n
        held += length_drag[i] * max(growth[i], 0.0) / n
    deep = settings[DEEP] if settings[DEEP] > 0 else -settings[DEEP] * wide
    softest = SOFTEST * settings[YIELD] / OVERLAP / across
    target, hardest = settings[YIELD] * wide, HARDEST * softest
    if held > 0:
        hardest = min(hardest, UNMOVED * target / held)
    hardness[0] = hardness[0] if hardness[0] > 0 else softest
    passes = 1.0 if settings[SOFT] > 0 else settings[MOST_PASSES]
    limits = softest, hardest, max(PEAK * deep, PEAKED * target)
    return MARGIN * wide, target, deep, limits, passes


@lean
def most_force(y, scale, radius, growth, drag, reach, is_soft, dof):
    """What bounds the mean force of contacts, times Δt: the greatest force that growth may exert,
    and those that the scaled moves y need, of all cells together, since a wall may bear them all.
    Infinite where cells stick or walls are soft, since these push as well."""
    held, moved, d = 0.0, 0.0, 2 if len(dof) == 4 else 3
    for w in range(is_soft.shape[0]):
        held = math.inf if is_soft[w] else held
    held = math.inf if max(reach[0], reach[1]) > 0 else held
    for i in range(y.shape[0]):
        held = max(held, drag[1][i] * growth[i])
        push, turn = 0.0, 0.0
        for k in range(degrees(dof) - 1):
            own = (y[i, k] / scale[i, k]) ** 2
            push += own if k < d else 0.0
            turn += 0.0 if k < d else own
        moved += math.sqrt(push) + math.sqrt(turn) / radius[i]
    return held + moved


@lean
def following(e, rows, hardness, target, limits, most):
    """α at which the mean overlap of the contacts that push, all of them and those between cells,
    is at most `target`, µm, and that of the eighth powers the third of the limits: harder at once,
    softer by a factor of two a step. But no contacts are so hard that with their overlaps as they
    are the mean force were more than MOST_FORCE times `most`. Rows at the ends of
    stretches do not count."""
    total, count, peaks, between, pairs = 0.0, 0, 0.0, 0.0, 0
    softest, hardest, highest = limits
    for r in range(e.shape[0]):
        pushes = (e[r] < 0) & (rows[4][r] == HARD)
        own = -e[r] if pushes else 0.0  # without branches: their outcome is not foreseen
        total += own
        between += own if rows[3][r] >= 0 else 0.0
        pairs += pushes & (rows[3][r] >= 0)
        part = (own / highest) ** 2
        part *= part
        peaks += part * part
        count += pushes
    wanted = softest
    if count:
        overlap = max(total / count, between / max(pairs, 1))
        peak = math.sqrt(math.sqrt(math.sqrt(max(peaks / count, 1e-300))))
        if overlap > 0:
            wanted = min(hardness * target / overlap, hardness / peak)
            bound = MOST_FORCE * most
            wanted = min(max(wanted, overlap / bound) if bound > 0 else softest, softest)
    return max(min(wanted, 2.0 * hardness), hardest)

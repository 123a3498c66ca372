"""The colours of categories."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

# An integer quantity with at most this many values is a category. These are the colours of 0, 1, …
# (of Okabe and Ito, and one of Tol, distinct for colour-blind readers): a type keeps its colour
# where others die. Types of cells are categories up to MOST_TYPES.
KINDS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#661100")
MOST_TYPES = 24
GOLDEN = 0.618034  # of a turn, from one hue to the next
# Saturation and value, in turn: with the hues they tell sixty numbers apart, by a ΔE of 8 and more.
SHADES = ((0.9, 0.95), (0.6, 0.9), (0.35, 0.85), (0.9, 0.75), (0.6, 0.6))
APART = 0.45  # of a colour that is not listed from all others, as red, green and blue


def colours_of_kinds(kinds: Sequence[int], keep: bool = False) -> list[Any]:
    """The colours of categories, by their numbers: those listed, and for others hues that are apart
    from these. keep: each number has one colour, whatever else there is."""
    if keep:
        known = colours_of_kinds(range(MOST_TYPES))
        each = (known[k] if 0 <= k < MOST_TYPES else colour_of_kind(k, 0) for k in kinds)
        return list(each)
    found = {k: colour_of_kind(k, 0) for k in kinds if 0 <= k < len(KINDS)}
    for kind in kinds:
        if kind not in found:
            made = [colour_of_kind(kind, k) for k in range(12)]
            far = [min((math.dist(c, x) for x in found.values()), default=1.0) for c in made]
            good = (c for c, x in zip(made, far, strict=True) if x >= APART)
            found[kind] = next(good, made[int(np.argmax(far))])
    return [found[kind] for kind in kinds]


def colours_by_number(numbers: np.ndarray) -> np.ndarray:
    """Red, green and blue (N, 3) of any integers (N,), by each of them alone. The hues of numbers
    that follow each other are far apart; of more than sixty, some look alike."""
    from matplotlib.colors import hsv_to_rgb, to_rgb

    kinds, of = np.unique(numbers, return_inverse=True)
    hue, shade = kinds * GOLDEN % 1.0, np.array(SHADES)[kinds % len(SHADES)]
    found = hsv_to_rgb(np.column_stack([hue, shade]))
    first = (kinds >= 0) & (kinds < len(KINDS))
    found[first] = np.array([to_rgb(KINDS[k]) for k in kinds[first]]).reshape(-1, 3)
    return found[of.reshape(-1)]


def colour_of_kind(kind: int, turns: int) -> tuple[float, ...]:
    """The colour of a category, by its number alone, or another one, so many hues further."""
    from matplotlib.colors import hsv_to_rgb, to_rgb

    if 0 <= kind < len(KINDS) and not turns:
        return to_rgb(KINDS[kind])
    hue = (kind * GOLDEN + turns / 12) % 1.0
    return tuple(hsv_to_rgb((hue, 0.6, (0.9, 0.6)[kind % 2])).tolist())

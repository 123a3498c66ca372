"""Designs that no other exceeds in all goals."""

from __future__ import annotations

import numpy as np


def nondominated(goals: np.ndarray) -> np.ndarray:
    """The rows of losses (n, G) that no other row exceeds: none is as low in all goals and lower
    in one. In order of the first goal; of equal rows the first. Rows with NaN, of designs that
    failed, are left out."""
    order = np.lexsort(goals.T[::-1])
    out: list[int] = []
    for row in order:
        mine = goals[row]
        if not np.isnan(mine).any() and not any((goals[k] <= mine).all() for k in out):
            out.append(int(row))
    return np.array(out, dtype=np.int64)


def spread(goals: np.ndarray, count: int) -> np.ndarray:
    """`count` rows of a front (F, G), all rows where it has no more: the two ends, then always the
    row that is farthest from those chosen, each goal as a share of its range. In order."""
    if len(goals) <= count:
        return np.arange(len(goals))
    wide = np.ptp(goals, axis=0)
    scaled = goals / np.where(wide > 0, wide, 1.0)
    chosen = [0, len(goals) - 1][:count]
    while len(chosen) < count:
        away = np.abs(scaled[:, None] - scaled[chosen]).max(2).min(1)
        chosen.append(int(away.argmax()))
    return np.array(sorted(chosen))

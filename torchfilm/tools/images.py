"""Which images of places on a periodic axis are seen in a window."""

from __future__ import annotations

import math

import numpy as np


def images_seen(
    x: np.ndarray, reach: np.ndarray, period: float, low: float, high: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which places (M,) have an image beside themselves, and how far away, (M,) µm: every `period`
    µm, where it reaches into the window from low to high. x, reach: (N,) µm."""
    which, away = [np.zeros(0, np.int64)], [np.zeros(0)]
    if len(x):
        first = math.floor((low - x.max() - reach.max()) / period)
        last = math.ceil((high - x.min() + reach.max()) / period)
        for shift in (turn * period for turn in range(first, last + 1) if turn):
            (seen,) = np.nonzero((x + shift + reach > low) & (x + shift - reach < high))
            which.append(seen)
            away.append(np.full(len(seen), shift))
    return np.concatenate(which), np.concatenate(away)

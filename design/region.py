"""Where simulations of a later round of inference lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BEYOND = 0.01  # share of the samples on either side of a region, before its margin
MARGIN = 0.25  # of the width between these, on either side
LEAST = 1e-3  # width: where the data lie beyond the bounds, all samples lie at one


@dataclass(frozen=True, eq=False)
class Region:
    """A box in the unit cube of the parameters.

    low, high: (D,) coordinates. start: the number of the first simulation in it.
    """

    low: np.ndarray
    high: np.ndarray
    start: int = 0

    @staticmethod
    def whole(size: int) -> Region:
        """The unit cube."""
        return Region(np.zeros(size), np.ones(size))

    @property
    def is_whole(self) -> bool:
        return bool((self.low == 0.0).all() and (self.high == 1.0).all())

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which designs (…, D) lie within, (…) bool."""
        within = (points >= self.low) & (points <= self.high)
        return np.asarray(within.all(-1))

    def around(self, samples: np.ndarray, dimensions: Sequence[int], start: int) -> Region:
        """The part of this region that holds nearly all samples (n, D), with a margin. Only the
        given dimensions narrow; the values of others have no order."""
        low, high = self.low.copy(), self.high.copy()
        for k in dimensions:
            first, last = np.quantile(samples[:, k], [BEYOND, 1.0 - BEYOND])
            margin = MARGIN * (last - first)
            # not beyond the region before, from which it may keep only LEAST
            least = min(LEAST, high[k] - low[k])
            middle = np.clip(0.5 * (first + last), low[k] + 0.5 * least, high[k] - 0.5 * least)
            low[k] = max(low[k], min(first - margin, middle - 0.5 * least))
            high[k] = min(high[k], max(last + margin, middle + 0.5 * least))
        return Region(low, high, start)

    def widen(self, points: np.ndarray) -> np.ndarray:
        """Coordinates of designs as shares of the region, in [0, 1]."""
        return (points - self.low) / (self.high - self.low)

    def narrow(self, shares: np.ndarray) -> np.ndarray:
        """The inverse of `widen`, within the region."""
        # rounding may lead beyond
        return np.clip(self.low + (self.high - self.low) * shares, self.low, self.high)

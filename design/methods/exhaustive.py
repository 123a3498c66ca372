"""Every design of a space in which there are few."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from design.methods.base import AskTell, Batch, Dimensions
from torchfilm import checks

MOST = 100_000  # designs


@dataclass(kw_only=True, eq=False)
class Exhaustive(AskTell):
    """Every design of a space once: for choices and whole numbers alone. The search then ends, and
    its finals take all that is left of the budget, up to 0.9 of it, whatever their share.

    batch: designs in a batch. Choices that exclude each other (`resolve`) make some designs twice.
    Raises InputError for a parameter without levels, and for more than 100,000 designs.
    """

    batch: int = 64

    def __post_init__(self) -> None:
        self.batch = checks.integer("Exhaustive.batch", self.batch, least=1)

    @property
    def over(self) -> bool:
        """Whether all designs have been grown."""
        return self._done >= designs_of(self._started())

    def _begin(self) -> None:
        space, self._done = self._started(), 0
        count = designs_of(space)
        if not math.isfinite(count):
            raise checks.input_error(
                "method",
                "exhaustive",
                "for choices and whole numbers alone",
                'Another is "racing".',
            )
        if count > MOST:
            raise checks.input_error(
                "method", "exhaustive", f"for at most {MOST:,} designs", f"There are {count:,.0f}."
            )
        # in an order in which neighbours are far apart: a budget may end before all
        self._order = np.random.default_rng(self._seed).permutation(int(count))

    def _next(self) -> Batch:
        levels = [int(n or 1) for n in self._started().levels]
        chosen = self._order[self._done : self._done + self.batch]
        places = np.stack(np.unravel_index(chosen, levels), 1)
        return Batch((places + 0.5) / np.array(levels))

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        self._done += len(batch.points)


def designs_of(space: Dimensions) -> float:
    """How many designs a space has; infinity where a parameter has no levels."""
    return math.prod(math.inf if n is None else float(n) for n in space.levels)

"""Sobol sequence: points that fill the space evenly, without learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design.methods.base import AskTell, Batch, sobol_points
from torchfilm import checks


@dataclass(kw_only=True, eq=False)
class Sobol(AskTell):
    """Points of a scrambled Sobol sequence (Owen 1998; scipy.stats.qmc): the baseline of every
    other method, and a map of the whole space.

    batch: points in a batch, any number; the sequence continues from batch to batch.
    """

    batch: int = 64

    def __post_init__(self) -> None:
        self.batch = checks.integer("Sobol.batch", self.batch, least=1)

    @property
    def wanted(self) -> int:
        return self.batch

    @property
    def fresh(self) -> bool:
        return False

    def draw(self, count: int) -> np.ndarray:
        points = sobol_points(self._started(), self._seed, self._drawn, count)
        self._drawn += count
        return points

    def take(self, rows: np.ndarray, loss: np.ndarray) -> None:
        """Does nothing: the method does not learn."""

    def _begin(self) -> None:
        self._drawn = 0

    def _next(self) -> Batch:
        return Batch(self.draw(self.batch))

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        pass

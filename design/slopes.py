"""Derivatives of losses, as search methods get them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives of losses by the coordinates in [0, 1], 0 by those with levels.

    gradient (n, D), of the loss. curvature (n, D, D): Gauss and Newton's, 2 JᵀJ of the target's
    residuals; NaN where the target has none.
    """

    gradient: np.ndarray
    curvature: np.ndarray

    @staticmethod
    def none(count: int, size: int) -> Slopes:
        """Of colonies that nothing is known of."""
        return Slopes(np.zeros((count, size)), np.full((count, size, size), np.nan))

    @staticmethod
    def unknown(count: int, size: int) -> Slopes:
        """Of colonies whose slopes cannot be known: NaN, at which a descent ends."""
        return Slopes(np.full((count, size), np.nan), np.full((count, size, size), np.nan))

    def put(self, rows: Sequence[int], other: Slopes) -> None:
        """Write those of some colonies."""
        self.gradient[rows], self.curvature[rows] = other.gradient, other.curvature

    def reduced(self, weight: np.ndarray) -> Slopes:
        """Of n designs, from those of n · R colonies with weights (n, R)."""
        n, r = weight.shape
        size = self.gradient.shape[1]
        each = weight[:, :, None]
        counted = lambda w, x: np.where(w > 0, w * x, 0.0).sum(1)  # also where x is no number
        gradient = counted(each, self.gradient.reshape(n, r, size))
        curvature = counted(each[..., None], self.curvature.reshape(n, r, size, size))
        return Slopes(gradient, curvature)


def joined(parts: Sequence[Slopes | None]) -> Slopes:
    """The slopes of several groups of colonies, one after the other."""
    given = [part for part in parts if part is not None]
    return Slopes(
        np.concatenate([part.gradient for part in given]),
        np.concatenate([part.curvature for part in given]),
    )

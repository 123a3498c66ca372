"""One batch of a search, and its results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from design.parameters import Value
from design.slopes import Slopes, joined


@dataclass(frozen=True, eq=False)
class Entry:
    """One batch and its results.

    points (n, D); loss (n,); losses and cells (n, R); reasons of failures, by (row, replicate);
    size: share of the full size; seconds: that they took to grow; values: the parameters of each
    point; streams (R,): of random numbers, one for each replicate. slopes: where the method asked
    for them; copies: colonies that were grown for each loss: more than 1 for its derivatives, 0
    where it was known before; goals (n, G): the losses of several targets side by side, NaN for a
    design that failed; each_goals (n, R, G): those of each replicate. choosing: seconds that the
    method took to propose them. residuals (n, K): where the method asked for them, NaN for a design
    that failed; None where all did.
    """

    points: np.ndarray
    loss: np.ndarray
    losses: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    size: float
    seconds: float
    values: Sequence[dict[str, Value]]
    streams: tuple[int, ...]
    slopes: Slopes | None = None
    copies: int = 1
    goals: np.ndarray | None = None
    each_goals: np.ndarray | None = None
    choosing: float = 0.0
    residuals: np.ndarray | None = None

    @property
    def replicates(self) -> int:
        """How many colonies each design has."""
        return len(self.streams)

    @property
    def target_losses(self) -> np.ndarray:
        """What a method learns: the losses (n,), or those of several targets (n, G)."""
        return self.loss if self.goals is None else self.goals

    @property
    def colonies(self) -> float:
        """Colonies simulated; one of another size counts as its share of the full size."""
        return len(self.points) * self.replicates * self.size * self.copies

    def followed_by(self, other: Entry) -> Entry:
        """This batch with further designs, grown in the same way."""
        join = lambda name: np.concatenate([getattr(self, name), getattr(other, name)])
        rows = len(self.points)
        return replace(
            self,
            points=join("points"),
            loss=join("loss"),
            losses=join("losses"),
            cells=join("cells"),
            reasons=self.reasons | {(r + rows, k): w for (r, k), w in other.reasons.items()},
            seconds=self.seconds + other.seconds,
            values=[*self.values, *other.values],
            goals=None if self.goals is None else join("goals"),
            each_goals=None if self.each_goals is None else join("each_goals"),
            slopes=None if self.slopes is None else joined([self.slopes, other.slopes]),
            residuals=joined_residuals([(e.residuals, e.loss.shape) for e in (self, other)]),
        )


def joined_residuals(
    parts: Sequence[tuple[np.ndarray | None, tuple[int, ...]]],
) -> np.ndarray | None:
    """The residuals of several groups of designs one after the other, from those of each and the
    shape of its losses: NaN where all of a group failed; None where all did."""
    known = next((x for x, _ in parts if x is not None), None)
    if known is None:
        return None
    fill = lambda shape: np.full((*shape, known.shape[-1]), np.nan)
    return np.concatenate([fill(shape) if x is None else x for x, shape in parts])

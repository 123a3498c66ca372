"""Racing: small cheap colonies first, and only the promising designs at full size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import kendalltau

from design.methods.base import AskTell, Batch, Source
from design.methods.cmaes import CMAES
from torchfilm import checks

# How fast the trust in small colonies follows the agreement in the last races.
RATE = 0.2


@dataclass(kw_only=True, eq=False)
class Racing(AskTell):
    """Draws more points than another method needs, grows them as small colonies, and keeps the best
    at each size.

    inner: the method that draws the points and learns from those grown to full size, CMAES,
    Bayesian or Sobol; None is CMAES(). sizes: shares of the full size, rising, the last 1. keep:
    the share of the points that continues from one size to the next. small: replicates at all sizes
    but the last. agree: the race is skipped where the order of the finalists in small and full
    colonies agrees less than this (Kendall's tau, smoothed over races, from 1). Then as many points
    as `inner` needs are grown to full size at once. -1 never skips. Where small colonies all have
    one loss, as where the pattern does not fit into them, there is no race any more. A new cloud of
    CMAES trusts small colonies again; a model does not. first: finalists of a race from which a
    cloud or a model is to begin, since the best of them counts most there; before them, `keep`
    chooses among full colonies of `small` replicates. A cloud that needs no more losses has a race
    like all others.

    A race is one bracket of successive halving (Jamieson and Talwalkar, AISTATS 2016), and a
    pre-selection for CMA-ES (Ulmer, Streichert and Zell, CEC 2003): all points come from the
    present cloud, and the method learns only the losses of full colonies. If small colonies say
    nothing about full ones, the finalists are a random part of the cloud: the step is that of
    CMA-ES, and only the small colonies are lost. If they mislead, `agree` stops the races. Brackets
    across generations are not used: a point from an earlier cloud says little about the present
    one.
    """

    inner: Source | None = None
    sizes: Sequence[float] = (0.25, 1.0)
    keep: float = 0.33
    small: int = 1
    agree: float = 0.1
    first: int = 5

    def __post_init__(self) -> None:
        self._source: Source = CMAES() if self.inner is None else self.inner
        self.inner = self._source
        if isinstance(self.inner, type) or not all(
            hasattr(type(self.inner), name) for name in ("wanted", "fresh", "draw", "take")
        ):
            raise checks.input_error(
                "Racing.inner",
                self.inner,
                "a method that can draw more points than it needs: CMAES(), Bayesian() or Sobol()",
            )
        self.sizes = checks.vector("Racing.sizes", self.sizes)
        if (
            len(self.sizes) < 2
            or self.sizes[0] <= 0
            or self.sizes[-1] != 1
            or any(a >= b for a, b in zip(self.sizes, self.sizes[1:], strict=False))
        ):
            raise checks.input_error(
                "Racing.sizes",
                self.sizes,
                "two or more rising shares above 0, the last of them 1, such as (0.25, 1)",
            )
        checks.number("Racing.keep", self.keep, least=0.01, most=0.99)
        self.small = checks.integer("Racing.small", self.small, least=1)
        checks.number("Racing.agree", self.agree, least=-1.0, most=1.0)
        self.first = checks.integer("Racing.first", self.first, least=2)

    def _begin(self) -> None:
        self._source.start(self._started(), self._seed, self._replicates)
        self._trust = 1.0
        self._open()

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The method inside learns them."""
        know = getattr(self._source, "know", None)
        if know is not None:
            know(points, loss)

    def _open(self) -> None:
        """Prepare the next race: no points drawn, none left."""
        self._rung = 0
        self._points = np.empty((0, self._started().size))
        self._left = np.empty(0, dtype=np.int64)
        self._early: np.ndarray | None = None  # losses of all drawn points, at the first size

    def recall(self, points: np.ndarray | None) -> None:
        """For a method inside that draws slowly: the points of a race that is about to begin."""
        recall = getattr(self._source, "recall", None)
        if recall is not None:
            recall(None if len(self._left) else points)

    def _plan(self) -> None:
        """The rungs of a race, each a size, replicates and how many points."""
        small, last = min(self.small, self._replicates), self._source.wanted
        rungs: list[tuple[float, int | None]] = [(size, small) for size in self.sizes[:-1]]
        if self._source.fresh:
            self._trust = 1.0
            if small == self._replicates:
                last = min(last, _before(self.first, self.keep))
            elif last > self.first:
                rungs.append((1.0, small))
                last = self.first
        rungs.append((1.0, None))
        counts = [last]
        while len(counts) < len(rungs):
            counts.insert(0, _before(last, self.keep ** len(counts)))
        self._rungs = [(*rung, count) for rung, count in zip(rungs, counts, strict=True)]
        if self._trust < self.agree:
            self._rungs = self._rungs[-1:]

    def _next(self) -> Batch:
        if not len(self._left):
            self._plan()
            self._points = self._source.draw(self._rungs[0][2])
            self._left = np.arange(len(self._points))
        size, replicates, _ = self._rungs[self._rung]
        return Batch(self._points[self._left], size=size, replicates=replicates)

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        if self._rung < len(self._rungs) - 1:
            if self._early is None:
                self._early = loss
            if np.ptp(loss) == 0:  # they say nothing: no further race of this cloud
                self._trust = -1.0
            self._rung += 1
            best = np.argsort(loss, kind="stable")[: self._rungs[self._rung][2]]
            self._left = self._left[np.sort(best)]
            return
        if self._early is not None and len(loss) > 1:
            found = float(kendalltau(self._early[self._left], loss).statistic)
            # NaN where all are equal, as where all failed: that says nothing
            if math.isfinite(found):
                self._trust += RATE * (found - self._trust)
        self._source.take(self._left, loss)
        self._open()


def _before(count: int, keep: float) -> int:
    """How many points, of which a share is kept, leave so many."""
    return math.ceil(count / keep - 1e-9)

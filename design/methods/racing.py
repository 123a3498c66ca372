"""Small cheap colonies first; only the promising designs are grown to full size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import kendalltau

from design.methods.base import Batch, Source, Turns, whole
from design.methods.cmaes import CMAES
from torchfilm import checks

# How fast the trust in small colonies follows what the last races showed.
RATE = 0.2


@dataclass(kw_only=True, eq=False)
class Racing(Turns):
    """Draws more points than another method wants, grows them as small colonies, and goes on at
    each size with the best of them.

    inner: the method that draws the points and learns from those that were grown in full, CMAES or
    Sobol; None is CMAES(). sizes: shares of the full size, rising, the last 1. keep: the share of
    the points that goes on from one size to the next. small: replicates grown at all sizes but the
    last. agree: the race is left out, and as many points as `inner` wants are grown in full at
    once, where small and full colonies agree less than this about the order of the finalists
    (Kendall's tau, smoothed over races, from 1). -1 races always. A new cloud of CMAES trusts small
    colonies again.

    One race is one bracket of successive halving (Jamieson and Talwalkar, AISTATS 2016), and what
    it hands to CMA-ES a pre-selection (Ulmer, Streichert and Zell, CEC 2003): all points come from
    the present cloud, and the method hears only losses of full colonies. Should small colonies tell
    nothing, the finalists are a random part of the cloud, so the step is CMA-ES's own and only the
    price of the small colonies is lost; should they mislead, `agree` ends it. Brackets across
    generations were not taken: a point that was drawn from an earlier cloud says little about the
    present one.
    """

    inner: Source | None = None
    sizes: Sequence[float] = (0.25, 1.0)
    keep: float = 0.33
    small: int = 1
    agree: float = 0.1

    def __post_init__(self) -> None:
        self._source: Source = CMAES() if self.inner is None else self.inner
        self.inner = self._source
        if isinstance(self.inner, type) or not all(
            hasattr(type(self.inner), name) for name in ("wanted", "fresh", "draw", "take")
        ):
            raise checks.input_error(
                "Racing.inner",
                self.inner,
                "a method whose points can be sieved, such as CMAES() or Sobol()",
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
        whole("Racing.small", self.small, least=1)
        checks.number("Racing.agree", self.agree, least=-1.0, most=1.0)

    def _begin(self) -> None:
        self._source.start(self._started(), self._seed, self._replicates)
        self._trust = 1.0
        self._open()

    def _open(self) -> None:
        """Make ready for the next race: nothing drawn, nobody left in it."""
        self._rung = 0
        self._points = np.empty((0, self._started().size))
        self._left = np.empty(0, dtype=np.int64)
        self._early: np.ndarray | None = None  # losses of all that were drawn, at the first size

    @property
    def _last(self) -> int:
        return len(self.sizes) - 1

    def _count(self, rung: int) -> int:
        """How many run at a size, so that as many as are wanted arrive at the last."""
        return math.ceil(self._source.wanted / self.keep ** (self._last - rung) - 1e-9)

    def _next(self) -> Batch:
        if not len(self._left):
            if self._source.fresh:
                self._trust = 1.0
            if self._trust < self.agree:
                self._rung = self._last
            self._points = self._source.draw(self._count(self._rung))
            self._left = np.arange(len(self._points))
        return Batch(
            self._points[self._left],
            size=self.sizes[self._rung],
            replicates=min(self.small, self._replicates) if self._rung < self._last else None,
        )

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        if self._rung < self._last:
            if self._early is None:
                self._early = loss
            self._rung += 1
            best = np.argsort(loss, kind="stable")[: self._count(self._rung)]
            self._left = self._left[np.sort(best)]
            return
        if self._early is not None:
            found = float(kendalltau(self._early[self._left], loss).statistic)
            # not a number where all are equal, as where all failed: nothing is known
            if math.isfinite(found):
                self._trust += RATE * (found - self._trust)
        self._source.take(self._left, loss)
        self._open()

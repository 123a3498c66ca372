"""Polishing: another method first, then the way down from its best designs, by derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from design.methods.base import AskTell, Batch, Method
from design.methods.local import Local, near, unlike
from design.methods.racing import Racing
from design.slopes import Slopes
from torchfilm import checks

OPTIONS = 6  # combinations of levels, each of which has a descent of its own


@dataclass(kw_only=True, eq=False)
class Polish(AskTell):
    """Searches with another method, and then follows gradients from its best designs.

    inner: the method that searches first; None is Racing(). after: designs that it grows before, in
    units of full colonies with all replicates; one at least is grown to full size. starts: the best
    of them, no two alike, from which `Local` descends side by side. Where all descents have ended,
    `inner` goes on. again: descend also from the best with each combination of few options, and
    again after as many further designs, from the best that are unlike all starts before.

    CMA-ES and racing find the valley; its floor is a matter of the last digits of several
    parameters at once, and a slope knows all of these. Derivatives cost colonies (see `Local`), so
    this is worth while where they are exact.
    """

    inner: Method | None = None
    after: int = 24
    starts: int = 3
    again: bool = False

    def __post_init__(self) -> None:
        self.inner = self._inner = Racing() if self.inner is None else self.inner
        if isinstance(self.inner, type) or not all(
            callable(getattr(self.inner, name, None)) for name in ("start", "ask", "tell")
        ):
            raise checks.input_error("Polish.inner", self.inner, "a method, such as Racing()")
        if getattr(self.inner, "several", False):
            raise checks.input_error("Polish.inner", self.inner, "a method for one target")
        if getattr(self.inner, "squares", False):
            raise checks.input_error("Polish.inner", self.inner, "a method that needs losses alone")
        self.after = checks.integer("Polish.after", self.after, least=1)
        self.starts = checks.integer("Polish.starts", self.starts, least=1)

    def describe(self) -> str:
        return super().describe().replace(", again=False", "")  # as older studies have it

    def _begin(self) -> None:
        self._inner.start(self._started(), self._seed, self._replicates)
        self._local = Local(starts=self.starts)
        self._local.start(self._started(), self._seed, self._replicates)
        self._spent, self._descending, self._over = 0.0, False, False
        self._due = float(self.after)
        self._begun = np.empty((0, self._started().size))  # starts of descents so far
        self._points = np.empty((0, self._started().size))
        self._loss = np.empty(0)
        self._whole = True  # the last batch inside: no race is half-way

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The method inside learns them, and descents may begin there."""
        know = getattr(self._inner, "know", None)
        if know is not None:
            know(points, loss)
        self._keep(points, loss)

    def recall(self, points: np.ndarray | None) -> None:
        """For a method inside that draws slowly: the points of its next batch."""
        recall = getattr(self._inner, "recall", None)
        if recall is not None:
            recall(points)

    def _keep(self, points: np.ndarray, loss: np.ndarray) -> None:
        self._points = np.concatenate([self._points, points])
        self._loss = np.concatenate([self._loss, loss])

    def _next(self) -> Batch:
        due = self._spent >= self._due and self._whole and not self._over
        if due and not self._descending and (best := self._starts()):
            self._begun = np.concatenate([self._begun, self._points[best]])
            self._local.know(self._points[best], self._loss[best])
            self._descending = True
        if self._descending and self._local.idle:
            self._descending, self._over = False, not self.again
            self._due = self._spent + self.after
        return self._local.ask() if self._descending else self._inner.ask()

    def _starts(self) -> list[int]:
        """The designs from which descents begin, the rows of all so far."""
        fresh = np.array([k for k, p in enumerate(self._points) if not near(p, self._begun)], int)
        points, loss = self._points[fresh], self._loss[fresh]
        best = unlike(points, loss, self.starts)
        levels = self._started().levels
        options = [k for k, count in enumerate(levels) if count is not None]
        count = math.prod(levels[k] or 1 for k in options)
        if self.again and options and count <= OPTIONS:
            # a descent keeps its options: the best design may have the wrong ones
            sizes = np.array([levels[k] for k in options])
            taken = np.minimum(points[:, options] * sizes, sizes - 1).astype(int)
            seen = {tuple(taken[k]) for k in best}
            for k in np.argsort(loss, kind="stable"):
                if tuple(taken[k]) not in seen:
                    seen.add(tuple(taken[k]))
                    best.append(int(k))
        return fresh[best].tolist()

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        if self._descending:
            self._local.tell(batch, loss)
        else:
            self._count(batch, loss)
            self._inner.tell(batch, loss)

    def _count(self, batch: Batch, loss: np.ndarray) -> None:
        """Count what `inner` grows, and keep its designs where they may be starts."""
        replicates = min(batch.replicates or self._replicates, self._replicates)
        self._spent += len(batch.points) * batch.size * replicates / self._replicates
        self._whole = batch.size == 1 and replicates == self._replicates
        if self._whole:
            self._keep(batch.points, loss)

    def _descend(self, loss: np.ndarray, slopes: Slopes) -> None:
        batch = self.ask()
        if self._descending:
            self._local.tell(batch, loss, slopes)
        else:  # a method inside that asks for slopes, too
            self._count(batch, loss)
            self._inner.tell(batch, loss, slopes)  # type: ignore[call-arg]

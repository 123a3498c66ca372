"""Least squares without derivatives: Gauss and Newton's steps, with slopes learnt by regression."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from design.methods.base import AskTell, Batch, snap, sobol_points
from torchfilm import checks

# Sobol designs of a start, and designs near the best from which slopes are learnt, for each
# coefficient of a regression; the fewest of both
OPENING, NEAR, FEWEST = 3.0, 3.5, 8
# Designs of a batch, for each parameter, and the fewest: more of them cost less time a colony, and
# fewer come further.
BATCH, LEAST_BATCH = 0.4, 4
# Half the width of the box in which steps end: at first and at most, where a start has been
# followed to its end, and by how much it changes after a batch. A loss above FAR_OFF is that of
# another valley: it is left sooner.
FIRST, WIDEST, LEAST = 0.3, 0.5, 0.03
WIDER, NARROWER = 1.3, 0.85
FAR_OFF, HASTY = 5.0, 0.75
GAIN = 1e-3  # share of the loss that a batch must gain, for the box to widen
BROAD = 0.5  # standard deviation of a coordinate of which the data say nothing
DAMPING = 0.1  # of a step, as a share of 1 / BROAD: for combinations of which they say nothing
TRIES = 20  # for a design that was not grown, where there are levels
NOTHING = 1e-9  # a loss below which all designs are alike
RIDGE = 1e-4  # of a regression, as a share of its weights


@dataclass(kw_only=True, eq=False)
class GaussNewton(AskTell):
    """Least squares for data of growing colonies, whose losses have no exact derivatives.

    batch: designs of a batch; None is 0.4 for each parameter, 4 at least. first: Sobol designs of a
    start; None is 3 (parameters + 1), 8 at least.

    A loss of data is a sum of squares of residuals, and a residual is a simpler function of the
    parameters than the sum. A regression learns a line for each, from the designs near the best
    (tricube weights; those with a great loss count less). The first design of a batch is where the
    sum of squares of these lines is least, within a box about the best; the others are drawn from
    the posterior that the lines imply, so that they spread where the data say little. The box
    widens after a batch that gains, and narrows after another, sooner far from any fit; at its
    least, a new start follows. Such slopes see through scatter and small steps, which derivatives
    do not, and need no colonies of their own. After Cartis and Roberts (Math. Program. Comput. 11,
    631, 2019), whose method is for one design at a time. A dimension with levels is rounded to
    these, so it should have an order; a design that was grown already is one at random in its
    place.
    """

    squares = True  # needs the residuals of data

    batch: int | None = None
    first: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("batch", 2), ("first", 4)):
            given = getattr(self, name)
            if given is not None:
                setattr(self, name, checks.integer(f"GaussNewton.{name}", given, least=least))

    def _begin(self) -> None:
        size = self._started().size
        self._points, self._loss = np.empty((0, size)), np.empty(0)
        self._residuals = np.empty((0, 0))
        self._known = np.empty((0, size))
        self._drawn = self._batches = self._run = 0  # Sobol designs; batches; where a start begins
        self._box = FIRST

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The best are grown again with the first batch, for their residuals."""
        best = np.argsort(loss, kind="stable")[: self._opening // 2]
        self._known = points[best]

    @staticmethod
    def opening(size: int) -> int:
        """The Sobol designs of a start, for as many parameters."""
        return max(FEWEST, math.ceil(OPENING * (size + 1)))

    @property
    def _opening(self) -> int:
        return self.first or self.opening(self._started().size)

    @property
    def _is_opening(self) -> bool:
        """Whether the next batch begins a start."""
        return len(self._points) == self._run

    def _next(self) -> Batch:
        space = self._started()
        if not self._is_opening:
            return Batch(self._fresh(snap(self._propose(), space.levels)), residuals=True)
        fresh = sobol_points(space, self._seed, self._drawn, self._opening)
        return Batch(np.concatenate([self._known, fresh]), residuals=True)

    def _fresh(self, points: np.ndarray) -> np.ndarray:
        """The points, with others at random in place of those that were grown: rounded to levels,
        they may be, and would tell nothing new."""
        space = self._started()
        grown = {p.tobytes() for p in self._points}
        rng = np.random.default_rng([self._seed, self._batches, 1])
        for row in range(len(points)):
            for _ in range(TRIES):
                if points[row].tobytes() not in grown:
                    break
                points[row] = snap(rng.random((1, space.size)), space.levels)[0]
            grown.add(points[row].tobytes())
        return points

    def _propose(self) -> np.ndarray:
        """Where the lines of the residuals have their least squares, and designs about it, (n,
        D)."""
        size = self._started().size
        centre = self._points[self._run + self._loss[self._run :].argmin()]
        value, slopes = self._lines(centre)
        low, high = np.maximum(-centre, -self._box), np.minimum(1.0 - centre, self._box)
        # residuals are divided by the root of their number K, and the likelihood is exp(-K loss/2)
        root = math.sqrt(len(value))
        matrix = np.vstack([root * slopes.T, DAMPING / BROAD * np.eye(size)])
        wanted = np.concatenate([-root * value, np.zeros(size)])
        # a coordinate at its bound needs some room, however little
        step = lsq_linear(matrix, wanted, (np.minimum(low, -1e-9), np.maximum(high, 1e-9))).x
        middle = np.clip(centre + step, 0.0, 1.0)
        information = root**2 * slopes @ slopes.T + np.eye(size) / BROAD**2
        rng = np.random.default_rng([self._seed, self._batches])
        count = self.batch or max(LEAST_BATCH, math.ceil(BATCH * size))
        normal = rng.standard_normal((count - 1, size))
        away = np.linalg.solve(np.linalg.cholesky(information).T, normal.T).T
        about = np.clip(middle + np.clip(away, -self._box, self._box), 0.0, 1.0)
        return np.vstack([middle, about])

    def _lines(self, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The lines of all residuals about a point: values (K,) there, and slopes (D, K)."""
        size = len(centre)
        away = self._points - centre
        distance = np.linalg.norm(away, axis=1)
        count = min(max(FEWEST, math.ceil(NEAR * (size + 1))), len(away))
        reach = 1.2 * np.partition(distance, count - 1)[count - 1] + 1e-9
        weight = np.clip(1.0 - (distance / reach) ** 3, 0.0, None) ** 3
        typical = max(float(np.median(self._loss[weight > 0])), NOTHING)
        weight /= 1.0 + self._loss / typical
        columns = np.column_stack([np.ones(len(away)), away])
        normal = columns.T @ (weight[:, None] * columns)
        slopes = np.arange(1, size + 1)
        normal[slopes, slopes] += RIDGE * weight.sum()
        found = np.linalg.solve(normal, columns.T @ (weight[:, None] * self._residuals))
        return found[0], found[1:]

    def _compare(self, batch: Batch, loss: np.ndarray, residuals: np.ndarray | None) -> None:
        opening, before = self._is_opening, self._loss[self._run :].min(initial=np.inf)
        self._batches += 1
        if opening:
            self._drawn += len(batch.points) - len(self._known)
            self._known = self._known[:0]
        if residuals is not None:
            sound = np.isfinite(residuals).all(1)
            kept = self._residuals.reshape(len(self._loss), residuals.shape[1])
            self._residuals = np.concatenate([kept, residuals[sound]])
            self._points = np.concatenate([self._points, batch.points[sound]])
            self._loss = np.concatenate([self._loss, loss[sound]])
        if opening:
            return
        best = self._loss[self._run :].min()
        if best < (1.0 - GAIN) * before:
            self._box = min(WIDER * self._box, WIDEST)
        else:
            self._box *= NARROWER if best < FAR_OFF else HASTY
        if self._box < LEAST:
            self._run, self._box = len(self._points), FIRST

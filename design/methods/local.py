"""Local search with derivatives: Levenberg and Marquardt's least squares from many starts, or
quasi-Newton where a target has no residuals."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from design.methods.base import AskTell, Batch, sobol_points
from design.slopes import Slopes
from torchfilm import checks

# Damping, as a share of the curvature: at the start, and from which a descent is given up.
FIRST, MOST = 1e-2, 1e6
LONGEST = 0.3  # of a step, in each coordinate
LEAST_STEP, LEAST_GAIN = 1e-4, 1e-4  # coordinates; share of the loss
# Steps in a row whose decrease is not what the derivatives promised, after which they mislead: with
# those of all replicates, and of fewer.
MISSES, FEW_MISSES = 4, 2
FAIR = 0.1  # share of the promised decrease that a step should bring at least
APART = 0.05  # starts that are nearer than this in every coordinate lead to the same end


@dataclass(eq=False)
class Descent:
    """A way down from one start: the best point (D,) so far with its loss and slopes, and the
    point that was proposed last, with the decrease that it promised.

    most: replicates of a design; seen: of how many its slopes are. sloped: whether they are known
    at the point. moved (D,): the step that led there.
    """

    point: np.ndarray
    loss: float
    most: int
    seen: int = 1
    sloped: bool = False
    moved: np.ndarray = field(default_factory=lambda: np.zeros(1))
    gradient: np.ndarray = field(default_factory=lambda: np.empty(0))
    curvature: np.ndarray = field(default_factory=lambda: np.empty(0))
    damping: float = FIRST
    growth: float = 2.0
    misses: int = 0
    over: str = ""
    proposed: np.ndarray = field(default_factory=lambda: np.empty(0))
    promised: float = 0.0

    def propose(self) -> np.ndarray:
        """The next point to evaluate, (D,)."""
        step = self._step()
        self.proposed = np.clip(self.point + step, 0.0, 1.0)
        moved = self.proposed - self.point
        self.promised = -float(self.gradient @ moved + 0.5 * moved @ self.curvature @ moved)
        return self.proposed

    def _step(self) -> np.ndarray:
        """(H + λ diag H) δ = −g in the coordinates that no bound stops."""
        point, gradient = self.point, self.gradient
        free = ~(
            ((point <= 0) & (gradient > 0)) | ((point >= 1) & (gradient < 0)) | (gradient == 0)
        )
        step = np.zeros(len(point))
        if free.any():
            inner = self.curvature[np.ix_(free, free)]
            scale = np.diag(inner).copy()
            scale = np.maximum(scale, 1e-6 * max(scale.max(), 1e-12))
            step[free] = -np.linalg.solve(inner + self.damping * np.diag(scale), gradient[free])
        longest = np.abs(step).max()
        return step * min(1.0, LONGEST / longest) if longest > 0 else step

    def set_slopes(self, gradient: np.ndarray, curvature: np.ndarray) -> None:
        """The slopes at the point."""
        if not np.isfinite(gradient).all():
            self._doubt("a derivative is no number")
            return
        if not np.isfinite(curvature).all():
            curvature = self._quasi_newton(gradient)
        self.gradient, self.curvature, self.sloped = gradient, curvature, True
        self.moved = np.zeros_like(gradient)
        if not self._step().any():  # held by bounds, or no slope
            self._doubt("converged")

    def learn(self, loss: float) -> None:
        """The loss at the proposed point."""
        moved, before = self.proposed - self.point, self.loss
        gain = before - loss
        ratio = gain / self.promised if self.promised > 0 else -1.0
        self.misses = 0 if ratio > FAIR else self.misses + 1
        if gain > 0:
            self.point, self.loss, self.moved, self.sloped = self.proposed, loss, moved, False
            # Nielsen (1999)
            self.damping *= max(1 / 3, 1 - (2 * min(ratio, 1.5) - 1) ** 3)
            self.growth = 2.0
        else:
            self.damping, self.growth = self.damping * self.growth, 2 * self.growth
        little = gain > 0 and gain < LEAST_GAIN * before and ratio > FAIR
        if little or np.abs(moved).max() < LEAST_STEP or self.damping > MOST:
            self._doubt("converged")
        elif self.misses >= (MISSES if self.seen == self.most else FEW_MISSES):
            self._doubt("derivatives mislead")

    def _doubt(self, why: str) -> None:
        """Slopes of more replicates; where they are of all, the descent is over."""
        if self.seen < self.most:
            self.seen, self.sloped, self.misses = min(2 * self.seen, self.most), False, 0
            self.damping, self.growth = FIRST, 2.0  # those of slopes that misled
        else:
            self.over = why

    def _quasi_newton(self, gradient: np.ndarray) -> np.ndarray:
        """The curvature after a step by BFGS's formula, damped as by Powell (1978)."""
        moved = self.moved
        if not moved.any():
            return max(float(np.linalg.norm(gradient)), 1e-12) / LONGEST * np.eye(len(gradient))
        known, change = self.curvature, gradient - self.gradient
        across = known @ moved
        bent, turned = float(moved @ across), float(moved @ change)
        if bent <= 0:
            return known
        if turned < 0.2 * bent:
            share = 0.8 * bent / (bent - turned)
            change = share * change + (1 - share) * across
        return (
            known
            - np.outer(across, across) / bent
            + np.outer(change, change) / float(moved @ change)
        )


def near(point: np.ndarray, others: np.ndarray) -> bool:
    """Whether a point (D,) is like one of others (n, D)."""
    return bool((np.abs(others - point).max(1) < APART).any())


def unlike(points: np.ndarray, loss: np.ndarray, most: int) -> list[int]:
    """The rows of the best designs that are not alike, the best first."""
    chosen: list[int] = []
    for k in np.argsort(loss, kind="stable"):
        if len(chosen) < most and not near(points[k], points[chosen]):
            chosen.append(int(k))
    return chosen


@dataclass(kw_only=True, eq=False)
class Local(AskTell):
    """Least squares by Levenberg and Marquardt (Moré 1978) from several starts side by side.

    starts: how many descents at a time. first: Sobol designs, whose best are the starts; None is 16
    for each start. A descent ends where it gains nothing more, or where four steps in a row bring
    less than a tenth of the decrease that the derivatives promised. The next best design of the
    first ones follows it, and then new Sobol designs. The bounds hold, and dimensions with levels
    keep the level of their start. Targets without residuals have quasi-Newton steps (BFGS).

    For the slopes at a point, a design is grown once for each parameter, or twice and once more
    where the derivatives are differences (`Objective.why_differences` says why); all these colonies
    count. So slopes are those of one replicate at first. Every step is scored with all replicates,
    without slopes. Where two steps in a row miss what was promised, and where a descent would end,
    it takes slopes of twice as many replicates, until they are of all.
    """

    starts: int = 4
    first: int | None = None

    def __post_init__(self) -> None:
        self.starts = checks.integer("Local.starts", self.starts, least=1)
        if self.first is not None:
            self.first = checks.integer("Local.first", self.first, least=self.starts)

    def _begin(self) -> None:
        if None not in self._started().levels:
            raise checks.InputError(
                "there is no slope to descend: every parameter is whole or a choice. Use another"
                ' method, such as "racing".'
            )
        self._tried = 0
        self._waiting: list[tuple[np.ndarray, float]] = []
        self._descents: list[Descent] = []
        self._asked: list[Descent] = []
        self._descended = False

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The first descents begin at these, the best first."""
        self._wait(points, loss, len(points))

    @property
    def _opening(self) -> int:
        """The Sobol designs before descents."""
        return self.first or 16 * self.starts

    @property
    def remark(self) -> str:
        if self._descended:
            return ""
        return (
            f"the search ended before its first descent: the {self._opening} Sobol designs from"
            " which descents start took all colonies. Give it more colonies, or fewer such designs:"
            " method=Local(first=…, starts=…)."
        )

    @property
    def idle(self) -> bool:
        """Whether all descents have ended, and no start waits."""
        return not self._waiting and all(d.over for d in self._descents)

    def _next(self) -> Batch:
        self._descents = [d for d in self._descents if not d.over]
        while self._waiting and len(self._descents) < self.starts:
            self._descents.append(Descent(*self._waiting.pop(0), self._replicates))
        if not self._descents:
            count = self._opening
            points = sobol_points(self._started(), self._seed, self._tried, count)
            self._tried += count
            return Batch(points)
        flat = [d for d in self._descents if not d.sloped]
        if not flat:
            return Batch(np.array([d.propose() for d in self._descents]))
        seen = min(d.seen for d in flat)
        self._asked = [d for d in flat if d.seen == seen]
        return Batch(np.array([d.point for d in self._asked]), replicates=seen, slopes=True)

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        if self._descents:
            for descent, found in zip(self._descents, loss.tolist(), strict=True):
                descent.learn(found)
        else:  # a quarter of the designs: the others are worse than where a descent would end
            self._wait(batch.points, loss, max(self.starts, len(loss) // 4))

    def _wait(self, points: np.ndarray, loss: np.ndarray, most: int) -> None:
        """The best of some designs are the next starts."""
        self._waiting = [(points[k], float(loss[k])) for k in unlike(points, loss, most)]

    def _descend(self, loss: np.ndarray, slopes: Slopes) -> None:
        self._descended = True
        for k, descent in enumerate(self._asked):
            descent.set_slopes(slopes.gradient[k], slopes.curvature[k])

"""CMA-ES: a normal distribution of points that moves, turns and shrinks towards low losses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from design.methods.base import AskTell, Batch, numpy_kept, snap, sobol_points
from design.quiet import alone_and_quiet
from torchfilm import checks

# A restart doubles the population, up to this many times the first: the batch must fit the machine.
MOST = 16
# The greatest width of a cloud around a design that is known before the search.
NEAR = 0.1
# Learning rate of the mean and damping of the step size, for losses with noise; cma's own are 1 and
# 1 (docs/methods.md gives the measurements).
SLOW = {"CMA_cmean": 0.4, "CSA_dampfac": 3.0}


@dataclass(kw_only=True, eq=False)
class CMAES(AskTell):
    """Covariance matrix adaptation (Hansen, "The CMA evolution strategy: a tutorial",
    arXiv:1604.00772), by the package cma.

    population: points in a batch. None is 4 + 3 ln D, rounded down, or, where there are levels, 6 +
    3 ln(D · dimensions with levels). sigma: the first standard deviation, as a share of each range.
    noisy: learn slowly, for losses with noise. A search grows every design on the same seeds, so
    its losses have none; those of a user's own function may. restarts: when a distribution has
    converged, begin another with twice the population (IPOP: Auger and Hansen, CEC 2005), at most
    16 times the first; False keeps the first.

    Every distribution begins at the best of a batch of Sobol points, and none while these are all
    equally good, as where every design fails. One that ended where all losses are equal and
    worse than at its start is followed by one of the same size. Levels are whole numbers for cma,
    in their order, with its lower bounds on their widths and its centring (Marty et al., PPSN
    2024). Dimensions with one level are left out. Where fewer than the two dimensions that cma
    needs remain, it gets idle ones that change nothing.
    """

    population: int | None = None
    sigma: float = 0.3
    restarts: bool = True
    noisy: bool = False

    def __post_init__(self) -> None:
        if self.population is not None:
            self.population = checks.integer("CMAES.population", self.population, least=4)
        checks.number("CMAES.sigma", self.sigma, above=0.0, most=1.0)
        for name in ("restarts", "noisy"):
            checks.choice(f"CMAES.{name}", getattr(self, name), (True, False))
        if find_spec("cma") is None:
            raise checks.InputError(f"CMAES needs the package cma: {checks.install('design')}.")

    def _begin(self) -> None:
        space = self._started()
        self._free = [axis for axis, levels in enumerate(space.levels) if levels != 1]
        counts = [space.levels[axis] for axis in self._free]
        # for cma a level is a whole number 0 … k - 1; with half a level at each end it is k wide
        self._scale = np.array([1.0 if k is None else float(k) for k in counts])
        self._shift = np.array([0.0 if k is None else 0.5 for k in counts])
        self._whole = [place for place, k in enumerate(counts) if k is not None]
        self._idle = max(0, 2 - len(self._free))
        self._first = self._size = self.population or self._usual(len(self._free) + self._idle)
        self._cloud: Any = None
        self._start = math.inf  # loss at the start of the cloud
        self._tried = self._draws = 0
        self._random = np.random.default_rng(self._seed)

    def _usual(self, size: int) -> int:
        return int(
            6 + 3 * math.log(size * len(self._whole)) if self._whole else 4 + 3 * math.log(size)
        )

    @property
    def wanted(self) -> int:
        return self._size

    @property
    def fresh(self) -> bool:
        return self._cloud is None

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The first cloud begins at the best of them, and is narrow: a wide one leaves what is
        known."""
        best = int(loss.argmin())
        self._start = float(loss[best])
        self._cloud = self._new(points[best], min(self.sigma, NEAR))

    def draw(self, count: int) -> np.ndarray:
        space = self._started()
        if self._cloud is None:
            self._points = sobol_points(space, self._seed, self._tried, count)
            self._tried += count
            return self._points
        self._draws += 1
        self._random = np.random.default_rng([self._seed, self._draws])
        with self._quiet():
            self._found = np.array(self._cloud.ask(number=count))
        points = np.full((count, space.size), 0.5)
        points[:, self._free] = (self._found[:, : len(self._free)] + self._shift) / self._scale
        return snap(points, space.levels)

    def take(self, rows: np.ndarray, loss: np.ndarray) -> None:
        if self._cloud is None:
            if loss.min() < loss.max():
                self._cloud, self._start = (
                    self._new(self._points[rows[int(loss.argmin())]], self.sigma),
                    float(loss.min()),
                )
            return
        with self._quiet():
            # cma must receive its own points, to the last bit
            self._cloud.tell(list(self._found[rows]), loss.tolist())
            stop = self._cloud.stop() if self.restarts else {}
        if stop:
            if loss.min() < loss.max() or loss.min() <= self._start:
                self._size = min(2 * self._size, MOST * self._first)
            self._cloud = None

    def _next(self) -> Batch:
        return Batch(self.draw(self._size))

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        self.take(np.arange(len(loss)), loss)

    def _new(self, start: np.ndarray, width: float) -> Any:
        """A cloud around a point."""
        import cma

        low, high = -self._shift, self._scale - self._shift
        idle = [0.5] * self._idle
        settings: dict[str, Any] = {
            "bounds": [[*low, *(0.0 for _ in idle)], [*high, *(1.0 for _ in idle)]],
            "CMA_stds": [*self._scale, *(1.0 for _ in idle)],
            "integer_variables": self._whole,
            "popsize": self._size,
            "CMA_mirrors": 0,
            **(SLOW if self.noisy else {}),
            "minstd": 1e-9,
            "tolx": 1e-7,
            "tolfun": 1e-9,
            "tolfunhist": 1e-10,
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": math.nan,
            "verbose": -9,
            "signals_filename": None,
        }
        with self._quiet():
            return cma.CMAEvolutionStrategy(
                [*(start[self._free] * self._scale - self._shift), *idle], width, settings
            )

    @contextmanager
    def _quiet(self) -> Iterator[None]:
        """For calls of cma: it warns of cases that are handled here, and draws from numpy's global
        generator in an assertion of its centring."""
        with alone_and_quiet(), numpy_kept([self._seed, self._draws]):
            yield

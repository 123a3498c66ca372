"""NSGA-II: a population whose designs cross and mutate, for several goals at once."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from design.methods.base import Batch, Turns, snap, sobol_points, whole
from design.slopes import Slopes
from torchfilm import checks


@dataclass(kw_only=True, eq=False)
class NSGA2(Turns):
    """NSGA-II (Deb et al., IEEE Trans. Evol. Comput. 6, 182, 2002), by the package pymoo, for the
    front of several goals.

    population: designs in a batch, kept from one to the next. The first batch is of Sobol points,
    of which those with the same levels count once.
    Designs that failed come after all others. `tell` takes the losses of all goals, (n, G), NaN for
    a design that failed.
    """

    population: int = 32
    several = True  # goals, not one loss

    def __post_init__(self) -> None:
        whole("NSGA2.population", self.population, least=4)
        if find_spec("pymoo") is None:
            raise checks.InputError(f"NSGA2 needs the package pymoo: {checks.install('pareto')}.")

    def _begin(self) -> None:
        self._points = _different(sobol_points(self._started(), self._seed, 0, self.population))
        self._search: Any = None

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The first batch begins with the best of them."""
        best = points[np.argsort(loss, kind="stable")]
        self._points = _different(np.concatenate([best, self._points]))[: self.population]

    def _next(self) -> Batch:
        if self._search is None:
            return Batch(self._points)
        self._asked = self._search.ask()
        return Batch(snap(np.array(self._asked.get("X"), dtype=np.float64), self._space.levels))  # type: ignore[union-attr]

    def tell(self, batch: Batch, loss: np.ndarray, slopes: Slopes | None = None) -> None:
        self._started()
        self._meet(batch)
        goals = np.array(loss, dtype=np.float64)
        if goals.ndim != 2 or len(goals) != len(batch.points) or goals.shape[1] < 2:
            raise checks.input_error(
                "goals of shape", goals.shape, f"({len(batch.points)}, G) with two goals or more"
            )
        if self._search is None:
            self._search = self._made(goals.shape[1])
            self._asked = self._search.ask()
        failed = np.isnan(goals).any(axis=1, keepdims=True)
        # the constraint keeps failed designs behind; their goals only have to be numbers
        self._asked.set("X", batch.points.copy())
        self._asked.set("F", np.where(failed, 0.0, goals))
        self._asked.set("G", np.where(failed, 1.0, -1.0))
        self._search.tell(infills=self._asked)
        self._batch = None

    def _made(self, goals: int) -> Any:
        from pymoo.algorithms.moo.nsga2 import NSGA2 as Algorithm
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        size = self._started().size
        problem = Problem(n_var=size, n_obj=goals, n_ieq_constr=1, xl=0.0, xu=1.0)
        algorithm = Algorithm(pop_size=self.population, sampling=self._points)
        algorithm.setup(problem, termination=NoTermination(), seed=self._seed)
        return algorithm


def _different(points: np.ndarray) -> np.ndarray:
    """Each of some points once, in their order: pymoo drops those that it has."""
    return points[np.sort(np.unique(points, axis=0, return_index=True)[1])]

"""NSGA-II: a population whose designs cross and mutate, for several goals at once."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from design.methods.base import AskTell, Batch, snap, sobol_points
from design.slopes import Slopes
from torchfilm import checks

SAME = 1e-9  # coordinates: less is rounding, as between the bounds of two studies


@dataclass(kw_only=True, eq=False)
class NSGA2(AskTell):
    """NSGA-II (Deb et al., IEEE Trans. Evol. Comput. 6, 182, 2002), by the package pymoo, for the
    front of several goals.

    population: designs in a batch, kept from one to the next. The first batch is of Sobol points,
    of which those with the same levels count once. Designs that were known before take their places
    with the losses that they have: the best of them, and Sobol points only where they are fewer.
    Designs that failed come after all others. `tell` and `know` take the losses of all goals,
    (n, G), NaN for a design that failed.
    """

    population: int = 32
    several = True  # goals, not one loss

    def __post_init__(self) -> None:
        self.population = checks.integer("NSGA2.population", self.population, least=4)
        if find_spec("pymoo") is None:
            raise checks.InputError(f"NSGA2 needs the package pymoo: {checks.install('pareto')}.")

    def _begin(self) -> None:
        self._points = _different(sobol_points(self._started(), self._seed, 0, self.population))
        self._known: tuple[np.ndarray, np.ndarray] | None = None
        self._search: Any = None

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """They are the first population, or a part of it: the best that did not fail. The first
        batch fills it up with designs that are not known."""
        goals = _goals(points, loss)
        first = np.sort(np.unique(points, axis=0, return_index=True)[1])
        sound = first[~np.isnan(goals[first]).any(1)]
        if not len(sound):
            return
        alike = (np.abs(self._points[:, None] - points[None]) < SAME).all(2).any(1)
        self._points = self._points[~alike]
        kept = sound[_fittest(goals[sound], self.population)]
        self._known = points[kept], goals[kept]
        self._points = self._points[: self.population - len(kept)]
        if not len(self._points):
            self._populate(*self._known)

    def _next(self) -> Batch:
        if self._search is None:
            return Batch(self._points)
        self._asked = self._search.ask()
        return Batch(snap(np.array(self._asked.get("X"), dtype=np.float64), self._space.levels))  # type: ignore[union-attr]

    def tell(
        self,
        batch: Batch,
        loss: np.ndarray,
        slopes: Slopes | None = None,
        residuals: np.ndarray | None = None,
    ) -> None:
        self._started()
        self._meet(batch)
        points, goals = batch.points, _goals(batch.points, loss)
        if self._search is not None:
            self._learn(points, goals)
        elif self._known is None:
            self._populate(points, goals)
        else:
            known, theirs = self._known
            self._populate(np.concatenate([known, points]), np.concatenate([theirs, goals]))
        self._batch = None

    def _populate(self, points: np.ndarray, goals: np.ndarray) -> None:
        """Begin with the first population."""
        self._search = self._made(points, goals.shape[1])
        self._asked = self._search.ask()
        self._learn(points, goals)

    def _learn(self, points: np.ndarray, goals: np.ndarray) -> None:
        failed = np.isnan(goals).any(axis=1, keepdims=True)
        # the constraint keeps failed designs behind; their goals only have to be numbers
        self._asked.set("X", points.copy())
        self._asked.set("F", np.where(failed, 0.0, goals))
        self._asked.set("G", np.where(failed, 1.0, -1.0))
        self._search.tell(infills=self._asked)

    def _made(self, points: np.ndarray, goals: int) -> Any:
        from pymoo.algorithms.moo.nsga2 import NSGA2 as Algorithm
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        size = self._started().size
        problem = Problem(n_var=size, n_obj=goals, n_ieq_constr=1, xl=0.0, xu=1.0)
        algorithm = Algorithm(pop_size=self.population, sampling=points)
        algorithm.setup(problem, termination=NoTermination(), seed=self._seed)
        return algorithm


def _goals(points: np.ndarray, loss: Any) -> np.ndarray:
    """The losses of all goals, (n, G) float64. Raises InputError for another shape."""
    goals = np.array(loss, dtype=np.float64)
    if goals.ndim != 2 or len(goals) != len(points) or goals.shape[1] < 2:
        raise checks.input_error(
            "goals of shape", goals.shape, f"({len(points)}, G) with two goals or more"
        )
    return goals


def _fittest(goals: np.ndarray, most: int) -> np.ndarray:
    """The rows of the `most` designs that NSGA-II keeps of some, (k,): by front, and on the last of
    them those that stand alone."""
    from pymoo.core.population import Population
    from pymoo.core.problem import Problem
    from pymoo.operators.survival.rank_and_crowding import RankAndCrowding

    among = Population.new(F=goals, row=np.arange(len(goals)))
    kept = RankAndCrowding().do(Problem(n_var=1, n_obj=goals.shape[1]), among, n_survive=most)
    return np.sort(np.array([one.get("row") for one in kept]))


def _different(points: np.ndarray) -> np.ndarray:
    """Each of some points once, in their order: pymoo drops those that it has."""
    return points[np.sort(np.unique(points, axis=0, return_index=True)[1])]

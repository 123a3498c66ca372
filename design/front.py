"""The front of a search with several goals: the designs that none exceeds in all of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import torchfilm as tf
from design.best import Best
from design.entries import Entry
from design.finals import fresh_goals
from design.front_plot import draw_front
from design.loss_bands import goal_errors
from design.objective import Objective
from design.parameters import Value, show_value
from design.pareto import nondominated, spread
from design.reasons import tally
from design.report import at_bound, cells_in, cost_words, failure_words
from design.study import Study
from design.targets.goals import Constrained, Goals, constrained, in_words, of_seeds
from design.trivial import trivial_losses
from torchfilm import checks, displays


class FrontSearch(Protocol):
    """What a front asks of the search that found it."""

    @property
    def objective(self) -> Objective: ...

    @property
    def study(self) -> Study: ...

    def design(self, point: np.ndarray) -> Best: ...


@dataclass(frozen=True, eq=False, repr=False)
class Front:
    """Designs that no other exceeds in all goals, in order of the first goal.

    search: that found them; titles: of the goals; points (F, D); goals (F, G): their losses; errors
    (F, G): the standard errors of these by the luck of the seeds, NaN where a goal is no mean of
    them and where there is one; seeds: fresh seeds on which these were measured, 0 where they are
    those of the search. untested: further designs of the front of the search, for which the finals
    had no room; `search.front(fresh=False)` has all. `front[k]` is a design as `Best`, with `save`,
    `colonies`, `table`.
    """

    search: FrontSearch = field(repr=False)
    titles: tuple[str, ...]
    points: np.ndarray = field(repr=False)
    goals: np.ndarray
    errors: np.ndarray = field(repr=False)
    seeds: int
    untested: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, row: int) -> Best:
        return self.search.design(self.points[row])

    def __iter__(self) -> Iterator[Best]:
        return (self[row] for row in range(len(self)))

    @property
    def values(self) -> list[dict[str, Value]]:
        """The parameters of each design by name."""
        return [self.search.objective.task.space.values(point) for point in self.points]

    def convergence(
        self, box: tuple[Sequence[float], Sequence[float]] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """After each batch of the search: the colonies simulated, and the hypervolume, (K,) each.

        That is the part of a box that the front so far exceeds (Zitzler and Thiele, 1999). box: the
        best and the worst value of each goal, (G,) each, to compare searches; by default those on
        the front of the whole search. Needs pymoo (the `pareto` extra).
        """
        from pymoo.indicators.hv import HV

        study = self.search.study
        full = study.full_goals()
        every = np.concatenate([goals for _, goals in full])
        good = every[nondominated(every)]
        low, high = (good.min(0), good.max(0)) if box is None else _checked_box(box, good.shape[1])
        measure = HV(ref_point=np.ones(every.shape[1]))
        spent = np.cumsum([e.colonies for e in study.entries])
        found, known = [], np.empty((0, every.shape[1]))
        of = {id(entry): goals for entry, goals in full}
        for entry in study.entries:
            if id(entry) in of:
                known = np.concatenate([known, of[id(entry)]])
                known = known[nondominated(known)]
            scaled = (known - low) / np.where(high > low, high - low, 1.0)
            found.append(float(measure(scaled)) if len(known) else 0.0)
        return spent, np.array(found)

    def table(self) -> str:
        """The goals and the parameters of each design; which lie at a bound; what colonies without
        a pattern would have; and what the search took. It grows the designs at both ends again."""
        lines = [*displays.aligned(self._rows()), self._where(), *self._remarks()]
        return displays.Text("\n".join(lines))

    def _remarks(self) -> list[str]:
        """What to know of the designs, and of the search."""
        task, study, lines = self.search.objective.task, self.search.study, []
        if constrained(task.target) and self.goals.min() >= Constrained.BROKEN / self._seeds:
            bounds = in_words(task.target.bounds)
            lines.append(f"no design meets the constraints ({bounds}): these miss them by least.")
        for p in task.space.parameters:
            there = [str(k) for k, v in enumerate(self.values) if at_bound(p, v[p.name])]
            if there:
                lines.append(f"{p.name} at a bound: design {', '.join(there)}")
        first = self[0].colonies()
        last = self[len(self) - 1].colonies() if len(self) > 1 else []
        lines.append(f"cells: {cells_in(first + last)}")
        goals: Any = task.target
        for title, part in zip(self.titles, goals.parts, strict=True):
            compared = part.names and part.pattern and not part.bounds and not of_seeds(part)
            if compared and (found := trivial_losses(part, first, task.reduced)):
                each = ", ".join(f"{name} {loss:.3f}" for name, loss in found.items())
                lines.append(f"{title} without a pattern: {each}")
        spent = f"{cost_words(study)}; {study.about.get('method', '')}".rstrip("; ")
        return [*lines, *failure_words(study, task.target), spent]

    @property
    def _seeds(self) -> int:
        return self.seeds or self.search.objective.task.replicates

    def _repr_html_(self) -> str:
        head, *rows = self._rows()
        return displays.card(f"Front: {self._where()}", displays.table(rows, head))

    def _rows(self) -> list[list[str]]:
        names = self.search.objective.task.space.names
        text = [["", *self.titles, *names]]
        for k, values in enumerate(self.values):
            goals = map(_with_error, self.goals[k], self.errors[k])
            text.append([str(k), *goals, *(show_value(values[name]) for name in names)])
        return text

    def _where(self) -> str:
        where = f"on {self.seeds} fresh seeds" if self.seeds else "on the seeds of the search"
        more = f"; {self.untested} more were not tested: search.front(fresh=False)"
        count = displays.counted(len(self), "design", "designs")
        return f"{count}, {where}{more if self.untested else ''}"

    def __repr__(self) -> str:
        return f"Front({', '.join(self.titles)}; {self._where()})"

    def plot(self, out: str | Path | None = None) -> tf.pictures.Picture:
        """Draw the front among all designs, colonies along it, and the hypervolume; `out` as for
        `Best.plot`. Needs matplotlib and pymoo (the `app` and `pareto` extras)."""
        every = np.concatenate([goals for _, goals in self.search.study.full_goals()])
        colonies = {int(k): self[int(k)].colonies() for k in spread(self.goals, 5)}
        figure = draw_front(
            self.search.objective.task.target,
            self.titles,
            every,
            self.goals,
            self.errors,
            colonies,
            self.convergence(),
            self.seeds,
        )
        return tf.pictures.Picture(figure, out)


def _checked_box(box: Any, goals: int) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a box, of so many goals."""
    pair = isinstance(box, (tuple, list)) and len(box) == 2
    each = [checks.vector("convergence(box)", x, goals) for x in box] if pair else []
    if not each or any(a >= b for a, b in zip(*each, strict=True)):
        raise checks.input_error(
            "convergence(box)",
            box,
            "the best and the worst value of each goal, such as ((0.0, 1.0), (1.0, 9.0))",
        )
    return np.array(each[0]), np.array(each[1])


def front_of(search: FrontSearch, study: Study, sizes: Sequence[float]) -> Front:
    """The front of a study: on fresh seeds where its designs were grown at all these sizes, else on
    the seeds of the search. Raises InputError before a design was grown to full size, and where all
    failed."""
    target = search.objective.task.target
    assert isinstance(target, Goals)
    full = study.full_goals()
    if not full:
        raise tf.InputError(
            "no design has been grown to full size yet: run the search for more colonies."
        )
    fresh, task = fresh_goals(study, sizes) if sizes else None, search.objective.task
    seeds = untested = 0
    points = np.concatenate([e.points for e, _ in full])
    goals = np.concatenate([g for _, g in full])
    kept = [e.each_goals for e, _ in full if e.each_goals is not None]
    # files of earlier versions lack them: as of one seed, without an error
    each = np.concatenate(kept) if len(kept) == len(full) else goals[:, None]
    if fresh is not None:
        known = {p.tobytes() for p in points[nondominated(goals)]}
        points, each = fresh
        seeds, goals = each.shape[1], np.asarray(task.reduced_goals(each))
        untested = len(known - {p.tobytes() for p in points})
    rows = nondominated(goals)
    if not len(rows) and seeds:
        checks.warn(
            f"each of the {len(points)} designs that were grown on fresh seeds failed there:"
            f" {_usual_failure(study.finals)}. The front is that on the seeds of the search."
        )
        return front_of(search, study, ())
    if not len(rows):
        raise tf.InputError(f"every design failed: {_usual_failure(study.entries)}")
    errors = goal_errors(task, each[rows])
    return Front(search, target.titles, points[rows], goals[rows], errors, seeds, untested)


def _with_error(goal: float, error: float) -> str:
    return f"{goal:.4g}" + (f" ± {error:.2g}" if np.isfinite(error) else "")


def _usual_failure(entries: Iterable[Entry]) -> str:
    return tally(why for entry in entries for why in entry.reasons.values())[0][0]

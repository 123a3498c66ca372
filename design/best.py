"""The best design of a search."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

import torchfilm as tf
from design import report, report_plot
from design.finals import FreshLosses
from design.growing import FinishedColonies
from design.intervals import Intervals, intervals_of
from design.objective import Objective
from design.parameters import Value
from design.robustness_check import check_robustness
from design.saved_design import write_design
from design.study import Study
from torchfilm import checks, displays


class SearchView(Protocol):
    """What a design asks of the search that found it."""

    @property
    def objective(self) -> Objective: ...

    @property
    def study(self) -> Study: ...

    @property
    def why_regrown(self) -> str: ...

    @property
    def why_chosen(self) -> str: ...

    def first(self) -> Best: ...

    def colonies(self, point: np.ndarray) -> list[FinishedColonies]: ...


@dataclass(frozen=True, eq=False, repr=False)
class Best:
    """The best design of a search.

    search: that found it; values: its parameters by name; point: their coordinates (D,); searched:
    the losses of its replicates in the search (R,); fresh: on seeds that the search did not use,
    None where it was not tested.
    """

    search: SearchView
    values: dict[str, Value]
    point: np.ndarray
    searched: np.ndarray
    fresh: FreshLosses | None = None

    # `best.check(…)` is `check_robustness(best, …)`
    check = check_robustness

    @property
    def loss(self) -> float:
        """On fresh seeds; where the design was not tested, in the search."""
        return self.searched_loss if self.fresh is None else self.fresh.loss

    @property
    def objective(self) -> Objective:
        """The objective that scored the design."""
        return self.search.objective

    @property
    def searched_loss(self) -> float:
        """In the search, where the lowest of many losses is low partly by luck."""
        return float(self.objective.task.reduced(self.searched[None])[0])

    @property
    def losses(self) -> np.ndarray:
        """Of each fresh seed (S,), or of each replicate in the search (R,)."""
        return self.searched if self.fresh is None else self.fresh.losses

    @property
    def band(self) -> tuple[float, float] | None:
        """Where the loss lies with a probability of 90 %; None where the design was not tested on
        fresh seeds. That of a quantile has an upper end from so many seeds on: 5 (of 0.5), 11
        (0.75), 29 (0.9). That of reduce="worst" ends at the worst seed that was grown: of S seeds,
        a new one is worse with a probability of 1/(S + 1)."""
        return None if self.fresh is None else self.fresh.band

    def __repr__(self) -> str:
        tested = "" if self.fresh is None else f" on {len(self.losses)} fresh seeds"
        return f"Best(values={self.values}, loss={self.loss:.4g}{tested})"

    def _repr_html_(self) -> str:
        # what is known without growing the colonies again
        found = self.search.study.first()
        assert found is not None
        first = self.objective.task.space.values(found)
        rows = report.parameter_rows(self.objective.task.space, first, self.values)
        losses: list[tuple[str, str]] = [
            ("loss in the search", report.show_loss(self.searched_loss))
        ]
        if self.fresh is not None:
            losses.append(
                ("loss on fresh seeds", report.fresh_words(self.objective.task, self.fresh))
            )
        study = self.search.study
        losses.append(("grown", f"{study.colonies:.0f} colonies in {study.time}"))
        head = ("parameter", "bounds", "first guess", "best design", "")
        return displays.card("Best design", displays.table(rows, head), displays.pairs(losses))

    def scene(self) -> tf.Scene:
        """The scene with these parameters, for one colony or any number of them; of several
        conditions under the first."""
        task = self.objective.task
        given = {**task.family.fixed, **self.values, **task.target.arguments[0]}
        return task.family.function(**given)

    def save(self, path: str | Path) -> Path:
        """Write the design to a `.json` file, which `torchfilm run` and `load_design` take.
        Replaces an older one."""
        checked = checks.file_path("path", path, ".json")
        return write_design(checked, self, colonies=self.search.study.colonies)

    def plot(self, out: str | Path | None = None) -> tf.pictures.Picture:
        """Draw the first guess, the best design, the target and the course of the search. A
        notebook displays the picture; with `out` it is saved there, in place of an older one. Needs
        matplotlib (the `app` extra)."""
        return tf.pictures.Picture(report_plot.draw(self._report()), out)

    def table(self) -> str:
        """The parameters with their bounds and the first guess, the losses and the measures."""
        return displays.Text(report.table(self._report()))

    def intervals(self) -> Intervals:
        """How well the data tell the parameters, as least squares have it: from the derivatives of
        all readings at the best fit, in one more run. `table()` of it, `interval(level)` and
        `correlation`. Raises InputError where the target is no data, or has no exact
        derivatives."""
        return intervals_of(self.objective, self.point, self.values, self.searched_loss)

    def colonies(self) -> list[FinishedColonies]:
        """The replicates at their ends, grown again once: the same colonies as were scored."""
        return self.search.colonies(self.point)

    def _report(self) -> report.SearchReport:
        search, first = self.search, self.search.first()
        first_guess, best = (
            report.ReportedDesign(
                title, d.values, d.point, d.searched_loss, d.searched, d.colonies(), d.fresh
            )
            for title, d in (("first guess", first), ("best", self))
        )
        return report.SearchReport(
            self.objective.task,
            search.study,
            search.why_regrown,
            first_guess,
            best,
            search.why_chosen,
        )

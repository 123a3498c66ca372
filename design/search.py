"""A search: a method proposes designs, the objective scores them, and a study keeps the results,
until the budget is used."""

from __future__ import annotations

import sys
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import torchfilm as tf
from design import report
from design.methods import Batch, Method, method_of
from design.objective import Evaluation, Objective
from design.parameters import Value
from design.progress import advance, open_bar
from design.robustness_check import check_robustness
from design.rollout import FinishedColonies
from design.saved_design import write_design
from design.slopes import Slopes
from design.study import Entry, Study
from design.task import Task, TaskOptions
from torchfilm import checks

if TYPE_CHECKING:
    from tqdm import tqdm


@dataclass(eq=False)
class SearchProgress:
    """What a search has found so far. grown: the colonies of designs that were drawn or measured,
    by their points."""

    study: Study
    why_regrown: str
    grown: dict[bytes, list[FinishedColonies]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Search(TaskOptions):
    """Search the parameters of a scene for colonies that form a pattern.

        search = Search(
            tf.scenes.boundary_detector,
            parameters=[Parameter("k3", 0.1, 10, log=True)],
            target=Stripe("yfp", at="border", width=8.0, cell_type=1),
            cells=150,
        )
        best = search.run(colonies=2000, study="stripe.h5")

    method: "cmaes", "sobol", "racing", "bayesian", one of their objects with settings of its own,
    or any object with start, ask and tell (`Method`). `TaskOptions` documents the other arguments;
    `search.objective.task` holds them checked. Raises the errors of `Task`, and InputError for a
    method that is not allowed.
    """

    method: str | Method = field(default="cmaes", kw_only=True)
    objective: Objective = field(init=False, repr=False)
    _progress: SearchProgress = field(init=False, repr=False)

    def __post_init__(self) -> None:
        task = Task.of(self)
        object.__setattr__(self, "method", method_of(self.method))
        object.__setattr__(self, "objective", Objective(task))
        started = SearchProgress(self._open_study(None), task.tried.why_regrown)
        object.__setattr__(self, "_progress", started)

    @property
    def study(self) -> Study:
        """The evaluations so far."""
        return self._progress.study

    @property
    def why_regrown(self) -> str:
        """The reason why colonies do not follow recorded growth, or ""."""
        return self._progress.why_regrown

    def run(
        self,
        colonies: int,
        *,
        study: str | Path | None = None,
        stop_at: float | None = None,
        executor: Executor | None = None,
        work_items: int = 1,
        progress: bool = True,
    ) -> Best:
        """Search until `colonies` have been simulated, or until the loss of a design is at most
        `stop_at`; returns the best design.

        colonies: each replicate of each design counts as one, a smaller colony as its share of the
        full size. The last batch may exceed the budget. study: the file that keeps every
        evaluation. If it exists and belongs to this search, the search resumes from it, and its
        colonies count. executor: of the `concurrent.futures` kind (processes, Dask, …). work_items:
        the least number of parts into which a batch is cut for it. progress: show a bar with the
        lowest loss so far. Raises InputError for an argument that is not allowed, for the study of
        another search, and where no design was grown to full size.
        """
        if isinstance(colonies, bool) or not isinstance(colonies, int) or colonies < 1:
            raise checks.input_error("colonies", colonies, "a whole number from 1")
        if stop_at is not None:
            checks.number("stop_at", stop_at)
        self._progress.study = self._open_study(study)
        task, method = self.objective.task, method_of(self.method)
        method.start(task.space, task.seed, task.replicates)
        _repeat_study(method, self.study)
        try:
            with open_bar(colonies, progress) as bar:
                _show(bar, self.study)
                while self.study.colonies < colonies and not _reached(self.study, stop_at):
                    batch = _ask(method, task)
                    found = self.objective.evaluate(
                        batch.points,
                        streams=range(min(batch.replicates or task.replicates, task.replicates)),
                        size=batch.size,
                        executor=executor,
                        work_items=work_items,
                        slopes=batch.slopes,
                    )
                    self._keep(found)
                    _tell(method, batch, found.loss, found.slopes)
                    _show(bar, self.study)
        except KeyboardInterrupt:
            self._report_interrupt(colonies)
            raise
        if self.study.entries and all(len(e.reasons) == e.losses.size for e in self.study.entries):
            reason = self.study.failures()[0][0]
            print(f"every colony failed; the most frequent reason: {reason}", file=sys.stderr)
        return self.best()

    def best(self) -> Best:
        """The best design so far. Raises InputError before a design was grown to full size."""
        found = self.study.best()
        if found is None:
            raise _none_yet()
        return self._design(*found)

    def first(self) -> Best:
        """The first design that was grown to full size. Raises InputError before there is one."""
        full = self.study.full()
        if not full:
            raise _none_yet()
        return self._design(full[0].points[0], float(full[0].loss[0]), full[0].losses[0])

    def _design(self, point: np.ndarray, loss: float, losses: np.ndarray) -> Best:
        return Best(self, self.objective.task.space.values(point), point, loss, losses)

    def _open_study(self, path: str | Path | None) -> Study:
        task = self.objective.task
        names = task.space.names
        about = task.describe() | {"names": list(names), "method": _describe(self.method)}
        streams = task.streams(None)
        if path is None:
            return Study(about, names, streams)
        return Study.open(path, about, names, streams)

    def _keep(self, found: Evaluation) -> None:
        """Add an evaluation to the study."""
        entry = Entry(
            found.points,
            found.loss,
            found.losses,
            found.cells,
            found.reasons,
            found.size,
            found.losses.shape[1],
            found.seconds,
            found.values,
            found.slopes,
            found.copies,
        )
        self.study.add(entry)
        self._progress.why_regrown = found.why_regrown

    def _report_interrupt(self, colonies: int) -> None:
        study = self.study
        kept = (
            f"{study.path} keeps them; run the search again to resume it"
            if study.path
            else "best() returns the best of them"
        )
        print(f"stopped at {study.colonies:.0f} of {colonies} colonies; {kept}.", file=sys.stderr)


@dataclass(frozen=True, eq=False)
class Best:
    """The best design of a search: its parameters by name, their point (D,), its loss, and the
    losses of its replicates (R,)."""

    search: Search = field(repr=False)
    values: dict[str, Value]
    point: np.ndarray = field(repr=False)
    loss: float
    losses: np.ndarray

    # `best.check(…)` is `check_robustness(best, …)`
    check = check_robustness

    @property
    def objective(self) -> Objective:
        """The objective that scored the design."""
        return self.search.objective

    def scene(self) -> tf.Scene:
        """The scene with these parameters, for one colony or any number of them."""
        family = self.objective.task.family
        return family.function(**family.fixed, **self.values)

    def save(self, path: str | Path) -> Path:
        """Write the design as JSON, which `torchfilm run` takes. Replaces an older file."""
        return write_design(
            Path(path),
            self.objective.task,
            self.values,
            loss=self.loss,
            losses=self.losses,
            colonies=self.search.study.colonies,
        )

    def plot(self, path: str | Path) -> Path:
        """Draw the first guess, the best design, the target and the course of the search. Needs
        matplotlib (the `app` extra)."""
        return report.draw(self._report(), Path(path))

    def table(self) -> str:
        """The parameters with their bounds and the first guess, the losses and the measures."""
        return report.table(self._report())

    def colonies(self) -> list[FinishedColonies]:
        """The replicates at their ends, grown again once: the same colonies as were scored."""
        grown, key = self.search._progress.grown, self.point.tobytes()
        if key not in grown:
            grown[key] = self.objective.colonies(self.point)
        return grown[key]

    def _report(self) -> report.SearchReport:
        first, best = (
            report.ReportedDesign(title, d.values, d.point, d.loss, d.colonies())
            for title, d in (("first guess", self.search.first()), ("best", self))
        )
        search = self.search
        return report.SearchReport(
            self.objective.task, search.study, search.why_regrown, first, best
        )


def _repeat_study(method: Method, study: Study) -> None:
    """Bring a method to where the study ends: it proposes each batch again and learns its losses.
    Raises InputError where it proposes other points."""
    for k, entry in enumerate(study.entries):
        batch = method.ask()
        # another machine may round in another way
        if batch.points.shape != entry.points.shape or not np.allclose(
            batch.points, entry.points, rtol=0, atol=1e-6
        ):
            raise tf.InputError(
                f"{study.path}: the method proposes other points than its batch {k} holds; another"
                " version of the method may have made the file. Start a new study."
            )
        same = replace(batch, points=entry.points)
        _tell(method, same, entry.loss, entry.slopes)


def _tell(method: Method, batch: Batch, loss: np.ndarray, slopes: Slopes | None) -> None:
    """Methods that never ask for slopes need not take any."""
    if batch.slopes:
        method.tell(batch, loss, slopes)  # type: ignore[call-arg]
    else:
        method.tell(batch, loss)


def _ask(method: Method, task: Task) -> Batch:
    """The next batch of a method."""
    batch = method.ask()
    if not isinstance(batch, Batch):
        raise tf.InputError(
            f"{type(method).__name__}.ask must return a design.Batch of points"
            f" (n, {task.space.size}), not {type(batch).__name__}."
        )
    return batch


def _reached(study: Study, stop_at: float | None) -> bool:
    found = study.best()
    return stop_at is not None and found is not None and found[1] <= stop_at


def _show(bar: tqdm | None, study: Study) -> None:
    """Show the colonies and the lowest loss so far."""
    if bar is None:
        return
    found = study.best()
    advance(bar, min(study.colonies, bar.total) - bar.n)
    failed = sum(len(e.reasons) for e in study.entries)
    best = "no full-size colony yet" if found is None else f"best loss {found[1]:.4f}"
    bar.set_postfix_str(best + (f", {failed} colonies failed" if failed else ""))


def _none_yet() -> tf.InputError:
    return tf.InputError(
        "no design has been grown to full size yet: run the search for more colonies."
    )


def _describe(method: str | Method) -> str:
    describe = getattr(method, "describe", None)
    return describe() if callable(describe) else type(method).__name__

"""A search: a method proposes designs, the objective scores them, and a study keeps the results,
until the budget is used. Then the best designs are tested on fresh seeds."""

from __future__ import annotations

import sys
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import torchfilm as tf
from design.best import Best
from design.finals import Finals, FinalsRun, fresh_losses, winner
from design.known import KnownDesigns, Start, known_designs
from design.methods import Method, method_of
from design.objective import Objective
from design.progress import advance, open_bar
from design.rollout import FinishedColonies
from design.study import Study
from design.task import Task, TaskOptions
from design.turn import Turn, repeat_study
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

    method: "cmaes", "sobol", "racing", "bayesian", "local", one of their objects with settings of
    its own, or any object with start, ask and tell (`Method`). finals: how the best designs are
    tested on fresh seeds; None leaves this out. start: designs from which the search starts: their
    values by name, a `Best`, the file of a saved design, or a `Study` or its file. A study of the
    same task with other bounds, or without some of the parameters, keeps its losses; of any other
    designs the best are grown again. `TaskOptions` documents the other arguments;
    `search.objective.task` holds them checked. Raises the errors of `Task`, and InputError for a
    method, finals or a start that are not allowed.
    """

    method: str | Method = field(default="cmaes", kw_only=True)
    finals: Finals | None = field(default_factory=Finals, kw_only=True)
    start: Start | None = field(default=None, kw_only=True, repr=False)
    objective: Objective = field(init=False, repr=False)
    _known: KnownDesigns | None = field(init=False, repr=False)
    _progress: SearchProgress = field(init=False, repr=False)

    def __post_init__(self) -> None:
        task = Task.of(self)
        if not isinstance(self.finals, Finals | None):
            raise checks.input_error("finals", self.finals, "Finals(…) or None")
        known = None if self.start is None else known_designs(self.start, task)
        for name, value in (
            ("method", method_of(self.method)), ("objective", Objective(task)), ("_known", known)
        ):  # fmt: skip
            object.__setattr__(self, name, value)
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
        """Search until `colonies` have been simulated, and return the best design.

        colonies: each replicate of each design counts as one, a smaller colony as its share of the
        full size; no more are grown. The last of them go to the finals: the best designs on fresh
        seeds, of which the best is returned. stop_at: a loss that is good enough. As soon as a
        design reaches it, and holds it on fresh seeds, the search ends. study: the file that keeps
        every evaluation. If it exists and belongs to this search, the search resumes from it, and
        its colonies count. executor: of the `concurrent.futures` kind (processes, Dask, …).
        work_items: the least number of parts into which a batch is cut for it. progress: show a bar
        with the lowest loss so far. Raises InputError for an argument that is not allowed, for the
        study of another search, and where no design was grown to full size.
        """
        self._check_run(colonies, stop_at)
        self._progress.study = self._open_study(study)
        try:
            with open_bar(colonies, progress) as bar:
                _show(bar, self.study)
                finals = None
                if self.finals is not None:
                    run = (self.objective.task, self.study, colonies, executor, work_items)
                    finals = FinalsRun(self.finals, *run)
                holds = self._search(colonies, stop_at, finals, bar, executor, work_items)
                if finals is not None and not holds:
                    finals.run()
                _show(bar, self.study)
        except KeyboardInterrupt:
            self._report_interrupt(colonies)
            raise
        if self.study.entries and all(len(e.reasons) == e.losses.size for e in self.study.entries):
            reason = self.study.failures()[0][0]
            print(f"every colony failed; the most frequent reason: {reason}", file=sys.stderr)
        return self.best()

    def _check_run(self, colonies: int, stop_at: float | None) -> None:
        least = self.objective.task.replicates
        if isinstance(colonies, bool) or not isinstance(colonies, int) or colonies < least:
            hint = "One design has so many replicates." if least > 1 else ""
            raise checks.input_error("colonies", colonies, f"a whole number from {least}", hint)
        if stop_at is not None:
            checks.number("stop_at", stop_at)

    def _search(
        self,
        colonies: int,
        stop_at: float | None,
        finals: FinalsRun | None,
        bar: tqdm | None,
        executor: Executor | None,
        work_items: int,
    ) -> bool:
        """Search with the part of the budget that the finals leave. Returns whether a design holds
        the wanted loss."""
        task, method = self.objective.task, method_of(self.method)
        limit = colonies - (self.finals.colonies(colonies) if self.finals else 0.0)
        method.start(task.space, task.seed, task.replicates)
        turn = repeat_study(method, self.study, self._known)
        while not self._reached(stop_at, finals):
            turn = turn or Turn.next_of(method, task, self.study, self._known)
            room = min(limit - self.study.searched, colonies - self.study.colonies)
            part = turn.part(self.objective, room)
            if part is None:
                return False
            streams = task.streams(None)[: part.replicates]
            found = self.objective.evaluate(
                part.points,
                streams=streams,
                size=part.size,
                executor=executor,
                work_items=work_items,
                slopes=part.slopes,
            )
            turn.take(found.entry(streams), self.study)
            self._progress.why_regrown = found.why_regrown
            if turn.complete:
                turn.tell(method)
                turn = None
            _show(bar, self.study)
        return True

    def _reached(self, stop_at: float | None, finals: FinalsRun | None) -> bool:
        """Whether the best design so far has the wanted loss, and holds it where it is tested."""
        if stop_at is None or not self.study.entries:
            return False
        if finals is not None:
            return finals.holds(stop_at)
        found = self.study.best()
        return found is not None and found[1] <= stop_at

    def best(self) -> Best:
        """The best design so far: on fresh seeds, where designs were tested on these. Raises
        InputError before a design was grown to full size."""
        found = self.study.best()
        if found is None:
            raise _none_yet()
        chosen = None
        if self.finals is not None:
            chosen = winner(self.objective.task, self.study, self.finals.sizes)
        return self._design(found[0] if chosen is None else chosen)

    def first(self) -> Best:
        """The first design that was grown to full size. Raises InputError before there is one."""
        found = self.study.first()
        if found is None:
            raise _none_yet()
        return self._design(found[0])

    def colonies(self, point: np.ndarray) -> list[FinishedColonies]:
        """The replicates of a design (D,) at their ends, grown again once: the same colonies as
        were scored."""
        grown, key = self._progress.grown, point.tobytes()
        if key not in grown:
            grown[key] = self.objective.colonies(point)
        return grown[key]

    def _design(self, point: np.ndarray) -> Best:
        task = self.objective.task
        fresh = None
        if self.finals is not None:
            fresh = fresh_losses(task, self.study, self.finals.sizes, point)
        return Best(self, task.space.values(point), point, self.study.scored(point)[1], fresh)

    def _open_study(self, path: str | Path | None) -> Study:
        task = self.objective.task
        names = task.space.names
        about = task.describe() | {"names": list(names), "method": _describe(self.method)}
        if self._known is not None:
            about["start"] = self._known.describe()
        streams = task.streams(None)
        if path is None:
            study = Study(about, names, streams)
        else:
            study = Study.open(path, about, names, streams)
        if self._known is not None and self._known.entry and not study.entries:
            study.entries.append(self._known.entry)
        return study

    def _report_interrupt(self, colonies: int) -> None:
        study = self.study
        kept = (
            f"{study.path} keeps them; run the search again to resume it"
            if study.path
            else "best() returns the best of them"
        )
        print(f"stopped at {study.colonies:.0f} of {colonies} colonies; {kept}.", file=sys.stderr)


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

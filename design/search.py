"""A search: a method proposes designs, the objective scores them, and a study keeps the results,
until the budget is used. Then the best designs are tested on fresh seeds."""

from __future__ import annotations

import math
import sys
import time
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import torchfilm as tf
from design.best import Best
from design.finals import MOST_SHARE, Finals, FinalsRun, fresh_losses, winner
from design.front import Front, front_of
from design.growing import FinishedColonies
from design.known import KnownDesigns, Start, known_designs
from design.methods import Chosen, Exhaustive, Method, choose, designs_of, method_of
from design.objective import Objective
from design.progress import finish, open_bar, show
from design.proposal import Proposal, checked_method, repeat_study
from design.remarks import (
    all_failed,
    remark_on_batch,
    remark_on_begin,
    remark_on_end,
    remark_on_stop,
    remark_on_stop_at,
)
from design.study import Study
from design.task import Task, TaskOptions
from design.trivial import check_within_reach
from torchfilm import checks, displays

if TYPE_CHECKING:
    from tqdm import tqdm

# A search ends where every colony of this share of its budget failed, of so many at least.
IN_VAIN, LEAST_IN_VAIN = 0.25, 64


@dataclass(eq=False)
class SearchProgress:
    """What a search has found so far. known: designs with which its study began; deadline: of the
    clock, s; late: it ended there; grown: colonies of designs that were drawn or measured, and
    scored: losses of those that only a report needs, by their points."""

    study: Study
    why_regrown: str
    chosen: Chosen | None = None
    known: KnownDesigns | None = None
    deadline: float = math.inf
    late: bool = False
    grown: dict[bytes, list[FinishedColonies]] = field(default_factory=dict)
    scored: dict[bytes, np.ndarray] = field(default_factory=dict)


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

    method: "cmaes", "sobol", "racing", "bayesian", "local", "polish", "gauss-newton", "exhaustive",
    for several goals "nsga2", one of their objects with settings of its own, or any object with
    start, ask and tell (`Method`); "auto" chooses, and `best.table()` says why. finals: how the
    best designs are tested on fresh seeds; None leaves this out. start: designs from which the
    search starts: their values by name, a `Best`, the file of a saved design, a `Study` or its
    file, or a list of these. A study of the same task with other bounds, or without some of the
    parameters, keeps its losses; of any other study the best designs are grown again; `run` prints
    which are left out, and why.
    method_seed: of what the method draws, by default `seed`, which the colonies have; to compare
    methods on the same colonies. `TaskOptions` documents the other arguments;
    `search.objective.task` holds them checked. Raises the errors of `Task`, and InputError for a
    method, finals or a start that are not allowed.
    """

    method: str | Method = field(default="auto", kw_only=True)
    finals: Finals | None = field(default_factory=Finals, kw_only=True)
    start: Start | None = field(default=None, kw_only=True, repr=False)
    method_seed: int | None = field(default=None, kw_only=True)
    objective: Objective = field(init=False, repr=False)
    _known: KnownDesigns | None = field(init=False, repr=False)
    _progress: SearchProgress = field(init=False, repr=False)

    @checks.once()  # it binds the scene of many designs
    def __post_init__(self) -> None:
        task = Task.of(self)
        if not isinstance(self.finals, Finals | None):
            raise checks.input_error("finals", self.finals, "Finals(…) or None")
        if self.method_seed is not None:
            seed = checks.integer("method_seed", self.method_seed, least=0)
            object.__setattr__(self, "method_seed", seed)
        known = None if self.start is None else known_designs(self.start, task)
        chosen = checked_method(self.method, task)
        made = {"method": chosen, "objective": Objective(task), "_known": known}
        for name, value in made.items():
            object.__setattr__(self, name, value)
        entry = None if known is None else known.entry
        parts = task.space.names, task.streams(None), entry
        study = Study.new(None, self._about("auto", known), *parts)
        object.__setattr__(self, "_progress", SearchProgress(study, task.tried.why_regrown))

    def __repr__(self) -> str:
        study = self.study
        names = ", ".join(study.names)
        return f"Search({study.about['scene']}, of {names}: {study.colonies:.0f} colonies so far)"

    def _repr_html_(self) -> str:
        return displays.card(repr(self), displays.text(self.study.info))

    @property
    def study(self) -> Study:
        """The evaluations so far."""
        return self._progress.study

    @property
    def why_regrown(self) -> str:
        """The reason why colonies do not follow recorded growth, or ""."""
        return self._progress.why_regrown

    @property
    def why_chosen(self) -> str:
        """The method that "auto" has chosen and why, or ""."""
        chosen = self._progress.chosen
        return f"{chosen.describe()} ({chosen.why})" if chosen and chosen.why else ""

    @checks.known_keywords
    @checks.once({checks.SMALL_SPECIES})  # said of the first design, as the search is made
    def run(
        self,
        colonies: int,
        *,
        study: str | Path | None = None,
        stop_at: float | None = None,
        wall_hours: float | None = None,
        executor: Executor | None = None,
        work_items: int = 1,
        progress: bool | None = None,
    ) -> Best | Any:  # Any: a Front, so that who has one goal need not ask which it is
        """Search until `colonies` have been simulated, and return the best design; with several
        goals, the front of those that none exceeds in all. It ends early where every colony of a
        quarter of them failed.

        colonies: each replicate of each design counts as one, a smaller colony as its share of the
        full size; no more are grown. The last of them go to the finals: the best designs on fresh
        seeds, of which the best is returned. stop_at: a loss that is good enough. As soon as a
        design reaches it, and holds it on fresh seeds, the search ends. study: the file that keeps
        every evaluation. If it exists and belongs to this search, the search resumes from it, and
        its colonies count. wall_hours: of the clock, after which no batch and no finals begin; a
        study may resume. executor: of the `concurrent.futures` kind (processes, Dask, …).
        work_items: the least number of parts into which a batch is cut for it. progress: a bar
        with the lowest loss so far: True, always; False, never; None, in a notebook and on a
        terminal. Raises InputError for an argument that is not allowed, for the study of another
        search, and where no design was grown to full size.
        """
        self._check_run(colonies, stop_at, work_items)
        self._begin(colonies, study, wall_hours)
        try:
            with open_bar(colonies, progress) as bar:
                show(bar, self.study)
                finals = None
                if self.finals is not None:
                    task = self.objective.task
                    under_each = colonies / task.conditions
                    run = (task, self.study, under_each, executor, work_items)
                    finals = FinalsRun(self.finals, *run, self._progress.deadline)
                holds = self._search(colonies, stop_at, finals, bar, executor, work_items)
                wanted = finals is not None and not holds and not all_failed(self.study)
                late = self._progress.late or (wanted and self._is_late)
                if finals is not None and wanted and not late:
                    self._with_all_left(finals, colonies).run()
                show(bar, self.study)
                finish(bar)
        except KeyboardInterrupt:
            remark_on_stop(self.objective.task, self.study, colonies)
            raise
        if late:
            remark_on_stop(
                self.objective.task, self.study, colonies, f" after wall_hours={wall_hours:g}"
            )
        assert self._progress.chosen is not None
        method = self._progress.chosen.method
        remark_on_end(self.objective.task, self.study, method, colonies, holds)
        return self.front() if self.objective.task.goals else self.best()

    def _with_all_left(self, finals: FinalsRun, colonies: int) -> FinalsRun:
        """The finals, which take all that is left where the method has grown all its designs."""
        if not self._is_over:
            return finals
        share = min(MOST_SHARE, 1.0 - self.study.searched / colonies)
        return replace(finals, finals=replace(finals.finals, share=max(share, finals.finals.share)))

    @property
    def _is_over(self) -> bool:
        """Whether the method of the run has nothing more to propose."""
        assert self._progress.chosen is not None
        return bool(getattr(self._progress.chosen.method, "over", False))

    def _check_run(self, colonies: int, stop_at: float | None, work_items: int) -> None:
        task = self.objective.task
        least, count = task.colonies_each, task.conditions
        under = f" under each of {count} conditions" if count > 1 else ""
        takes = f"One design takes replicates={task.replicates} colonies{under}."
        hint = takes if least > 1 else ""
        checks.integer("colonies", colonies, least=least, hint=hint)
        checks.integer("work_items", work_items, least=1)
        if stop_at is not None:
            checks.number("stop_at", stop_at)
            if task.goals:
                rule = "None with several goals, since a front has no one loss"
                raise checks.input_error("stop_at", stop_at, rule)
            remark_on_stop_at(task, self.finals, colonies / count)

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
        assert self._progress.chosen is not None
        task, method = self.objective.task, self._progress.chosen.method
        seed = task.seed if self.method_seed is None else self.method_seed
        method.start(task.space, seed, task.replicates)
        known = self._progress.known
        proposal = repeat_study(method, task, self.study, known)
        within_reach = check_within_reach(self.objective, self.study)
        while True:
            if not (self._is_late and finals) and self._reached(stop_at, finals):
                return True
            if self._is_late:  # read again: a test of a wanted loss grows colonies
                self._progress.late = self._room(colonies, False) >= task.colonies_each
                return False
            in_vain = self.study.searched >= max(IN_VAIN * colonies, LEAST_IN_VAIN)
            if proposal is None and (self._is_over or (in_vain and all_failed(self.study))):
                return False
            count = len(self.study.entries)
            proposal = proposal or Proposal.of_number(count, method, task, known)
            part = proposal.part(self.objective, self._room(colonies, False))
            if part is None and finals is not None and self._may_be_certain and finals.sound():
                part = proposal.part(self.objective, self._room(colonies, True))
            if part is None:
                return False
            streams = task.streams(None)[: part.replicates]
            found = self.objective.evaluate(
                part.points, streams=streams, size=part.size, executor=executor,
                work_items=work_items, slopes=part.slopes, residuals=part.residuals,
            )  # fmt: skip
            proposal.take(found.entry(streams), self.study)
            within_reach = within_reach or check_within_reach(self.objective, self.study)
            remark_on_batch(task, self.study, part.size, found.loss)
            self._progress.why_regrown = found.why_regrown
            if proposal.complete:
                proposal.tell(method)
                proposal = None
            show(bar, self.study)

    def _reserved(self, colonies: int, certain: bool = False) -> float:
        """How many of the colonies are for the finals. certain: seeds make no difference."""
        count = self.objective.task.conditions
        return count * self.finals.colonies(colonies / count, certain) if self.finals else 0.0

    def _room(self, colonies: int, certain: bool) -> float:
        """How many colonies the search may still grow, one design at least. Earlier finals leave
        the new ones their share."""
        limit = max(colonies - self._reserved(colonies, certain), self.objective.task.colonies_each)
        return limit - self.study.colonies

    @property
    def _may_be_certain(self) -> bool:
        """Whether seeds may make no difference, as in fits of circuits without noise."""
        task = self.objective.task
        return self.objective.least_squares and not task.target.pattern and not task.goals

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
        return self.design(found[0] if chosen is None else chosen)

    def front(self, fresh: bool = True) -> Front:
        """The designs that no other exceeds in all goals: on fresh seeds, where designs were tested
        on these; or all, on the seeds of the search. Raises InputError for a search with one
        target, and before a design was grown to full size."""
        if not self.objective.task.goals:
            raise checks.input_error("front", "one target", "of several: give targets=[…]")
        sizes = () if self.finals is None or not fresh else self.finals.sizes
        return front_of(self, self.study, sizes)

    def first(self) -> Best:
        """The first design of the search; grown now where the search grew it only small. Raises
        InputError before there is one."""
        point = self.study.first()
        if point is None:
            raise _none_yet()
        losses, kept = self.study.scored(point), self._progress.scored
        if losses is None:
            if point.tobytes() not in kept:
                kept[point.tobytes()] = self.objective.evaluate(point[None]).losses[0]
            losses = kept[point.tobytes()]
        return self._design(point, losses)

    def colonies(self, point: np.ndarray) -> list[FinishedColonies]:
        """The replicates of a design (D,) at their ends, grown again once: the same colonies as
        were scored."""
        self.objective.task.space.values(point)  # raises InputError for what is no point
        grown, key = self._progress.grown, np.asarray(point, np.float64).tobytes()
        if key not in grown:
            grown[key] = self.objective.colonies(point)
        return grown[key]

    def design(self, point: np.ndarray) -> Best:
        """A design (D,) that was grown to full size."""
        self.objective.task.space.values(point)  # raises InputError for what is no point
        losses = self.study.scored(point)
        if losses is None:
            rule = "of a design that was grown to full size"
            raise checks.input_error("point", point.tolist(), rule)
        return self._design(point, losses)

    def _design(self, point: np.ndarray, losses: np.ndarray) -> Best:
        task = self.objective.task
        values, fresh = task.space.values(point), None
        if self.finals is not None:
            fresh = fresh_losses(task, self.study, self.finals.sizes, point)
        return Best(self, values, point, losses, fresh)

    def _choose(self, colonies: int, resumed: Study | None) -> Chosen:
        """The method of a run. resumed: the study that goes on."""
        task = self.objective.task
        if self.method != "auto":
            return Chosen(method_of(self.method))
        before = "" if resumed is None else resumed.about.get("method", "")
        chosen = choose(
            task.space.size,
            colonies / task.colonies_each,
            task.goals,
            task.target.pattern,
            self.objective.least_squares,
            task.tried.stochastic,
            task.replicates,
            before,
            # where choices are resolved, several designs are one
            math.inf if task.space.digest else designs_of(task.space),
            (colonies - self._reserved(colonies)) / task.colonies_each,
            task.target.comparable and len(task.space.moving) == task.space.size,
        )
        told = task.tried.stochastic or isinstance(chosen.method, Exhaustive) or before
        why = "" if told else self.objective.why_no_squares
        return replace(chosen, why=f"{chosen.why}; no exact derivatives: {why}") if why else chosen

    def _about(self, method: str, known: KnownDesigns | None) -> dict[str, Any]:
        """What the losses of a study depend on."""
        task = self.objective.task
        about = task.describe() | {"names": list(task.space.names), "method": method}
        if self.method_seed is not None:
            about["method seed"] = self.method_seed
        return about | ({} if known is None else known.about())

    def _begin(self, colonies: int, path: str | Path | None, wall_hours: float | None) -> None:
        """Choose the method of a run, and open its study, which may resume."""
        task, progress = self.objective.task, self._progress
        progress.deadline, progress.late = math.inf, False
        if wall_hours is not None:
            hours = checks.number("wall_hours", wall_hours, above=0.0)
            progress.deadline = time.monotonic() + 3600.0 * hours
        path = None if path is None else checks.file_path("study", path)
        resumed = Study.read(path) if path is not None and path.exists() else None
        progress.chosen, known = self._choose(colonies, resumed), self._known
        if known is not None and resumed is not None:
            known = known.begun(resumed)
        about = self._about(progress.chosen.describe(), known)
        if resumed is not None:
            resumed.check(about)
        entry = None if known is None else known.entry
        parts = task.space.names, task.streams(None), entry
        progress.known, progress.study = known, resumed or Study.new(path, about, *parts)
        if known is not None and known.remark:
            print(known.remark, file=sys.stderr)
        remark_on_begin(task)

    @property
    def _is_late(self) -> bool:
        """Whether the hours of the run have passed."""
        return time.monotonic() >= self._progress.deadline


def _none_yet() -> tf.InputError:
    return tf.InputError(
        "no design has been grown to full size yet: run the search for more colonies."
    )

"""The objective: designs in, losses out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from design import executors
from design.derivatives import along, differences, neighbours
from design.entries import Entry
from design.growing import FinishedColonies
from design.parameters import Value
from design.scoring import cut_work_items, finished_colonies, run_work_item
from design.slopes import Slopes
from design.task import Task
from torchfilm import checks


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The losses of some designs.

    points (n, D); values: their parameters by name; losses (n, R), of each replicate; loss (n,);
    cells (n, R), of each colony at its end; reasons, by (row, replicate), why a colony failed;
    size: share of the full size; why_regrown: the reason why colonies did not follow recorded
    growth, or ""; seconds; slopes: of the n designs, where they were asked for; copies: colonies
    that were grown for each loss (n, R); goals (n, G), each_goals (n, R, G), residuals (n, K): as
    `Entry` has them.
    """

    points: np.ndarray
    values: list[dict[str, Value]]
    losses: np.ndarray
    loss: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    size: float
    why_regrown: str
    seconds: float
    slopes: Slopes | None = None
    copies: int = 1
    goals: np.ndarray | None = None
    each_goals: np.ndarray | None = None
    residuals: np.ndarray | None = None

    def entry(self, streams: tuple[int, ...], size: float | None = None) -> Entry:
        """For a study. streams: that were evaluated; size: share of the full size of the search,
        where the objective has another."""
        return Entry(
            points=self.points,
            loss=self.loss,
            losses=self.losses,
            cells=self.cells,
            reasons=self.reasons,
            size=self.size if size is None else size,
            seconds=self.seconds,
            values=self.values,
            streams=streams,
            slopes=self.slopes,
            copies=self.copies,
            goals=self.goals,
            each_goals=self.each_goals,
            residuals=self.residuals,
        )


@dataclass(frozen=True, eq=False)
class Objective(metaclass=checks.KnownKeywords):
    """Maps designs of a task to their losses: how far their colonies are from the target."""

    task: Task

    def __post_init__(self) -> None:
        if not isinstance(self.task, Task):
            raise checks.input_error("task", self.task, "a Task(…)")

    @checks.known_keywords
    def evaluate(
        self,
        points: np.ndarray,
        *,
        streams: Sequence[int] | None = None,
        size: float = 1.0,
        executor: Executor | None = None,
        work_items: int = 1,
        slopes: bool = False,
        residuals: bool = False,
    ) -> Evaluation:
        """Grow and score designs, (n, D) coordinates in [0, 1]. All replicates of all designs share
        as few batches as fit into memory.

        streams: of random numbers, one for each replicate; by default 0 … replicates − 1. size:
        share of `cells` and `until`, for a cheap first look. slopes: also derivatives by the
        parameters without levels: exact where `why_differences` is "", else from differences.
        residuals: also those of a `comparable` target. executor: of the `concurrent.futures` kind,
        for other processes or machines. work_items: the least number of parts for it. This process
        runs what the executor loses, and warns. The losses are the same to the bit however the
        designs are divided, on machines of the same kind. Raises InputError for points, streams or
        a size that are not allowed, and for residuals of a target that has none to compare.
        """
        begun, task = time.perf_counter(), self.task
        try:
            points = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise checks.input_error("points", points, "an array of numbers") from error
        if (
            points.ndim != 2
            or points.shape[1] != task.space.size
            or not len(points)
            or not bool(((points >= 0) & (points <= 1)).all())
        ):
            raise checks.input_error(
                "points", points.shape, f"(n, {task.space.size}) coordinates in [0, 1]"
            )
        checks.number("size", size, above=0.0, most=1.0)
        if residuals and not task.target.comparable:
            rule = "False: this target has none that compare from colony to colony"
            raise checks.input_error("residuals", residuals, rule)
        chosen, run = task.streams(streams), (size, executor, work_items, residuals)
        if not slopes:
            found = self._grow(points, None, chosen, *run)
        elif self.why_differences:
            found = self._differences(points, chosen, *run)
        else:
            found = self._grow(points, [along(task.space, p) for p in points], chosen, *run)
        return replace(found, seconds=time.perf_counter() - begun)

    @property
    def why_differences(self) -> str:
        """Why slopes are differences between runs, and not exact; "" where they are exact."""
        task = self.task
        if not task.space.moving:
            raise checks.InputError(
                "there are no derivatives: every parameter is whole or a choice. Use another"
                ' method, such as "racing".'
            )
        if task.target.reduced(np.zeros((1, task.replicates))) is not None:
            return "the loss is a statistic of several seeds"
        return task.why_rough

    @property
    def least_squares(self) -> bool:
        """Whether the loss is a sum of squares with exact derivatives."""
        return self._may_be_squares and not self.why_differences

    @property
    def why_no_squares(self) -> str:
        """Why a sum of squares has no exact derivatives, or ""."""
        return self.why_differences if self._may_be_squares else ""

    @property
    def _may_be_squares(self) -> bool:
        return self.task.target.squares and bool(self.task.space.moving)

    def copies(self, slopes: bool) -> int:
        """Colonies that are grown for each loss."""
        moving = len(self.task.space.moving)
        of_slopes = 1 if not slopes else 1 + 2 * moving if self.why_differences else moving
        return of_slopes * self.task.conditions

    def _grow(
        self,
        points: np.ndarray,
        tangents: list[list[dict[str, float]]] | None,
        streams: tuple[int, ...],
        size: float,
        executor: Executor | None,
        work_items: int,
        residuals: bool,
    ) -> Evaluation:
        task, count = self.task, len(streams)
        values = [task.space.values(point) for point in points]
        items = cut_work_items(task, values, count, size, work_items, tangents, residuals)
        results = (
            ((item, run_work_item(task, item, streams, size)) for item in items)
            if executor is None
            else executors.run_work_items(task, items, streams, size, executor)
        )
        losses = np.full((len(points), count), np.nan)
        cells = np.zeros((len(points), count), np.int64)
        gathered = Slopes.none(len(points) * count, task.space.size)
        reasons: dict[tuple[int, int], str] = {}
        why_regrown = ""
        goals = np.full((len(points), count, task.goals), np.nan)
        apart: np.ndarray | None = None
        for item, found in results:
            rows = list(item.rows)
            if found.residuals is not None:
                if apart is None:
                    apart = np.full((*losses.shape, found.residuals.shape[2]), np.nan)
                apart[rows] = found.residuals
            if found.goals is not None:
                goals[rows] = found.goals
            losses[rows], cells[rows] = found.losses, found.cells
            reasons |= {(rows[row], k): words for (row, k), words in found.reasons.items()}
            why_regrown = why_regrown or found.why_regrown
            if found.slopes is not None:
                gathered.put([row * count + k for row in rows for k in range(count)], found.slopes)
        shares = task.shares(losses)
        slopes = None if tangents is None else gathered.reduced(shares)
        mean = None if apart is None else _shared(shares, apart)
        copies = task.conditions * (1 if tangents is None else len(tangents[0]))
        return Evaluation(
            points, values, losses, task.reduced(losses), cells, reasons, size, why_regrown, 0.0,
            slopes, copies, task.reduced_goals(goals), goals if task.goals else None, mean,
        )  # fmt: skip

    def _differences(self, points: np.ndarray, streams: tuple[int, ...], *run: Any) -> Evaluation:
        """Of each point and of its neighbours, grown side by side."""
        space = self.task.space
        beside = [neighbours(space, point) for point in points]
        each = 1 + len(beside[0])
        every = np.concatenate([np.vstack([p, b]) for p, b in zip(points, beside, strict=True)])
        found = self._grow(every, None, streams, *run)
        first = slice(None, None, each)
        loss = found.loss.copy()
        loss[[row for row, _ in found.reasons]] = np.nan  # no slope leads to a failure
        slopes = differences(space, loss.reshape(-1, each)[:, 1:])
        return replace(
            found,
            points=points, values=found.values[first], losses=found.losses[first],
            loss=found.loss[first], cells=found.cells[first], slopes=slopes,
            copies=each * found.copies,
            goals=None if found.goals is None else found.goals[first],
            each_goals=None if found.each_goals is None else found.each_goals[first],
            residuals=None if found.residuals is None else found.residuals[first],
            reasons={(r // each, k): w for (r, k), w in found.reasons.items() if not r % each},
        )  # fmt: skip

    def colonies(
        self, point: np.ndarray, *, streams: Sequence[int] | None = None
    ) -> list[FinishedColonies]:
        """The colonies of one design, (D,), at their ends, for pictures and measures. Colonies that
        fail are left out."""
        values = self.task.space.values(np.asarray(point))
        return finished_colonies(self.task, values, self.task.streams(streams))


def _shared(shares: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """The residuals (n, K) of designs, from those of their replicates (n, R, K) that have a share
    in the loss, (n, R)."""
    each = shares[:, :, None]
    return np.where(each > 0, each * residuals, 0.0).sum(1)

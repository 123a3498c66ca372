"""The objective: designs in, losses out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from design import executors
from design.parameters import Value
from design.rollout import FinishedColonies
from design.scoring import cut_work_items, finished_colonies, run_work_item
from design.task import Task
from torchfilm import checks


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The losses of some designs.

    points (n, D); values: their parameters by name; losses (n, R), of each replicate; loss (n,);
    cells (n, R), of each colony at its end; reasons, by (row, replicate), why a colony failed;
    size: share of the full size; why_regrown: the reason why colonies did not follow recorded
    growth, or ""; seconds.
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


@dataclass(frozen=True, eq=False)
class Objective:
    """Maps designs of a task to their losses: how far their colonies are from the target."""

    task: Task

    def evaluate(
        self,
        points: np.ndarray,
        *,
        streams: Sequence[int] | None = None,
        size: float = 1.0,
        executor: Executor | None = None,
        work_items: int = 1,
    ) -> Evaluation:
        """Grow and score designs, (n, D) coordinates in [0, 1]. All replicates of all designs share
        as few batches as fit into memory.

        streams: of random numbers, one for each replicate; by default 0 … replicates − 1. size:
        share of `cells` and `until`, for a cheap first look. executor: of the `concurrent.futures`
        kind, for other processes or machines. work_items: the least number of parts for it. This
        process runs what the executor loses, and warns. The losses are the same to the bit however
        the designs are divided, on machines of the same kind. Raises InputError for points, streams
        or a size that are not allowed.
        """
        begun, task = time.perf_counter(), self.task
        points = np.asarray(points, dtype=np.float64)
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
        chosen = task.streams(streams)
        values = [task.space.values(point) for point in points]
        items = cut_work_items(task, values, len(chosen), size, work_items)
        results = (
            ((item, run_work_item(task, item, chosen, size)) for item in items)
            if executor is None
            else executors.run_work_items(task, items, chosen, size, executor)
        )
        losses = np.full((len(points), len(chosen)), np.nan)
        cells = np.zeros((len(points), len(chosen)), np.int64)
        reasons: dict[tuple[int, int], str] = {}
        why_regrown = ""
        for item, found in results:
            rows = list(item.rows)
            losses[rows], cells[rows] = found.losses, found.cells
            reasons |= {(rows[row], k): words for (row, k), words in found.reasons.items()}
            why_regrown = why_regrown or found.why_regrown
        loss, seconds = task.reduced(losses), time.perf_counter() - begun
        return Evaluation(points, values, losses, loss, cells, reasons, size, why_regrown, seconds)

    def colonies(
        self, point: np.ndarray, *, streams: Sequence[int] | None = None
    ) -> list[FinishedColonies]:
        """The colonies of one design, (D,), at their ends, for pictures and measures. Colonies that
        fail are left out."""
        values = self.task.space.values(np.asarray(point))
        return finished_colonies(self.task, values, self.task.streams(streams))

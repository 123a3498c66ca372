"""Grow one part of an evaluation in one batch of colonies, and score each colony."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

import torchfilm as tf
from design import colonies, memory
from design.parameters import Value
from design.rollout import FinishedColonies, grow
from design.targets.base import Target
from design.task import Task


@dataclass(frozen=True)
class WorkItem:
    """Part of an evaluation: the rows of designs whose scenes have the same structure, and the
    values of their parameters."""

    rows: tuple[int, ...]
    values: tuple[dict[str, Value], ...]


@dataclass(frozen=True, eq=False)
class WorkResult:
    """The result of a work item: losses and cells (n, R), and the reasons of failures by (row of
    the item, replicate). why_regrown: the reason why no recorded growth was used, or ""."""

    losses: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    why_regrown: str


def cut_work_items(
    task: Task, values: Sequence[dict[str, Value]], replicates: int, size: float, least: int
) -> list[WorkItem]:
    """Cut designs into at least `least` parts, where there are as many designs. One scene can hold
    each part, and one batch fits into memory."""
    structural = [p.name for p in task.space.parameters if p.levels is not None]
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, design in enumerate(values):
        groups.setdefault(tuple(repr(design[n]) for n in structural), []).append(row)
    out = []
    for rows in groups.values():
        most = task.most or _max_colonies(task, [values[r] for r in rows], size)
        wanted = max(
            math.ceil(len(rows) / max(1, most // replicates)),
            math.ceil(least * len(rows) / len(values)),
        )
        count = min(len(rows), wanted)
        cuts = [len(rows) * k // count for k in range(count + 1)]  # as even as possible
        out += [
            WorkItem(tuple(rows[a:b]), tuple(values[r] for r in rows[a:b]))
            for a, b in itertools.pairwise(cuts)
        ]
    return out


def _max_colonies(task: Task, values: Sequence[dict[str, Value]], size: float) -> int:
    """How many colonies of designs with the same structure fit into memory at once."""
    for design in values:
        # the scene may refuse a design; the first that it accepts shows the grid
        with contextlib.suppress(tf.InputError):
            nodes = colonies.grid_nodes(task.family.scene([design]), task.dtype)
            return memory.max_colonies(nodes, task.end(size)[0], task.dtype, task.device)
    return 1


def run_work_item(task: Task, item: WorkItem, streams: tuple[int, ...], size: float) -> WorkResult:
    """Grow and score a work item in one batch; in halves where it does not fit into memory, or
    where the scene refuses one of its designs."""
    count, replicates = len(item.rows), len(streams)
    try:
        return _grow_and_score(task, item, streams, size)
    except (tf.InputError, tf.SimulationError) as error:
        if count == 1:
            return WorkResult(
                np.full((1, replicates), task.target.failed),
                np.zeros((1, replicates), np.int64),
                {(0, k): str(error) for k in range(replicates)},
                "",
            )
    except (MemoryError, RuntimeError) as error:
        if count == 1 or not memory.is_lack_of_memory(error):
            raise
    half = count // 2
    first, second = (
        run_work_item(task, WorkItem(item.rows[part], item.values[part]), streams, size)
        for part in (slice(0, half), slice(half, count))
    )
    moved = {(row + half, k): reason for (row, k), reason in second.reasons.items()}
    return WorkResult(
        np.concatenate([first.losses, second.losses]),
        np.concatenate([first.cells, second.cells]),
        first.reasons | moved,
        first.why_regrown or second.why_regrown,
    )


@torch.no_grad()
def _grow_and_score(
    task: Task, item: WorkItem, streams: tuple[int, ...], size: float
) -> WorkResult:
    count, replicates = len(item.rows), len(streams)
    scene = task.family.scene(item.values, repeat=replicates)
    prepared = colonies.prepare(scene, streams * count, task.settings)
    losses = np.full(count * replicates, task.target.failed, np.float64)
    cells = np.zeros(count * replicates, np.int64)
    reasons: dict[tuple[int, int], str] = {}
    most_cells, until = task.end(size)
    for event in grow(prepared, cells=most_cells, until=until, note=task.target.note):
        if not isinstance(event, FinishedColonies):
            reasons[divmod(event.colony_id, replicates)] = event.reason
            continue
        ids = event.state.colony_id.tolist()
        score = _scores(task.target, event)
        for colony_id, number in zip(ids, score.tolist(), strict=True):
            if not math.isfinite(number):
                reasons[divmod(colony_id, replicates)] = f"the target's loss was {number}"
        losses[ids] = np.where(np.isfinite(score), score, task.target.failed)
        cells[ids] = event.state.counts.cpu().numpy()
    shape = (count, replicates)
    return WorkResult(losses.reshape(shape), cells.reshape(shape), reasons, prepared.why_regrown)


def _scores(target: Target, finished: FinishedColonies) -> np.ndarray:
    """The losses of finished colonies, (B,)."""
    count = finished.state.colonies
    found = target.loss(finished.state, finished.history)
    if not isinstance(found, torch.Tensor) or found.shape != (count,):
        raise TypeError(
            f"{type(target).__name__}.loss must return a tensor of shape ({count},), one number for"
            " each colony"
        )
    return found.double().cpu().numpy()


@torch.no_grad()
def finished_colonies(
    task: Task, values: dict[str, Value], streams: tuple[int, ...]
) -> list[FinishedColonies]:
    """The full-size colonies of one design at their ends, without those that fail."""
    try:
        scene = task.family.scene([values], repeat=len(streams))
        prepared = colonies.prepare(scene, streams, task.settings)
    except tf.InputError:  # the scene refuses this design
        return []
    cells, until = task.end(1.0)
    events = grow(prepared, cells=cells, until=until, note=task.target.note)
    return [e for e in events if isinstance(e, FinishedColonies)]

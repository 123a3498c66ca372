"""Grow one part of an evaluation in one batch of colonies, and score each colony."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np
import torch

import torchfilm as tf
from design import colonies, memory
from design.derivatives import Gathered
from design.entries import joined_residuals
from design.growing import FinishedColonies, grow
from design.parameters import Value
from design.scene_family import UnfitDesign, why_rough
from design.slopes import Slopes, joined
from design.targets.base import Target, check_squares
from design.targets.goals import Goals
from design.task import Task

T = TypeVar("T")


@dataclass(frozen=True)
class WorkItem:
    """Part of an evaluation: the rows of designs whose scenes have the same structure, and the
    values of their parameters. tangents: for the derivatives, of each design the tangents of its
    copies (`derivatives.along`); None where only losses are wanted. residuals: whether those of a
    comparable target are wanted."""

    rows: tuple[int, ...]
    values: tuple[dict[str, Value], ...]
    tangents: tuple[list[dict[str, float]], ...] | None = None
    residuals: bool = False

    def take(self, places: Sequence[int]) -> WorkItem:
        """The designs at some places."""
        of = lambda x: tuple(x[k] for k in places)
        tangents = self.tangents and of(self.tangents)
        return WorkItem(of(self.rows), of(self.values), tangents, self.residuals)


@dataclass(frozen=True, eq=False)
class WorkResult:
    """The result of a work item: losses and cells (n, R), and the reasons of failures by (row of
    the item, replicate). why_regrown: the reason why no recorded growth was used, or "". slopes: of
    the n · R colonies, where they were asked for. goals: of each colony (n, R, G), NaN where it
    failed; None where all did. residuals: (n, R, K) where they were asked for, so too."""

    losses: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    why_regrown: str
    slopes: Slopes | None = None
    goals: np.ndarray | None = None
    residuals: np.ndarray | None = None


def cut_work_items(
    task: Task,
    values: Sequence[dict[str, Value]],
    replicates: int,
    size: float,
    least: int,
    tangents: Sequence[list[dict[str, float]]] | None = None,
    residuals: bool = False,
) -> list[WorkItem]:
    """Cut designs into at least `least` parts, where there are as many designs. One scene can hold
    each part, and one batch fits into memory. tangents, residuals: as `WorkItem` has them."""
    of_copies = None if tangents is None else tuple(tangents)
    whole = WorkItem(tuple(range(len(values))), tuple(values), of_copies, residuals)
    colonies_each = replicates * task.conditions * (1 if tangents is None else len(tangents[0]))
    structural = [p.name for p in task.space.parameters if p.structural]
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, design in enumerate(values):
        groups.setdefault(tuple(repr(design[n]) for n in structural), []).append(row)
    out = []
    apart = (_unfit_apart(task, values, rows) for rows in groups.values())
    for rows in itertools.chain.from_iterable(apart):
        most = task.most or _max_colonies(
            task, [values[r] for r in rows], size, tangents is not None
        )
        wanted = max(
            math.ceil(len(rows) / max(1, most // colonies_each)),
            math.ceil(least * len(rows) / len(values)),
        )
        count = min(len(rows), wanted)
        cuts = [len(rows) * k // count for k in range(count + 1)]  # as even as possible
        out += [whole.take(rows[a:b]) for a, b in itertools.pairwise(cuts)]
    return out


def _unfit_apart(
    task: Task, values: Sequence[dict[str, Value]], rows: list[int]
) -> list[list[int]]:
    """The rows of designs with the same structure, each unfit one by itself: it must not cut the
    batch of the others in halves."""

    def is_unfit(among: list[int]) -> bool:
        try:
            task.family.scene([values[row] for row in among])
        except UnfitDesign:
            return True
        except tf.InputError:  # `run_work_item` finds the design that the scene refuses
            return False
        return False

    if not is_unfit(rows):
        return [rows]
    unfit = [row for row in rows if is_unfit([row])]
    fit = [row for row in rows if row not in unfit]
    return [*([fit] if fit else []), *([row] for row in unfit)]


def _max_colonies(task: Task, values: Sequence[dict[str, Value]], size: float, slopes: bool) -> int:
    """How many colonies of designs with the same structure fit into memory at once."""
    cells, until = task.end(size)
    for design in values:
        # the scene may refuse a design; the first that it accepts shows the grid
        with contextlib.suppress(tf.InputError):
            scene = task.family.scene([design])
            first = colonies.first_state(scene, task.dtype, task.conditions)
            nodes, founders = colonies.grid_nodes(first), task.tried.founders
            each = task.target.kept(first) if slopes else 0.0
            notes = memory.kept_notes(each, founders, cells, until, cast(float, task.dt))
            return memory.max_colonies(nodes, cells, task.dtype, task.device, notes)
    return 1


def in_halves(
    item: WorkItem, act: Callable[[WorkItem], T]
) -> Iterator[tuple[WorkItem, T | Exception]]:
    """What `act` makes of a work item, or of its halves, one after the other, where it does not fit
    into memory or where the scene refuses one of its designs: of that one the error."""
    count = len(item.rows)
    try:
        yield item, act(item)
        return
    except (tf.InputError, tf.SimulationError) as error:
        if count == 1:
            yield item, error
            return
    except (MemoryError, RuntimeError) as error:
        if count == 1 or not memory.is_lack_of_memory(error):
            raise
    for part in (range(count // 2), range(count // 2, count)):
        yield from in_halves(item.take(part), act)


def run_work_item(task: Task, item: WorkItem, streams: tuple[int, ...], size: float) -> WorkResult:
    """Grow and score a work item in one batch, or `in_halves`."""
    act = lambda part: _grow_and_score(task, part, streams, size)
    parts = [
        _refused(task, part, len(streams), str(found)) if isinstance(found, Exception) else found
        for part, found in in_halves(item, act)
    ]
    return parts[0] if len(parts) == 1 else _side_by_side(task, parts, len(streams))


def _refused(task: Task, item: WorkItem, replicates: int, reason: str) -> WorkResult:
    """The result of one design that the scene refuses."""
    return WorkResult(
        np.full((1, replicates), task.target.failed),
        np.zeros((1, replicates), np.int64),
        {(0, k): reason for k in range(replicates)},
        "",
        None if item.tangents is None else Slopes.none(replicates, task.space.size),
    )


def _side_by_side(task: Task, parts: list[WorkResult], replicates: int) -> WorkResult:
    """The results of the parts of a work item as one."""
    before = [0, *itertools.accumulate(len(part.losses) for part in parts)]
    reasons = [
        {(row + first, k): why for (row, k), why in part.reasons.items()}
        for first, part in zip(before, parts, strict=False)
    ]
    slopes = [part.slopes for part in parts if part.slopes is not None]
    return WorkResult(
        np.concatenate([part.losses for part in parts]),
        np.concatenate([part.cells for part in parts]),
        dict(itertools.chain.from_iterable(found.items() for found in reasons)),
        next((part.why_regrown for part in parts if part.why_regrown), ""),
        joined(slopes) if slopes else None,
        np.concatenate([_goals(task, part, replicates) for part in parts]),
        joined_residuals([(x.residuals, x.losses.shape) for x in parts]),
    )


def _goals(task: Task, part: WorkResult, replicates: int) -> np.ndarray:
    """The losses of each goal (n, R, G); NaN where all colonies failed."""
    none = np.full((len(part.losses), replicates, task.goals), np.nan)
    return none if part.goals is None else part.goals


@torch.no_grad()
@tf.one_torch_thread()
def _grow_and_score(
    task: Task, item: WorkItem, streams: tuple[int, ...], size: float
) -> WorkResult:
    """The colonies of a replicate stand side by side in the batch: one under each condition, and
    these again for each derivative."""
    count, replicates = len(item.rows), len(streams) * task.conditions
    copies = 1 if item.tangents is None else len(item.tangents[0])
    with tf.tangents.forward_mode() if item.tangents else contextlib.nullcontext():
        scene = _scene(task, item, len(streams))
        prepared = colonies.prepare(
            scene,
            [s for _ in item.rows for s in streams for _ in range(task.conditions * copies)],
            task.settings,
        )
        if item.tangents and why_rough(scene, prepared.why_regrown):
            # no slope is better than a wrong one
            plain = _grow_and_score(task, replace(item, tangents=None), streams, size)
            return replace(plain, slopes=Slopes.unknown(count * len(streams), task.space.size))
        losses = np.full(count * replicates, task.target.failed, np.float64)
        goals = np.full((count * replicates, task.goals), np.nan)
        cells = np.zeros(count * replicates, np.int64)
        gathered = Gathered(task.space, count * replicates) if item.tangents else None
        residuals: dict[int, np.ndarray] = {}
        reasons: dict[tuple[int, int], str] = {}
        most_cells, until = task.end(size)
        note = task.target.course if item.tangents else task.target.note
        fewest = task.target.fewest
        for event in grow(prepared, cells=most_cells, until=until, note=note, fewest=fewest):
            if not isinstance(event, FinishedColonies):
                number = int(_numbers([event.colony_id], task.conditions, copies)[0])
                reasons[divmod(number, replicates)] = event.reason
                continue
            numbers = _numbers(event.state.colony_id.tolist(), task.conditions, copies)
            places = _places(numbers, copies)
            first, ids = places[:, 0], numbers[places[:, 0]].tolist()
            score = _scores(task.target, event)[first]
            score, why = _below_failed(task.target, score, event, places[:, 0])
            reasons |= {divmod(ids[k], replicates): words for k, words in why.items()}
            unfit = np.array(_unfit(task, event.state, size))[first].tolist()
            reasons |= {divmod(k, replicates): w for k, w in zip(ids, unfit, strict=True) if w}
            good = np.isfinite(score) & np.array([not why for why in unfit])
            check_squares(task.target, event.state, event.history, score, first, good)
            losses[ids] = np.where(good, score, task.target.failed)
            if isinstance(task.target, Goals):
                each = task.target.losses(event.state, event.history).cpu().numpy()[first]
                goals[ids] = np.where(good[:, None], each, np.nan)
            if item.residuals:
                apart = _residuals(task.target, event)[first]
                residuals |= {k: apart[at] for at, k in enumerate(ids) if good[at]}
            cells[ids] = event.state.counts.cpu().numpy()[first]
            if gathered is not None:
                gathered.add(task.target, event, ids, places)
                gathered.forget([k for k, well in zip(ids, good, strict=True) if not well])
    shape, slopes = (count, replicates), None if gathered is None else gathered.slopes
    found = WorkResult(
        losses.reshape(shape), cells.reshape(shape), reasons, prepared.why_regrown, slopes,
        goals.reshape(*shape, task.goals), _in_rows(residuals, shape),
    )  # fmt: skip
    return found if task.conditions == 1 else _of_replicates(task, found)


def _numbers(ids: Sequence[int], conditions: int, copies: int) -> np.ndarray:
    """The numbers of colonies with these ids, (B,), among those without copies."""
    block, rest = np.divmod(np.asarray(ids), conditions * copies)
    return block * conditions + rest % conditions


def _places(numbers: np.ndarray, copies: int) -> np.ndarray:
    """Where the copies of each colony are in the batch, (n, copies), from the lowest number on."""
    return np.argsort(numbers, kind="stable").reshape(-1, copies)


def _of_replicates(task: Task, found: WorkResult) -> WorkResult:
    """The result of replicates (n, R), from that of their colonies, one under each condition: the
    mean of their losses, and the fewest cells. Where one failed, the replicate did. Each of its
    residuals is that of one condition, 0 in the colonies under others."""
    shape = (len(found.losses), -1, task.conditions)
    reasons: dict[tuple[int, int], str] = {}
    for (row, k), words in sorted(found.reasons.items()):
        replicate, condition = divmod(k, task.conditions)
        reasons.setdefault((row, replicate), f"where {task.target.label(condition)}: {words}")
    losses = found.losses.reshape(shape).mean(2)
    for place in reasons:
        losses[place] = task.target.failed
    cells = found.cells.reshape(shape).min(2)
    slopes = found.slopes
    if slopes is not None:
        slopes = slopes.reduced(np.full((losses.size, task.conditions), 1.0 / task.conditions))
        failed = [row * losses.shape[1] + replicate for row, replicate in reasons]
        slopes.put(failed, Slopes.none(len(failed), task.space.size))
    residuals = found.residuals
    if residuals is not None:
        each = residuals.reshape(*losses.shape, task.conditions, -1)
        residuals = each.sum(2) / math.sqrt(task.conditions)
    return replace(
        found, losses=losses, cells=cells, reasons=reasons, slopes=slopes, goals=None,
        residuals=residuals,
    )  # fmt: skip


def _below_failed(
    target: Target, score: np.ndarray, event: FinishedColonies, rows: np.ndarray
) -> tuple[np.ndarray, dict[int, str]]:
    """Losses (n,) of some rows (n,) of finished colonies that a search can compare, NaN for the
    others, and why, by their places: a colony that grew must not look worse than one that
    failed."""
    why, undefined = {}, np.flatnonzero(~np.isfinite(score)).tolist()
    words = _undefined(target, event, [int(rows[k]) for k in undefined])
    missing = dict(zip(undefined, words, strict=True))
    for k, number in enumerate(score.tolist()):
        if not math.isfinite(number):
            why[k] = f"the target's loss was {number}{missing[k]}"
        elif number > target.failed:
            why[k] = (
                f"the target's loss was {number:g}, above {target.failed:g}, that of a failed"
                " colony. Give your target a class attribute `failed` above all its losses"
            )
    return np.where([k in why for k in range(len(score))], np.nan, score), why


def _undefined(target: Target, event: FinishedColonies, rows: list[int]) -> list[str]:
    """Of each of these colonies the first measure that data are compared with and that is not a
    number."""
    known = target.evidence
    if not rows or not known:
        return [""] * len(rows)
    found = target.measures(event.state, event.history)
    each = [(n, found[n].isnan() & target.concerns(n, event.state)) for n in found if n in known]
    out = []
    for row in rows:
        name = next((name for name, missing in each if missing[row]), None)
        reason = "" if name is None else target.why_undefined(name)
        as_ = f", as {reason}" if reason else ""
        out.append("" if name is None else f": {name} was not a number{as_}")
    return out


def _unfit(task: Task, state: tf.State, size: float) -> list[str]:
    """Why each finished colony cannot be scored, "" where it can."""
    wanted = task.end(size)[0]
    least = min(task.target.fewest, wanted or task.target.fewest)
    if wanted is not None:
        least = max(least, math.ceil(wanted / 2))
    why = task.target.unfit(state) if size >= 1.0 else [""] * state.colonies
    for k, count in enumerate(state.counts.tolist()):
        if count < least and (count or task.target.fewest):
            of = f"half of {wanted}" if wanted else f"the least for {type(task.target).__name__}"
            why[k] = (
                f"it has {count} cells at {state.time:g} h, and {least}, {of}, are needed: a"
                " smaller colony shows no pattern. Raise until."
            )
    return why


def _scene(task: Task, item: WorkItem, replicates: int) -> tf.Scene:
    """The scene of all colonies of a work item."""
    if item.tangents is None:
        return task.family.scene(item.values, repeat=replicates)
    each = [
        (values, tangent)
        for values, tangents in zip(item.values, item.tangents, strict=True)
        for _ in range(replicates)
        for tangent in tangents
    ]
    return task.family.scene([v for v, _ in each], tangents=[t for _, t in each])


def _scores(target: Target, finished: FinishedColonies) -> np.ndarray:
    """The losses of finished colonies, (B,)."""
    count = finished.state.colonies
    found = target.loss(finished.state, finished.history)
    if not isinstance(found, torch.Tensor) or found.shape != (count,) or found.is_complex():
        raise TypeError(
            f"{type(target).__name__}.loss must return a tensor of shape ({count},), one number for"
            " each colony"
        )
    return found.double().cpu().numpy()


def _residuals(target: Target, finished: FinishedColonies) -> np.ndarray:
    """The residuals of finished colonies, (B, K)."""
    found, count = target.residuals(finished.state, finished.history), finished.state.colonies
    if not isinstance(found, torch.Tensor) or found.dim() != 2 or len(found) != count:
        raise TypeError(
            f"{type(target).__name__}.residuals must return a tensor of shape ({count}, K), since"
            " the target is comparable"
        )
    return found.double().cpu().numpy()


def _in_rows(each: dict[int, np.ndarray], shape: tuple[int, int]) -> np.ndarray | None:
    """Residuals (n, R, K) from those of each colony (K,) by its number, NaN where it failed; None
    where all did."""
    if not each:
        return None
    out = np.full((shape[0] * shape[1], len(next(iter(each.values())))), np.nan)
    out[list(each)] = list(each.values())
    return out.reshape(*shape, -1)


@tf.one_torch_thread()
@torch.no_grad()
def finished_colonies(
    task: Task, values: dict[str, Value], streams: tuple[int, ...]
) -> list[FinishedColonies]:
    """The full-size colonies of one design at their ends, without those that fail."""
    try:
        scene = task.family.scene([values], repeat=len(streams))
        each = [stream for stream in streams for _ in range(task.conditions)]
        prepared = colonies.prepare(scene, each, task.settings)
    except tf.InputError:  # the scene refuses this design
        return []
    cells, until = task.end(1.0)
    target = task.target
    events = grow(prepared, cells=cells, until=until, note=target.note, fewest=target.fewest)
    return [e for e in events if isinstance(e, FinishedColonies)]

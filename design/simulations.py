"""Simulations for inference: colonies of random parameters, and their statistics."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

import torchfilm as tf
from design import colonies
from design.data_file import Stamp, reading, replacing, stamp, write_values
from design.executors import check_executor
from design.growing import FailedColony, grow
from design.parameters import Value
from design.prior import Prior
from design.reasons import tally
from design.region import Region
from design.scoring import WorkItem, cut_work_items, in_halves
from design.targets.measured import NO_CELLS
from design.targets.observed import Observed
from design.targets.observed_conditions import averaged, checked_data, errors, places
from design.task import SURVIVORS, Task
from torchfilm import checks

FORMAT, VERSION = "torchfilm simulations", 1
NOISE = 5  # of the stream of random numbers that errors of measurement follow
BATCH = 256  # designs that are grown at once, and after which the file is written


@dataclass(frozen=True, eq=False)
class Simulations:
    """Statistics of colonies of random parameters.

    points: coordinates of the parameters, (n, D) in [0, 1]; statistics: (n, K), means
    over the colonies of each, NaN where one of them failed. cells: (n,) of each, the mean of its
    colonies. reasons: of failures, by row. regions: of the rounds of inference that have begun.
    """

    points: np.ndarray
    statistics: np.ndarray
    cells: np.ndarray
    reasons: dict[int, str] = field(default_factory=dict)
    regions: tuple[Region, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @property
    def sound(self) -> np.ndarray:
        """The simulations that did not fail, (n,) bool."""
        return np.isfinite(self.statistics).all(1)

    def take(self, rows: slice) -> Simulations:
        """Some of them, from the first on."""
        start, stop, _ = rows.indices(len(self))
        reasons = {k - start: words for k, words in self.reasons.items() if start <= k < stop}
        arrays = self.points[rows], self.statistics[rows], self.cells[rows]
        return Simulations(*arrays, reasons, self.regions)

    def within(self, region: Region) -> np.ndarray:
        """Those that did not fail and lie within a region, (n,) bool."""
        return self.sound & region.holds(self.points)

    def followed_by(self, other: Simulations) -> Simulations:
        moved = {k + len(self): words for k, words in other.reasons.items()}
        return Simulations(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.statistics, other.statistics]),
            np.concatenate([self.cells, other.cells]),
            self.reasons | moved,
            self.regions,
        )

    def failures(self) -> list[tuple[str, int]]:
        """The reasons of failures and how often each came, as `tally` counts them."""
        return tally(self.reasons.values())


def observed_of(task: Task) -> Observed:
    """The data of a task of inference."""
    return checked_data(task.target)


def about(task: Task, prior: Prior, rounds: tuple[int, int] | None = None) -> dict[str, Any]:
    """What simulations depend on, as plain data: all of the task but the observed numbers, which
    those of several rounds depend on, too. rounds: how many simulations, in how many rounds."""
    found = task.describe() | {"target": repr(observed_of(task).plan)}
    del found["code of the target"]
    if task.reduce != SURVIVORS:
        del found["reduce"]
    if prior.given:
        found["prior"] = prior.describe()
    if rounds is not None:
        data = observed_of(task)
        found["simulations and rounds"] = list(rounds)
        found["observed numbers"] = [list(map(float, v)) for v in (data.values, data.spread)]
    return found


def simulate_designs(
    task: Task,
    count: int,
    *,
    prior: Prior | None = None,
    regions: tuple[Region, ...] = (),
    rounds: tuple[int, int] | None = None,
    path: Path | None = None,
    executor: Executor | None = None,
    seen: Callable[[int], None] = lambda count: None,
) -> Simulations:
    """Simulate `count` designs with parameters drawn from the prior (by default evenly), each with
    `task.replicates` colonies, under each condition, and random numbers of its own.

    regions: of the rounds that have begun, by their first simulations; by default one of all
    values. rounds: how many simulations in how many rounds, where there are several. path: of the
    file that keeps them and the regions; those that it holds are not simulated again. executor: of
    the `concurrent.futures` kind. seen: called with the number of designs that are known.
    Simulation k is the same in any batch and on any machine of the same kind. Raises InputError for
    an executor that would hang.
    """
    if executor is not None:
        check_executor(executor)
    prior = prior or Prior(task.space)
    before = None if path is None else stamp(path)
    kept = about(task, prior, rounds)
    known = _read(path, task, kept)
    if len(regions) > len(known.regions):
        known = replace(known, regions=regions)
    seen(min(count, len(known)))
    draws = np.random.default_rng(task.seed).random((max(count, len(known)), task.space.size))
    points = _points(prior, draws, known.regions)
    starts = range(len(known), count, BATCH)
    parts = [(first, points[first : min(first + BATCH, count)]) for first in starts]
    run = partial(_simulate_part, task)
    for found in map(run, parts) if executor is None else executor.map(run, parts):
        known = known.followed_by(found)
        before = _write(path, task, kept, known, before)
        seen(len(known))
    return known.take(slice(0, count))


def simulate_points(task: Task, points: np.ndarray, first: int) -> Simulations:
    """Simulate given designs, (n, D). first: the number of the first of them, which says which
    random numbers it follows."""
    values = [task.space.values(point) for point in points]
    statistics = np.full((len(points), len(observed_of(task).values)), np.nan)
    cells, reasons = np.full(len(points), np.nan), {}
    for item in cut_work_items(task, values, task.replicates, 1.0, 1):
        for row, found, count, why in _run_item(task, item, first):
            statistics[row], cells[row] = found, count
            if why:
                reasons[row] = why
    noise = np.array(errors(observed_of(task)))
    if noise.any():  # data are measured with errors; each simulation has its own
        draws = (np.random.default_rng([task.seed, NOISE, first + k]) for k in range(len(points)))
        statistics = statistics + noise * np.array([d.normal(size=len(noise)) for d in draws])
    return Simulations(points, statistics, cells, reasons)


def _simulate_part(task: Task, part: tuple[int, np.ndarray]) -> Simulations:
    return simulate_points(task, part[1], part[0])


def _run_item(
    task: Task, item: WorkItem, first: int
) -> Iterator[tuple[int, np.ndarray, float, str]]:
    """Row, statistics (K,), cells and reason of failure of each design of a work item."""
    for part, found in in_halves(item, partial(_grow_item, task, first=first)):
        if isinstance(found, Exception):
            nothing = np.full(len(observed_of(task).values), np.nan)
            yield part.rows[0], nothing, math.nan, str(found)
        else:
            yield from found


@tf.one_torch_thread()
@torch.no_grad()
def _grow_item(task: Task, item: WorkItem, first: int) -> list[tuple[int, np.ndarray, float, str]]:
    observed, each = observed_of(task), task.replicates * task.conditions
    streams = [(first + row) * each + k for row in item.rows for k in range(each)]
    scene = task.family.scene(item.values, repeat=task.replicates)
    prepared = colonies.prepare(scene, streams, task.settings)
    found = np.full((len(streams), len(observed.values)), np.nan)
    counts = np.full(len(streams), np.nan)
    good = np.zeros(len(streams), bool)
    gone, reasons = dict[int, str](), dict[int, str]()
    cells, until = task.end(1.0)
    fewest = task.target.fewest
    for event in grow(prepared, cells=cells, until=until, note=observed.note, fewest=fewest):
        if isinstance(event, FailedColony):
            died = task.reduce == SURVIVORS and event.reason.startswith(NO_CELLS)
            (gone if died else reasons)[event.colony_id // each] = event.reason
            continue
        ids = event.state.colony_id.cpu().numpy()
        good[ids] = True
        found[ids] = observed.statistics(event.state, event.history).cpu().numpy()
        counts[ids] = event.state.counts.cpu().numpy()
        for colony_id, why in zip(ids.tolist(), observed.unfit(event.state), strict=True):
            if why:  # it has stopped before the data were observed
                found[colony_id], good[colony_id] = np.nan, False
                reasons[colony_id // each] = why
    # of the colonies of a replicate, each statistic is that of the one under its condition
    columns = np.arange(len(observed.values))
    shape = (len(item.rows), task.replicates, task.conditions, len(columns))
    each_own = found.reshape(shape)[:, :, places(observed), columns]
    if task.reduce == SURVIVORS:
        living = good.reshape(shape[:3])[:, :, places(observed)]
        own = np.array(averaged(observed, observed.colonies))
        means = _means_of_living(each_own, own, living)
        reasons = {k: x for k, x in gone.items() if not living[k].any(0).all()} | reasons
    else:
        means = _means(each_own, np.array(averaged(observed, task.replicates)))
    names = observed.plan.names
    for k in np.flatnonzero(~np.isfinite(means).all(1)).tolist():
        name = names[int(np.flatnonzero(~np.isfinite(means[k]))[0])]
        why = observed.why_undefined(name)
        reasons.setdefault(k, f"{name} is not a number{f', as {why}' if why else ''}")
    counted = counts.reshape(len(item.rows), each)
    if task.reduce == SURVIVORS:
        counted = _means_of_living(counted[..., None], np.array([each]), good.reshape(-1, each, 1))
    size = counted.mean(1).tolist()
    return [(row, means[k], size[k], reasons.get(k, "")) for k, row in enumerate(item.rows)]


def _means(found: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Of each statistic over its first `count` (K,) replicates: (n, K) from (n, R, K). NaN where
    any replicate is."""
    within = np.arange(found.shape[1])[:, None] < count
    return (found * within).sum(1) / count


def _means_of_living(found: np.ndarray, count: np.ndarray, living: np.ndarray) -> np.ndarray:
    """Of each statistic over the first `count` (K,) of the replicates that live, or all where they
    are fewer: (n, K) from (n, R, K). living: (n, R, K). NaN where none does, or one of them is."""
    within = living & (living.cumsum(1) <= count)
    number = within.sum(1)
    total = np.where(within, found, 0.0).sum(1)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _points(prior: Prior, draws: np.ndarray, regions: Sequence[Region]) -> np.ndarray:
    """Designs of the prior, (n, D), from even draws; each lies in the last region that begins no
    later."""
    found = prior.points(draws)
    for region in regions:
        if not region.is_whole:
            low, high = prior.units(np.stack([region.low, region.high]))
            later = low + (high - low) * draws[region.start :]
            found[region.start :] = prior.points(later).clip(region.low, region.high)
    return found


def random_points(
    task: Task, prior: Prior, count: int, *, stream: int, region: Region | None = None
) -> np.ndarray:
    """Further random designs, (n, D), within a region, by default anywhere; none of those that
    `simulate_designs` draws."""
    draws = np.random.default_rng([task.seed, stream]).random((count, task.space.size))
    return _points(prior, draws, [] if region is None else [replace(region, start=0)])


def shown_values(task: Task, points: np.ndarray) -> dict[str, list[Value]]:
    """The values of designs (n, D) by the names of parameters."""
    found = [task.space.values(point) for point in points]
    return {name: [values[name] for values in found] for name in task.space.names}


def _write(
    path: Path | None, task: Task, kept: Mapping[str, Any], known: Simulations, before: Stamp | None
) -> Stamp | None:
    """In place of the older file, where there is one, whose `stamp` is `before`; the new one. kept:
    what the simulations are `about`."""
    if path is None:
        return None
    with replacing(path, FORMAT, VERSION, kept, "earlier simulations", before) as file:
        file["points"], file["statistics"] = known.points, known.statistics
        file["cells"] = known.cells
        file["regions"] = np.array([[r.low, r.high] for r in known.regions])
        file["starts of regions"] = [r.start for r in known.regions]
        names = list(observed_of(task).plan.names)
        file.create_dataset("names", data=names, dtype=h5py.string_dtype())
        for name, column in shown_values(task, known.points).items():
            write_values(file, name, column)
        file.attrs["reasons"] = json.dumps(known.reasons)
        mark = str(file.attrs["written"])
    return mark


def _read(path: Path | None, task: Task, wanted: Mapping[str, Any]) -> Simulations:
    """What a file holds; nothing where there is none. wanted: what they should be `about`. Raises
    InputError for the file of another task and for one that cannot be read."""
    names = observed_of(task).plan.names
    regions: tuple[Region, ...] = (Region.whole(task.space.size),)
    if path is None or not path.exists():
        nothing = np.empty((0, task.space.size)), np.empty((0, len(names))), np.empty(0)
        return Simulations(*nothing, {}, regions)
    with reading(path, FORMAT, VERSION, "file of simulations") as file:
        kept, mine = json.loads(file.attrs["about"]), dict(wanted)
        reasons = {int(k): words for k, words in json.loads(file.attrs["reasons"]).items()}
        points, cells = file["points"][...], np.full(len(file["points"]), np.nan)
        if "cells" in file:  # older files have none
            cells = file["cells"][...]
        if "regions" in file:  # older files are of one round
            starts = file["starts of regions"][...].tolist()
            regions = tuple(
                Region(ends[0], ends[1], start)
                for ends, start in zip(file["regions"][...], starts, strict=True)
            )
        found = Simulations(points, file["statistics"][...], cells, reasons, regions)
        kept["statistics"] = [n.decode() for n in file["names"][...]]
    mine["statistics"] = list(names)
    plain = json.loads(json.dumps(mine))
    differing = [name for name in plain | kept if kept.get(name) != plain.get(name)]
    if differing:
        raise checks.input_error(
            "path",
            str(path),
            f"a file of the same simulations; this one differs in {', '.join(differing)}",
            "Give another path.",
        )
    return found

"""The check of a design: fresh seeds, other colony sizes, changed parameters, and the parameters
that matter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import numpy as np

from design.loss_bands import standard_error
from design.objective import Objective
from design.parameters import Choice, Parameter, Space, Value
from design.progress import advance, open_bar
from design.robustness import ParameterChange, Resized, Robustness
from design.sensitivity import loss_indices
from design.targets.base import Target
from design.targets.several import observed_at
from design.task import Task
from design.variation import varied
from torchfilm import checks

USUAL = (0.5, 2.0)  # sizes of colonies beside the searched one


class ScoredDesign(Protocol):
    """A design and its losses: what a check needs of `Best`."""

    @property
    def objective(self) -> Objective: ...

    @property
    def values(self) -> Mapping[str, Value]: ...

    @property
    def point(self) -> np.ndarray: ...

    @property
    def searched(self) -> np.ndarray: ...


@checks.known_keywords
def check_robustness(
    best: ScoredDesign,
    *,
    seeds: int = 32,
    sizes: Sequence[float] | None = None,
    change: float = 0.2,
    vary: float = 0.0,
    samples: int = 0,
    threshold: float | None = None,
    executor: Executor | None = None,
    work_items: int = 1,
    progress: bool | None = None,
) -> Robustness:
    """Check the best design of a search on colonies that the search did not see.

    seeds: streams of random numbers, those right after the searched ones (with R replicates: R … R
    + seeds − 1). Every part of the check uses the same streams, so that differences are due to what
    is changed. sizes: further colony sizes, as shares of the one searched, above 1 too; by default
    0.5 and 2, and none where colonies end when data were observed. change: each parameter alone at
    value·(1 ± change), or at the bound that this exceeds; a whole number at its neighbours, a
    choice at each other option. vary: all parameters at once, as where parts are uncertain: as many
    variants as seeds, each number but whole ones times its own exp(vary · normal number), within
    its bounds, on four of the streams in turn; 0 leaves them out. samples: a power of two, for
    Sobol' indices over the whole space (Saltelli et al. 2010; scipy.stats.sobol_indices) of the
    mean loss on the searched streams, where a failed colony counts with its loss. They cost
    samples·(D + 2)·R colonies; 0 leaves them out. threshold: a loss that is good enough; the result
    gives the share of seeds that reach it. executor, work_items: as in `Objective.evaluate`. Raises
    InputError for an argument that is not allowed.
    """
    if not isinstance(getattr(best, "objective", None), Objective):
        raise checks.input_error("best", best, "the design that a search returned, a Best")
    checks.integer("work_items", work_items, least=1)
    sizes = _sizes(best.objective.task.target, sizes)
    _check_arguments(seeds, sizes, change, vary, samples, threshold)
    objective, task = best.objective, best.objective.task
    searched, dimensions = task.replicates, task.space.size
    streams = tuple(range(searched, searched + seeds))
    changes, points = _changed_points(task.space, best, change)
    moved = (points != best.point).any(1) | (np.arange(len(points)) == 0)
    cost = samples * (dimensions + 2) * searched
    run: dict[str, Any] = {"executor": executor, "work_items": work_items}
    note = f"{cost} for {samples} samples of {dimensions} parameters" if samples else ""
    total = seeds * (int(moved.sum()) + sum(sizes) + (vary > 0)) + cost
    with open_bar(total, progress, "check", note) as bar:
        found = objective.evaluate(points[moved], streams=streams, **run)
        advance(bar, found.losses.size)
        losses = np.full((len(points), seeds), np.nan)
        losses[moved] = found.losses
        resized = []
        for share in sizes:
            resized.append(_resized(task.resized(share), share, best.point, streams, **run))
            advance(bar, seeds * share)
        at_once = varied(objective, best.point, float(vary), streams, **run) if vary else None
        advance(bar, seeds if vary else 0)
        indices = loss_indices(objective, samples, bar=bar, **run) if samples else None
    return Robustness(
        values=dict(best.values),
        streams=streams,
        losses=losses[0],
        failed=sum(row == 0 for row, _ in found.reasons) / seeds,
        searched=np.array(best.searched),
        threshold=threshold,
        sizes=tuple(resized),
        changes=tuple(
            _measured_change(task.space.parameters[k], k, wanted, p, row, losses[0])
            for (k, wanted, _), p, row in zip(changes, points[1:], losses[1:], strict=True)
        ),
        indices=indices,
        varied=at_once,
    )


def _sizes(target: Target, given: Sequence[float] | None) -> Sequence[float]:
    """The further sizes of colonies: data of one time do not compare with others."""
    seen = observed_at(target)
    if given is None:
        return USUAL if seen is None else ()
    if seen is not None and np.size(given):
        rule = f"left out, since the data were observed at {seen:g} h"
        raise checks.input_error("sizes", given, rule)
    return given


def _changed_points(
    space: Space, best: ScoredDesign, change: float
) -> tuple[list[tuple[int, Value, Value]], np.ndarray]:
    """The changes, as (number of the parameter, requested value, used value), and the points: that
    of the design, then that of each change."""
    changes = [
        (k, *pair)
        for k, p in enumerate(space.parameters)
        for pair in _changed_values(p, best.values[p.name], change)
    ]
    moved = [_moved(space, best.point, k, value) for k, _, value in changes]
    return changes, np.concatenate([best.point[None], *moved])


def _resized(
    task: Task, share: float, point: np.ndarray, streams: tuple[int, ...], **run: Any
) -> Resized:
    found = Objective(task).evaluate(point[None], streams=streams, **run)
    return Resized(float(share), task.cells, task.until, found.losses[0])


def _check_arguments(
    seeds: int,
    sizes: Sequence[float],
    change: float,
    vary: float,
    samples: int,
    threshold: float | None,
) -> None:
    checks.integer("seeds", seeds, least=1)
    if isinstance(sizes, str) or not isinstance(sizes, Sequence):
        raise checks.input_error(
            "sizes",
            sizes,
            "a list of shares of the colony size, such as (0.5, 2.0), or () for none",
        )
    for share in sizes:
        checks.number(
            "sizes",
            share,
            above=0.0,
            hint="A share of the colony size: 2.0 for colonies twice as large.",
        )
    checks.number("change", change, above=0.0, hint="0.2 changes each parameter by 20 %.")
    if change >= 1:
        raise checks.input_error("change", change, "below 1", "0.2 changes each parameter by 20 %.")
    checks.number("vary", vary, least=0.0, most=3.0, hint="0.2 varies parameters by some 20 %.")
    if checks.integer("samples", samples, least=0) and (samples & (samples - 1) or samples == 1):
        below = max(2, 1 << (samples.bit_length() - 1))
        raise checks.input_error(
            "samples",
            samples,
            "0 or a power of two from 2",
            f"Sobol points are even in powers of two only: give {below} or {2 * below}.",
        )
    if threshold is not None:
        checks.number("threshold", threshold)


def _changed_values(
    parameter: Parameter | Choice, value: Value, change: float
) -> list[tuple[Value, Value]]:
    """The values to try instead: as requested, and within the bounds."""
    if isinstance(parameter, Choice):
        return [(o, o) for o in parameter.options if repr(o) != repr(value)]
    if parameter.whole:
        return [(v, v) for v in (value - 1, value + 1) if parameter.low <= v <= parameter.high]
    wanted = [value * (1 + sign * change) for sign in (-1, 1)]
    return [(v, min(max(v, parameter.low), parameter.high)) for v in wanted]


def _moved(space: Space, point: np.ndarray, k: int, value: Value) -> np.ndarray:
    """The point (1, D) with another value of one parameter; the point itself where it has that
    value already."""
    parameter = space.parameters[k]
    moved = point[None].copy()
    if repr(value) != repr(parameter.value(float(point[k]))):
        moved[0, k] = parameter.coordinate(value)
    return moved


def _measured_change(
    parameter: Parameter | Choice,
    k: int,
    wanted: Value,
    point: np.ndarray,
    losses: np.ndarray,
    before: np.ndarray,
) -> ParameterChange:
    gained = losses - before
    error = standard_error(gained)
    value = parameter.value(float(point[k]))
    return ParameterChange(parameter.name, wanted, value, losses, float(gained.mean()), error)

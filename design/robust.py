"""How a design holds up: on seeds that it was not searched on, at other sizes, with its parameters
changed one by one; and which parameters matter at all."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import qmc, sobol_indices

import torchfilm as tf
from design import report
from design.methods.base import whole
from design.objective import Objective
from design.parameters import Choice, Parameter, Value
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from tqdm import tqdm

    from design.search import Best

DESIGNS = 256  # at once for the indices, so that the bar moves
RESAMPLES = 200  # for the errors of the indices


@dataclass(frozen=True, eq=False)
class Resized:
    """The design in colonies of another size. share: of the size searched; cells, until (h): where
    they end; losses (S,), of the fresh seeds."""

    share: float
    cells: int | None
    until: float | None
    losses: np.ndarray


@dataclass(frozen=True, eq=False)
class ParameterChange:
    """The design with one parameter changed. wanted: the value asked for; value: the one used,
    within the bounds; losses (S,), of the fresh seeds.

    difference: the mean change of the loss against the same seeds, and its standard error. All NaN
    where the value used is the design's own: at a bound, or 0.
    """

    name: str
    wanted: Value
    value: Value
    losses: np.ndarray
    difference: float
    error: float

    @property
    def clipped(self) -> bool:
        """Whether the value asked for lies beyond a bound."""
        return isinstance(self.wanted, float) and not math.isclose(
            self.wanted, self.value, rel_tol=1e-9
        )


@dataclass(frozen=True, eq=False)
class Indices:
    """Sobol' indices of the loss over the whole space, (D,) each. first: the share of its variance
    that a parameter explains alone; total: with all that others do through it. Their standard
    errors, by resampling the points. samples, and the colonies that they cost.
    """

    first: np.ndarray
    total: np.ndarray
    first_error: np.ndarray
    total_error: np.ndarray
    samples: int
    colonies: int


@dataclass(frozen=True, eq=False)
class Robustness:
    """How a design holds up.

    values: its parameters; streams (S,): the fresh streams of random numbers; losses (S,): the loss
    of each; failed: share of the colonies that failed; searched (R,): the losses that the search
    saw. threshold: a loss that is good enough, or None.
    """

    values: dict[str, Value]
    streams: tuple[int, ...]
    losses: np.ndarray
    failed: float
    searched: np.ndarray
    threshold: float | None
    sizes: tuple[Resized, ...]
    changes: tuple[ParameterChange, ...]
    indices: Indices | None

    @property
    def mean(self) -> float:
        return float(self.losses.mean())

    @property
    def median(self) -> float:
        return float(np.median(self.losses))

    @property
    def high(self) -> float:
        """The loss that nine of ten seeds do not exceed (0.9 quantile)."""
        return float(np.quantile(self.losses, 0.9))

    @property
    def reached(self) -> float | None:
        """Share of the seeds whose loss is at most the threshold."""
        return None if self.threshold is None else float((self.losses <= self.threshold).mean())

    def table(self) -> str:
        """All of it, to read."""
        first, last = self.streams[0], self.streams[-1]
        lines = [
            f"searched on streams 0 … {first - 1}, checked on {len(self.streams)} fresh ones,"
            f" {first} … {last}; failed: {self.failed:.0%}"
        ]
        if self.threshold is not None:
            lines.append(f"loss at most {self.threshold:g}: {self.reached:.0%} of them")
        rows: list[tuple[str, ...]] = [("", "cells", "hours", "mean", "median", "90 %")]
        rows += [
            ("searched", "", "", *_summary(self.searched)),
            ("fresh", "", "", *_summary(self.losses)),
        ]
        rows += [
            (f"× {s.share:g}", _or_blank(s.cells), _or_blank(s.until), *_summary(s.losses))
            for s in self.sizes
        ]
        lines += _aligned(rows)
        rows = [("parameter", "value", "changed to", "asked for", "loss change", "± error")]
        for c in self.changes:
            asked = report.shown(c.wanted) if c.clipped else ""
            told = (
                ("", "")
                if math.isnan(c.difference)
                else (f"{c.difference:+.4f}", "" if math.isnan(c.error) else f"{c.error:.4f}")
            )
            rows.append(
                (c.name, report.shown(self.values[c.name]), report.shown(c.value), asked, *told)
            )
        lines += ["", *_aligned(rows)]
        if self.indices is not None:
            rows = [("parameter", "first", "±", "total", "±")]
            columns = (
                self.indices.first,
                self.indices.first_error,
                self.indices.total,
                self.indices.total_error,
            )
            rows += [
                (name, *(f"{c[k]:.3f}" for c in columns)) for k, name in enumerate(self.values)
            ]
            lines += [
                "",
                (
                    f"share of the loss's variance over the whole space, {self.indices.samples}"
                    f" samples, {self.indices.colonies} colonies"
                ),
                *_aligned(rows),
            ]
        return "\n".join(lines)

    def save(self, path: str | Path) -> Path:
        """Write all of it as JSON; null where there is no number. Replaces an older file."""
        told = _plain(self) | {
            "mean": self.mean,
            "median": self.median,
            "high": self.high,
            "reached": self.reached,
        }
        path = Path(path)
        path.write_text(json.dumps(told, indent=1) + "\n")
        return path

    def plot(self, path: str | Path) -> Path:
        """Draw losses on searched and fresh seeds, what changes do, and which parameters matter.
        Needs matplotlib (the `app` extra)."""
        try:
            from matplotlib.figure import Figure
        except ImportError as error:
            raise tf.InputError(
                'pictures need matplotlib: pip install "torchfilm[app]".'
            ) from error
        path, panels = Path(path), 2 if self.indices is None else 3
        figure = Figure(figsize=(3.6 * panels, 3.2), layout="constrained")
        axes = figure.subplots(1, panels)
        _draw_losses(axes[0], self)
        _draw_changes(axes[1], self)
        if self.indices is not None:
            _draw_indices(axes[2], self.indices, list(self.values))
        figure.savefig(path, dpi=160)
        return path


def robustness(
    best: Best,
    *,
    seeds: int = 32,
    sizes: Sequence[float] = (0.5, 2.0),
    change: float = 0.2,
    samples: int = 0,
    threshold: float | None = None,
    executor: Executor | None = None,
    pieces: int = 1,
    progress: bool = True,
) -> Robustness:
    """How the best design of a search holds up.

    seeds: colonies on streams of random numbers that the search did not see, those right after its
    own (with R replicates: R … R + seeds − 1); every part below uses the same ones, so that
    differences are due to what is changed. sizes: further colony sizes, as shares of the one
    searched, above 1 too. change: each parameter alone at value·(1 ± change), at the bound where
    that lies beyond; a whole number at its neighbours, a choice at each other option. samples: a
    power of two, for Sobol' indices over the whole space (Saltelli et al. 2010;
    scipy.stats.sobol_indices), of the mean loss of the searched streams, a failed colony with its
    loss; they cost samples·(D + 2)·R colonies. 0 leaves them out. threshold: a loss that is good
    enough, whose share of the seeds is told. executor, pieces: as in `Objective.evaluate`.
    """
    objective = best.search.objective
    _check(seeds, sizes, change, samples, threshold)
    searched = objective.replicates
    streams = tuple(range(searched, searched + seeds))
    asked = [
        (k, *pair)
        for k, p in enumerate(objective.space.parameters)
        for pair in _changed(p, best.values[p.name], change)
    ]
    points = np.concatenate(
        [best.point[None], *(_moved(objective, best.point, k, value) for k, _, value in asked)]
    )
    moved = (points != best.point).any(1)
    moved[0] = True
    cost = samples * (objective.space.size + 2) * searched
    with report.bar(seeds * (int(moved.sum()) + sum(sizes)) + cost, progress) as bar:
        if bar is not None:
            bar.set_description_str("check")
            bar.set_postfix_str(
                f"{cost} for {samples} samples of {objective.space.size} parameters"
                if samples
                else ""
            )
        found = objective.evaluate(points[moved], streams=streams, executor=executor, pieces=pieces)
        _spent(bar, found.losses.size)
        losses = np.full((len(points), seeds), np.nan)
        losses[moved] = found.losses
        resized = []
        for share in sizes:
            other = objective.resized(share)
            there = other.evaluate(
                best.point[None], streams=streams, executor=executor, pieces=pieces
            )
            resized.append(Resized(float(share), other.cells, other.until, there.losses[0]))
            _spent(bar, seeds * share)
        indices = _indices(objective, samples, executor, pieces, bar) if samples else None
    changes = tuple(
        _change(objective, k, wanted, p, row, losses[0])
        for (k, wanted, _), p, row in zip(asked, points[1:], losses[1:], strict=True)
    )
    failed = sum(row == 0 for row, _ in found.reasons) / seeds
    return Robustness(
        dict(best.values),
        streams,
        losses[0],
        failed,
        np.array(best.losses),
        threshold,
        tuple(resized),
        changes,
        indices,
    )


def _check(
    seeds: int, sizes: Sequence[float], change: float, samples: int, threshold: float | None
) -> None:
    whole("seeds", seeds, least=1)
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
    if whole("samples", samples, least=0) and (samples & (samples - 1) or samples == 1):
        below = max(2, 1 << (samples.bit_length() - 1))
        raise checks.input_error(
            "samples",
            samples,
            "0 or a power of two from 2",
            f"Sobol points are even in powers of two only: give {below} or {2 * below}.",
        )
    if threshold is not None:
        checks.number("threshold", threshold)


def _changed(
    parameter: Parameter | Choice, value: Value, change: float
) -> list[tuple[Value, Value]]:
    """The values to try instead: as wanted, and within the bounds."""
    if isinstance(parameter, Choice):
        return [(o, o) for o in parameter.options if repr(o) != repr(value)]
    if parameter.whole:
        return [(v, v) for v in (value - 1, value + 1) if parameter.low <= v <= parameter.high]
    wanted = [value * (1 + sign * change) for sign in (-1, 1)]
    return [(v, min(max(v, parameter.low), parameter.high)) for v in wanted]


def _moved(objective: Objective, point: np.ndarray, k: int, value: Value) -> np.ndarray:
    """The point (1, D) with the value of one parameter; the point itself where that is its value
    already."""
    parameter = objective.space.parameters[k]
    moved = point[None].copy()
    if repr(value) != repr(parameter.value(float(point[k]))):
        moved[0, k] = parameter.coordinate(value)
    return moved


def _change(
    objective: Objective,
    k: int,
    wanted: Value,
    point: np.ndarray,
    losses: np.ndarray,
    before: np.ndarray,
) -> ParameterChange:
    parameter = objective.space.parameters[k]
    gained = losses - before
    error = float(gained.std(ddof=1)) / math.sqrt(len(gained)) if len(gained) > 1 else math.nan
    return ParameterChange(
        parameter.name,
        wanted,
        parameter.value(float(point[k])),
        losses,
        float(gained.mean()),
        error,
    )


def _indices(
    objective: Objective, samples: int, executor: Executor | None, pieces: int, bar: tqdm | None
) -> Indices:
    """Sobol' indices of the mean loss over the replicates, all on the searched streams."""
    size, replicates = objective.space.size, objective.replicates
    one, other = np.hsplit(
        qmc.Sobol(2 * size, scramble=True, rng=np.random.default_rng(objective.seed)).random(
            samples
        ),
        2,
    )
    points = np.concatenate(
        [one, other, *(np.where(np.arange(size) == k, other, one) for k in range(size))]
    )
    losses = np.empty(len(points))
    for begin in range(0, len(points), DESIGNS):
        part = slice(begin, begin + DESIGNS)
        losses[part] = objective.evaluate(
            points[part], executor=executor, pieces=pieces
        ).losses.mean(1)
        _spent(bar, losses[part].size * replicates)
    rows = losses.reshape(size + 2, samples)
    first, total = _estimated(rows)
    random = np.random.default_rng(objective.seed)
    drawn = np.array(
        [_estimated(rows[:, random.integers(samples, size=samples)]) for _ in range(RESAMPLES)]
    )
    first_error, total_error = drawn.std(0)
    return Indices(first, total, first_error, total_error, samples, len(points) * replicates)


def _spent(bar: tqdm | None, colonies: float) -> None:
    if bar is not None:
        bar.update(colonies)


def _estimated(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and total indices, (D,) each, from the losses (D + 2, n) at points A, B, and A with one
    column of B."""
    # twice the same output: scipy cannot tell the axes of one parameter and one output apart
    twice = {"f_A": rows[[0, 0]], "f_B": rows[[1, 1]], "f_AB": np.stack([rows[2:], rows[2:]], 1)}
    found = sobol_indices(func=twice, n=rows.shape[1])
    return found.first_order.reshape(2, -1)[0], found.total_order.reshape(2, -1)[0]


def _summary(losses: np.ndarray) -> tuple[str, ...]:
    return tuple(f"{x:.4f}" for x in (losses.mean(), np.median(losses), np.quantile(losses, 0.9)))


def _or_blank(number: float | None) -> str:
    return "" if number is None else f"{number:g}"


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            x.rjust(w) if k else x.ljust(w) for k, (x, w) in enumerate(zip(row, wide, strict=True))
        ).rstrip()
        for row in rows
    ]


def _plain(given: Any) -> Any:
    """As JSON holds it."""
    if isinstance(given, np.ndarray):
        return _plain(given.tolist())
    if isinstance(given, (list, tuple)):
        return [_plain(x) for x in given]
    if isinstance(given, float):
        return given if math.isfinite(given) else None
    if isinstance(given, (Resized, ParameterChange, Indices, Robustness, dict)):
        return {
            name: _plain(value)
            for name, value in (given if isinstance(given, dict) else vars(given)).items()
        }
    return given


def _draw_losses(ax: Axes, found: Robustness) -> None:
    """Each seed's loss (dots) and their median (line), one column a size."""
    columns = [
        ("searched", found.searched),
        ("fresh", found.losses),
        *((f"× {s.share:g}", s.losses) for s in found.sizes),
    ]
    for k, (_, losses) in enumerate(columns):
        across = k + 0.25 * np.linspace(-1, 1, len(losses)) if len(losses) > 1 else np.array([k])
        ax.plot(across, losses, ".", color="C3" if k else "0.5", ms=4)
        ax.hlines(np.median(losses), k - 0.35, k + 0.35, color="black", lw=1)
    if found.threshold is not None:
        ax.axhline(found.threshold, color="0.6", lw=0.8, ls=":")
    ax.set(
        xticks=range(len(columns)),
        xticklabels=[name for name, _ in columns],
        ylabel="loss",
        ylim=(0, None),
    )
    ax.set_title("each seed, and the median", fontsize=9)


def _draw_changes(ax: Axes, found: Robustness) -> None:
    """How much each change adds to the loss, with its standard error."""
    rows = [c for c in found.changes if not math.isnan(c.difference)]
    places = np.arange(len(rows))[::-1]
    ax.barh(
        places,
        [c.difference for c in rows],
        xerr=np.nan_to_num([c.error for c in rows]),
        color="C0",
        ecolor="0.3",
    )
    ax.axvline(0, color="black", lw=0.8)
    ax.set(
        yticks=places,
        yticklabels=[f"{c.name} = {report.shown(c.value)}" for c in rows],
        xlabel="change of the loss",
    )
    ax.set_title("one parameter changed", fontsize=9)


def _draw_indices(ax: Axes, indices: Indices, names: list[str]) -> None:
    places = np.arange(len(names))[::-1]
    for shift, what, error, words in (
        (0.2, indices.first, indices.first_error, "alone"),
        (-0.2, indices.total, indices.total_error, "with others"),
    ):
        ax.barh(places + shift, what, 0.38, xerr=error, label=words, ecolor="0.3")
    ax.set(yticks=places, yticklabels=names, xlabel="share of the loss's variance")
    ax.axvline(0, color="black", lw=0.8)
    ax.legend(fontsize=7, frameon=False)
    ax.set_title("which parameters matter", fontsize=9)

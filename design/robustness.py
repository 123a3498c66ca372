"""The result of a robustness check, with its table, file and picture."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

import torchfilm as tf
from design.loss_bands import standard_error
from design.parameters import Value, show_value
from design.robustness_plots import draw_changes, draw_indices, draw_losses
from design.sensitivity import Indices
from design.variation import Varied
from torchfilm import checks, displays


@dataclass(frozen=True, eq=False)
class Resized:
    """The design in colonies of another size. share: of the searched size; cells, until (h): the
    end of a colony; losses (S,), of the fresh seeds."""

    share: float
    cells: int | None
    until: float | None
    losses: np.ndarray


@dataclass(frozen=True, eq=False)
class ParameterChange:
    """The design with one parameter changed. wanted: the requested value; value: the one used,
    within the bounds; losses (S,), of the fresh seeds.

    difference: the mean change of the loss on the same seeds; error: its standard error. All three
    are NaN where the value used is that of the design: at a bound, or 0.
    """

    name: str
    wanted: Value
    value: Value
    losses: np.ndarray
    difference: float
    error: float

    @property
    def clipped(self) -> bool:
        """Whether the requested value lies beyond a bound."""
        return isinstance(self.wanted, float) and not math.isclose(
            self.wanted, self.value, rel_tol=1e-9
        )


@dataclass(frozen=True, eq=False, repr=False)
class Robustness:
    """How robust a design is.

    values: its parameters; streams (S,): the fresh streams of random numbers; losses (S,): the loss
    of each; failed: share of the colonies that failed; searched (R,): the losses in the search;
    threshold: a loss that is good enough, or None; sizes, changes: the design in other sizes and
    with other parameters; indices: which parameters matter, or None; varied: variants in which all
    parameters differ at once, or None.
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
    varied: Varied | None = None

    @property
    def mean(self) -> float:
        return float(self.losses.mean())

    @property
    def median(self) -> float:
        return float(np.median(self.losses))

    @property
    def high(self) -> float:
        """The 0.9 quantile of the losses on these seeds. Somewhat less than nine of ten new seeds
        do not exceed it: some 82 % where 8 were grown, 88 % where 32 were."""
        return float(np.quantile(self.losses, 0.9))

    @property
    def reached(self) -> float | None:
        """Share of the seeds whose loss is at most the threshold; None without one."""
        return None if self.threshold is None else float((self.losses <= self.threshold).mean())

    def __repr__(self) -> str:
        return f"Robustness({len(self.losses)} fresh seeds, mean loss {self.losses.mean():.4g})"

    def _repr_html_(self) -> str:
        return tf.displays.card("Robustness", tf.displays.text(self.table()))

    def table(self) -> str:
        """All results as text."""
        first, last = self.streams[0], self.streams[-1]
        lines = [
            f"searched on streams 0 … {first - 1}, checked on {len(self.streams)} fresh ones,"
            f" {first} … {last}; failed: {self.failed:.0%}"
        ]
        if self.threshold is not None:
            lines.append(f"loss at most {self.threshold:g}: {self._reached_words()}")
        head = ("", "cells", "hours", "mean", "± error", "median", "0.9 quantile")
        rows: list[tuple[str, ...]] = [head]
        rows += [
            ("searched", "", "", *_summary(self.searched)),
            ("fresh", "", "", *_summary(self.losses)),
        ]
        rows += [
            (f"× {s.share:g}", _or_blank(s.cells), _or_blank(s.until), *_summary(s.losses))
            for s in self.sizes
        ]
        if self.varied is not None:
            name = f"all parameters × exp({self.varied.vary:g} z)"
            rows.append((name, "", "", *_summary(self.varied.losses)))
        lines += displays.aligned(rows, left=(0,))
        if self.varied is not None:
            change, error = self.varied.change(self.losses)
            known = "" if math.isnan(error) else f" ± {error:.4f}"
            lines.append(
                f"all parameters at once (z: normal numbers) change the loss by {change:+.4f}"
                f"{known} on the same"
                f" {displays.counted(len(np.unique(self.varied.streams)), 'seed')}"
                + f"; bounds held {self.varied.clipped:.0%} of the varied values"
                * (self.varied.clipped > 0)
            )
        lines += ["", *displays.aligned(self._change_rows(), left=(0,))]
        if self.indices is not None:
            lines += [
                "",
                f"share of the loss's variance over the whole space, {self.indices.samples}"
                f" samples, {self.indices.colonies} colonies",
                *displays.aligned(self._index_rows(self.indices), left=(0,)),
            ]
        return tf.displays.Text("\n".join(lines))

    def _reached_words(self) -> str:
        """The share of seeds that reach the threshold, with its interval (Wilson)."""
        count, good = len(self.losses), int((self.losses <= self.threshold).sum())
        interval = binomtest(good, count).proportion_ci(0.9, method="wilson")
        return (
            f"{good / count:.0%} of them (90 % interval of the share {interval.low:.0%} to"
            f" {interval.high:.0%})"
        )

    def _change_rows(self) -> list[tuple[str, ...]]:
        head = ("parameter", "value", "changed to", "requested", "loss change", "± error")
        rows: list[tuple[str, ...]] = [head]
        for c in self.changes:
            requested = show_value(c.wanted) if c.clipped else ""
            difference = "" if math.isnan(c.difference) else f"{c.difference:+.4f}"
            error = "" if math.isnan(c.error) else f"{c.error:.4f}"
            value = show_value(self.values[c.name])
            rows.append((c.name, value, show_value(c.value), requested, difference, error))
        return rows

    def _index_rows(self, indices: Indices) -> list[tuple[str, ...]]:
        columns = (indices.first, indices.first_error, indices.total, indices.total_error)
        return [
            ("parameter", "first", "±", "total", "±"),
            *(
                (name, *(f"{column[k]:.3f}" for column in columns))
                for k, name in enumerate(self.values)
            ),
        ]

    def save(self, path: str | Path) -> Path:
        """Write all results to a `.json` file, with null where there is no number. Replaces an
        older file."""
        saved = _plain(self) | {
            "mean": self.mean,
            "median": self.median,
            "high": self.high,
            "reached": self.reached,
        }
        path = checks.file_path("path", path, ".json")
        checks.write_whole(path, json.dumps(saved, indent=1) + "\n")
        return path

    def plot(self, out: str | Path | None = None) -> tf.pictures.Picture:
        """Draw the losses on searched and fresh seeds, the changes of the loss, and which
        parameters matter; `out` as for `Best.plot`. Needs matplotlib (the `app` extra)."""
        panels = 2 if self.indices is None else 3
        figure = tf.pictures.new_figure(3.6 * panels, 3.2)
        axes = figure.subplots(1, panels)
        sizes = [(f"× {s.share:g}", s.losses) for s in self.sizes]
        columns = [("searched", self.searched), ("fresh", self.losses), *sizes]
        if self.varied is not None:
            columns.append(("all varied", self.varied.losses))
        draw_losses(axes[0], columns, self.threshold)
        draw_changes(
            axes[1],
            [
                (f"{c.name} = {show_value(c.value)}", c.difference, c.error)
                for c in self.changes
                if not math.isnan(c.difference)
            ],
        )
        if (found := self.indices) is not None:
            first, total = (found.first, found.first_error), (found.total, found.total_error)
            draw_indices(axes[2], list(self.values), first, total)
        return tf.pictures.Picture(figure, out)


def _summary(losses: np.ndarray) -> tuple[str, ...]:
    error = "" if math.isnan(by := standard_error(losses)) else f"{by:.4f}"
    mean, median, high = losses.mean(), np.median(losses), np.quantile(losses, 0.9)
    return f"{mean:.4f}", error, f"{median:.4f}", f"{high:.4f}"


def _or_blank(number: float | None) -> str:
    return "" if number is None else f"{number:g}"


def _plain(given: Any) -> Any:
    """A result as data that JSON can hold."""
    if isinstance(given, np.ndarray):
        return _plain(given.tolist())
    if isinstance(given, (list, tuple)):
        return [_plain(x) for x in given]
    if isinstance(given, float):
        return given if math.isfinite(given) else None
    if isinstance(given, (Resized, ParameterChange, Indices, Varied, Robustness, dict)):
        return {
            name: _plain(value)
            for name, value in (given if isinstance(given, dict) else vars(given)).items()
        }
    return given

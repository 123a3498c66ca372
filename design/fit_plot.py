"""The picture of a fit: measured numbers, and those of simulated colonies, over time or dose."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import torchfilm as tf
from design.targets.readings import DataPoint

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LISTED = 8  # conditions that a legend names
FAR = 30.0  # doses of which the largest is so many times the smallest are drawn by their logarithms
WITHIN = 1.64  # standard errors, within which 90 % of data lie
FARTHEST, LINEAR = 15.0, 3.0  # standard errors: of a linear axis; of the linear part of another
Ends = Mapping[str, tuple[float, float, float]]  # the middle, the least and the most, by full name


@dataclass(frozen=True)
class Curve:
    """Simulated numbers. title: in a legend; line: its style."""

    title: str
    line: str
    values: Ends


def measures_of(readings: Sequence[DataPoint]) -> list[str]:
    """The measures, one panel each."""
    return list(dict.fromkeys(r.name for r in readings))


def are_curves(readings: Sequence[DataPoint]) -> bool:
    """Whether they make curves: of several times, or data of several conditions. Of a number alone,
    and of ranges, such as those of a gate, colonies show more."""
    times, labels = {r.time for r in readings}, {r.label for r in readings}
    return len(times) > 1 or (len(labels) > 1 and all(r.low == r.high for r in readings))


def spread_over(found: Mapping[str, Sequence[float]]) -> Ends:
    """The mean, the least and the most of each measure over colonies."""
    each = {n: np.array(x, dtype=float) for n, x in found.items()}
    kept = {n: x[np.isfinite(x)] for n, x in each.items()}
    return {n: (float(x.mean()), float(x.min()), float(x.max())) for n, x in kept.items() if len(x)}


def draw_readings(
    axes: Sequence[Axes], readings: Sequence[DataPoint], curves: Sequence[Curve]
) -> None:
    """Draw each measure on axes of its own: what was measured as points with their spreads, ranges
    as bars, and simulated numbers as lines, a colour for each condition. Over time; over the dose
    where all are of one time and the conditions differ by one number."""
    place, words, doses = _places(readings)
    labels = list(dict.fromkeys(r.label for r in readings))
    colours = _colours(len(labels) if not doses else 1)
    for ax, name in zip(axes, measures_of(readings), strict=True):
        mine = [r for r in readings if r.name == name]
        for k, label in enumerate([""] if doses else labels):
            some = [r for r in mine if doses or r.label == label]
            _draw_one(ax, some, place, colours[k], label if k < LISTED else "", curves)
        ax.set_xlabel(words)
        ax.set_ylabel(name)
    ranges = any(r.low != r.high for r in readings)
    _legend(axes, curves, "measured or wanted" if ranges else "measured")


def draw_pulls(ax: Axes, ends: Mapping[str, Sequence[float]]) -> None:
    """Draw a row for each statistic: from where to where it is predicted, by a line with a mark in
    the middle, in standard errors of the data from what was observed. Those on one side of it
    differ in their colour and in their marks."""
    rows = range(len(ends))
    for row, (low, middle, high) in zip(rows, ends.values(), strict=True):
        out = low > 0.0 or high < 0.0
        colour, mark = ("C3", "D") if out else ("C0", "o")
        ax.plot([low, high], [row, row], color=colour, lw=1.6, solid_capstyle="butt")
        ax.plot(middle, row, mark, color=colour, ms=4)
    ax.axvline(0.0, color="0.2", lw=0.8)
    ax.axvspan(-WITHIN, WITHIN, color="0.9", zorder=0)
    if max(abs(x) for row in ends.values() for x in row) > FARTHEST:
        ax.set_xscale("symlog", linthresh=LINEAR)
        ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.set_yticks(rows, list(ends), fontsize=7)
    ax.set_ylim(len(ends) - 0.5, -0.5)
    ax.set_xlabel("predicted less observed, standard errors (grey: 90 % of a right model's data)")
    ax.xaxis.label.set_fontsize(8)


def _draw_one(
    ax: Axes, readings: Sequence[DataPoint], place: Any, colour: Any, label: str,
    curves: Sequence[Curve],
) -> None:  # fmt: skip
    ordered = sorted(readings, key=place)
    for reading in ordered:
        x = place(reading)
        if reading.low == reading.high:
            ax.errorbar(x, reading.low, yerr=reading.spread, fmt="o", ms=4, lw=1, color=colour)
            continue
        ends = [end for end in (reading.low, reading.high) if math.isfinite(end)]
        ax.plot([x] * len(ends), ends, color=colour, lw=5, alpha=0.35, solid_capstyle="butt")
        if len(ends) == 1:  # an open end
            ax.plot(x, ends[0], "v" if math.isinf(reading.low) else "^", color=colour, ms=7)
    for curve in curves:
        known = [(place(r), *curve.values[r.full]) for r in ordered if r.full in curve.values]
        if not known:
            continue
        x, middle, low, high = (np.array(column) for column in zip(*known, strict=True))
        alone = "_" if len(x) == 1 else ""  # a line of one point is none
        ax.plot(x, middle, curve.line, marker=alone, ms=12, color=colour, lw=1.2, label=label)
        if (high > low).any():
            ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        label = ""


def _places(readings: Sequence[DataPoint]) -> tuple[Any, str, bool]:
    """Where a reading stands on the axis, what the axis is, and whether that is the dose."""
    times = {r.time for r in readings}
    names = {name for r in readings for name in r.under}
    if len(times) == 1 and len(names) == 1:
        (name,) = names
        doses = sorted(r.under[name] for r in readings)
        above = [dose for dose in doses if dose > 0]
        if above and max(above) > FAR * min(above):
            # a dose of 0 has no logarithm: it stands a step to the left of the others
            none = min(above) / 10 ** max(0.5, 0.15 * math.log10(max(above) / min(above)))
            at = lambda r: math.log10(max(r.under[name], none))
            zero = f"; 0 at {none:.2g}" if doses[0] <= 0 else ""
            return at, f"log10 {name}{zero}", True
        return lambda r: r.under[name], name, True
    labels = list(dict.fromkeys(r.label for r in readings))
    if None in times or (len(times) == 1 and len(labels) > 1):
        return lambda r: labels.index(r.label), "condition", False
    return lambda r: r.time, "time, h", False


def _colours(count: int) -> list[Any]:
    if count == 1:
        return ["C0"]
    import matplotlib

    return [matplotlib.colormaps["viridis"](0.9 * k / (count - 1)) for k in range(count)]


def _legend(axes: Sequence[Axes], curves: Sequence[Curve], points: str) -> None:
    """Conditions by colour, curves by their lines, and what points are."""
    from matplotlib.lines import Line2D

    known: dict[str, Any] = {}
    for ax in axes:  # a condition may have no reading of the first measure
        known |= {n: x for x, n in zip(*ax.get_legend_handles_labels(), strict=True)}
    labels, handles = list(known), list(known.values())
    handles += [Line2D([], [], color="0.4", ls=curve.line) for curve in curves]
    handles.append(Line2D([], [], color="0.4", marker="o", ls="", ms=4))
    labels += [tf.displays.shortened(curve.title, 30) for curve in curves]
    axes[0].legend(handles, [*labels, points], fontsize=7, frameon=False)

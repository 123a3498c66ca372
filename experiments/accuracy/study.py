"""Work–precision studies: settings with their errors and costs, the front, CSV, tables and plots.

A study compares several settings of the simulator. Each setting is one point with errors and costs.
The front is the set of points that no other point beats in both error and cost.
"""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

REPEATS = 3
SHORT_AXIS = 2.0  # decades
COLUMNS = ("series", "setting", "default", "step", "seconds")  # of a CSV file, before work


@dataclass(frozen=True)
class Point:
    """One setting of a study.

    series: the knob that this setting changes, or "several". A plot joins the points of a series.
    setting: description for the tables. errors: by name, against the study's reference.
    seconds: processor time on this machine. work: a cost that does not depend on hardware, in the
    study's unit. band: half-widths of 95 % confidence intervals, for errors that are statistics
    over seeds. step: the step that an order is measured against (h or µm); None excludes the
    point from orders.
    """

    series: str
    setting: str
    errors: dict[str, float]
    seconds: float
    work: float
    default: bool = False
    band: dict[str, float] = field(default_factory=dict)
    step: float | None = None


@dataclass(frozen=True)
class Study:
    """Points under one title.

    work: unit of the points' `work`. shown: the errors to plot; the table and the CSV file have
    all errors. facts: further figures by name, which the text of the appendix quotes.
    """

    name: str
    title: str
    work: str
    shown: tuple[str, ...]
    points: Sequence[Point]
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of all errors, in order of first appearance."""
        return tuple(dict.fromkeys(name for p in self.points for name in p.errors))

    def front(self, error: str, cost: Callable[[Point], float] = lambda p: p.work) -> list[Point]:
        """Returns the points that no other point beats in both error and cost, cheapest first."""
        best, kept = math.inf, []
        for p in sorted(
            (p for p in self.points if math.isfinite(p.errors.get(error, math.nan))),
            key=lambda p: (cost(p), p.errors[error]),
        ):
            if p.errors[error] < best:
                best = p.errors[error]
                kept.append(p)
        return kept

    def orders(self, error: str) -> dict[str, float]:
        """Returns the slope of log error against log step, by least squares, for each series
        with at least three steps."""
        found = {}
        for name in dict.fromkeys(p.series for p in self.points):
            at = [
                (math.log(p.step), math.log(p.errors[error]))
                for p in self.points
                if p.series == name and p.step and p.errors.get(error, 0.0) > 0.0
            ]
            if len({x for x, _ in at}) >= 3:
                x, y = zip(*at, strict=True)
                found[name] = statistics.linear_regression(x, y).slope
        return found


def timed(run: Callable[[], Any], repeats: int = REPEATS) -> tuple[Any, float]:
    """Returns the result of `run` and the median processor time of `repeats` runs, s.

    Other work on the machine does not lengthen processor time. It counts all threads, so run the
    studies on one thread.
    """
    seconds = []
    for _ in range(repeats):
        start = process_time()
        found = run()
        seconds.append(process_time() - start)
    return found, statistics.median(seconds)


def write_csv(study: Study, path: Path) -> None:
    """Writes one line for each point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bands = [n for n in study.errors if any(n in p.band for p in study.points)]
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow([*COLUMNS, study.work, *study.errors, *(f"± {n}" for n in bands)])
        for p in study.points:
            step = "" if p.step is None else f"{p.step:g}"
            errors = [_digits(p.errors.get(n)) for n in study.errors]
            widths = [_digits(p.band.get(n)) for n in bands]
            first = [
                p.series,
                p.setting,
                int(p.default),
                step,
                f"{p.seconds:.6g}",
                f"{p.work:.10g}",
            ]
            rows.writerow([*first, *errors, *widths])


def read_csv(path: Path) -> tuple[str, list[Point]]:
    """Reads what `write_csv` wrote. Returns the unit of work and the points."""
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        names = list(rows.fieldnames or ())
        work, *measured = names[len(COLUMNS) :]
        errors = [n for n in measured if not n.startswith("± ")]
        points = [
            Point(
                row["series"],
                row["setting"],
                {n: float(row[n]) for n in errors if row[n]},
                float(row["seconds"]),
                float(row[work]),
                row["default"] == "1",
                {n: float(row[f"± {n}"]) for n in errors if row.get(f"± {n}")},
                float(row["step"]) if row["step"] else None,
            )
            for row in rows
        ]
    return work, points


def _digits(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def table(study: Study) -> str:
    """Returns the points as a Markdown table.

    Bold settings are on the front of the first error in `shown`, ties included. The default is
    marked.
    """
    first = study.shown[0]
    front = {(p.work, p.errors[first]) for p in study.front(first)}
    lines = [
        "| setting | " + " | ".join(study.errors) + f" | {study.work} | time, s |",
        "|---" * (len(study.errors) + 3) + "|",
    ]
    for p in study.points:
        errors = [_with_band(p, n) for n in study.errors]
        mark = " (default)" if p.default else ""
        name = (f"**{p.setting}**" if (p.work, p.errors.get(first)) in front else p.setting) + mark
        lines.append(f"| {name} | " + " | ".join(errors) + f" | {p.work:,.0f} | {p.seconds:.3g} |")
    return "\n".join(lines)


def order_lines(study: Study) -> list[str]:
    """Returns one Markdown list item for each series that has an order."""
    by_series: dict[str, list[str]] = {}
    for error in study.errors:
        for series, slope in study.orders(error).items():
            by_series.setdefault(series, []).append(f"{error} {slope:.2f}")
    return [f"- {series}: {'; '.join(orders)}" for series, orders in by_series.items()]


def _with_band(p: Point, name: str) -> str:
    if name not in p.errors:
        return "-"
    return f"{p.errors[name]:.2g}" + (f" ± {p.band[name]:.1g}" if name in p.band else "")


def plot(study: Study, path: Path) -> None:
    """Plots each error in `shown` against work and against time, log–log.

    The grey line is the front; the star is the default.
    """
    fig, axes = plt.subplots(
        len(study.shown),
        2,
        figsize=(10, 3.6 * len(study.shown)),
        squeeze=False,
        layout="constrained",
    )
    for row, error in zip(axes, study.shown, strict=True):
        for ax, label, cost in (
            (row[0], study.work, lambda p: p.work),
            (row[1], "time, s", lambda p: p.seconds),
        ):
            _draw(ax, study, error, cost)
            ax.set(xlabel=label, ylabel=error)
    axes[0, 1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    fig.suptitle(study.title)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def _draw(ax: Axes, study: Study, error: str, cost: Callable[[Point], float]) -> None:
    for k, name in enumerate(dict.fromkeys(p.series for p in study.points)):
        chosen = [p for p in study.points if p.series == name and p.errors.get(error, 0.0) > 0.0]
        x, y = [cost(p) for p in chosen], [p.errors[error] for p in chosen]
        band = [p.band.get(error, 0.0) for p in chosen]
        # points of one knob are joined; combinations of knobs are not
        shape = "o-" if len(chosen) > 1 and name != "several" else "o"
        ax.errorbar(
            x,
            y,
            yerr=band if any(band) else None,
            fmt=shape,
            ms=4,
            lw=0.7,
            alpha=0.8,
            color=f"C{k % 10}",
            label=name,
        )
    front = study.front(error, cost)
    ax.plot(
        [cost(p) for p in front],
        [p.errors[error] for p in front],
        color="black",
        lw=2,
        alpha=0.35,
        drawstyle="steps-post",
        label="front",
    )
    default = [p for p in study.points if p.default and p.errors.get(error, 0.0) > 0.0]
    ax.plot(
        [cost(p) for p in default],
        [p.errors[error] for p in default],
        "*",
        color="black",
        ms=14,
        zorder=5,
        label="default",
    )
    ax.set(xscale="log", yscale="log")
    for axis, (low, high) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        _mark(axis, math.log10(high / low))
    ax.grid(True, which="both", lw=0.2)


def _mark(axis: Axis, decades: float) -> None:
    """Labels whole decades; on short axes also values between, few enough not to overlap."""
    axis.set_minor_formatter(NullFormatter())
    if decades < SHORT_AXIS:
        axis.set_major_locator(
            LogLocator(
                subs=(1.0, 2.0, 5.0) if decades > 0.5 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
            )
        )
        axis.set_major_formatter(FuncFormatter(lambda x, _: _number(x)))


def _number(x: float) -> str:
    return (
        f"{x:g}"
        if 1e-3 <= x < 1e5
        else f"{x:.1e}".replace(".0e", "e").replace("e+0", "e").replace("e-0", "e-")
    )

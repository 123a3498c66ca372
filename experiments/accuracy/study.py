"""What a work–precision study is: settings, their errors and costs, the front of those that nothing
beats, and how it is told (CSV, plot, table)."""

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


@dataclass(frozen=True)
class Point:
    """One setting of a study.

    series: which knob was turned, or "several"; points of one series are joined. setting: in words,
    shown in tables. errors: by name, against the study's reference. seconds: of this machine; work:
    free of hardware, in the study's unit. band: half-widths of 95 % confidence bands of errors that
    are statistics over seeds. step: what an order is measured against (h or µm), if anything.
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
    """Points under one title. work: the unit of their `work`; reference: what the errors are
    measured against; shown: the errors that are plotted (the others are in the table and the CSV);
    words: what was run."""

    name: str
    title: str
    words: str
    reference: str
    work: str
    shown: tuple[str, ...]
    points: Sequence[Point]

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of all errors, in the order in which they come up."""
        return tuple(dict.fromkeys(name for p in self.points for name in p.errors))

    def front(self, error: str, cost: Callable[[Point], float] = lambda p: p.work) -> list[Point]:
        """The points that no other beats in both error and cost, cheapest first."""
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
        """By series, the slope of log error against log step, by least squares, where there are
        three steps or more."""
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
    """What it returns, and the median seconds of some runs: of the processor, which other work on
    the machine does not lengthen, on one thread."""
    seconds = []
    for _ in range(repeats):
        begun = process_time()
        found = run()
        seconds.append(process_time() - begun)
    return found, statistics.median(seconds)


def write_csv(study: Study, path: Path) -> None:
    """All points, a line each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        bands = [n for n in study.errors if any(n in p.band for p in study.points)]
        table.writerow(
            [
                "series",
                "setting",
                "default",
                "step",
                "seconds",
                study.work,
                *study.errors,
                *(f"± {n}" for n in bands),
            ]
        )
        for p in study.points:
            found = [_digits(p.errors.get(n)) for n in study.errors] + [
                _digits(p.band.get(n)) for n in bands
            ]
            table.writerow(
                [
                    p.series,
                    p.setting,
                    int(p.default),
                    "" if p.step is None else f"{p.step:g}",
                    f"{p.seconds:.4g}",
                    f"{p.work:.6g}",
                    *found,
                ]
            )


def _digits(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def table(study: Study) -> str:
    """The points in Markdown; the front of the first error shown is in bold, the default marked."""
    front = study.front(study.shown[0])
    lines = [
        "| setting | " + " | ".join(study.errors) + f" | {study.work} | time, s |",
        "|---" * (len(study.errors) + 3) + "|",
    ]
    for p in study.points:
        told = [_told(p, n) for n in study.errors]
        name = (f"**{p.setting}**" if p in front else p.setting) + (
            " (default)" if p.default else ""
        )
        lines.append(f"| {name} | " + " | ".join(told) + f" | {p.work:,.0f} | {p.seconds:.3g} |")
    orders = [
        f"{name}: {error} {slope:.2f}"
        for error in study.errors
        for name, slope in study.orders(error).items()
    ]
    tail = ["", "Order in the step, by least squares: " + "; ".join(orders) + "."] if orders else []
    return "\n".join([*lines, *tail])


def _told(p: Point, name: str) -> str:
    if name not in p.errors:
        return "-"
    return f"{p.errors[name]:.2g}" + (f" ± {p.band[name]:.1g}" if name in p.band else "")


def plot(study: Study, path: Path) -> None:
    """Log–log: each error that is shown against work and against time, the front as a line, the
    default as a star."""
    fig, axes = plt.subplots(
        len(study.shown),
        2,
        figsize=(10, 3.6 * len(study.shown)),
        squeeze=False,
        layout="constrained",
    )
    for row, error in zip(axes, study.shown, strict=True):
        for ax, what, cost in (
            (row[0], study.work, lambda p: p.work),
            (row[1], "time, s", lambda p: p.seconds),
        ):
            _draw(ax, study, error, cost)
            ax.set(xlabel=what, ylabel=error)
    axes[0, 1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    fig.suptitle(study.title)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def _draw(ax: Axes, study: Study, error: str, cost: Callable[[Point], float]) -> None:
    for k, name in enumerate(dict.fromkeys(p.series for p in study.points)):
        mine = [p for p in study.points if p.series == name and p.errors.get(error, 0.0) > 0.0]
        x, y = [cost(p) for p in mine], [p.errors[error] for p in mine]
        band = [p.band.get(error, 0.0) for p in mine]
        # one knob is a way through them, several are a cloud
        shape = "o-" if len(mine) > 1 and name != "several" else "o"
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
    usual = [p for p in study.points if p.default and p.errors.get(error, 0.0) > 0.0]
    ax.plot(
        [cost(p) for p in usual],
        [p.errors[error] for p in usual],
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
    """Numbers at whole decades; where there may be one of them or none, also between: few enough
    that they do not overlap."""
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

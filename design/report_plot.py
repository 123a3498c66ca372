"""The picture of a search: the first guess, the best design, the target and the course."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

import torchfilm as tf
from design.fit_plot import Curve, are_curves, draw_readings, measures_of, spread_over
from design.growing import FinishedColonies
from design.parameters import Choice, Parameter, Space, show_value
from design.report import (
    ReportedDesign,
    SearchReport,
    best_trivial,
    each_measured,
    misses_constraints,
    shown_loss,
    trivial_answers,
)
from design.targets.base import OUTSIDE, Target, known
from design.targets.goals import Constrained
from design.targets.readings import DataPoint, readings_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = 3  # replicates side by side, or one under so many conditions
MOST_SHOWN = 6
LETTERS, OPTION = 16, 10  # that are shown of a name of a parameter, and of an option
# losses of which the largest is so many times the smallest are drawn by their logarithms
WIDE = 100.0


def draw(report: SearchReport) -> Figure:
    """Draw the first guess above and the best design below, with the target over each colony, and
    the course of the search beside them; of numbers measured at several times or doses, these and
    the fit. Needs matplotlib (the `app` extra)."""
    readings = readings_of(report.task.target)
    fits = are_curves(readings)
    figure, aside = _draw_fit(report, readings) if fits else _draw_designs(report)
    _draw_convergence(figure.add_subplot(aside[0]), report)
    _draw_parameters(figure.add_subplot(aside[1]), report)
    return figure


def _draw_fit(report: SearchReport, readings: Sequence[DataPoint]) -> tuple[Figure, Any]:
    """The readings and what the best design and the first guess have there; the figure, and where
    the rest goes."""
    target, panels = report.task.target, len(measures_of(readings))
    figure = tf.pictures.new_figure(3.4 * panels + 4.2, 4.8)
    title = f"best, {shown_loss(target, report.best.loss)}"
    figure.suptitle(f"fit of {len(readings)} readings: {title}", fontsize=10)
    grid = figure.add_gridspec(2, panels + 1, width_ratios=[1.3] * panels + [1.5])
    curves = [
        Curve(one.title, line, spread_over(each_measured(target, one.colonies)))
        for one, line in ((report.best, "-"), (report.first, ":"))
    ]
    axes = [figure.add_subplot(grid[:, k]) for k in range(panels)]
    draw_readings(axes, readings, curves)
    return figure, (grid[0, panels], grid[1, panels])


def _draw_designs(report: SearchReport) -> tuple[Figure, Any]:
    """The colonies of the first guess and the best design; the figure, and where the rest goes."""
    designs = (report.first, report.best)
    target, conditions = report.task.target, report.task.conditions
    shown = SHOWN if conditions == 1 else min(conditions, MOST_SHOWN)
    grown = [_one_by_one(d.colonies)[:shown] for d in designs]
    columns = max(1, *(len(g) for g in grown))
    names = _shown(target, report.best.colonies)
    frames = [[_cells(d.state, k, names) for d, k in g] for g in grown]
    every = [cells for row in frames for cells in row]
    size = tuple(np.max([_extent(cells) for cells in every], axis=0)) if every else (1.0, 1.0)
    height = 6.2 if size[1] > 0.6 * size[0] else 4.6  # wide colonies leave room above
    figure = tf.pictures.new_figure(2.6 * columns + 4.2, height)
    about = re.sub(" ([≤≥]) ", "\u00a0\\1\u00a0", target.describe())  # no line ends between the two
    words = [f"target: {about}", *([target.mark] if target.mark else [])]
    width = 26 * columns + 42
    figure.suptitle("\n".join(textwrap.fill(line, width) for line in words), fontsize=10)
    grid = figure.add_gridspec(
        3, columns + 1, width_ratios=[1.0] * columns + [1.5], height_ratios=[1.0, 1.0, 0.05]
    )
    # a bright first guess must not hide the winner
    limits = _limits(target, names, frames[1] or every)
    scales: list[Any] = []
    for row, one in enumerate(designs):
        axes = [figure.add_subplot(grid[row, k]) for k in range(columns)]
        title = f"{one.title}, {shown_loss(target, one.loss)}"
        if one.fresh is not None:  # no wider than a panel
            again = shown_loss(target, one.fresh.loss).removeprefix("loss ").split()[0]
            title += f"\n({again} on fresh seeds)"
        scales = _draw_row(axes, grown[row], frames[row], target, size, limits, title) or scales
    bars = [figure.add_subplot(grid[2, k]) for k in range(columns)]
    units = {n: f.unit for d in report.best.colonies for n, f in d.state.declared.items()}
    for bar, scale in zip(bars, scales, strict=False):
        over = any(float(f[scale.name].max(initial=0.0)) > scale.limits[1] for f in every)
        unit = scale.unit or units.get(scale.name, "")
        tf.pictures.colour_bar(bar, replace(scale, unit=unit, beyond="max" if over else "neither"))
    for bar in bars[len(scales) :]:
        bar.set_visible(False)
    return figure, (grid[0, columns], grid[1:, columns])


def draw_colonies(
    axes: Sequence[Axes],
    target: Target,
    designs: Sequence[list[FinishedColonies]],
    titles: Sequence[str],
) -> None:
    """Draw the first colony of each design on axes of its own, with the target over it, in one
    scale of colours."""
    grown = [_one_by_one(finished)[:1] for finished in designs]
    names = _shown(target, [finished for each in designs for finished in each])
    frames = [[_cells(d.state, k, names) for d, k in g] for g in grown]
    every = [cells for row in frames for cells in row]
    size = tuple(np.max([_extent(cells) for cells in every], axis=0)) if every else (1.0, 1.0)
    limits = _limits(target, names, every)
    for ax, one, cells, title in zip(axes, grown, frames, titles, strict=True):
        _draw_row([ax], one, cells, target, size, limits, title)


def _one_by_one(finished: list[FinishedColonies]) -> list[tuple[FinishedColonies, int]]:
    """Single colonies as (batch, place in it), in order of their ids."""
    return sorted(
        ((d, k) for d in finished for k in range(d.state.colonies)),
        key=lambda x: int(x[0].state.colony_id[x[1]]),
    )


def _extent(cells: dict[str, np.ndarray]) -> np.ndarray:
    """Half the sides of a rectangle that contains a colony, (2,) µm; neither below a third of the
    other, so that a panel holds its title."""
    place = cells["position"][:, :2]
    half = np.ptp(place, axis=0) / 2 + (cells["length"] / 2 + cells["radius"]).max() + 0.5
    return np.maximum(half, half.max() / 3)


def _colour(name: str, place: int) -> str:
    """The colour of a species: the one that its name states, or one of a list. Red light is shown
    as magenta, which colour-blind readers tell from green."""
    known = {
        "cfp": "cyan",
        "gfp": "lime",
        "yfp": "yellow",
        "rfp": "magenta",
        "blue": "dodgerblue",
        "white": "white",
        "red": "magenta",
        "green": "lime",
    }
    return known.get(name.lower(), ("yellow", "cyan", "magenta", "lime", "white", "red")[place % 6])


def _shown(target: Target, grown: list[FinishedColonies]) -> list[str]:
    """What the colours of cells show: what the target reads, signals at the cells, too. Of one that
    reads no species and tells no strains apart, the first species, if there is one."""
    if not grown:
        return []
    state = grown[0].state
    if target.names or target.strains:
        there = known(state)
        return [n for n in target.names if n in there]
    species = [n for n, f in state.declared.items() if f.is_species]
    return species[:1]


def _cells(state: tf.State, place: int, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The cells of the colony at `place`, with those signals at them that are shown."""
    cells = tf.pictures.frame_of(state).colony(place)
    signals = [n for n in names if n.startswith(OUTSIDE)]
    contact = state.contact() if signals else None
    if contact is not None:
        mine = state.colony == place
        found = {n: contact.found[n.removeprefix(OUTSIDE)][mine] for n in signals}
        cells |= {n: x.detach().cpu().numpy() for n, x in found.items()}
    return cells


def _limits(
    target: Target, names: Sequence[str], frames: list[dict[str, np.ndarray]]
) -> dict[str, tuple[float, float]]:
    """The range of colours of what is shown: that of these frames, and up to what the target calls
    lit. One for both designs, so that these can be compared."""
    high = {n: max((float(f[n].max()) for f in frames), default=1.0) for n in names}
    return {n: (0.0, max(high[n], target.lit_from.get(n, 0.0)) or 1.0) for n in names}


def _draw_row(
    axes: list[Axes],
    grown: list[tuple[FinishedColonies, int]],
    frames: list[dict[str, np.ndarray]],
    target: Target,
    size: tuple[float, float],
    limits: dict[str, tuple[float, float]],
    title: str,
) -> list[Any]:
    """Draw colonies of one design, coloured by the species of the target. Returns the scales of the
    colours; none without species or colonies."""
    names = list(limits)
    colour = names[0] if len(names) == 1 else None if names else target.strains
    channels = {n: _colour(n, k) for k, n in enumerate(names)} if len(names) > 1 else None
    scales: list[Any] = []
    for ax, (done, k), cells in zip(axes, grown, frames, strict=False):
        x, y = (cells["position"][:, :2].max(0) + cells["position"][:, :2].min(0)) / 2
        window = (x - size[0], x + size[0], y - size[1], y + size[1])
        if channels:
            ax.set_facecolor("black")
        scales = tf.pictures.draw_cells(
            ax, cells, colour=colour, channels=channels, limits=limits, window=window
        )
        target.draw(ax, done.state, k, done.history)
        tf.pictures.scale_bar(ax)
        number = int(done.state.colony_id[k])
        under = target.label(number % len(target.arguments))
        first = f"{title}\n{under}" if under else title
        ax.set_title(first if ax is axes[0] else target.caption(number), fontsize=9)
    for ax in axes[len(grown) :]:
        ax.set_visible(False)
    return scales if names else []


def _draw_convergence(ax: Axes, report: SearchReport) -> None:
    """The loss of the first guess, of every full-size design that did not fail, and the lowest so
    far; and of the best trivial answer."""
    study = report.study
    spent = np.concatenate([[0.0], study.convergence()[0]])
    places, losses = [np.empty(0)], [np.empty(0)]
    for entry, begin, end in zip(study.entries, spent[:-1], spent[1:], strict=True):
        if study.is_full(entry):
            places.append(np.linspace(begin, end, len(entry.loss) + 1)[1:])
            failed = np.isin(np.arange(len(entry.loss)), [row for row, _ in entry.reasons])
            losses.append(np.where(failed, np.nan, entry.loss))
    x, y = np.concatenate(places), np.concatenate(losses)
    first, words = report.first.loss, ("loss", "designs at full size (grey), the best so far (red)")
    missed = misses_constraints(report.task.target, y)
    none = missed.any() and missed[~np.isnan(y)].all()  # of those that did not fail meets them
    if missed.any():
        if none:
            y, first = y - Constrained.BROKEN, first - Constrained.BROKEN
            words = "constraints missed", words[1]
        else:
            y = np.where(missed, np.nan, y)
            first = np.nan if misses_constraints(report.task.target, first) else first
            words = words[0], f"{words[1]};\nthose that miss constraints are left out"
    ax.plot(x, y, ".", color="0.75", ms=2, zorder=0)
    ax.step(x, np.fmin.accumulate(y), where="post", color="C3")
    if report.first.colonies:
        ax.plot([0.0], [first], "o", color="0.55", clip_on=False)  # as among parameters
    answers = {} if none else trivial_answers(report)
    if answers:
        name = best_trivial(report.task.target, answers)
        ax.axhline(answers[name], color="0.3", lw=0.8, ls="--")
        ax.annotate(
            f"without a pattern: {name}", (1.0, answers[name]), xycoords=("axes fraction", "data"),
            xytext=(-2, -2), textcoords="offset points", ha="right", va="top", fontsize=7,
            color="0.3", bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 0.6},
        )  # fmt: skip
    some = y[np.isfinite(y)]
    wide = len(some) > 0 and some.min() > 0 and some.max() > WIDE * some.min()
    if wide:
        ax.set_yscale("log")
    ax.set(xlabel="colonies simulated", ylabel=words[0], **({} if wide else {"ylim": (0, None)}))
    ax.set_title(words[1], fontsize=9)


def _places(space: Space, shown: ReportedDesign) -> list[float]:
    """Between the bounds, from 0 to 1; of a choice that of the option that is used, to which the
    task may have resolved what the search had drawn."""
    each = zip(space.parameters, shown.point, strict=True)
    return [p.coordinate(shown.values[p.name]) if isinstance(p, Choice) else x for p, x in each]


def _draw_parameters(ax: Axes, report: SearchReport) -> None:
    """The best design and the first guess between the bounds."""
    space, first, best = report.task.space, report.first, report.best
    rows = np.arange(space.size)[::-1]
    ax.hlines(rows, 0, 1, color="0.85", lw=4, zorder=0)
    ax.plot(_places(space, first), rows, "o", color="0.55", label=first.title)
    ax.plot(_places(space, best), rows, "D", color="C3", label=best.title)
    for y, p in zip(rows, space.parameters, strict=True):
        low, high = (
            (f"{p.low:g}", f"{p.high:g}")
            if isinstance(p, Parameter)
            else tuple(tf.displays.shortened(str(p.options[k]), OPTION) for k in (0, -1))
        )
        for x, bound, side in ((0, low, "right"), (1, high, "left")):
            ax.annotate(
                bound,
                (x, y),
                xytext=(-7 if side == "right" else 7, 0),  # clear of a marker at the bound
                textcoords="offset points",
                ha=side,
                va="center",
                fontsize=7,
                color="0.4",
            )
    names = [tf.displays.shortened(p.name, LETTERS) for p in space.parameters]
    values = [show_value(best.values[p.name]) for p in space.parameters]
    labels = [f"{name} = {value}" for name, value in zip(names, values, strict=True)]
    ax.set(yticks=rows, yticklabels=labels, xticks=[], xlim=(-0.28, 1.28))
    ax.set_ylim(-0.7, space.size - 0.3)
    ax.tick_params(left=False)
    for side in ("left", "right", "top", "bottom"):
        ax.spines[side].set_visible(False)
    ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False)

"""The report of a search: a table, and a picture of the first guess, the best design and the
target."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

import torchfilm as tf
from design.finals import FreshLosses
from design.parameters import Choice, Parameter, Space, Value, show_value
from design.rollout import FinishedColonies
from design.study import Study
from design.targets.base import Target
from design.targets.goals import Goals
from design.targets.observed import Observed
from design.task import Task
from design.trivial import trivial_losses

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = 3  # replicates side by side
LUCKY = 0.8  # of the band on fresh seeds: a search that saw less than this was misled
SUCCESS = 0.25  # of the loss of the best trivial answer: as in the comparison of methods
FITS = 2.0  # a greater loss is not that of colonies like the observed ones, which is about 1
NEAR = 0.005  # of a bound, as a share of the range (of its logarithm)


@dataclass(frozen=True, eq=False)
class ReportedDesign:
    """A design that a report shows: its values by name, its point (D,), its loss in the search, its
    colonies at their ends, and its losses on fresh seeds, where it was tested."""

    title: str
    values: dict[str, Value]
    point: np.ndarray
    loss: float
    colonies: list[FinishedColonies]
    fresh: FreshLosses | None = None


@dataclass(frozen=True, eq=False)
class SearchReport:
    """What a report of a search shows. why_regrown: the reason why colonies did not follow recorded
    growth, or ""; why_chosen: the method, if the search chose it, and why."""

    task: Task
    study: Study
    why_regrown: str
    first: ReportedDesign
    best: ReportedDesign
    why_chosen: str = ""


def table(report: SearchReport) -> str:
    """Parameters with bounds, first guess and best value; then losses and measures."""
    first, best, study = report.first, report.best, report.study
    rows: list[tuple[str, ...]] = [("parameter", "bounds", first.title, best.title, "")]
    rows += parameter_rows(report.task.space, first.values, best.values)
    rows.append((_loss_title(report), "", f"{first.loss:.4f}", f"{best.loss:.4f}", ""))
    rows += _goals(report)
    if best.fresh is not None:
        title, loss = f"{_loss_title(report)} on fresh seeds", f"{best.fresh.loss:.4f}"
        rows.append((title, "", "", loss, _seeds(best.fresh)))
    rows.append(("cells", "", *(_cells(design.colonies) for design in (first, best)), ""))
    target = report.task.target
    old, new = (each_measured(target, design.colonies) for design in (first, best))
    seen = {name: f"{value:.4g} ± {by:.2g}" for name, (value, by) in target.observed.items()}
    if seen:
        rows = [(*row, "") for row in rows]
        rows[0] = (*rows[0][:5], "observed")
    for name in new:
        means = (show_value(_mean(values)) for values in (old.get(name, []), new[name]))
        row = (name, "", *means, _spread(new[name]))
        rows.append((*row, seen.get(name, "")) if seen else row)
    wide = [max(len(r[k]) for r in rows) for k in range(len(rows[0]))]
    lines = [
        "  ".join(
            x.rjust(w) if k in (2, 3) else x.ljust(w)
            for k, (x, w) in enumerate(zip(r, wide, strict=True))
        ).rstrip()
        for r in rows
    ]
    lines += _undefined(target, new)
    lines += _warnings(report)
    failed = study.failed
    lines += [
        f"most frequent failure: {reason} ({times} colonies)"
        for reason, times in study.failures()[:1]
    ]
    how = (
        f"grown again for each design: {report.why_regrown}"
        if report.why_regrown
        else "circuits ran on one recorded growth"
    )
    if report.why_chosen:
        lines.append(report.why_chosen)
    spent = f"{study.colonies:.0f} colonies in {study.seconds:.0f} s"
    lines.append(spent + (f", {failed} failed" if failed else "") + f"; {how}")
    return "\n".join(lines)


def parameter_rows(
    space: Space, first: Mapping[str, Value], best: Mapping[str, Value]
) -> list[tuple[str, ...]]:
    """For each parameter its name, its bounds, its first and its best value, and whether that lies
    at a bound."""
    return [
        (
            p.name,
            _bounds(p),
            show_value(first[p.name]),
            show_value(best[p.name]),
            _at_bound(p, best[p.name]),
        )
        for p in space.parameters
    ]


def fresh_words(fresh: FreshLosses) -> str:
    """The loss on fresh seeds, with its band."""
    return f"{fresh.loss:.4f} ({_seeds(fresh)})"


def _seeds(fresh: FreshLosses) -> str:
    low, high = fresh.band
    return f"{low:.4f} … {high:.4f}, {len(fresh.losses)} seeds"


def _loss_title(report: SearchReport) -> str:
    return "sum of goals" if report.task.goals else "loss"


def _goals(report: SearchReport) -> list[tuple[str, ...]]:
    """A row for each of several goals: its mean over the replicates."""
    target = report.task.target
    if not isinstance(target, Goals):
        return []
    each = [
        torch.cat([target.losses(part.state, part.history) for part in design.colonies]).mean(0)
        for design in (report.first, report.best)
        if design.colonies
    ]
    return [
        (title, "", *(f"{float(found[k]):.4f}" for found in each), "")
        for k, title in enumerate(target.titles)
        if len(each) == 2
    ]


def _warnings(report: SearchReport) -> list[str]:
    """The losses of trivial answers, and what they and the bounds say of the best design."""
    best, space = report.best, report.task.space
    answers: dict[str, float] = {}
    lines: list[str] = []
    target = report.task.target
    # a sum of goals compares nothing; data, and a target without species, have no trivial answers
    if target.names and target.pattern and not report.task.goals and best.colonies:
        answers = trivial_losses(target, best.colonies)
        lines = ["without a pattern: " + ", ".join(f"{n} {x:.3f}" for n, x in answers.items())]
    least = min(answers, key=lambda n: answers[n], default="")
    if least and best.loss >= answers[least]:
        lines.append(
            f"the best design is no better than {least!r}: it has found no pattern. Larger"
            " colonies, or a narrower target, tell patterns apart."
        )
    elif least and best.loss > SUCCESS * answers[least]:
        lines.append(
            f"the pattern is weak: the best design has {best.loss / answers[least]:.2f} of the loss"
            f" of {least!r}, and a good one {SUCCESS:g} or less. Simulate more colonies, free more"
            " parameters, or grow larger colonies."
        )
    if isinstance(target, Observed) and best.loss > FITS:
        lines.append(_poor_fit(target, best))
    if best.fresh is not None and best.loss < LUCKY * best.fresh.band[0]:
        lines.append(
            f"the {report.task.replicates} seeds of the search were lucky: {best.loss:.4f} there,"
            f" {best.fresh.loss:.4f} on fresh ones. Such losses mislead a search; give it more"
            " replicates."
        )
    bound = [p.name for p in space.parameters if _at_bound(p, best.values[p.name])]
    if bound:
        lines.append(f"at a bound: {', '.join(bound)}; better values may lie beyond it.")
    return lines


def _undefined(target: Target, found: Mapping[str, list[float]]) -> list[str]:
    """Why measures are undefined in some colonies."""
    reasons = {n: target.why_undefined(n) for n, v in found.items() if np.isnan(v).any()}
    return [f"{name} is undefined: {why}." for name, why in reasons.items() if why]


def _poor_fit(target: Observed, best: ReportedDesign) -> str:
    """What a design that is unlike the data misses most."""
    seen, found = target.observed, measured(target, best.colonies)
    apart = {n: abs(found[n] - value) / by for n, (value, by) in seen.items() if n in found}
    worst = sorted((n for n in apart if np.isfinite(apart[n])), key=lambda n: -apart[n])[:SHOWN]
    words = ", ".join(f"{n} by {apart[n]:.1f} spreads" for n in worst)
    return (
        "colonies that grew as the observed ones did have a loss of about 1. The best design is off"
        f" most in {words}. Search longer, free more parameters, or change the model."
    )


def _at_bound(parameter: Parameter | Choice, value: Value) -> str:
    """Where a number lies on a bound of its own: within NEAR of its range."""
    if isinstance(parameter, Choice) or parameter.whole:
        return ""
    place = parameter.coordinate(value)
    return (
        "at its lower bound" if place < NEAR else "at its upper bound" if place > 1 - NEAR else ""
    )


def _cells(finished: list[FinishedColonies]) -> str:
    """The numbers of cells of some colonies."""
    counts = [n for part in finished for n in part.state.counts.tolist()]
    if not counts:
        return "none"
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)}–{max(counts)}"


def _mean(values: list[float]) -> float:
    """Of the colonies that have a measure; NaN where none has."""
    return float(np.nanmean(values)) if not np.isnan(values).all() else float("nan")


def _spread(values: list[float]) -> str:
    """The standard deviation of a measure between colonies, and how many have it."""
    some = np.array([x for x in values if np.isfinite(x)])
    spread = f"± {float(some.std(ddof=1)):.2g}" if len(some) > 1 else ""
    missing = sum(np.isnan(x) for x in values)
    return spread + (f" (undefined in {missing} of {len(values)})" if missing else "")


def _bounds(parameter: Parameter | Choice) -> str:
    if isinstance(parameter, Parameter):
        return f"{parameter.low:g} … {parameter.high:g}"
    return " | ".join(map(str, parameter.options))


def each_measured(target: Target, finished: Iterable[FinishedColonies]) -> dict[str, list[float]]:
    """The measures of a target, of each colony."""
    found: dict[str, list[float]] = {}
    for part in finished:
        for name, value in target.measures(part.state, part.history).items():
            found.setdefault(name, []).extend(value.double().tolist())
    return found


def measured(target: Target, finished: Iterable[FinishedColonies]) -> dict[str, float]:
    """The mean of each measure of a target over the colonies that have it; NaN where none has."""
    return {name: _mean(v) for name, v in each_measured(target, finished).items()}


def draw(report: SearchReport) -> Figure:
    """Draw the first guess above and the best design below, with the target over each colony, and
    the course of the search beside them. Needs matplotlib (the `app` extra)."""
    designs = (report.first, report.best)
    grown = [_one_by_one(d.colonies)[:SHOWN] for d in designs]
    columns = max(1, *(len(g) for g in grown))
    target = report.task.target
    frames = [[tf.pictures.frame_of(d.state).colony(k) for d, k in g] for g in grown]
    every = [cells for row in frames for cells in row]
    size = tuple(np.max([_extent(cells) for cells in every], axis=0)) if every else (1.0, 1.0)
    height = 6.2 if size[1] > 0.6 * size[0] else 4.6  # wide colonies leave room above
    figure = tf.pictures.new_figure(2.6 * columns + 4.2, height)
    grid = figure.add_gridspec(
        3, columns + 1, width_ratios=[1.0] * columns + [1.5], height_ratios=[1.0, 1.0, 0.05]
    )
    limits = _limits(target, every)
    scales: list[Any] = []
    for row, one in enumerate(designs):
        axes = [figure.add_subplot(grid[row, k]) for k in range(columns)]
        title = f"{one.title}, loss {one.loss:.3f}"
        if one.fresh is not None:
            title += f"\n({one.fresh.loss:.3f} on fresh seeds)"  # no wider than a panel
        scales = _draw_row(axes, grown[row], frames[row], target, size, limits, title) or scales
    bars = [figure.add_subplot(grid[2, k]) for k in range(columns)]
    for bar, scale in zip(bars, scales, strict=False):
        tf.pictures.colour_bar(bar, scale)
    for bar in bars[len(scales) :]:
        bar.set_visible(False)
    _draw_convergence(figure.add_subplot(grid[0, columns]), report.study)
    _draw_parameters(figure.add_subplot(grid[1:, columns]), report)
    return figure


def draw_colonies(
    axes: Sequence[Axes],
    target: Target,
    designs: Sequence[list[FinishedColonies]],
    titles: Sequence[str],
) -> None:
    """Draw the first colony of each design on axes of its own, with the target over it, in one
    scale of colours."""
    grown = [_one_by_one(finished)[:1] for finished in designs]
    frames = [[tf.pictures.frame_of(d.state).colony(k) for d, k in g] for g in grown]
    every = [cells for row in frames for cells in row]
    size = tuple(np.max([_extent(cells) for cells in every], axis=0)) if every else (1.0, 1.0)
    limits = _limits(target, every)
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
    """The colour of a species: the one that its name states, or one of a list."""
    known = {
        "cfp": "cyan",
        "gfp": "lime",
        "yfp": "yellow",
        "rfp": "red",
        "blue": "dodgerblue",
        "white": "white",
        "red": "red",
        "green": "lime",
    }
    return known.get(name.lower(), ("yellow", "cyan", "magenta", "red", "lime", "white")[place % 6])


def _limits(target: Target, frames: list[dict[str, np.ndarray]]) -> dict[str, tuple[float, float]]:
    """The range of colours of each species that the target reads in cells: one for both designs, so
    that these can be compared."""
    names = [n for n in target.names if not n.startswith("out.")]
    return {n: (0.0, max((float(f[n].max()) for f in frames), default=1.0) or 1.0) for n in names}


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
    colour = names[0] if len(names) == 1 else None
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
        ax.set_title(
            title if ax is axes[0] else f"replicate {int(done.state.colony_id[k])}", fontsize=9
        )
    for ax in axes[len(grown) :]:
        ax.set_visible(False)
    return scales if names else []


def _draw_convergence(ax: Axes, study: Study) -> None:
    """The loss of every full-size design, and the lowest so far."""
    spent = np.concatenate([[0.0], study.convergence()[0]])
    places, losses = [np.empty(0)], [np.empty(0)]
    for entry, begin, end in zip(study.entries, spent[:-1], spent[1:], strict=True):
        if study.is_full(entry):
            places.append(np.linspace(begin, end, len(entry.loss) + 1)[1:])
            losses.append(entry.loss)
    x, y = np.concatenate(places), np.concatenate(losses)
    ax.plot(x, y, ".", color="0.75", ms=2, zorder=0)
    ax.step(x, np.minimum.accumulate(y), where="post", color="C3")
    ax.set(xlabel="colonies simulated", ylabel="loss", ylim=(0, None))
    ax.set_title("every design (grey), the best so far (red)", fontsize=9)


def _draw_parameters(ax: Axes, report: SearchReport) -> None:
    """The best design and the first guess between the bounds."""
    space, first, best = report.task.space, report.first, report.best
    rows = np.arange(space.size)[::-1]
    ax.hlines(rows, 0, 1, color="0.85", lw=4, zorder=0)
    ax.plot(first.point, rows, "o", color="0.55", label=first.title)
    ax.plot(best.point, rows, "D", color="C3", label=best.title)
    for y, p in zip(rows, space.parameters, strict=True):
        low, high = (
            (f"{p.low:g}", f"{p.high:g}")
            if isinstance(p, Parameter)
            else (str(p.options[0]), str(p.options[-1]))
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
    ax.set(
        yticks=rows,
        yticklabels=[f"{p.name} = {show_value(best.values[p.name])}" for p in space.parameters],
        xticks=[],
        xlim=(-0.28, 1.28),
    )
    ax.set_ylim(-0.7, space.size - 0.3)
    ax.tick_params(left=False)
    for side in ("left", "right", "top", "bottom"):
        ax.spines[side].set_visible(False)
    ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False)

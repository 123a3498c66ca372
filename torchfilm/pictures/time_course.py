"""A time course: how many cells colonies have, and what they contain, in the course of a run."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.categories import KINDS, colours_of_kinds
from torchfilm.pictures.colours import TYPES
from torchfilm.pictures.figures import check_not_results, opened
from torchfilm.pictures.page import checked_dpi
from torchfilm.pictures.picture import Picture, new_figure
from torchfilm.pictures.run_courses import ALL, BAND, BIOVOLUME, RunCourse, run_course
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE, HIGH = 5.0, 2.2  # inches, of a panel
MANY = 10  # replicates, beyond which a band shows them
TALL = 12  # names in a column of the legend
FEW = 4  # colonies up to which a band shows the spread between cells
TENFOLD = 10.0  # numbers of cells of such a range are drawn by their logarithms
STYLES = ("-", "--", ":", "-.")  # of colonies, where colours are those of kinds


@checks.known_keywords
def time_course(
    what: str | Path | Results | Mapping[str, str | Path | Results],
    *quantities: str,
    by: str | None = None,
    conditions: str | Sequence[str] | Mapping[int, str] | None = None,
    colonies: Sequence[int] | None = None,
    most: int = 8,
    log: bool = False,
    out: str | Path | None = None,
    dpi: float = 160,
) -> Picture:
    """Draw the number of cells of each colony against time, and below it each quantity: the mean
    over its cells, of up to four lines also the band from 10 to 90 % of them. Colonies of one
    condition are replicates: thin lines of one colour beside their mean, or if they are more than
    ten, the band from 10 to 90 % of them. A mean of numbers of cells counts those without as 0;
    other means are of colonies that have cells.

    what: a results file, or its path; or several runs by name, {"drug": "drug.h5", "control":
    "control.h5"}, whose colonies are replicates unless their parameters differ. quantities: fields
    of the cells, "volume", "age" or "born", signals at them as "out.NAME", or "biovolume", µm³, of
    all cells of a colony. by: a field of whole numbers, such as "cell_type": cells of each are
    counted apart, a colour for each, and a style of lines for each of up to four conditions.
    conditions: a parameter that has one value per colony, as tables name it, or several: colonies
    in which these are the same are of one condition; or names by id, {0: "control", 1: "control",
    2: "starved"}. By default all parameters count, where up to two differ. colonies: their ids;
    default those of the first `most` conditions that had cells. log: logarithmic axes of the
    quantities; the number of cells has one where it grows more than tenfold. Where all cells of a
    line have died, a triangle at 0 marks when; a logarithmic axis then has a 0 below 1. A cross
    marks where a colony has failed. out: save the picture there. Raises InputError for a quantity
    that is not recorded, and for a file of one frame."""
    checked_dpi(dpi)
    checks.choice("log", log, (True, False))
    checks.integer("most", most, least=1)
    runs = _runs(what)
    if by is not None:
        most = min(most, max(1, len(STYLES) // len(runs)))
    courses = []
    for name, one in runs.items():
        with opened(one) as results, _named(name):
            check_not_results(results.path, out)
            courses.append(run_course(results, name, quantities, by, conditions, colonies, most))
    lines = _lines(courses, by)
    figure = new_figure(WIDE, HIGH * (1 + len(quantities)) + 0.3, dpi)
    axes = list(figure.subplots(1 + len(quantities), 1, sharex=True, squeeze=False)[:, 0])
    seen = _draw_runs(axes, courses, lines, _sums(quantities))
    _finish_all(axes, courses, quantities, seen, log)
    if len(runs) > 1 or courses[0].several or by is not None:
        _legend(axes[0])
    titles = ", ".join(dict.fromkeys(x.title for x in courses))
    figure.suptitle(titles, fontsize=9, parse_math=False)
    return Picture(figure, out)


@contextlib.contextmanager
def _named(run: str) -> Iterator[None]:
    """Raise InputErrors with the name of the run, if it is one of several."""
    try:
        yield
    except checks.InputError as error:
        raise checks.InputError(f"run {run!r}: {error}" if run else str(error)) from error


def _runs(what: Any) -> Mapping[str, Any]:
    """The files by their names; "" for one alone."""
    if not isinstance(what, Mapping | list | tuple):
        return {"": what}
    if (
        not isinstance(what, Mapping)
        or not what
        or not all(isinstance(name, str) and name for name in what)
    ):
        rule = 'files by the names of runs, such as {"drug": "drug.h5", "control": "control.h5"}'
        raise checks.input_error("results", what, rule)
    return what


@dataclass(frozen=True)
class CourseLine:
    """The cells of a colony at a place of the batch, or those of one kind, and how to draw them."""

    place: int
    kind: int
    label: str
    colour: Any
    style: str


def _sums(quantities: Sequence[str]) -> list[int]:
    """The panels whose values are of all cells of a colony, 0 without cells."""
    return [0, *(1 + k for k, name in enumerate(quantities) if name == BIOVOLUME)]


def _draw_runs(
    axes: Sequence[Axes],
    courses: Sequence[RunCourse],
    lines: Sequence[Sequence[CourseLine]],
    sums: Sequence[int],
) -> list[np.ndarray]:
    """Draw the lines of each run, and return what they show, (frames, lines, panels, 3) of each."""
    band, everything = sum(map(len, lines)) <= FEW, []
    for course, own in zip(courses, lines, strict=True):
        seen = course.values([(x.place, x.kind) for x in own])
        failed = course.failed[:, [course.places.index(x.place) for x in own]]
        everything.append(seen)
        for label in dict.fromkeys(x.label for x in own):
            same = np.array([k for k, x in enumerate(own) if x.label == label])
            _draw_alike(axes, course.times, seen[:, same], [own[k] for k in same], failed[:, same],
                        band=band, sums=sums)  # fmt: skip
    return everything


def _draw_alike(
    axes: Sequence[Axes], times: np.ndarray, seen: np.ndarray, lines: Sequence[CourseLine],
    failed: np.ndarray, *, band: bool, sums: Sequence[int],
) -> None:  # fmt: skip
    """Draw the lines of one condition, (frames, lines, panels, 3), and their mean if they are
    several. failed: (frames, lines) where the colony has failed."""
    several, many = len(lines) > 1, len(lines) > MANY
    for k, line in enumerate(lines if not many else ()):
        _draw(axes, times, seen[:, k], line, band and not several, several)
        _draw_end(axes[0], times, seen[:, k, 0, 0], line, several, failed[:, k])
    if not several:
        return
    filled = seen.copy()
    none = np.isnan(seen[:, :, 0, 0]) & ~failed
    for panel in sums:  # those without cells count, whether dead or of other kinds
        filled[:, :, panel][none] = 0.0
    mean = _mean(filled)
    if many:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of a frame without any cell
            mean[:, :, 1:] = np.nanpercentile(filled[..., 0], BAND, axis=1).transpose(1, 2, 0)
    first = replace(lines[0], label=f"{lines[0].label}, mean of {len(lines)}")
    _draw(axes, times, mean, first, band=many, of_counts=many)


def _draw(
    axes: Sequence[Axes], times: np.ndarray, seen: np.ndarray, line: CourseLine,
    band: bool = False, thin: bool = False, of_counts: bool = False,
) -> None:  # fmt: skip
    """Draw one line in each panel, and a band below the first, or in each if `of_counts`. seen: of
    each frame, (frames, panels, 3): the value, and the ends of the band. thin: one of several
    replicates."""
    width: dict[str, Any] = {"lw": 0.5, "alpha": 0.7} if thin else {"lw": 1.2}
    label = None if thin else line.label
    for row, ax in enumerate(axes):
        value, low, high = seen[:, row].T
        ax.plot(times, value, color=line.colour, ls=line.style, label=label, **width)
        if band and (row or of_counts):
            ax.fill_between(times, low, high, color=line.colour, alpha=0.2, lw=0)


def _draw_end(
    ax: Axes,
    times: np.ndarray,
    counts: np.ndarray,
    line: CourseLine,
    thin: bool,
    failed: np.ndarray,
) -> None:
    """Mark where the cells of a line die out, and draw that there are 0 from then on; or where its
    colony fails. counts: of each frame; NaN without cells. failed: (frames,) where it has."""
    gone, size = _gone(counts) & ~failed, 12 if thin else 30
    last = np.flatnonzero(~failed)[-1:]
    if failed.any() and counts[last] > 0:
        ax.scatter(times[last], counts[last], s=size, color=line.colour, marker="x", zorder=3)
    change = np.diff(gone.astype(int), prepend=0, append=0)
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    zero, lw = np.zeros(len(begin)), 0.5 if thin else 1.2
    ax.hlines(zero, times[begin], times[end], color=line.colour, ls=line.style, lw=lw)
    ax.scatter(times[begin], zero, s=size, color=line.colour, marker="v", zorder=3)


def _gone(counts: np.ndarray) -> np.ndarray:
    """(frames, …) where no cells are left of those that were there before."""
    none = np.isnan(counts)
    return none & np.logical_or.accumulate(~none)


def _scale_of_counts(each: Sequence[np.ndarray]) -> str:
    """Of the axis of numbers of cells, of each run (frames, lines): logarithmic where they grow
    more than tenfold, and linear from 0 to 1 below that, where cells die out."""
    alive = np.concatenate([counts[counts > 0] for counts in each])
    if alive.max(initial=0.0) <= TENFOLD * max(1, alive.min(initial=np.inf)):
        return "linear"
    return "symlog" if any(bool(_gone(counts).any()) for counts in each) else "log"


def _mean(seen: np.ndarray) -> np.ndarray:
    """The mean of colonies, (frames, colonies, panels, 3), that have cells; NaN where none has."""
    some = ~np.isnan(seen)
    total = np.where(some, seen, 0.0).sum(1)
    return np.divide(total, some.sum(1), out=np.full_like(total, np.nan), where=some.any(1))


def _lines(courses: Sequence[RunCourse], by: str | None) -> list[list[CourseLine]]:
    """Those of each run: one for each colony, or for each kind of each. Those of one condition have
    the label and the colour in common; or with kinds, the style."""
    labels = list(dict.fromkeys(name for course in courses for name in course.named.values()))
    if by is None:
        colours = dict(zip(labels, _colours(len(labels)), strict=True))
        return [
            [CourseLine(p, ALL, name, colours[name], "-") for p, name in course.named.items()]
            for course in courses
        ]
    if len(labels) > len(STYLES):
        rule = f"colonies of up to {len(STYLES)} conditions where cells are told apart by {by!r}"
        raise checks.input_error("colonies", labels, rule, "See conditions=…")
    kinds = sorted(set[int]().union(*(course.kinds for course in courses)))
    styles = dict(zip(labels, STYLES, strict=False))
    several = len(courses) > 1 or courses[0].several
    out = []
    for course in courses:
        own = course.type_names if by == TYPES else ()
        kind_name = {k: own[k] if 0 <= k < len(own) else f"{by} {k}" for k in kinds}
        out.append([
            CourseLine(p, kind, f"{name}, " * several + kind_name[kind], c, styles[name])
            for p, name in course.named.items()
            for kind, c in zip(kinds, _colours_of(kinds, by), strict=True)
        ])  # fmt: skip
    return out


def _colours_of(kinds: Sequence[int], by: str) -> list[Any]:
    """A colour for each kind, as in pictures of cells; where there are many, a ramp."""
    if by == TYPES or len(kinds) <= len(KINDS):
        return colours_of_kinds(kinds, by == TYPES)
    return _colours(len(kinds))


def _colours(count: int) -> list[Any]:
    """A colour for each colony: those of kinds, or where there are more a ramp."""
    from matplotlib import colormaps

    if count <= len(KINDS):
        return list(KINDS[:count])
    return [colormaps["viridis"](k / (count - 1)) for k in range(count)]


def _legend(ax: Axes) -> None:
    """Name the lines, beside the first panel."""
    columns = -(-len(ax.get_legend_handles_labels()[1]) // TALL)
    made = ax.legend(
        fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=columns
    )
    for text in made.get_texts():
        text.set_parse_math(False)  # names may hold a $


def _finish_all(
    axes: Sequence[Axes],
    courses: Sequence[RunCourse],
    quantities: Sequence[str],
    seen: Sequence[np.ndarray],
    log: bool,
) -> None:
    """Label the panels and scale their axes. seen: of each run, (frames, lines, panels, 3)."""
    _finish(axes[0], "cells", _scale_of_counts([x[:, :, 0, 0] for x in seen]))
    for row, name in enumerate(quantities):
        unit = courses[0].units[name]
        some = any(bool((x[:, :, 1 + row] > 0).any()) for x in seen)  # or there is no logarithm
        words = name if name == BIOVOLUME else f"mean of {name}"
        _finish(
            axes[1 + row], words + f" ({unit})" * bool(unit), "log" if log and some else "linear"
        )
    axes[-1].set_xlabel("time (h)")
    # of the runs, also where their last cells died before
    ends = np.array([min(x.times[0] for x in courses), max(x.times[-1] for x in courses)])
    axes[-1].set_xlim(*(ends + 0.05 * np.diff(ends) * [-1, 1]))


def _finish(ax: Axes, label: str, scale: str) -> None:
    """scale: "linear", "log", or "symlog", which has 0, too."""
    ax.set_ylabel(label, parse_math=False)
    more = {"linthresh": 1.0, "linscale": 0.5, "subs": range(2, 10)} if scale == "symlog" else {}
    ax.set_yscale(scale, **more)
    if more:  # a margin below 0 as narrow as that above, whatever is filled
        ax.set_ylim(bottom=max(ax.get_ylim()[0], -0.25))
    ax.grid(False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)

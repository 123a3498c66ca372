"""A time course: how many cells colonies have, and what they contain, in the course of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.categories import KINDS, colours_of_kinds
from torchfilm.pictures.colours import TYPES
from torchfilm.pictures.figures import check_not_results, choose_colonies, opened
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.page import checked_dpi
from torchfilm.pictures.picture import Picture, new_figure
from torchfilm.pictures.place_and_time import Columns, known_quantities, unit_at_cells
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE, HIGH = 5.0, 2.2  # inches, of a panel
FEW = 4  # colonies up to which a band shows the spread between cells
BAND = (10.0, 90.0)  # percentiles
TENFOLD = 10.0  # numbers of cells of such a range are drawn by their logarithms
ALL = -1  # the kind of cells that are not told apart
STYLES = ("-", "--", ":", "-.")  # of colonies, where colours are those of kinds


@checks.known_keywords
def time_course(
    what: str | Path | Results,
    *quantities: str,
    by: str | None = None,
    colonies: Sequence[int] | None = None,
    most: int = 8,
    log: bool = False,
    out: str | Path | None = None,
    dpi: float = 160,
) -> Picture:
    """Draw the number of cells of each colony against time, and below it the mean of each quantity
    over its cells; of up to four lines also the band from 10 to 90 % of the cells. Where
    colonies differ in parameters, those of the same ones are thin lines of one colour, without a
    band, beside the mean of those that have cells.

    what: a results file, or its path. quantities: fields of the cells, "volume", "age" or "born",
    or signals at them as "out.NAME". by: a field of whole numbers, such as "cell_type": cells of
    each are counted apart, a colour for each, and a style of lines for each of up to four colonies.
    colonies: their ids; default the first `most` that had cells. log: logarithmic axes of the
    quantities; the number of cells has one where it grows more than tenfold. Where all cells of a
    line have died, a triangle at 0 marks when; a logarithmic axis then has a 0 below 1. out: save
    the picture there. Raises InputError for a quantity that is not recorded, and for a file of one
    frame."""
    with opened(what) as results:
        check_not_results(results.path, out)
        checked_dpi(dpi)
        checks.choice("log", log, (True, False))
        if len(results) < 2:
            raise checks.InputError(f"a time course needs two frames, and {results.path} has one")
        frames = RecordedFrames(results, range(len(results)))
        most = most if by is None else min(most, len(STYLES))
        places, more = choose_colonies(frames.shown(False), results.colony_id, colonies, most)
        wanted = quantities if by is None else (*quantities, by)
        each = known_quantities(results, *wanted)
        found = [_seen(cells, known, places, by, quantities) for cells, known in each]
        lines = _lines(places, sorted({kind for one in found for _, kind in one}), by, frames)
        none = np.full((1 + len(quantities), 3), np.nan)
        seen = np.stack([[one.get((x.place, x.kind), none) for x in lines] for one in found])
        figure = new_figure(WIDE, HIGH * (1 + len(quantities)) + 0.3, dpi)
        axes = list(figure.subplots(1 + len(quantities), 1, sharex=True, squeeze=False)[:, 0])
        seen[:, :, 0][seen[:, :, 0] == 0] = np.nan
        each_label = Counter(x.label for x in lines)
        for k, line in enumerate(lines):
            band, several = len(lines) <= FEW, each_label[line.label] > 1
            _draw(axes, results.times, seen[:, k], line, band and not several, several)
            _draw_none(axes[0], results.times, seen[:, k, 0, 0], line, several)
        for label in (n for n, count in each_label.items() if count > 1):
            same = [k for k, x in enumerate(lines) if x.label == label]
            first = replace(lines[same[0]], label=f"{label}, mean of {len(same)}")
            _draw(axes, results.times, _mean(seen[:, same]), first)
        _finish(axes[0], "cells", _scale_of_counts(seen[:, :, 0, 0]))
        for row, name in enumerate(quantities):
            unit = unit_at_cells(results, name)
            some = bool((seen[:, :, 1 + row] > 0).any())  # or there is no logarithm
            scale = "log" if log and some else "linear"
            _finish(axes[1 + row], f"mean of {name}" + f" ({unit})" * bool(unit), scale)
        axes[-1].set_xlabel("time (h)")
        ends = results.times[[0, -1]]  # of the run, also where its last cell died before
        axes[-1].set_xlim(*(ends + 0.05 * np.diff(ends) * [-1, 1]))
        if len(results.colony_id) > 1 or by is not None:
            _legend(axes[0])
        figure.suptitle(f"{frames.title}{more}", fontsize=9, parse_math=False)
        return Picture(figure, out)


@dataclass(frozen=True)
class CourseLine:
    """The cells of a colony at a place of the batch, or those of one kind, and how to draw them."""

    place: int
    kind: int
    label: str
    colour: Any
    style: str


def _draw(
    axes: Sequence[Axes], times: np.ndarray, seen: np.ndarray, line: CourseLine,
    band: bool = False, thin: bool = False,
) -> None:  # fmt: skip
    """Draw one line in each panel, and below the first the band of the cells. seen: of each frame,
    (frames, panels, 3): the value, and the ends of the band. thin: one of several replicates."""
    width: dict[str, Any] = {"lw": 0.5, "alpha": 0.7} if thin else {"lw": 1.2}
    label = None if thin else line.label
    for row, ax in enumerate(axes):
        value, low, high = seen[:, row].T
        ax.plot(times, value, color=line.colour, ls=line.style, label=label, **width)
        if band and row:
            ax.fill_between(times, low, high, color=line.colour, alpha=0.2, lw=0)


def _draw_none(
    ax: Axes, times: np.ndarray, counts: np.ndarray, line: CourseLine, thin: bool
) -> None:
    """Mark where the cells of a line die out, and draw that there are 0 from then on. counts: of
    each frame; NaN without cells."""
    gone = _gone(counts)
    change = np.diff(gone.astype(int), prepend=0, append=0)
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    zero, lw = np.zeros(len(begin)), 0.5 if thin else 1.2
    ax.hlines(zero, times[begin], times[end], color=line.colour, ls=line.style, lw=lw)
    ax.scatter(times[begin], zero, s=12 if thin else 30, color=line.colour, marker="v", zorder=3)


def _gone(counts: np.ndarray) -> np.ndarray:
    """(frames, …) where no cells are left of those that were there before."""
    none = np.isnan(counts)
    return none & np.logical_or.accumulate(~none)


def _scale_of_counts(counts: np.ndarray) -> str:
    """Of the axis of numbers of cells, (frames, lines): logarithmic where they grow more than
    tenfold, and linear from 0 to 1 below that, where cells die out."""
    alive = counts[counts > 0]
    if alive.max(initial=0.0) <= TENFOLD * max(1, alive.min(initial=np.inf)):
        return "linear"
    return "symlog" if _gone(counts).any() else "log"


def _mean(seen: np.ndarray) -> np.ndarray:
    """The mean of colonies, (frames, colonies, panels, 3), that have cells; NaN where none has."""
    some = ~np.isnan(seen)
    total = np.where(some, seen, 0.0).sum(1)
    return np.divide(total, some.sum(1), out=np.full_like(total, np.nan), where=some.any(1))


def _lines(
    places: Sequence[int], kinds: Sequence[int], by: str | None, frames: RecordedFrames
) -> list[CourseLine]:
    """One for each colony, or for each kind of each. Without kinds, replicates have the label and
    the colour in common."""
    named = {p: frames[0].name(p) for p in places}
    labels = list(dict.fromkeys(named.values()))
    if by is None:
        colours = dict(zip(labels, _colours(len(labels)), strict=True))
        return [CourseLine(p, ALL, name, colours[name], "-") for p, name in named.items()]
    if len(labels) < len(named):
        ids = frames.results.colony_id
        named = {p: f"{name}, colony {ids[p]}" for p, name in named.items()}
    name = named.__getitem__
    if len(places) > len(STYLES):
        rule = f"up to {len(STYLES)} colonies where cells are told apart by {by!r}"
        raise checks.input_error("colonies", [name(p) for p in places], rule)
    several, own = len(frames[0].counts) > 1, frames[0].type_names if by == TYPES else ()
    kind_name = {k: own[k] if 0 <= k < len(own) else f"{by} {k}" for k in kinds}
    return [
        CourseLine(p, kind, f"{name(p)}, " * several + kind_name[kind], c, style)
        for p, style in zip(places, STYLES, strict=False)
        for kind, c in zip(kinds, _colours_of(kinds, by), strict=True)
    ]


def _seen(
    cells: Columns, known: Columns, places: Sequence[int], by: str | None, names: Sequence[str]
) -> dict[tuple[int, int], np.ndarray]:
    """Of the cells of each place and kind their number, three times, and of each quantity the mean,
    and the ends of the band, (1 + quantities, 3); NaN without cells."""
    kind = np.full(len(cells["uid"]), ALL) if by is None else known[by]
    if kind.dtype.kind not in "iub":
        raise checks.input_error("by", by, "a field of whole numbers, such as 'cell_type'")
    out = {}
    for one in [ALL] if by is None else np.unique(kind).tolist():
        for place in places:
            mine = (cells["colony"] == place) & (kind == one)
            found = np.full((1 + len(names), 3), np.nan)
            found[0] = mine.sum()
            for row, name in enumerate(names):
                values = known[name][mine].astype(float)
                if len(values):
                    found[1 + row] = values.mean(), *np.percentile(values, BAND)
            out[place, one] = found
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
    made = ax.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for text in made.get_texts():
        text.set_parse_math(False)  # names may hold a $


def _finish(ax: Axes, label: str, scale: str) -> None:
    """scale: "linear", "log", or "symlog", which has 0, too."""
    ax.set_ylabel(label, parse_math=False)
    more = {"linthresh": 1.0, "linscale": 0.5, "subs": range(2, 10)} if scale == "symlog" else {}
    ax.set_yscale(scale, **more)
    ax.grid(False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)

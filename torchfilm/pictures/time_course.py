"""A time course: how many cells colonies have, and what they contain, in the course of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.colours import KINDS
from torchfilm.pictures.figures import check_not_results, choose_colonies, opened
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.page import checked_dpi
from torchfilm.pictures.picture import Picture, new_figure
from torchfilm.pictures.place_and_time import known_quantities, unit_at_cells
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE, HIGH = 5.0, 2.2  # inches, of a panel
FEW = 4  # colonies up to which a band shows the spread between cells
BAND = (10.0, 90.0)  # percentiles
TENFOLD = 10.0  # numbers of cells of such a range are drawn by their logarithms


@checks.known_keywords
def time_course(
    what: str | Path | Results,
    *quantities: str,
    colonies: Sequence[int] | None = None,
    most: int = 8,
    out: str | Path | None = None,
    dpi: float = 160,
) -> Picture:
    """Draw the number of cells of each colony against time, and below it the mean of each quantity
    over its cells; of up to four colonies also the band from 10 to 90 % of the cells.

    what: a results file, or its path. quantities: fields of the cells, or signals at them as
    "out.NAME". colonies: their ids; default the first `most` that had cells. out: save the picture
    there. Raises InputError for a quantity that is not recorded, and for a file of one frame."""
    with opened(what) as results:
        check_not_results(results.path, out)
        checked_dpi(dpi)
        if len(results) < 2:
            raise checks.InputError(f"a time course needs two frames, and {results.path} has one")
        frames = RecordedFrames(results, range(len(results)))
        places, more = choose_colonies(frames.shown(False), results.colony_id, colonies, most)
        seen = [_seen(results, k, places, quantities) for k in range(len(results))]
        figure = new_figure(WIDE, HIGH * (1 + len(quantities)) + 0.3, dpi)
        axes = figure.subplots(1 + len(quantities), 1, sharex=True, squeeze=False)[:, 0]
        counts, first = results.counts[:, places], frames[0]
        labels = [first.name(place) for place in places]
        colours = _colours(len(places))
        for k, (label, colour) in enumerate(zip(labels, colours, strict=True)):
            alive = np.where(counts[:, k] > 0, counts[:, k], np.nan)
            axes[0].plot(results.times, alive, color=colour, lw=1.2, label=label)
        _finish(axes[0], "cells", log=counts.max() > TENFOLD * max(1, counts[counts > 0].min()))
        for row, name in enumerate(quantities):
            of_name = np.stack([found[row] for found in seen])  # (frames, colonies, 3)
            for k, colour in enumerate(colours):
                mean, low, high = of_name[:, k].T
                axes[1 + row].plot(results.times, mean, color=colour, lw=1.2)
                if len(places) <= FEW:
                    axes[1 + row].fill_between(results.times, low, high, color=colour, alpha=0.2,
                                               lw=0)  # fmt: skip
            unit = unit_at_cells(results, name)
            _finish(axes[1 + row], f"mean of {name}" + f" ({unit})" * bool(unit))
        axes[-1].set_xlabel("time (h)")
        if len(results.colony_id) > 1:
            axes[0].legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        figure.suptitle(f"{frames.title}{more}", fontsize=9, parse_math=False)
        return Picture(figure, out)


def _seen(
    results: Results, frame: int, places: Sequence[int], names: Sequence[str]
) -> list[np.ndarray]:
    """Of each quantity the mean, and the ends of the band, in each of these colonies, (C, 3); NaN
    without cells."""
    cells, known = known_quantities(results, frame, *names)
    out = []
    for name in names:
        found = np.full((len(places), 3), np.nan)
        for k, place in enumerate(places):
            mine = known[name][cells["colony"] == place].astype(float)
            if len(mine):
                found[k] = mine.mean(), *np.percentile(mine, BAND)
        out.append(found)
    return out


def _colours(count: int) -> list[Any]:
    """A colour for each colony: those of kinds, or where there are more a ramp."""
    from matplotlib import colormaps

    if count <= len(KINDS):
        return list(KINDS[:count])
    return [colormaps["viridis"](k / (count - 1)) for k in range(count)]


def _finish(ax: Axes, label: str, log: bool = False) -> None:
    ax.set_ylabel(label, parse_math=False)
    if log:
        ax.set_yscale("log")
    ax.grid(False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)

"""A kymograph: what cells contain along a coordinate, in the course of a run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfilm.io.blocks import blocks
from torchfilm.io.identity import declared_fields
from torchfilm.io.results import Results
from torchfilm.io.table import volumes
from torchfilm.pictures.colours import MEAN, PlotStyle, checked_range, scale_of
from torchfilm.pictures.figures import check_not_results, opened
from torchfilm.pictures.frames import AGES, VOLUME, of_lineage, unit_of
from torchfilm.pictures.page import checked_dpi
from torchfilm.pictures.picture import Picture, new_figure
from torchfilm.pictures.scales import Scale, ValueRange
from torchfilm.spatial import binned_mean, checked_edges
from torchfilm.state import OUTSIDE
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups

Columns = Mapping[str, np.ndarray]

BIN = 1.0  # µm: the default width of a bin, that of a cell
ALONG = ("x", "y", "z", "radius")


@checks.known_keywords
def kymograph(
    what: str | Path | Results,
    quantity: str,
    *,
    along: str = "x",
    edges: Sequence[float] | None = None,
    colony: int | None = None,
    limits: tuple[float, float] | None = None,
    log: bool = False,
    out: str | Path | None = None,
    dpi: float = 160,
) -> Picture:
    """Draw how a quantity of cells changes along a coordinate in the course of a run: place from
    left to right, time from top to bottom. A field is the mean over the cells in a bin at a
    recorded frame, and empty without cells.

    what: a results file, or its path. quantity: a field of the cells, "volume", "age" or
    "born", or a signal at them as "out.NAME". along: "x", "y", "z", or "radius" from the colony's
    centre. edges: of the bins, µm, ascending; default bins of 1 µm where there are cells. colony:
    its id; default the first. limits: the range of colours; default that of the means, of a
    concentration 1 % or wider. log: logarithmic colours, as for `show`. out: save the picture
    there."""
    with opened(what) as results:
        check_not_results(results.path, out)
        checks.choice("along", along, ALONG[: int(results.attributes["dim"])] + ALONG[3:])
        checked_dpi(dpi)
        style = _style(limits, log)
        if len(results) < 2:
            raise checks.InputError(f"a kymograph needs two frames, and {results.path} has one")
        ids = results.colony_id.tolist()
        chosen = ids[0] if colony is None else checks.integer("colony", colony, least=0)
        if chosen not in ids:
            raise checks.input_error("colony", colony, f"one of {', '.join(map(str, ids))}")
        each, own = known_quantities(results, quantity), ids.index(chosen)
        seen = [_seen(cells, known, own, quantity, along) for cells, known in each]
        places = np.concatenate([place for place, _ in seen])
        if not len(places):
            raise checks.InputError(f"colony {chosen} of {results.path} has no cell in any frame")
        bins, values = _bins(places, edges), np.concatenate([value for _, value in seen])
        if not ((places >= bins[0]) & (places <= bins[-1])).any():
            span = f"a range with cells, which are at {places.min():.3g} to {places.max():.3g} µm"
            raise checks.input_error("edges", (float(bins[0]), float(bins[-1])), span)
        frame = np.repeat(np.arange(len(seen)), [len(place) for place, _ in seen])
        groups = Groups(torch.from_numpy(frame), len(seen), ordered=True)
        value, place = torch.from_numpy(values), torch.from_numpy(places)
        grid = binned_mean(groups, value, place, bins.tolist()).numpy()
        unit, drawn = unit_at_cells(results, quantity), ValueRange()
        drawn.add(grid)
        scale = scale_of(MEAN, drawn, style, {MEAN: unit})
        figure = new_figure(5.0, 4.0, dpi)
        ax = figure.add_subplot()
        mesh = _draw(ax, bins, _between(results.times), grid, scale)
        ax.grid(False)
        ax.invert_yaxis()
        where = "distance from the centre" if along == "radius" else along
        ax.set(xlabel=f"{where} (µm)", ylabel="time (h)")
        title = f"{quantity}, colony {chosen}" if len(ids) > 1 else quantity
        ax.set_title(title, parse_math=False)
        bar = figure.colorbar(mesh, extend=scale.beyond)
        bar.set_label(f"mean of {quantity}" + f" ({unit})" * bool(unit), parse_math=False)
        return Picture(figure, out)


def _style(limits: tuple[float, float] | None, log: bool) -> PlotStyle:
    """How means are coloured, whatever they are of."""
    checks.choice("log", log, (True, False))
    given = None if limits is None else checked_range("limits", limits)
    if log and given is not None and given[0] <= 0:
        rule = "a range above 0, where colours are logarithmic"
        raise checks.input_error("limits", limits, rule)
    return PlotStyle(colour=MEAN, limits=None if given is None else {MEAN: given}, log=log)


def _draw(ax: Any, bins: np.ndarray, times: np.ndarray, grid: np.ndarray, scale: Scale) -> Any:
    """Draw means (frames, bins) between these edges, as in other pictures whatever the style. What
    is below a logarithmic scale has its lowest colour; NaN has none."""
    from matplotlib.colors import LogNorm, Normalize

    norm = LogNorm(*scale.limits) if scale.log else Normalize(*scale.limits)
    filled = np.maximum(grid, scale.limits[0]) if scale.log else grid
    return ax.pcolormesh(bins, times, filled, norm=norm, cmap="viridis")


def _between(times: np.ndarray) -> np.ndarray:
    """Where a frame begins and ends in the picture, (F + 1,) h: half-way to its neighbours."""
    return np.concatenate([times[:1], 0.5 * (times[1:] + times[:-1]), times[-1:]])


def _seen(
    cells: Columns, known: Columns, place: int, quantity: str, along: str
) -> tuple[np.ndarray, np.ndarray]:
    """Where the cells of a colony are, and what they have of the quantity, at a frame, (N,)."""
    mine = cells["colony"] == place
    position, value = cells["position"][mine], known[quantity][mine].astype(float)
    if along != "radius":
        return position[:, "xyz".index(along)], value
    volume = volumes(*(cells[n][mine].astype(float) for n in ("length", "radius")))[:, None]
    centre = (volume * position).sum(0) / volume.sum() if len(position) else 0.0
    return np.hypot(*(position - centre)[:, :2].T), value


def known_quantities(
    results: Results, *wanted: str, by: str | None = None
) -> Iterator[tuple[Columns, Columns]]:
    """The cells of each frame, and what it tells of each cell, (N,) by name, signals at them under
    "out.NAME"; volumes, ages and hours of birth where they are wanted. by: a field that they have,
    too. Raises InputError for a wanted name that the file does not tell."""
    hidden, ids, tree = results.internal_fields, results.colony_id, None
    for block in blocks(results, range(len(results))):
        cells, signals = block.cells(), block.signals()
        known = {n: x for n, x in cells.items() if x.ndim == 1 and n not in hidden}
        known |= {OUTSIDE + n: x for n, x in signals.items()}
        if VOLUME in wanted and VOLUME not in known:
            known[VOLUME] = volumes(cells["length"], cells["radius"])
        if asked := [n for n in AGES if n in wanted and n not in known]:
            times = results.times[block.frames][block.which]
            known |= of_lineage(tree or (tree := results.lineage()), ids, cells, times, asked)
        _check_known(known, signals, wanted, by)
        ends = np.searchsorted(block.which, np.arange(len(block.frames) + 1))
        for first, end in itertools.pairwise(ends):
            rows = slice(first, end)
            yield {n: x[rows] for n, x in cells.items()}, {n: x[rows] for n, x in known.items()}


def _check_known(known: Columns, signals: Columns, wanted: Sequence[str], by: str | None) -> None:
    """Raise InputError for a wanted name that no cell has. signals: at the cells, by name."""
    names = [n for n in known if n not in ("uid", "parent", "colony")]
    names += [n for n in (VOLUME, *AGES) if n not in known]
    for quantity in wanted:
        if not isinstance(quantity, str):
            hint = 'Several follow one another: time_course(results, "gfp", "rfp").'
            raise checks.input_error("quantity", quantity, "a name, as text", hint)
        if quantity not in known:
            hint = checks.suggestion(quantity, names)
            hint = (
                "A time course draws the number of cells in any case." * (quantity == "cells")
                or hint
            )
            if quantity in signals:
                hint = f"What is outside of cells is {OUTSIDE + quantity!r}."
            raise checks.input_error("quantity", quantity, f"one of {', '.join(names)}", hint)
    if by is not None and by not in known:
        hint = checks.suggestion(by, known)
        hint = hint or "For a parameter that differs between colonies: conditions=…"
        raise checks.input_error("by", by, f"one of {', '.join(known)}", hint)


def _bins(places: np.ndarray, edges: Sequence[float] | None) -> np.ndarray:
    """The edges of the bins, (K + 1,) µm."""
    if edges is None:
        low, high = np.floor(places.min() / BIN), np.floor(places.max() / BIN) + 1
        return BIN * np.arange(low, high + 1)
    return np.array(checked_edges("kymograph", edges))


def unit_at_cells(results: Results, quantity: str) -> str:
    """The unit of a quantity of the cells, or of a signal at them; "" without."""
    declared = declared_fields(results.attributes)
    return unit_of(quantity, {name: str(entry[1]) for name, entry in declared.items()})

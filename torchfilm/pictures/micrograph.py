"""Cells drawn over the image that they were read from, for checking."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.initial_cells import Cells
from torchfilm.micrographs.mask_files import read_image
from torchfilm.micrographs.record import Micrograph
from torchfilm.pictures.draw import scale_bar
from torchfilm.pictures.page import checked_dpi, figure_class, set_page_title
from torchfilm.pictures.picture import Picture
from torchfilm.pictures.shapes import outlines
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH, HEIGHT, NARROWEST = 7.2, 8.4, 3.2  # inches
BELOW, BARE = 0.25, 0.65  # inches, for the scale bar; for it and the title, of two lines at most
PLAIN, OVERLAP = "#19d3f3", "#ff3b30"  # outlines
SHADES = (0.5, 99.5)  # percentiles of the image that are drawn black and white
SHALLOW = 0.1  # of a width; masks that touch give capsules that overlap by some less than that
NAMED = 40  # how many overlapping cells are named


@checks.known_keywords
def overlay(
    cells: Cells,
    over: Any,
    out: str | Path | None = None,
    *,
    frame: int | None = None,
    depth: float | None = None,
    labels: bool = False,
    dpi: float = 200,
) -> Picture:
    """Draw the outlines of cells over the image that they were read from.

    cells: of `Cells.from_masks`, or of `Cells.from_table` with a pixel size. over: the micrograph
    or the label image, an array (rows, columns) or (rows, columns, 3), or a .tif or .png file. out:
    the picture's path (.png, .pdf, .svg), as for `show`. frame: of a stack. Cells that overlap by
    more than `depth` µm, by default a tenth of their median width, are red and carry their labels.
    labels: name all cells. Raises InputError if the cells are not from an image, or lie outside of
    this one.
    """
    figure_class()
    if not isinstance(cells, Cells):
        raise checks.input_error("overlay(cells)", type(cells).__name__, "Cells")
    if cells.dim != 2:
        raise checks.input_error("overlay(cells)", "cells in space", "cells in the plane")
    if cells.micrograph is None:
        raise checks.InputError(
            "these cells have no pixel size, so their places in an image are unknown. Read them by"
            " Cells.from_masks, or by Cells.from_table with pixel_size=…."
        )
    if depth is None:
        depth = SHALLOW * 2.0 * float(np.median(cells.radius)) if cells.count else 0.0
    checks.number("depth", depth, least=0.0, hint="µm.")
    checked_dpi(dpi)
    image, source, _ = read_image(over, frame, "micrograph")
    seen = cells.micrograph
    _check_within(cells, seen, image, source)
    rows, columns = image.shape[:2]
    inches = max(NARROWEST, min(WIDTH, (HEIGHT - BARE) * columns / rows))
    tall = inches * rows / columns
    figure = figure_class()(figsize=(inches, tall + BARE), dpi=dpi)
    ax = figure.add_axes((0.0, BELOW / (tall + BARE), 1.0, tall / (tall + BARE)))
    found = cells.overlaps(depth)
    touching = list(dict.fromkeys(k for i, j, _ in found for k in (i, j)))  # the deepest first
    _draw(ax, cells, seen, image, touching, range(cells.count) if labels else touching[:NAMED])
    scale_bar(ax)
    words = f"none overlap by over {depth:.2g} µm"
    if found:
        pairs = "1 pair overlaps" if len(found) == 1 else f"{len(found)} pairs overlap"
        words = f"{pairs} by over {depth:.2g} µm (red), by up to {found[0][2]:.2g} µm"
    set_page_title(figure, f"{cells.count} cells over {Path(source).name}; {words}")
    return Picture(figure, out)


def _draw(
    ax: Axes, cells: Cells, seen: Micrograph, image: np.ndarray, touching: Any, named: Any
) -> None:
    """Draw the image and the outlines, in µm from the centre of the image's first pixel, rows
    down."""
    from matplotlib.collections import PolyCollection

    rows, columns = image.shape[:2]
    size = seen.pixel_size
    edges = (-0.5 * size, (columns - 0.5) * size, (rows - 0.5) * size, -0.5 * size)
    ax.imshow(_grey(image), cmap="gray", vmin=0.0, vmax=1.0, extent=edges, interpolation="nearest")
    place = size * seen.pixels(cells.position, rows)
    shapes = outlines(place, cells.axis * (1.0, -1.0), cells.length, cells.radius, points=28)
    colours = np.full(cells.count, PLAIN, dtype=object)
    colours[touching] = OVERLAP
    pixel = 72 * ax.get_window_extent().width / ax.figure.dpi / columns  # points
    ax.add_collection(
        PolyCollection(
            list(shapes),
            facecolors="none",
            edgecolors=list(colours),
            linewidths=min(1.0, max(0.5, 0.5 * pixel)),
        )
    )
    for k in named:
        ax.text(
            place[k, 0],
            place[k, 1],
            str(k) if seen.label is None else str(seen.label[k]),
            color=colours[k],
            fontsize=5,
            ha="center",
            va="center",
            clip_on=True,
        )
    ax.set(xlim=edges[:2], ylim=edges[2:], xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set(linewidth=0.4, edgecolor="#808080")


def _grey(image: np.ndarray) -> np.ndarray:
    """An image from 0, black, to 1, white; its colours without their opacity."""
    values = image[..., :3].astype(np.float64) if image.ndim == 3 else image.astype(np.float64)
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise checks.InputError("the micrograph has no finite number.")
    low, high = np.percentile(finite, SHADES)
    if high <= low:  # few pixels differ, as in a label image of few cells
        low, high = finite.min(), finite.max()
    return np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)


def _check_within(cells: Cells, seen: Micrograph, image: np.ndarray, source: str) -> None:
    """Raise InputError for another image, as far as that can be seen."""
    rows, columns = image.shape[:2]
    if seen.image is not None and seen.image != (rows, columns):
        raise checks.InputError(
            f"{source} has {rows} × {columns} pixels, and the cells are from an image of"
            f" {seen.image[0]} × {seen.image[1]}. Give the micrograph of these masks."
        )
    place = seen.pixels(cells.position, rows)
    outside = np.flatnonzero(
        (place < -0.5).any(1) | (place[:, 0] > columns - 0.5) | (place[:, 1] > rows - 0.5)
    )
    if outside.size:
        at = int(outside[0])
        raise checks.InputError(
            f"{outside.size} of {cells.count} cells lie outside of {source}, which has {rows} ×"
            f" {columns} pixels: {seen.name(at)} at row {place[at, 1]:.0f}, column"
            f" {place[at, 0]:.0f}. Is it another image, or does y go"
            f" {'up' if seen.y_down else 'down'} in the table?"
        )

"""Pictures: cells drawn as the capsules that they are. Needs matplotlib (the `app` extra)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.results import Results
from torchfilm.state import PER_CELL, State
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VIEWS = {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
CAP_POINTS = 7  # points on each half circle of an outline


def _matplotlib() -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise checks.InputError('Pictures need matplotlib: pip install "torchfilm[app]".') from error
    return Figure


def frame_of(state: State) -> dict[str, np.ndarray]:
    """The state's cells as arrays by name, as `Results.frame` gives them."""
    columns = {n: getattr(state, n) for n in PER_CELL} | dict(state.fields)
    return {n: v.detach().cpu().numpy() for n, v in columns.items() if v.shape[:1] == (state.cells,)}


def outlines(position: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Outline polygons (N, 2·CAP_POINTS, 2) of capsules seen along the line of sight: position, axis (N, 2) of the projection, µm.

    The projection of a capsule is a capsule whose centreline is shortened, so an upright cell is a circle.
    """
    size = np.hypot(axis[:, 0], axis[:, 1])
    way = np.where(size[:, None] > 1e-9, axis / np.maximum(size, 1e-9)[:, None], (1.0, 0.0))
    side = np.stack([-way[:, 1], way[:, 0]], 1)
    half = 0.5 * length * size
    turn = np.linspace(-math.pi / 2, math.pi / 2, CAP_POINTS)
    parts = []
    for sign in (1.0, -1.0):
        end = position + sign * half[:, None] * way
        around = sign * (np.cos(turn)[None, :, None] * way[:, None] + np.sin(turn)[None, :, None] * side[:, None])
        parts.append(end[:, None] + radius[:, None, None] * around)
    return np.concatenate(parts, 1)


def _wheel() -> Any:
    """A cyclic colour map of even, muted colours: one that passes through white or black would hide cells of one direction."""
    from matplotlib.colors import ListedColormap, hsv_to_rgb

    hue = np.linspace(0, 1, 256, endpoint=False)
    return ListedColormap(hsv_to_rgb(np.stack([hue, np.full(256, 0.55), np.full(256, 0.85)], 1)))


def draw_cells(ax: Axes, cells: dict[str, np.ndarray], *, colour: str = "angle", view: str = "xy", limits: tuple[float, float] | None = None) -> Any:
    """Draw one colony's cells on matplotlib axes, in µm.

    colour: "angle" of the axis in the view (a cyclic map), or any quantity per cell by name. view: "xy", "xz" or "yz".
    limits: fixed colour range; by default that of the data.
    """
    from matplotlib.collections import PolyCollection

    u, v = VIEWS[view]
    order = np.argsort(cells["position"][:, 3 - u - v]) if cells["position"].shape[1] == 3 else np.arange(len(cells["uid"]))
    axis = cells["axis"][order][:, [u, v]]
    if colour == "angle":
        values, cmap, limits = np.mod(np.arctan2(axis[:, 1], axis[:, 0]), math.pi), _wheel(), (0.0, math.pi)
    elif colour in cells and cells[colour].ndim == 1:
        values, cmap = cells[colour][order].astype(float), "viridis"
    else:
        raise checks.refuse("colour", colour, "'angle' or one of " + ", ".join(n for n in cells if cells[n].ndim == 1))
    shapes = outlines(cells["position"][order][:, [u, v]], axis, cells["length"][order], cells["radius"][order])
    collection = PolyCollection(list(shapes), array=values, cmap=cmap, edgecolors="black", linewidths=0.0)
    collection.set_clim(*(limits if limits is not None else (float(values.min(initial=0)), float(values.max(initial=1)))))
    ax.add_collection(collection)
    low, high = shapes.reshape(-1, 2).min(0), shapes.reshape(-1, 2).max(0)
    pad = 0.04 * float((high - low).max())
    ax.set(xlim=(low[0] - pad, high[0] + pad), ylim=(low[1] - pad, high[1] + pad), aspect="equal", xticks=[], yticks=[])
    width_px = ax.get_window_extent().width
    # an outline helps where a cell is many pixels wide and drowns the colour where it is few
    collection.set_linewidth(min(0.4, 0.012 * width_px / max(1.0, float((high - low).max()))))
    return collection


def scale_bar(ax: Axes) -> None:
    """A bar of a round length, in µm, at the lower left."""
    low, high = ax.get_xlim()
    bottom, top = ax.get_ylim()
    rough = 0.3 * (high - low)
    size = max(s for e in (-1, 0, 1, 2, 3, 4) for s in (10.0**e, 2 * 10.0**e, 5 * 10.0**e) if s <= rough)
    x, y = low + 0.05 * (high - low), bottom + 0.05 * (top - bottom)
    ax.plot([x, x + size], [y, y], color="black", linewidth=2.5, solid_capstyle="butt")
    ax.text(x + size / 2, y + 0.012 * (top - bottom), f"{size:g} µm", ha="center", va="bottom", fontsize=7)


def sheet(
    cells: dict[str, np.ndarray],
    path: str | Path,
    *,
    colour: str = "angle",
    view: str = "xy",
    title: str = "",
    most: int = 36,
    ids: np.ndarray | None = None,
) -> Path:
    """A sheet of the colonies of one frame (see `Results.frame`), one panel each, all to one scale; written to `path`.

    More than `most` colonies: the first ones, and the title says so.
    """
    figure = sheet_figure(cells, colour=colour, view=view, title=title, most=most, ids=ids)
    try:
        figure.savefig(path, dpi=160)
    except (OSError, ValueError) as error:  # no such folder; no such kind of picture
        raise checks.InputError(
            f"{path} cannot be written as a picture: {error}. Choose a folder that exists and a name that ends in .png, .pdf or .svg."
        ) from error
    return Path(path)


def sheet_figure(cells: dict[str, np.ndarray], *, colour: str, view: str, title: str, most: int, ids: np.ndarray | None) -> Figure:
    figure_class = _matplotlib()
    checks.choice("view", view, tuple(VIEWS))
    present = np.unique(cells["colony"])
    total, shown = len(present), present[:most]
    if total == 0:
        raise checks.InputError("there is no cell to draw in this frame.")
    u, v = VIEWS[view]
    if max(u, v) >= cells["position"].shape[1]:
        raise checks.refuse("view", view, '"xy" for 2-D cells')
    spans = [np.ptp(cells["position"][cells["colony"] == c][:, [u, v]], 0) + 4.0 for c in shown]
    width, height = np.max(spans, 0)
    # as many columns as make the whole sheet about square
    columns = min(len(shown), max(1, round(math.sqrt(len(shown) * height / width))))
    rows = math.ceil(len(shown) / columns)
    panel = min(8.0 / columns, 8.0 * width / (rows * height)) if len(shown) > 1 else min(8.0, 8.0 * width / height)
    figure = figure_class(figsize=(columns * panel + (0.9 if colour != "angle" else 0.1), rows * (panel * height / width + 0.2) + 0.5), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).reshape(-1)
    limits = None if colour == "angle" or colour not in cells else (float(cells[colour].min()), float(cells[colour].max()))
    last = None
    for ax, colony in zip(axes, shown, strict=False):
        mine = {n: v[cells["colony"] == colony] for n, v in cells.items()}
        last = draw_cells(ax, mine, colour=colour, view=view, limits=limits)
        ax.set_title(f"colony {colony if ids is None else ids[colony]}: {len(mine['uid'])} cells", fontsize=7, pad=2)
    for ax in axes[: len(shown)]:  # one scale for all
        x, y = np.mean(ax.get_xlim()), np.mean(ax.get_ylim())
        ax.set(xlim=(x - width / 2, x + width / 2), ylim=(y - height / 2, y + height / 2))
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    scale_bar(axes[0])
    if colour != "angle":
        figure.colorbar(last, ax=list(axes), shrink=0.6, label=colour)
    more = f" (first {len(shown)} of {total} colonies)" if total > len(shown) else ""
    figure.suptitle(title + more, fontsize=9)
    return figure


def show(path: str | Path, *, frame: int = -1, colour: str = "angle", view: str = "xy", out: str | Path | None = None) -> Path:
    """Draw one frame of a results file as a sheet; by default to the file's own name with .png. Returns the picture's path."""
    with Results(path) as results:
        cells = results.frame(frame)
        k = results._index(frame)
        title = f"{results.attributes['scene'].splitlines()[0].split(':')[0]}, t = {results.times[k]:g} h, colour: {colour}"
        target = Path(out) if out is not None else Path(path).with_suffix(".png")
        return sheet(cells, target, colour=colour, view=view, title=title, ids=results.colony_id)

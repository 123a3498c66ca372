"""Drawing on matplotlib axes: cells, a signal behind them, walls, a scale bar, legends; in µm."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.pictures.colours import (
    ANGLE,
    CELLS,
    MEAN,
    PlotStyle,
    is_rgb,
    paint_cells,
    range_of,
    scale_of,
    values_of,
)
from torchfilm.pictures.scales import Scale, ValueRange
from torchfilm.pictures.shapes import CAP_POINTS, VIEWS, Window, along, box, outlines, section, span
from torchfilm.state import OUTSIDE
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WALL = "#a0522d"  # not grey, so that it differs from a signal
FAR = 1e6  # µm: the end of a wall that has none
# the colour outside the box of a signal: not grey, so that nobody reads it as a concentration
OUTSIDE_BOX = "#efe4d2"
OBSTACLE = "#d2b48c"
# How far lines at the edges of the axes are seen beyond them, in sizes of the axes.
BEYOND = 0.006
SMALL, TINY = 7.0, 6.0  # points
ROUND = 0.05  # inches of a radius above which an outline of few points has visible corners


def draw_cells(
    ax: Axes,
    cells: Mapping[str, np.ndarray],
    *,
    colour: str | None = None,
    channels: Mapping[str, str] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    log: bool | str | Sequence[str] = False,
    view: str = "xy",
    window: Window | None = None,
) -> list[Scale]:
    """Draw cells, as `Results.frame` gives them; returns their scales, for `colour_bar`.

    colour, channels, limits, log, view: as for `show`; the default range is that of these cells.
    window: the range of the axes; default all cells.
    """
    _check_axes(ax)
    if not isinstance(cells, Mapping):
        hint = "Such as those of one colony: tf.Results(path).frame(-1), or Frame.colony(0)."
        raise checks.input_error("cells", type(cells).__name__, "columns of cells by name", hint)
    colour = ANGLE if colour is None and channels is None else colour
    style = PlotStyle(colour=colour, channels=channels, limits=limits, view=view, log=log)
    scales = []
    for name in style.quantities:
        if channels is None and is_rgb(cells, name):
            if style.is_log(name):
                raise checks.input_error("log", log, f"left out: {name} is a colour itself")
            continue
        if (name in cells and cells[name].ndim != 1) or name not in (*cells, "angle"):
            raise checks.input_error(
                "colour",
                name,
                "'angle' or one of " + ", ".join(n for n in cells if cells[n].ndim == 1),
            )
        seen = range_of(name)
        seen.add(cells[name] if name in cells else values_of(cells, name, view))
        scales.append(scale_of(name, seen, style, {}))
    covered = span(cells, view)
    if window is None and covered is not None:
        pad = 0.04 * float((covered[1] - covered[0]).max())
        window = (
            covered[0, 0] - pad,
            covered[1, 0] + pad,
            covered[0, 1] - pad,
            covered[1, 1] + pad,
        )
    if window is not None:
        left, right, bottom, top = checks.vector("window", window, 4)
        set_window(ax, (left, right, bottom, top))
    add_cells(ax, cells, scales, style)
    return scales


def _check_axes(ax: object) -> None:
    """Raise InputError for what are no axes of matplotlib."""
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        hint = "Such as those of fig, ax = plt.subplots()."
        raise checks.input_error("ax", type(ax).__name__, "axes of matplotlib", hint)


def draw_signal(
    ax: Axes,
    values: np.ndarray,
    origin: Sequence[float] | np.ndarray,
    spacing: Sequence[float] | np.ndarray,
    *,
    name: str = "signal",
    view: str = "xy",
    section: float | str = MEAN,
    limits: tuple[float, float] | None = None,
    log: bool = False,
) -> Scale:
    """Draw a signal (nx, ny, nz) of one colony; returns its scale, for `colour_bar`.

    values, origin, spacing: as `Results.signal` and `Results.grid` give them. White is lowest and
    black highest. section: where the signal is cut, the coordinate along the line of sight, µm, or
    "mean" for its mean along it. limits: the range from white to black; default the range of the
    drawn values. log: logarithmic colours, as for `show`.
    """
    _check_axes(ax)
    if np.ndim(values) != 3:
        raise checks.input_error("values", f"of shape {np.shape(values)}", "of shape (nx, ny, nz)")
    checks.choice("log", log, (True, False))
    style = PlotStyle(
        background=name,
        view=view,
        section=section,
        limits=None if limits is None else {name: limits},
        log=log,
    )
    if section == CELLS:
        raise checks.input_error("section", section, 'a coordinate in µm, or "mean"')
    flat = cut(values, np.asarray(origin), np.asarray(spacing), style, None)
    seen = ValueRange()
    seen.add(flat)
    scale = scale_of(OUTSIDE + name, seen, style, {})
    low, high = box(np.asarray(origin), np.asarray(spacing), values.shape, view)
    set_window(ax, (low[0], high[0], low[1], high[1]))
    add_signal(ax, flat, (low[0], high[0], low[1], high[1]), scale)
    return scale


def cut(
    values: np.ndarray,
    origin: np.ndarray,
    spacing: np.ndarray,
    style: PlotStyle,
    height: float | None,
) -> np.ndarray:
    """The section or mean of a signal in the view, (nu, nv).

    height: the coordinate of the cells along the line of sight, for a section there.
    """
    at = (
        None
        if style.section == MEAN
        else height
        if style.section == CELLS
        else float(style.section)
    )
    if style.section == CELLS and at is not None:
        # cells beyond the box read the value at its face
        k = along(style.view)
        at = min(max(at, float(origin[k])), float(origin[k] + spacing[k] * values.shape[k]))
    return section(values, origin, spacing, view=style.view, at=at)


def set_window(ax: Axes, window: Window) -> None:
    """Set the range of the axes, with equal scales and no ticks."""
    left, right, bottom, top = window
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])


def add_signal(ax: Axes, flat: np.ndarray, extent: Window, scale: Scale) -> None:
    """Draw a section of a signal (nu, nv) behind the cells."""
    window = (*ax.get_xlim(), *ax.get_ylim())
    ax.set_facecolor(OUTSIDE_BOX)
    ax.imshow(
        scale.paint(flat).transpose(1, 0, 2),
        origin="lower",
        extent=extent,
        interpolation="bilinear",
        zorder=0,
    )
    set_window(ax, window)


def add_obstacles(ax: Axes, solid: np.ndarray, extent: Window) -> None:
    """Draw where there is no medium, (nu, nv) bool, with an outline as of hard walls."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba

    window = (*ax.get_xlim(), *ax.get_ylim())
    colours = np.zeros((*solid.shape, 4))
    colours[solid] = to_rgba(OBSTACLE)
    ax.imshow(colours.transpose(1, 0, 2), origin="lower", extent=extent, interpolation="nearest",
              zorder=0.3)  # fmt: skip
    left, right, bottom, top = extent
    du, dv = (right - left) / solid.shape[0], (top - bottom) / solid.shape[1]
    corner = lambda k, j: (left + k * du, bottom + j * dv)
    across = np.argwhere(solid[1:] != solid[:-1])
    along_u = np.argwhere(solid[:, 1:] != solid[:, :-1])
    lines = [(corner(k + 1, j), corner(k + 1, j + 1)) for k, j in across]
    lines += [(corner(k, j + 1), corner(k + 1, j + 1)) for k, j in along_u]
    ax.add_collection(LineCollection(lines, colors=WALL, linewidths=0.8, zorder=0.4), autolim=False)
    set_window(ax, window)


def add_cells(
    ax: Axes, cells: Mapping[str, np.ndarray], scales: Sequence[Scale], style: PlotStyle
) -> Any:
    """Draw cells into the window of the axes, the nearest to the viewer last."""
    from matplotlib.collections import PolyCollection

    u, v = VIEWS[style.view]
    if cells["position"].shape[1] == 3:
        # In "xz" the viewer looks along +y, since x, z and −y are right-handed.
        order = np.argsort(
            cells["position"][:, along(style.view)] * (-1 if style.view == "xz" else 1),
            kind="stable",
        )
        cells = {name: value[order] for name, value in cells.items()}
    left, right = ax.get_xlim()
    inch = ax.get_window_extent().width / ax.figure.dpi / abs(right - left)  # inches per µm
    largest = inch * float(cells["radius"].max(initial=0.0))
    points = CAP_POINTS if largest < ROUND else 4 * CAP_POINTS
    shapes = outlines(
        cells["position"][:, [u, v]],
        cells["axis"][:, [u, v]],
        cells["length"],
        cells["radius"],
        points=points,
    )
    # an outline helps where a cell is large on paper; where a cell is small it would hide the
    # colour
    width = min(0.4, 1.2 * inch)
    own = style.channels is None and is_rgb(cells, style.quantities[0])  # which may be black
    edge = "#808080" if own else "black" if style.channels is None else "#d0d0d0"
    made = PolyCollection(
        list(shapes),
        facecolors=paint_cells(cells, scales, style),
        edgecolors=edge,
        linewidths=width,
        zorder=1,
    )
    ax.add_collection(made, autolim=False)
    return made


def add_walls(ax: Axes, walls: Sequence[Mapping[str, Any]], colony: int, view: str) -> None:
    """Draw the walls of the colony with this id behind its cells.

    walls: as in `Results.walls`. Hard walls are lines, soft ones dashed lines. A flat wall ends
    where it is behind a hard one; one that is not perpendicular to the view is omitted.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle

    for artist in [a for a in (*ax.lines, *ax.patches) if a.get_gid() == WALL]:
        artist.remove()
    own = lambda x: x[colony] if isinstance(x, list) else x
    seen = VIEWS[view]
    style: Any = {"color": WALL, "linewidth": 0.8, "zorder": 0.5, "gid": WALL}
    dashes: Callable[[Any], Any] = lambda wall: "--" if wall["soft"] else "-"
    flat = []
    for wall in walls:
        if "radius" in wall:
            centre = tuple(own(wall["centre"][k]) for k in seen)
            round_wall = {"fill": False, "linestyle": dashes(wall), **style}
            _whole_at_edges(ax, ax.add_patch(Circle(centre, own(wall["radius"]), **round_wall)))
            continue
        normal = np.array([own(wall["normal"][k]) for k in seen])
        if np.hypot(*normal) > 1.0 - 1e-6:
            flat.append((normal, own(wall["offset"]), dashes(wall)))
    for k, (normal, offset, dash) in enumerate(flat):
        others = [(n, o) for j, (n, o, d) in enumerate(flat) if j != k and d == "-"]
        if (ends := _ends(normal, offset, others)) is not None:
            _whole_at_edges(ax, ax.add_artist(Line2D(*ends.T, linestyle=dash, **style)))


def add_faces(ax: Axes, faces: Mapping[str, tuple[float, float]], view: str) -> None:
    """Draw the faces of a periodic space as dotted lines, after the walls."""
    style: Any = {"color": WALL, "linewidth": 0.8, "linestyle": ":", "zorder": 2, "gid": WALL}
    for k, line in zip(VIEWS[view], (ax.axvline, ax.axhline), strict=True):
        for at in faces.get("xyz"[k], ()):
            _whole_at_edges(ax, line(at, **style))


def _whole_at_edges(ax: Axes, line: Any) -> None:
    """Show the whole width of a line at an edge of the axes, where a half might be no pixel."""
    from matplotlib.transforms import Bbox, TransformedBbox

    line.set_clip_path(None)
    line.set_clip_box(TransformedBbox(Bbox([[-BEYOND] * 2, [1 + BEYOND] * 2]), ax.transAxes))


def _ends(
    normal: np.ndarray, offset: float, others: Sequence[tuple[np.ndarray, float]]
) -> np.ndarray | None:
    """The ends (2, 2) of a flat wall between the others, µm; None where it is behind them. Walls
    bound x · normal >= offset."""
    foot, along_it = offset * normal, np.array([-normal[1], normal[0]])
    low, high = -FAR, FAR
    for n, o in others:
        slope, inside = float(n @ along_it), float(n @ foot) - o
        if abs(slope) < 1e-9:  # parallel
            if inside < -1e-9:
                return None
        elif slope > 0:
            low = max(low, -inside / slope)
        else:
            high = min(high, -inside / slope)
    return None if low >= high else foot + np.outer([low, high], along_it)


def scale_bar(ax: Axes) -> float:
    """A bar of a round length just below the axes, at the left, where it hides nothing. It keeps
    to its length where the limits or the size of the axes change.

    Returns its length, µm.
    """
    from matplotlib import rcParams
    from matplotlib.transforms import ScaledTranslation

    from torchfilm.pictures.bar import ScaleBar

    _check_axes(ax)
    low, high = sorted(ax.get_xlim())
    rough = 0.3 * (high - low)
    power = math.floor(math.log10(rough))
    # half of it, too: the logarithm of a number just below a power of ten is rounded up
    size = max(s for x in (0.5, 1, 2, 5) if (s := x * 10.0**power) <= rough)
    # in units of the axes, so that the bar moves with them
    below = ax.transAxes + ScaledTranslation(0, -5 / 72, ax.figure.dpi_scale_trans)
    ax.add_line(ScaleBar(size, below, rcParams["text.color"]))
    ax.annotate(
        f"{size:g} µm",
        (0, 0),
        xycoords="axes fraction",
        xytext=(0, -8),
        textcoords="offset points",
        va="top",
        fontsize=SMALL,
        annotation_clip=False,
    )
    return size


def colour_bar(ax: Axes, scale: Scale) -> None:
    """Fill axes with the legend of a scale: colours from left to right, name above, range below.

    Pointed ends mean that values lie outside the range.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import BoundaryNorm, LogNorm, Normalize

    if scale.kinds:
        count = len(scale.kinds)
        norm: Any = BoundaryNorm(np.arange(count + 1) - 0.5, count)
        ticks, words = np.arange(count), scale.words
    elif scale.log:
        low, high = scale.limits
        norm, ticks = LogNorm(low, high), np.array([low, math.sqrt(low * high), high])
        more = -math.floor(math.log10((high - low) / high))  # digits in which the ends differ
        words = [f"{x:.{2 + more}g}" for x in ticks]
    else:
        low, high = scale.limits
        norm, ticks = Normalize(low, high), np.array([low, 0.5 * (low + high), high])
        words = numbers(ticks / 10.0**scale.power)
    bar = Colorbar(
        ax,
        ScalarMappable(norm, scale.cmap),
        orientation="horizontal",
        extend=scale.beyond,
        extendfrac=0.06,
    )
    bar.set_ticks(list(ticks), labels=words)
    for label in ax.get_xticklabels():
        label.set_parse_math(False)  # names may hold a $
    bar.minorticks_off()
    bar.outline.set_linewidth(0.4)
    ax.tick_params(labelsize=TINY, length=2, width=0.4, pad=1.5)
    ax.set_title(scale.title, fontsize=SMALL, pad=3, parse_math=False)


def numbers(values: np.ndarray) -> list[str]:
    """Numbers as text, with about three digits of the range that they span."""
    decimals = min(17, max(0, 2 - math.floor(math.log10(values.max() - values.min()))))
    words = (f"{x:.{decimals}f}" for x in values)
    words = (w.rstrip("0").rstrip(".") if "." in w else w for w in words)
    return ["0" if w == "-0" else w for w in words]

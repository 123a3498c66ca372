"""The page: panels of one size and scale, with titles, a scale bar and legends; in inches."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.pictures.colours import (
    CELLS,
    MEAN,
    TYPES,
    PlotStyle,
    default_colour,
    is_rgb,
    range_of,
    scale_of,
)
from torchfilm.pictures.draw import (
    add_cells,
    add_faces,
    add_obstacles,
    add_signal,
    add_walls,
    colour_bar,
    cut,
    scale_bar,
    set_window,
)
from torchfilm.pictures.frames import Frame
from torchfilm.pictures.scales import Scale
from torchfilm.pictures.shapes import Window, along, box, span, span_of_faces, window, with_images
from torchfilm.tools import checks
from torchfilm.tools.whole_files import written_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT, NARROWEST = 7.2, 8.4, 3.2  # inches: greatest width and height, least width
EDGE, GAP, HEAD = 0.12, 0.07, 0.19  # margin, between panels, title of a panel
# height of a legend with its ticks; of the scale bar; between two legends, for their end numbers
BAR, BELOW, ROOM = 0.36, 0.24, 0.45
LETTER = 0.056  # width of a letter of 7 points, about
MOST_DPI = 2400.0
TOGETHER = 0.1  # how much larger a window of all colonies may be, as a share of its size


def figure_class() -> Any:
    """matplotlib's Figure. Raises InputError if matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise checks.InputError(f"Pictures require matplotlib: {checks.install('app')}.") from error
    return Figure


@dataclass(frozen=True, eq=False)
class PanelLayout:
    """The common layout of a picture's panels.

    places: the indices of the colonies in the batch. windows: the window of each. scales: of the
    cells. behind: the scale of the signal, or None.
    """

    style: PlotStyle
    places: Sequence[int]
    windows: Mapping[int, Window]
    scales: tuple[Scale, ...]
    behind: Scale | None

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of every panel, µm."""
        left, right, bottom, top = next(iter(self.windows.values()))
        return right - left, top - bottom


def plan_layout(frames: Sequence[Frame], places: Sequence[int], style: PlotStyle) -> PanelLayout:
    """The layout for some frames: one window per colony, and one range per quantity.

    It reads the frames once. Without a colour, the first frame says what colours the cells.
    """
    if style.colour is None and style.channels is None:
        style = replace(style, colour=default_colour(frames[0]))
    seen = {
        name: range_of(name)
        for name in (*style.quantities, *([style.signal] if style.signal else []))
    }
    coloured: set[str] = set()  # quantities that are colours themselves
    covered: dict[int, np.ndarray] = {}
    boxes: dict[int, np.ndarray] = {}
    for frame in frames:
        style.check(frame)
        for place in places:
            cells = frame.colony(place)
            if (new := span(cells, style.view)) is not None:
                new = span_of_faces(frame.faces, new, style.view)
                covered[place] = _union(covered.get(place), new)
            for name in style.quantities:
                if is_rgb(cells, name):
                    coloured.add(name)
                elif name in cells:
                    seen[name].add(cells[name])
            if (
                (style.background or style.whole)
                and frame.origin is not None
                and frame.spacing is not None
                and frame.shape is not None
            ):
                boxes[place] = _union(
                    boxes.get(place),
                    box(frame.origin[place], frame.spacing, tuple(frame.shape[place]), style.view),
                )
            if style.signal is not None:
                seen[style.signal].add(signal_section(frame, place, style, cells))
    scaled = [name for name in style.quantities if name not in coloured]
    scales = tuple(_named(scale_of(n, seen[n], style, frame.units), frame) for n in scaled)
    behind = (
        None
        if style.signal is None
        else scale_of(style.signal, seen[style.signal], style, frame.units, _where(frame, style))
    )
    if any(frame.walls for frame in frames):
        covered = _together(covered)
    return PanelLayout(style, places, _windows(places, covered, boxes, style), scales, behind)


def _named(scale: Scale, frame: Frame) -> Scale:
    """The scale of types with their names, where these fit on a page."""
    if scale.name != TYPES or not scale.kinds:
        return scale
    named = replace(scale, names=frame.type_names)
    return named if _slot(named) <= WIDTH - 2 * EDGE else scale


def _union(a: np.ndarray | None, b: np.ndarray) -> np.ndarray:
    """The smallest box around two boxes (2, 2); a may be None."""
    return b if a is None else np.stack([np.minimum(a[0], b[0]), np.maximum(a[1], b[1])])


def _together(covered: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Between walls that all see, colonies at about the same place are shown at the same place:
    their boxes (2, 2) become the one around them all, if that is little larger than the largest."""
    if not covered:
        return {}
    boxes = np.stack(list(covered.values()))
    all_of_them = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
    largest = (boxes[:, 1] - boxes[:, 0]).max(0)
    alike = bool((all_of_them[1] - all_of_them[0] <= TOGETHER * largest.max() + largest).all())
    return {place: all_of_them if alike else own for place, own in covered.items()}


def _windows(
    places: Sequence[int],
    covered: Mapping[int, np.ndarray],
    boxes: Mapping[int, np.ndarray],
    style: PlotStyle,
) -> dict[int, Window]:
    """Windows of one size, µm.

    A window is around the cells with a margin, within the box of the signal if the cells are in it;
    or the whole box.
    """
    shown = (
        {place: _union(covered.get(place), boxes[place]) for place in places}
        if style.whole
        # the box, where all cells are gone
        else {place: covered[place] if place in covered else boxes[place] for place in places}
    )
    sizes = []
    for place in places:
        extent = shown[place][1] - shown[place][0]
        room = extent if style.whole else extent + 2.0 * (1.0 + 0.04 * extent.max())
        if place in boxes:
            whole = boxes[place][1] - boxes[place][0]
            # cells that press against a wall at a face of the box extend slightly beyond it
            room = np.where(extent < 1.02 * whole, np.minimum(room, whole), extent)
        sizes.append(room)
    size = np.max(sizes, 0)
    size = np.maximum(size, 0.1 * size.max())  # a flat box seen from the side is a line
    return {place: window(shown[place], size, boxes.get(place)) for place in places}


def signal_section(
    frame: Frame, place: int, style: PlotStyle, cells: Mapping[str, np.ndarray]
) -> np.ndarray:
    """The background of one colony, (nu, nv)."""
    assert style.background is not None and frame.origin is not None and frame.spacing is not None
    height = _height(frame, place, style, cells) if style.section == CELLS else None
    return cut(
        frame.signals[style.background][place], frame.origin[place], frame.spacing, style, height
    )


def solid_section(
    frame: Frame, place: int, style: PlotStyle, cells: Mapping[str, np.ndarray]
) -> np.ndarray | None:
    """Where obstacles are in the view of one colony, (nu, nv) bool: at the section of the signal,
    and for a mean where the whole line of sight is solid. None without obstacles."""
    if not frame.solid:
        return None
    assert frame.origin is not None and frame.spacing is not None
    height = _height(frame, place, style, cells) if style.section == CELLS else None
    whole = frame.solid[place].astype(float)
    return cut(whole, frame.origin[place], frame.spacing, style, height) > 0.999


def _height(frame: Frame, place: int, style: PlotStyle, cells: Mapping[str, np.ndarray]) -> float:
    """The position of cells along the line of sight, µm.

    It is their mean, or the plane of 2-D cells; the middle of the box if there are no cells.
    """
    assert frame.origin is not None and frame.spacing is not None and frame.shape is not None
    k = along(style.view)
    low = float(frame.origin[place, k])
    high = low + float(frame.spacing[k] * frame.shape[place, k])
    if frame.dim == 3:
        return float(cells["position"][:, k].mean()) if len(cells["length"]) else 0.5 * (low + high)
    if frame.height is None and frame.shape[place, k] > 1 and not low <= 0.0 <= high:
        shown = f"the height of the cells, from {low:g} to {high:g} µm, which is not in this file"
        raise checks.input_error("section", style.section, shown, 'Give it, or "mean".')
    return frame.height or 0.0


def _where(frame: Frame, style: PlotStyle) -> str:
    """The place of the section through the signal, for its legend."""
    k = along(style.view)
    if frame.shape is None or bool((frame.shape[:, k] == 1).all()):
        return ""
    letter = "xyz"[k]
    if style.section == MEAN:
        return f", mean over {letter}"
    if style.section == CELLS and frame.dim == 3:
        return f", {letter} of the cells"
    at = frame.height or 0.0 if style.section == CELLS else float(style.section)
    return f", {letter} = {at:g} µm"


def _extent(frame: Frame, place: int, style: PlotStyle) -> Window:
    """The box of a colony's medium in the view."""
    assert frame.origin is not None and frame.spacing is not None and frame.shape is not None
    low, high = box(frame.origin[place], frame.spacing, tuple(frame.shape[place]), style.view)
    return low[0], high[0], low[1], high[1]


def fill(ax: Axes, frame: Frame, place: int, layout: PanelLayout, titles: Sequence[str]) -> None:
    """Draw one colony of one frame in a panel, and replace what the panel showed.

    titles: from long to short; the longest that fits is written.
    """
    for artist in (*ax.collections, *ax.images):
        artist.remove()
    set_window(ax, layout.windows[place])
    cells = frame.colony(place)
    if layout.behind is not None:
        flat = signal_section(frame, place, layout.style, cells)
        add_signal(ax, flat, _extent(frame, place, layout.style), layout.behind)
    elif layout.style.channels is not None:
        ax.set_facecolor("black")
    solid = solid_section(frame, place, layout.style, cells)
    if solid is not None:
        add_obstacles(ax, solid, _extent(frame, place, layout.style))
    add_walls(ax, frame.walls, int(frame.colony_id[place]), layout.style.view)
    add_faces(ax, frame.faces, layout.style.view)
    shown = with_images(cells, frame.faces, layout.style.view, layout.windows[place])
    add_cells(ax, shown, layout.scales, layout.style)
    whole = ax.figure.get_figwidth()  # type: ignore[union-attr]
    inches = ax.get_position().width * whole + 0.5 * GAP
    title = next((t for t in titles if LETTER * len(t) <= inches), "")
    ax.set_title(title, fontsize=7, pad=2.5, parse_math=False)


def make_page(
    rows: int, columns: int, layout: PanelLayout, title: str, *, dpi: float
) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of panels (row by row), its title, a scale bar and legends.

    The panels are empty but have their windows.
    """
    checked_dpi(dpi)
    width, height = layout.size
    room = WIDTH - 2 * EDGE - (columns - 1) * GAP
    panel = min(room / columns, ((HEIGHT - 1.2) / rows - HEAD) * width / height)
    across = columns * panel + (columns - 1) * GAP
    legends = [*layout.scales, *([layout.behind] if layout.behind is not None else [])]
    inches = max(NARROWEST, across + 2 * EDGE, *(_slot(s) + 2 * EDGE for s in legends))
    left = 0.5 * (inches - across)
    top = 0.1 + 0.15 * len(_lines(title, inches))
    tall = panel * height / width
    bars, depth = _legend(legends, inches, left + 0.3 * panel + 0.15)
    total = top + rows * (HEAD + tall) + (rows - 1) * GAP + BELOW + depth + EDGE
    # even numbers of pixels, as films require
    figure = figure_class()(
        figsize=tuple(2 * math.ceil(x * dpi / 2) / dpi for x in (inches, total)), dpi=dpi
    )
    wide, high = figure.get_size_inches()

    def place(x: float, y: float, w: float, h: float) -> Axes:
        """Axes with their upper left corner x to the right and y down from the page's, inches."""
        return figure.add_axes((x / wide, 1 - (y + h) / high, w / wide, h / high))

    axes = []
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        ax = place(
            left + column * (panel + GAP), top + row * (HEAD + tall + GAP) + HEAD, panel, tall
        )
        set_window(ax, (0.0, width, 0.0, height))
        for spine in ax.spines.values():
            spine.set(linewidth=0.4, edgecolor="#808080")
        axes.append(ax)
    scale_bar(axes[(rows - 1) * columns])
    under = top + rows * (HEAD + tall) + (rows - 1) * GAP
    for scale, (x, y, w) in zip(legends, bars, strict=True):
        colour_bar(place(x, under + y, w, 0.08), scale)
    set_page_title(figure, title)
    return figure, axes


def checked_dpi(dpi: float) -> float:
    """The pixels per inch of a picture. Raises InputError for what is no number from 1 on."""
    return checks.number("dpi", dpi, least=1.0, most=MOST_DPI, hint="Pixels per inch.")


def set_page_title(figure: Figure, title: str) -> None:
    """Write a page's title, and replace the one before."""
    wide, high = figure.get_size_inches()
    figure.suptitle(
        "\n".join(_lines(title, wide)),
        fontsize=9,
        y=1 - 0.6 * EDGE / high,
        va="top",
        linespacing=1.1,
        parse_math=False,  # names may hold a $
    )


def _lines(title: str, width: float) -> list[str]:
    """A title in lines that fit on a page of this width, inches."""
    return textwrap.wrap(title, max(10, int((width - 2 * EDGE) / (LETTER * 9 / 7))))


def _slot(scale: Scale) -> float:
    """The width that a legend takes, inches."""
    longest = max(map(len, scale.words), default=0)
    kinds = max(0.2, LETTER * longest + 0.02) * len(scale.kinds)
    return max(1.0, LETTER * len(scale.title) - 0.1, kinds) + ROOM


def _legend(
    scales: Sequence[Scale], width: float, taken: float
) -> tuple[list[tuple[float, float, float]], float]:
    """The place of each colour bar: (from the left, down from the panels, width), inches.

    Also how far down they extend below the scale bar. They are at the right of the scale bar if all
    fit there, where it has `taken` of the width; otherwise in rows of their own.
    """
    slots = [_slot(s) for s in scales]
    beside = sum(slots) + EDGE <= width - max(taken, 0.9)
    limit = width - EDGE
    rows: list[list[int]] = [[]]
    for k, slot in enumerate(slots):
        if rows[-1] and sum(slots[j] for j in rows[-1]) + slot > limit - EDGE:
            rows.append([])
        rows[-1].append(k)
    bars = []
    for r, row in enumerate(rows):
        x = limit - sum(slots[k] for k in row)
        y = 0.2 + r * (BAR + 0.06) + (0.0 if beside else BELOW - 0.04)
        for k in row:
            bars.append((x + 0.5 * ROOM, y, slots[k] - ROOM))
            x += slots[k]
    deepest = max((y for _, y, _ in bars), default=0.0) + 0.22
    return bars, max(0.0, deepest - BELOW)


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure to `path`, and return the path.

    Raises InputError if the format or the folder is not valid.
    """
    path = check_picture_path(path)
    with written_whole(path) as beside:
        figure.savefig(beside, dpi=figure.dpi)
    return path


def check_picture_path(path: object) -> Path:
    """The path of a picture. Raises InputError for what is no path, or has no suffix of a picture:
    matplotlib would add one, and perhaps replace another file."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if not isinstance(path, (str, Path)) or Path(path).suffix.lower()[1:] not in known:
        rule = "a path whose name ends in .png, .pdf or .svg"
        raise checks.input_error("picture", str(path), rule)
    return Path(path)

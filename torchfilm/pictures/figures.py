"""Figures: sheets of colonies at one time, and strips of several times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.colours import CELLS, Limits, PlotStyle
from torchfilm.pictures.frames import Frame, RecordedFrames, frame_of
from torchfilm.pictures.page import PanelLayout, figure_class, fill, make_page, plan_layout, save
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE = 2.0  # panels wider than this many heights are placed one below the other


def show(
    path: str | Path,
    *,
    frame: int = -1,
    colour: str | None = None,
    channels: Mapping[str, str] | None = None,
    background: str | None = None,
    limits: Limits | None = None,
    view: str = "xy",
    section: float | str = CELLS,
    whole: bool = False,
    colonies: Sequence[int] | None = None,
    out: str | Path | None = None,
    dpi: float = 200,
) -> Path:
    """Draw one frame of a results file, with one panel per colony. Returns the picture's path.

    colour: the quantity that colours the cells: "angle", the direction of their axes (the default),
    or any quantity per cell by name. channels: instead of colour, several quantities at once as in
    fluorescence microscopy, each with the colour of its light; the colours add up: {"cfp": "cyan",
    "yfp": "yellow"}. background: a signal of the medium, white lowest and black highest.

    limits: the range of colours by name of a drawn quantity, such as {"yfp": (0, 2)}. A signal with
    the name of a quantity of the cells is "out.NAME". The default is the range of all that is drawn
    in the picture (from 0 for a channel; over the whole box for a signal).

    view: "xy", "xz" or "yz". section: where a signal in three dimensions is cut: at the height of
    the "cells" (their mean in each colony, the values that they read), its "mean" along the line of
    sight, or at a coordinate, µm. whole: show the whole box of the medium, not only the colony with
    a margin. colonies: their ids; default the first 36. out: the picture; its suffix sets the
    format (.png, .pdf, .svg); default the name of the results file with .png. dpi: pixels per inch;
    a page is 7.2 inches wide.
    """
    figure_class()
    style = PlotStyle(colour, channels, background, limits, view, section, whole)
    with Results(path) as results:
        frames = RecordedFrames(results, [frame], background)
        target = output_path(path, out, ".png")
        places, more = choose_colonies(frames.present, frames.results.colony_id, colonies, 36)
        title = f"{frames.title}, t = {frames.times[0]:.5g} h{view_note(style)}{more}"
        return save(sheet_figure(frames[0], places, style, title, dpi), target)


def sheet(
    what: State | Frame,
    path: str | Path,
    *,
    scene: Scene | None = None,
    colour: str | None = None,
    channels: Mapping[str, str] | None = None,
    background: str | None = None,
    limits: Limits | None = None,
    view: str = "xy",
    section: float | str = CELLS,
    whole: bool = False,
    colonies: Sequence[int] | None = None,
    title: str = "",
    most: int = 36,
    dpi: float = 200,
) -> Path:
    """Draw the colonies of a state, one panel each, all with one scale, to the picture `path`.

    scene: of the state, whose walls are drawn; a state does not know them, a frame does. most: the
    greatest number of colonies; the title says if there are more. The other options are those of
    `show`.
    """
    if scene is not None and isinstance(what, Frame):
        raise checks.InputError("sheet got a frame and a scene: a frame has its own walls.")
    figure_class()
    style = PlotStyle(colour, channels, background, limits, view, section, whole)
    frame = what if isinstance(what, Frame) else frame_of(what, scene)
    places, more = choose_colonies(frame.counts > 0, frame.colony_id, colonies, most)
    return save(sheet_figure(frame, places, style, title + more, dpi), path)


def strip(
    path: str | Path,
    *,
    times: Sequence[float] | None = None,
    frames: int | None = None,
    colour: str | None = None,
    channels: Mapping[str, str] | None = None,
    background: str | None = None,
    limits: Limits | None = None,
    view: str = "xy",
    section: float | str = CELLS,
    whole: bool = False,
    colonies: Sequence[int] | None = None,
    out: str | Path | None = None,
    dpi: float = 200,
) -> Path:
    """Draw one or more colonies at several times, with one scale and one range of colours.

    times: h; the recorded frame nearest to each time is drawn, with its own time as title. frames:
    instead, at most this many frames, evenly spaced from first to last; default 4. A colony is a
    row. Panels that are more than twice as wide as high are placed one below the other, and a
    colony is a column. colonies: their ids; default the first 4. out: default NAME_strip.png in the
    folder of NAME.h5. The other options are those of `show`.
    """
    figure_class()
    style = PlotStyle(colour, channels, background, limits, view, section, whole)
    with Results(path) as results:
        recorded = RecordedFrames(results, choose_frames(results.times, times, frames), background)
        target = output_path(path, out, "_strip.png")
        places, more = choose_colonies(recorded.present, results.colony_id, colonies, 4)
        layout = plan_layout(recorded, places, style)
        one = (
            f", colony {results.colony_id[places[0]]}"
            if len(places) == 1 and len(results.colony_id) > 1
            else ""
        )
        return save(
            strip_figure(recorded, layout, f"{recorded.title}{one}{view_note(style)}{more}", dpi),
            target,
        )


def sheet_figure(
    frame: Frame, places: Sequence[int], style: PlotStyle, title: str, dpi: float
) -> Figure:
    """A figure with one panel per colony, for one frame."""
    layout = plan_layout([frame], places, style)
    figure, axes = make_page(*square(layout), layout, title, dpi=dpi)
    fill_sheet(axes, frame, layout)
    return figure


def square(layout: PanelLayout) -> tuple[int, int]:
    """The rows and columns that make a sheet about square."""
    width, height = layout.size
    count = len(layout.places)
    columns = min(count, max(1, round(math.sqrt(count * height / width))))
    return math.ceil(count / columns), columns


def fill_sheet(axes: Sequence, frame: Frame, layout: PanelLayout) -> None:
    """Draw one panel per colony, and hide the other panels."""
    for ax, place in zip(axes, layout.places, strict=False):
        name, count = f"colony {frame.colony_id[place]}", int(frame.counts[place])
        fill(
            ax,
            frame,
            place,
            layout,
            [f"{name}: {count} cell{'' if count == 1 else 's'}", name, str(frame.colony_id[place])],
        )
    for ax in axes[len(layout.places) :]:
        ax.set_visible(False)


def strip_figure(frames: RecordedFrames, layout: PanelLayout, title: str, dpi: float) -> Figure:
    """A figure with one panel per colony and time."""
    width, height = layout.size
    down = width > WIDE * height
    shape = (len(frames), len(layout.places)) if down else (len(layout.places), len(frames))
    figure, axes = make_page(*shape, layout, title, dpi=dpi)
    clocks = [f"{t:.5g}" for t in frames.times]
    for k, frame in enumerate(frames):
        for row, place in enumerate(layout.places):
            count = int(frame.counts[place])
            words = f"{clocks[k]} h, {count} cell{'' if count == 1 else 's'}"
            titles = [words, f"{clocks[k]} h"]
            if len(layout.places) > 1:
                name = f"colony {frame.colony_id[place]}"
                titles = [
                    f"{name}, {words}",
                    f"{name}, {clocks[k]} h",
                    f"{frame.colony_id[place]}: {clocks[k]} h",
                ]
            fill(
                axes[k * shape[1] + row if down else row * shape[1] + k],
                frame,
                place,
                layout,
                titles,
            )
    return figure


def choose_colonies(
    present: np.ndarray, ids: np.ndarray, colonies: Sequence[int] | None, most: int
) -> tuple[list[int], str]:
    """The indices of the colonies to draw, and a note for the title if some are omitted.

    Raises InputError if no colony has cells, or a given id has none.
    """
    alive = [int(p) for p in np.flatnonzero(present)]
    if not alive:
        raise checks.InputError("this frame has no cell to draw.")
    if colonies is None:
        return alive[:most], (
            f" (first {most} of {len(alive)} colonies)" if len(alive) > most else ""
        )
    places = {int(ids[p]): p for p in alive}
    wrong = [c for c in colonies if c not in places]
    if wrong or not colonies:
        shown = ", ".join(map(str, list(places)[:12])) + (", …" if len(places) > 12 else "")
        raise checks.input_error(
            "colonies", list(colonies), f"ids of colonies that have cells here: {shown}"
        )
    return [places[c] for c in dict.fromkeys(colonies)], ""


def choose_frames(
    recorded: np.ndarray, times: Sequence[float] | None, frames: int | None
) -> list[int]:
    """The indices of a strip's frames."""
    if times is None:
        count = 4 if frames is None else frames
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise checks.input_error("frames", frames, "a whole number from 1")
        wanted = np.linspace(recorded[0], recorded[-1], count) if count > 1 else recorded[-1:]
        return sorted({int(np.abs(recorded - t).argmin()) for t in wanted})
    if frames is not None:
        raise checks.InputError("times and frames both set the frames to draw: give one of them.")
    # half of the longest interval between two frames: a time further away was not recorded
    slack = 0.5 * float(np.diff(recorded).max(initial=0.0)) + 1e-9
    places = []
    for t in checks.vector("times", times):
        if not recorded[0] - slack <= t <= recorded[-1] + slack:
            raise checks.input_error(
                "times", t, f"within the recorded times, {recorded[0]:g} to {recorded[-1]:g} h"
            )
        places.append(int(np.abs(recorded - t).argmin()))
    if not places:
        raise checks.input_error("times", times, "at least one time")
    return places


def view_note(style: PlotStyle) -> str:
    """The axes of the view for a title; empty for the xy view."""
    return "" if style.view == "xy" else f", {style.view[0]} across and {style.view[1]} up"


def output_path(path: str | Path, out: str | Path | None, ending: str) -> Path:
    """The path of a picture. Raises InputError if it is the results file itself."""
    if not isinstance(path, (str, Path)):
        raise checks.input_error(
            "results",
            path,
            "the path of a results file",
            "For a state, use tf.pictures.sheet(state, out).",
        )
    own = Path(path)
    target = Path(out) if out is not None else own.with_name(own.stem + ending)
    if target.absolute() == own.absolute():
        raise checks.input_error("out", str(target), "another file than the results")
    return target

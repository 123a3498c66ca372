"""Sheets of colonies at one time, and strips of times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.colours import CELLS, Limits, PlotStyle
from torchfilm.pictures.frames import Frame, Recorded, frame_of
from torchfilm.pictures.page import PanelLayout, figure_class, fill, page, save, survey
from torchfilm.state import State
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE = 2.0  # panels wider than this many heights stand one below the other


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
    """Draw one frame of a results file, a panel a colony; by default to the file's own name with
    .png. Returns the picture's path.

    colour: what colours the cells: "angle", the direction of their axes (the default), or any
    quantity per cell by name. channels: instead of colour, several quantities at once as in a
    fluorescence picture, each with the colour of its light, which add up: {"cfp": "cyan", "yfp":
    "yellow"}. background: a signal of the medium, white lowest and black highest. limits: the range
    of colours of what is drawn, by name, such as {"yfp": (0, 2)}; a signal that shares its name
    with a quantity of the cells is "out.NAME". Without, it is that of all that is drawn in the
    picture (from 0 for a channel; of a signal, in all of its box). view: "xy", "xz" or "yz".
    section: where a signal in three dimensions is seen: at the height of the "cells" (the mean of
    each colony's; what they read), its "mean" along the line of sight, or at a coordinate, µm.
    whole: the whole box of the medium, not just the colony and some room. colonies: their ids; by
    default the first 36. out: the picture; its kind is that of its name (.png, .pdf, .svg). dpi:
    pixels an inch; a page is 7.2 inches wide.
    """
    figure_class()
    look = PlotStyle(colour, channels, background, limits, view, section, whole)
    with Results(path) as results:
        frames = Recorded(results, [frame], background)
        target = beside(path, out, ".png")
        places, more = chosen(frames.present, frames.results.colony_id, colonies, 36)
        title = f"{frames.title}, t = {frames.times[0]:.5g} h{seen_along(look)}{more}"
        return save(sheet_figure(frames[0], places, look, title, dpi), target)


def sheet(
    what: State | Frame,
    path: str | Path,
    *,
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
    """A sheet of the colonies of a state, one panel each, all to one scale; written to `path`. The
    options are those of `show`.

    More than `most` colonies: the first ones, and the title says so.
    """
    figure_class()
    look = PlotStyle(colour, channels, background, limits, view, section, whole)
    frame = what if isinstance(what, Frame) else frame_of(what)
    places, more = chosen(frame.counts > 0, frame.colony_id, colonies, most)
    return save(sheet_figure(frame, places, look, title + more, dpi), path)


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
    """Draw one or more colonies at several times, all panels to one scale and one range of colours;
    by default to NAME_strip.png beside NAME.h5.

    times: h; the recorded frame nearest to each is drawn, and its own time is written. frames:
    instead, this many of them (at most), evenly spaced from first to last; 4 without either. A
    colony is a row; panels that are more than twice as wide as high stand one below the other, and
    a colony is a column. colonies: their ids; by default the first 4. The other options are those
    of `show`.
    """
    figure_class()
    look = PlotStyle(colour, channels, background, limits, view, section, whole)
    with Results(path) as results:
        recorded = Recorded(results, picked(results.times, times, frames), background)
        target = beside(path, out, "_strip.png")
        places, more = chosen(recorded.present, results.colony_id, colonies, 4)
        made = survey(recorded, places, look)
        one = (
            f", colony {results.colony_id[places[0]]}"
            if len(places) == 1 and len(results.colony_id) > 1
            else ""
        )
        return save(
            strip_figure(recorded, made, f"{recorded.title}{one}{seen_along(look)}{more}", dpi),
            target,
        )


def sheet_figure(
    frame: Frame, places: Sequence[int], look: PlotStyle, title: str, dpi: float
) -> Figure:
    made = survey([frame], places, look)
    figure, axes = page(*square(made), made, title, dpi=dpi)
    fill_sheet(axes, frame, made)
    return figure


def square(made: PanelLayout) -> tuple[int, int]:
    """Rows and columns that make a sheet about square."""
    width, height = made.size
    count = len(made.places)
    columns = min(count, max(1, round(math.sqrt(count * height / width))))
    return math.ceil(count / columns), columns


def fill_sheet(axes: Sequence, frame: Frame, made: PanelLayout) -> None:
    """A panel a colony; those left over are hidden."""
    for ax, place in zip(axes, made.places, strict=False):
        name, count = f"colony {frame.colony_id[place]}", int(frame.counts[place])
        fill(
            ax,
            frame,
            place,
            made,
            [f"{name}: {count} cell{'' if count == 1 else 's'}", name, str(frame.colony_id[place])],
        )
    for ax in axes[len(made.places) :]:
        ax.set_visible(False)


def strip_figure(frames: Recorded, made: PanelLayout, title: str, dpi: float) -> Figure:
    width, height = made.size
    down = width > WIDE * height
    shape = (len(frames), len(made.places)) if down else (len(made.places), len(frames))
    figure, axes = page(*shape, made, title, dpi=dpi)
    clocks = [f"{t:.5g}" for t in frames.times]
    for k, frame in enumerate(frames):
        for row, place in enumerate(made.places):
            count = int(frame.counts[place])
            words = f"{clocks[k]} h, {count} cell{'' if count == 1 else 's'}"
            titles = [words, f"{clocks[k]} h"]
            if len(made.places) > 1:
                name = f"colony {frame.colony_id[place]}"
                titles = [
                    f"{name}, {words}",
                    f"{name}, {clocks[k]} h",
                    f"{frame.colony_id[place]}: {clocks[k]} h",
                ]
            fill(
                axes[k * shape[1] + row if down else row * shape[1] + k], frame, place, made, titles
            )
    return figure


def chosen(
    present: np.ndarray, ids: np.ndarray, colonies: Sequence[int] | None, most: int
) -> tuple[list[int], str]:
    """The places of the colonies to draw, and what the title says if these are not all that have
    cells."""
    alive = [int(p) for p in np.flatnonzero(present)]
    if not alive:
        raise checks.InputError("there is no cell to draw in this frame.")
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


def picked(recorded: np.ndarray, times: Sequence[float] | None, frames: int | None) -> list[int]:
    """The frames of a strip."""
    if times is None:
        count = 4 if frames is None else frames
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise checks.input_error("frames", frames, "a whole number from 1")
        wanted = np.linspace(recorded[0], recorded[-1], count) if count > 1 else recorded[-1:]
        return sorted({int(np.abs(recorded - t).argmin()) for t in wanted})
    if frames is not None:
        raise checks.InputError("times and frames both say which frames to draw: give one of them.")
    # half of the longest pause between two frames: what is further away was not recorded
    slack = 0.5 * float(np.diff(recorded).max(initial=0.0)) + 1e-9
    places = []
    for t in checks.vector("times", times):
        if not recorded[0] - slack <= t <= recorded[-1] + slack:
            raise checks.input_error(
                "times", t, f"within what was recorded, {recorded[0]:g} to {recorded[-1]:g} h"
            )
        places.append(int(np.abs(recorded - t).argmin()))
    if not places:
        raise checks.input_error("times", times, "at least one time")
    return places


def seen_along(look: PlotStyle) -> str:
    return "" if look.view == "xy" else f", {look.view[0]} across and {look.view[1]} up"


def beside(path: str | Path, out: str | Path | None, ending: str) -> Path:
    """Where a picture goes; never onto the results themselves."""
    if not isinstance(path, (str, Path)):
        raise checks.input_error(
            "results",
            path,
            "the path of a results file",
            "A state is drawn by tf.pictures.sheet(state, out).",
        )
    own = Path(path)
    target = Path(out) if out is not None else own.with_name(own.stem + ending)
    if target.absolute() == own.absolute():
        raise checks.input_error("out", str(target), "another file than the results")
    return target

"""Figures: sheets of colonies at one time, and strips of several times."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchfilm.io.results import Results
from torchfilm.pictures.colours import CELLS, Limits, PlotStyle
from torchfilm.pictures.frames import Frame, RecordedFrames, frame_of
from torchfilm.pictures.page import PanelLayout, figure_class, fill, make_page, plan_layout
from torchfilm.pictures.picture import Picture
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE = 2.0  # panels wider than this many heights are placed one below the other


@checks.known_keywords
def show(
    what: str | Path | Results | State | Frame,
    *,
    frame: int = -1,
    scene: Scene | None = None,
    colour: str | None = None,
    values: Mapping[str, Any] | None = None,
    channels: Mapping[str, str] | None = None,
    background: str | None = None,
    limits: Limits | None = None,
    log: bool | str | Sequence[str] = False,
    view: str = "xy",
    section: float | str = CELLS,
    whole: bool = False,
    colonies: Sequence[int] | None = None,
    most: int = 36,
    title: str | None = None,
    out: str | Path | None = None,
    dpi: float = 200,
) -> Picture:
    """Draw the colonies of a results file at one time, or those of a state, with one panel each.
    A notebook displays the picture that is returned; a file is written only with `out`.

    what: a results file, or its path, of which `frame` is drawn (the last by default); or a state,
    with the `scene` whose walls are drawn: a state does not know them; or a `Frame`.

    colour: the quantity that colours the cells: "angle", the direction of their axes, or any
    quantity per cell by name, or "volume", µm³; of a file also "age" and "born", h, and "founder",
    a colour for each line of descent. The default is the type of the cells where there are several,
    else the first species of a circuit, else the angle. channels: instead of colour, several
    quantities as in fluorescence microscopy, each with the colour of its light, which add up:
    {"cfp": "cyan", "yfp": "yellow"}. background: a signal of the medium, from white to black.

    values: quantities of your own of a state, by name, one number for each cell: `values={"real
    growth (1/h)": tf.measure.growth_rates(state, earlier)}`; or three, its red, green and blue. The
    first colours the cells, unless `colour` says otherwise.

    limits: the range of colours by name of a drawn quantity, such as {"yfp": (0, 2)}. A signal with
    the name of a quantity of the cells is "out.NAME". The default is the range of all that is drawn
    in the picture (from 0 for a channel; over the whole box for a signal). log: True for
    logarithmic colours, or the names of their quantities. The default range goes down to a
    ten-thousandth of the highest value; a pointed end of the bar says where values are lower.

    view: "xy", "xz" or "yz". section: where a signal in three dimensions is cut: at the height of
    the "cells" (their mean in each colony, the values that they read), its "mean" along the line of
    sight, or at a coordinate, µm. whole: show the whole box of the medium, not only the colony with
    a margin. colonies: their ids; default the first `most`, and the title says if there are more.

    out: the picture's path; its suffix sets the format (.png, .pdf, .svg); it replaces an older
    picture. dpi: pixels per inch; a page is 7.2 inches wide.
    """
    figure_class()
    if values is not None and not isinstance(values, Mapping):
        rule = 'numbers of each cell by name, such as {"my level": level}'
        raise checks.input_error("values", values, rule)
    if values and colour is None and channels is None:
        colour = next(iter(values))
    style = PlotStyle(colour, channels, background, limits, view, section, whole, log)
    if isinstance(what, (State, Frame)):
        shown, heading = _given_frame(what, scene, frame, values, style), name_of(scene)
    elif values:
        rule = "left out for results: they are of the cells of one state"
        raise checks.input_error("values", list(values), rule)
    else:
        shown, heading = _recorded_frame(what, scene, frame, style, out)
    return Picture(_one_time(shown, heading, style, colonies, most, title, dpi), out)


def state_figure(
    state: State,
    scene: Scene | None,
    style: PlotStyle,
    colonies: Sequence[int] | None,
    most: int,
    dpi: float,
) -> Figure | None:
    """A state as a figure, with the colonies of `colonies` that have cells; None without any."""
    frame = frame_of(state, scene).asked(style.quantities)
    alive = set(frame.colony_id[frame.counts > 0].tolist())
    if colonies is not None:
        colonies = [c for c in colonies if c in alive]
    if not alive or colonies == []:
        return None
    return _one_time(frame, name_of(scene), style, colonies, most, None, dpi)


def _one_time(
    frame: Frame,
    heading: str,
    style: PlotStyle,
    colonies: Sequence[int] | None,
    most: int,
    title: str | None,
    dpi: float,
) -> Figure:
    """Colonies at one time. heading: the words before the time, where there is no title."""
    boxed = style.shows_box and frame.origin is not None
    present = np.ones_like(frame.counts, dtype=bool) if boxed else frame.counts > 0
    places, more = choose_colonies(present, frame.colony_id, colonies, most)
    if title is not None and not isinstance(title, str):
        raise checks.input_error("title", title, "text")
    if title is None:
        title = f"{heading}t = {frame.time:.5g} h{view_note(style)}"
    return sheet_figure(frame, places, style, title + more, dpi)


def name_of(scene: Scene | None) -> str:
    """The scene's name as a title begins with it."""
    return "" if scene is None else f"{scene.name}, "


def _given_frame(
    what: State | Frame,
    scene: Scene | None,
    frame: int,
    values: Mapping[str, Any] | None,
    style: PlotStyle,
) -> Frame:
    """The frame of a state, with quantities of the user's own and those that colour its cells."""
    if frame != -1:
        rule = "left out for a state, which is of one time"
        raise checks.input_error("frame", frame, rule)
    if isinstance(what, Frame) and scene is not None:
        raise checks.InputError("show got a frame and a scene: a frame has its own walls.")
    given = what if isinstance(what, Frame) else frame_of(what, scene)
    return _with(values, given).asked(style.quantities)


def _with(values: Mapping[str, Any] | None, frame: Frame) -> Frame:
    """The frame with quantities of the user's own."""
    count, more = len(frame.cells["colony"]), {}
    for name, given in (values or {}).items():
        array = np.asarray(given.detach().cpu() if isinstance(given, Tensor) else given)
        colours = array.shape == (count, 3) and count != 0
        if not (array.shape == (count,) or colours) or array.dtype.kind not in "fiub":
            shown = f"{array.dtype} of shape {array.shape}"
            rule = f"{count} numbers, one a cell, or three for each, its colour"
            raise checks.input_error(f"values[{name!r}]", shown, rule)
        if colours and not ((array >= 0) & (array <= 1)).all():
            shown = f"{array.min():g} to {array.max():g}"
            raise checks.input_error(f"values[{name!r}]", shown, "red, green and blue from 0 to 1")
        if name in frame.cells:
            raise checks.input_error("values", name, "other names than the cells have already")
        more[name] = array
    units = {**frame.units, **dict.fromkeys(more, "")}  # "age" may be one of them
    return replace(frame, cells={**frame.cells, **more}, units=units)


def _recorded_frame(
    what: object, scene: Scene | None, frame: int, style: PlotStyle, out: str | Path | None
) -> tuple[Frame, str]:
    """A frame of a results file, and the words before the time in its title."""
    if scene is not None:
        raise checks.InputError("show got results and a scene: results have their own walls.")
    with opened(what) as results:
        check_not_results(results.path, out)
        recorded = RecordedFrames(results, [frame], style.background, style.quantities)
        return recorded[0], f"{recorded.title}, "


@checks.known_keywords
def strip(
    what: str | Path | Results,
    *,
    times: Sequence[float] | None = None,
    count: int | None = None,
    colour: str | None = None,
    channels: Mapping[str, str] | None = None,
    background: str | None = None,
    limits: Limits | None = None,
    log: bool | str | Sequence[str] = False,
    view: str = "xy",
    section: float | str = CELLS,
    whole: bool = False,
    colonies: Sequence[int] | None = None,
    out: str | Path | None = None,
    dpi: float = 200,
) -> Picture:
    """Draw one or more colonies at several times, with one scale and one range of colours.

    times: h; the recorded frame nearest to each time is drawn, with its own time as title. count:
    instead, at most this many frames, evenly spaced from first to last; default 4. A colony is a
    row. Panels that are more than twice as wide as high are placed one below the other, and a
    colony is a column. colonies: their ids; default the first 4. what: a results file, or its path.
    The other options are those of `show`.
    """
    figure_class()
    style = PlotStyle(colour, channels, background, limits, view, section, whole, log)
    with opened(what) as results:
        check_not_results(results.path, out)
        chosen = choose_frames(results.times, times, count)
        recorded = RecordedFrames(results, chosen, background, style.quantities)
        places, more = choose_colonies(
            recorded.shown(style.shows_box), results.colony_id, colonies, 4
        )
        layout = plan_layout(recorded, places, style)
        one = (
            f", colony {results.colony_id[places[0]]}"
            if len(places) == 1 and len(results.colony_id) > 1
            else ""
        )
        title = f"{recorded.title}{one}{view_note(style)}{more}"
        return Picture(strip_figure(recorded, layout, title, dpi), out)


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
        name, count = frame.name(place), int(frame.counts[place])
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
                name = frame.name(place)
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
    checks.integer("most", most, least=1)
    colonies = checked_ids(colonies)
    alive = [int(p) for p in np.flatnonzero(present)]
    if not alive:
        raise checks.InputError(
            "this frame has no cell to draw: its colonies have lost all cells. Draw an earlier one"
            " (frame=…, --frame), or a signal (background=…, --background)."
        )
    if colonies is None:
        notes = [f"first {most} of {len(alive)} colonies"] if len(alive) > most else []
        gone = [str(int(ids[p])) for p in np.flatnonzero(~present)]
        if gone:
            which = f"colony {gone[0]} has" if len(gone) == 1 else f"{len(gone)} colonies have"
            notes.append(f"{which} no cells")
        return alive[:most], f" ({', '.join(notes)})" if notes else ""
    places = {int(ids[p]): p for p in alive}
    wrong = [c for c in colonies if c not in places]
    if wrong:
        shown = ", ".join(map(str, list(places)[:12])) + (", …" if len(places) > 12 else "")
        raise checks.input_error(
            "colonies", colonies, f"ids of colonies that have cells here: {shown}"
        )
    return [places[c] for c in dict.fromkeys(colonies)], ""


def checked_ids(colonies: object) -> list[int] | None:
    """The ids of colonies to draw as a list; None for all. Raises InputError for anything else."""
    if colonies is None:
        return None
    listed = colonies.tolist() if hasattr(colonies, "tolist") else colonies
    if not isinstance(listed, (list, tuple, range)) or not listed:
        hint = f"Write colonies=[{listed}]." if isinstance(listed, int) else ""
        raise checks.input_error("colonies", colonies, "a list of at least one colony's id", hint)
    return [checks.integer("colonies", each, least=0) for each in listed]


def choose_frames(
    recorded: np.ndarray, times: Sequence[float] | None, count: int | None
) -> list[int]:
    """The indices of a strip's frames."""
    if times is None:
        count = checks.integer("count", 4 if count is None else count, least=1)
        wanted = np.linspace(recorded[0], recorded[-1], count) if count > 1 else recorded[-1:]
        return sorted({int(np.abs(recorded - t).argmin()) for t in wanted})
    if count is not None:
        raise checks.InputError("times and count both set the frames to draw: give one of them.")
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


@contextmanager
def opened(what: object) -> Iterator[Results]:
    """A results file, which stays open if it is given open."""
    if isinstance(what, Results):
        yield what
    elif isinstance(what, (str, Path)):
        with Results(what) as results:
            yield results
    else:
        hint = (
            'States are drawn by tf.show(state); record a run by tf.simulate(…, record="run.h5").'
        )
        if isinstance(what, Scene):
            hint = "Run the scene; its founders are tf.show(scene.bind().start(), scene=scene)."
        raise checks.input_error("results", what, "a results file, or its path", hint)


def check_not_results(results: Path, out: str | Path | None) -> None:
    """Raise InputError if a picture would replace the results that it shows."""
    if out is not None and Path(out).absolute() == results.absolute():
        raise checks.input_error("out", str(out), "another file than the results")

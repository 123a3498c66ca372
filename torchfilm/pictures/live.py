"""A picture of a run while it goes on."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchfilm.pictures.colours import CELLS, Limits, PlotStyle
from torchfilm.pictures.figures import checked_ids, state_figure
from torchfilm.pictures.page import check_picture_path, checked_dpi, figure_class, save
from torchfilm.pictures.picture import png_of
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.displays import Output, in_notebook

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHARE = 0.2  # of the time of a run, which drawing takes at most


class LivePlot(metaclass=checks.KnownKeywords):
    """Draws the colonies of a run while it goes on: an observer for `tf.simulate`.

        for state in tf.simulate(scene, cells=500, observers=[tf.LivePlot(colour="yfp")]):
            pass

    In a notebook the picture below the cell is drawn again in place. With `out` it is saved there,
    as in a script, where it is needed; it replaces an older picture. It is drawn for the first
    state, every `seconds` of waiting time at most, so rarely that drawing takes less than a fifth
    of the time, and for the last state. Colonies without cells are left out; where none has
    any, the last picture stays. The other options are those of `tf.show`.

    Raises InputError for options that are not allowed, and without `out` outside of a notebook.
    """

    def __init__(
        self,
        out: str | Path | None = None,
        *,
        seconds: float = 1.0,
        scene: Scene | None = None,
        colour: str | None = None,
        channels: Mapping[str, str] | None = None,
        background: str | None = None,
        limits: Limits | None = None,
        log: bool | str | Sequence[str] = False,
        view: str = "xy",
        section: float | str = CELLS,
        whole: bool = False,
        colonies: Sequence[int] | None = None,
        most: int = 9,
        dpi: float = 150,
    ):
        figure_class()
        self.style = PlotStyle(colour, channels, background, limits, view, section, whole, log)
        self.seconds = checks.number("LivePlot.seconds", seconds, least=0.0)
        self.notebook = in_notebook()
        if out is None and not self.notebook:
            hint = "A notebook needs none."
            raise checks.input_error("LivePlot.out", out, "the picture's path in a script", hint)
        self.out = None if out is None else check_picture_path(out)
        self.scene, self.colonies = scene, checked_ids(colonies)
        self.most, self.dpi = checks.integer("most", most, least=1), checked_dpi(dpi)
        self._begin()

    def _begin(self) -> None:
        self.output = Output() if self.notebook else None
        self.last: State | None = None
        self.drawn, self.next = -1, -math.inf

    def __call__(self, state: State) -> None:
        """Look at a state of the run."""
        self.last = state
        if time.perf_counter() >= self.next:
            self._draw(state)

    def close(self) -> None:
        """Draw the last state. `tf.simulate` calls this; the plot may then observe another run."""
        if self.last is not None and self.last.step != self.drawn:
            self._draw(self.last)
        self._begin()

    def _draw(self, state: State) -> None:
        begun = time.perf_counter()
        self.drawn = state.step
        figure = state_figure(state, self.scene, self.style, self.colonies, self.most, self.dpi)
        if figure is not None:
            self._put(figure)
        spent = time.perf_counter() - begun
        self.next = time.perf_counter() + max(self.seconds, spent * (1 / SHARE - 1))

    def _put(self, figure: Figure) -> None:
        if self.output is not None:
            png, size = png_of(figure)
            words = f"LivePlot({self.last})"
            self.output.show({"image/png": png, "text/plain": words}, {"image/png": size})
        if self.out is not None:  # at once, so that a viewer never reads half a picture
            save(figure, self.out)

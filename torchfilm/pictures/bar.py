"""The line of a scale bar. matplotlib, which is optional, is needed to import this."""

from __future__ import annotations

from typing import Any

from matplotlib.lines import Line2D


class ScaleBar(Line2D):
    """A line that is `size` µm of its axes long, from their left end, whenever it is drawn.
    transform: x is a share of the axes' width."""

    def __init__(self, size: float, transform: Any, colour: str):
        self.size = size
        super().__init__(
            [0, 0], [0, 0], transform=transform, color=colour, linewidth=2.0,
            solid_capstyle="butt", clip_on=False,
        )  # fmt: skip

    def draw(self, renderer: Any) -> None:
        assert self.axes is not None  # nothing else draws it
        low, high = sorted(self.axes.get_xlim())
        self.set_xdata([0, self.size / (high - low)])
        super().draw(renderer)

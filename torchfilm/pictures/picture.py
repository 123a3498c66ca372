"""A picture: a figure that displays itself in a notebook and is saved where it is given a path."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchfilm.pictures.page import figure_class, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHARP = 2.0  # pixels of the file for one of the page in a notebook


class Picture:
    """A figure that a notebook displays.

    figure: of matplotlib, to which you may add. out: save it there, in place of an older picture.
    path: where it was saved last, or None.
    """

    def __init__(self, figure: Figure, out: str | Path | None = None):
        self.figure = figure
        self.path: Path | None = None
        if out is not None:
            self.save(out)

    def save(self, out: str | Path) -> Path:
        """Save the picture, and return its path. The suffix sets the format: .png, .pdf or .svg. As
        matplotlib does, it replaces an older picture of that name. Raises InputError for another
        suffix, and for a folder that does not exist."""
        self.path = save(self.figure, out)
        return self.path

    def __repr__(self) -> str:
        width, height = (round(x * self.figure.dpi) for x in self.figure.get_size_inches())
        where = "not saved: give out=…, or save(path)" if self.path is None else f"in {self.path}"
        return f"Picture({width} × {height} pixels, {where})"

    def _repr_png_(self) -> tuple[bytes, dict[str, Any]]:
        return png_of(self.figure)


def new_figure(width: float, height: float, dpi: float = 160) -> Figure:
    """An empty figure of matplotlib, for a `Picture`. width, height: inches. Raises InputError if
    matplotlib is not installed."""
    return figure_class()(figsize=(width, height), dpi=dpi, layout="constrained")


def png_of(figure: Figure) -> tuple[bytes, dict[str, Any]]:
    """A figure as PNG, and the size at which a notebook shows it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=figure.dpi)
    width, height = figure.get_size_inches() * figure.dpi / SHARP
    return buffer.getvalue(), {"width": round(width), "height": round(height)}

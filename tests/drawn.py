"""Shared by the tests of pictures: frames by hand, and what is drawn of them."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from torchfilm.pictures import Frame
from torchfilm.pictures.colours import PlotStyle
from torchfilm.pictures.figures import choose_colonies, fill_sheet
from torchfilm.pictures.page import make_page, plan_layout

# half a step of 8-bit colour, and one more for the rounding of what is blended
NEAR = 2 / 255


def frame(
    position,
    *,
    colony=None,
    signals=None,
    origin=(-8.0, -8.0, -4.0),
    spacing=(1.0, 1.0, 1.0),
    height=None,
    **fields,
) -> Frame:
    """Round cells of radius 1 at (N, d), with any fields.

    signals: (nx, ny, nz), the same for all colonies.
    """
    position = np.asarray(position, dtype=float)
    n, dim = position.shape
    colony = np.zeros(n, dtype=int) if colony is None else np.asarray(colony)
    axis = np.zeros((n, dim))
    axis[:, 0] = 1
    cells = {
        "colony": colony,
        "uid": np.arange(n),
        "position": position,
        "axis": axis,
        "length": np.zeros(n),
        "radius": np.ones(n),
    }
    cells |= {name: np.asarray(value) for name, value in fields.items()}
    ids = np.arange(colony.max() + 1)
    if signals is None:
        return Frame(cells, 0.0, ids)
    shape = np.tile(next(iter(signals.values())).shape, (len(ids), 1))
    grids = {name: [np.asarray(v, dtype=float)] * len(ids) for name, v in signals.items()}
    return Frame(
        cells,
        0.0,
        ids,
        {},
        grids,
        np.tile(np.array(origin, dtype=float), (len(ids), 1)),
        shape,
        np.array(spacing),
        height,
    )


class Drawn:
    """A sheet as pixels, to read colours at positions."""

    def __init__(self, what: Frame, **options):
        style = PlotStyle(**options)
        places, _ = choose_colonies(what.counts > 0, what.colony_id, None, 36)
        self.layout = plan_layout([what], places, style)
        self.figure, self.axes = make_page(1, len(places), self.layout, "", dpi=100)
        fill_sheet(self.axes, what, self.layout)
        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        self.pixels = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0

    def at(self, x: float, y: float, panel: int = 0) -> np.ndarray:
        """The colour at a position, µm."""
        u, v = self.axes[panel].transData.transform((x, y))
        return self.pixels[len(self.pixels) - 1 - int(v), int(u)]


def viridis(level: float) -> np.ndarray:
    from matplotlib import colormaps

    return np.array(colormaps["viridis"](level)[:3])


def ramp(axis: int, shape=(16, 16, 8)) -> np.ndarray:
    """0 to 1 from the first voxel to the last along an axis."""
    return np.moveaxis(
        np.broadcast_to(
            np.linspace(0, 1, shape[axis]), np.moveaxis(np.empty(shape), axis, -1).shape
        ),
        -1,
        axis,
    )

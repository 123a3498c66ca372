"""Pictures: cells drawn as capsules, coloured by their quantities, over the signal around them.

They require matplotlib (the `app` extra). `show` draws a frame of a results file, or a state,
`strip` several frames, `movie` makes a film, and `kymograph` shows a quantity by place and time.
`LivePlot` draws a run while it goes on. `overlay` draws cells over the micrograph that they were
read from. Each picture is a `Picture`, which a notebook displays and which is saved where a path is
given. For figures of your own, `draw_cells` and `draw_signal` draw on matplotlib axes, and
`colour_bar` and `scale_bar` add the legends.
"""

from torchfilm.pictures.draw import colour_bar, draw_cells, draw_signal, scale_bar
from torchfilm.pictures.figures import show, strip
from torchfilm.pictures.frames import Frame, frame_of
from torchfilm.pictures.live import LivePlot
from torchfilm.pictures.micrograph import overlay
from torchfilm.pictures.movies import movie
from torchfilm.pictures.picture import Picture, new_figure
from torchfilm.pictures.place_and_time import kymograph
from torchfilm.pictures.scales import Scale
from torchfilm.pictures.shapes import VIEWS, outlines
from torchfilm.pictures.time_course import time_course

__all__ = [
    "VIEWS",
    "Frame",
    "LivePlot",
    "Picture",
    "Scale",
    "colour_bar",
    "draw_cells",
    "draw_signal",
    "frame_of",
    "kymograph",
    "movie",
    "new_figure",
    "outlines",
    "overlay",
    "scale_bar",
    "show",
    "strip",
    "time_course",
]

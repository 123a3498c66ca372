"""Pictures: cells drawn as the capsules that they are, coloured by what they hold, over the signal
about them. Needs matplotlib (the `app` extra).

`show` draws a frame of a results file, `strip` several times of it, `movie` films it, and `sheet`
draws a state. For figures of your own, `draw_cells` and `draw_signal` draw on matplotlib axes, and
`colour_bar` and `scale_bar` say what was drawn.
"""

from torchfilm.pictures.colours import Scale
from torchfilm.pictures.draw import colour_bar, draw_cells, draw_signal, scale_bar
from torchfilm.pictures.figures import sheet, show, strip
from torchfilm.pictures.frames import Frame, frame_of
from torchfilm.pictures.movies import movie
from torchfilm.pictures.shapes import VIEWS, outlines

__all__ = [
    "VIEWS",
    "Frame",
    "Scale",
    "colour_bar",
    "draw_cells",
    "draw_signal",
    "frame_of",
    "movie",
    "outlines",
    "scale_bar",
    "sheet",
    "show",
    "strip",
]

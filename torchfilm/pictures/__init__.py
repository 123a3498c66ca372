"""Pictures: cells drawn as capsules, coloured by their quantities, over the signal around them.

They require matplotlib (the `app` extra). `show` draws a frame of a results file, `strip` several
frames of it, `movie` makes a film of it, and `sheet` draws a state. `overlay` draws cells over the
micrograph that they were read from. For figures of your own,
`draw_cells` and `draw_signal` draw on matplotlib axes, and `colour_bar` and `scale_bar` add the
legends.
"""

from torchfilm.pictures.colours import Scale
from torchfilm.pictures.draw import colour_bar, draw_cells, draw_signal, scale_bar
from torchfilm.pictures.figures import sheet, show, strip
from torchfilm.pictures.frames import Frame, frame_of
from torchfilm.pictures.micrograph import overlay
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
    "overlay",
    "scale_bar",
    "sheet",
    "show",
    "strip",
]

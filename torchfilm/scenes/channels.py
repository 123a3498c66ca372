"""Growth channels, closed or open at one end."""

from __future__ import annotations

from torchfilm.distributions import Uniform
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.removal import Removal
from torchfilm.initial_cells import Cells
from torchfilm.physics.walls import Channel
from torchfilm.scene import Scene


def channel(
    width: float = 10.0,
    length: float = 60.0,
    open_ended: bool = True,
    rate: float = 1.0,
    shortest: float = 3.5,
    longest: float = 4.5,
    length_drag: float = 10.0,
) -> Scene:
    """Cells in a channel from x = 0 to `length` µm, `width` µm wide.

    The founder grows at `rate`, 1/h; cells divide at a centreline length between `shortest` and
    `longest` µm. open_ended: cells that pass the end at x = length are removed; otherwise the
    channel is closed and pressure stops growth. With length_drag 10, the paper's, cells deep in a
    channel grow slower than those at its mouth; with 1e5 all grow freely until the channel is full.
    """
    walls = Channel(width, low_end=0.0, high_end=None if open_ended else length)
    leave = [Removal(low=(-1.0, -width), high=(length, width))] if open_ended else []
    return Scene(
        Growth(rate=rate),
        Division(length=Uniform(shortest, longest)),
        Mechanics(dim=2, walls=[walls], length_drag=length_drag),
        *leave,
        founders=Cells([[length / 4, 0.0]], [[1.0, 0.0]]),
    )

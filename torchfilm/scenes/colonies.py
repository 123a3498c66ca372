"""Microcolonies: in the plane, between agarose and coverslip, and with growth at one edge only.

They follow the paper's figures 1, 2 and 4.
"""

from __future__ import annotations

import torch

from torchfilm.distributions import Uniform
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.rules import Rules
from torchfilm.physics.walls import Plane
from torchfilm.rule_views import CellsView
from torchfilm.scene import Scene


def microcolony(
    dim: int = 2,
    rate: float = 1.0,
    law: str = "volume",
    shortest: float = 3.5,
    longest: float = 4.5,
    agarose: float = 16.0,
    length_drag: float = 1e5,
) -> Scene:
    """A colony from one cell (Fig. 1, 2).

    rate: of growth, 1/h. A cell divides at a centreline length between `shortest` and `longest` µm.
    dim 2: strictly in the plane. dim 3: between a soft agarose below (stiffness `agarose`, μ·µm/h)
    and a hard coverslip above.

    The colony grows freely, as those of E. coli do under a microscope. With length_drag 10, the
    paper's, pressure slows it from a hundred cells on.
    """
    walls = (
        ()
        if dim == 2
        else (Plane(z=-0.5, facing="+z", stiffness=agarose), Plane(z=0.5, facing="-z"))
    )
    return Scene(
        Growth(rate=rate, law=law),
        Division(length=Uniform(shortest, longest)),
        Mechanics(dim=dim, walls=walls, length_drag=length_drag),
    )


def programmed_growth(
    rate: float = 1.0,
    edge: float = 10.0,
    shortest: float = 3.5,
    longest: float = 4.5,
    length_drag: float = 10.0,
) -> Scene:
    """A colony in which only cells within `edge` µm of its rightmost point grow (Fig. 4).

    The growing tip is pushed to the right, like a meristem. Pressure limits growth (length_drag 10,
    the paper's); it matters little here, since few cells grow.
    """

    def update(cells: CellsView) -> None:
        x = cells.position[:, 0]
        cells.growth_rate = torch.where(cells.colony_max(x) - x <= edge, rate, 0.0)

    return Scene(
        Rules(update),
        Growth(),
        Division(length=Uniform(shortest, longest)),
        Mechanics(dim=2, length_drag=length_drag),
    )

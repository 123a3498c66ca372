"""Microcolonies: in the plane, between agarose and coverslip, and with growth at one edge only.

They follow the paper's figures 1, 2 and 4. And cells that stick together and move.
"""

from __future__ import annotations

from functools import partial

import torch

from torchfilm.distributions import Uniform
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.motility import Motility
from torchfilm.effects.rules import Rules
from torchfilm.initial_cells import Cells
from torchfilm.inocula import inoculum
from torchfilm.physics.adhesion import Adhesion
from torchfilm.physics.walls import Plane, Sphere
from torchfilm.rule_views import CellsView
from torchfilm.scene import Scene
from torchfilm.values import ByType, Value


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

    rate: of growth, 1/h; law: of what, as of `Growth`. A cell divides at a centreline length
    between `shortest` and `longest` µm. dim 2: strictly in the plane. dim 3: between a soft agarose
    below (stiffness `agarose`, μ·µm/h) and a hard coverslip above.

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

    The growing tip is pushed to the right, like a meristem. They grow at `rate`, 1/h, and divide at
    a centreline length between `shortest` and `longest` µm. Pressure limits growth (length_drag 10,
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


def strain_sorting(
    strength: Value = 300.0,
    reach: float = 0.2,
    speed: Value = 14.0,
    reversals: Value = 4.0,
    turning: Value = 0.4,
    cells: int = 300,
    chamber: float = 25.0,
    length_drag: float = 1e5,
) -> Scene:
    """Two strains, well mixed, that sort: each has an adhesin that binds to itself alone.

    The plan is that of Glass and Riedel-Kruse 2018 (Cell 174, 649): adhesins on the surface of
    E. coli decide who sticks to whom. Cells do not grow. They move along their axis, at `speed`
    µm/h, reverse (`reversals`, 1/h) and turn (`turning`, rad²/h), in a round chamber of the radius
    `chamber` µm. strength, reach: of a bond between two cells of a strain, μ·µm²/h and µm. A
    cell 1.6 µm long moves with a force of 1.6 · speed. cells: how many there are. length_drag: as
    of `Mechanics`. The constants are chosen here.
    """
    return Scene(
        Motility(speed, reversals=reversals, turning=turning),
        Mechanics(
            dim=2,
            walls=[Sphere(centre=(0.0, 0.0), radius=chamber)],
            length_drag=length_drag,
            adhesion=[
                Adhesion(ByType({0: strength, 1: 0.0}), reach),
                Adhesion(ByType({0: 0.0, 1: strength}), reach),
            ],
        ),
        founders=partial(_two_strains, cells, chamber),
        dt=0.01,
    )


def _two_strains(cells: int, chamber: float, seed: int) -> Cells:
    return inoculum(cells, chamber - 1.0, types={0: 0.5, 1: 0.5}, length=0.6, seed=seed)

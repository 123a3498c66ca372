"""Colonies whose growth is limited by a nutrient."""

from __future__ import annotations

from torch import Tensor

from torchfilm.distributions import Uniform
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.signal import Signal
from torchfilm.scene import Scene
from torchfilm.signals.boundary_conditions import BoundaryConditions, Dirichlet


def nutrient_limited(
    supply: float | Tensor = 1.0,
    half: float | Tensor = 0.1,
    diffusion: float | Tensor = 10.0,
    growth_yield: float | Tensor = 1.0,
    rate: float | Tensor = 1.0,
    size: float = 240.0,
    spacing: float = 4.0,
    length_drag: float = 1e5,
) -> Scene:
    """A colony that consumes a nutrient, which diffuses from the edge of a box `size` µm wide.

    At the edge the nutrient is kept at `supply`. Only a rim of the colony grows. Where diffusion is
    slow, bumps of the rim grow faster and branch. Growth is `rate` (1/h) · s/(half + s).
    growth_yield: µm³ of cell from one unit of concentration × µm³. The layer is 1 µm deep, like the
    cells. length_drag: with the default the nutrient limits growth, and pressure does not.
    """
    edge = Dirichlet(supply)
    half_size = size / 2
    return Scene(
        Monod("nutrient", rate=rate, half=half, growth_yield=growth_yield),
        Growth(),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, length_drag=length_drag),
        Medium(
            nutrient=Signal(diffusion=diffusion, initial=supply),
            box=((-half_size, -half_size), (half_size, half_size)),
            spacing=spacing,
            depth=1.0,
            boundary=BoundaryConditions(x=edge, y=edge),
        ),
    )

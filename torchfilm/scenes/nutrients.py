"""Colonies and biofilms whose growth is limited by a nutrient."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from torch import Tensor

from torchfilm.distributions import Uniform
from torchfilm.effects.division import Division
from torchfilm.effects.erosion import Erosion
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.removal import Removal
from torchfilm.effects.signal import Signal
from torchfilm.initial_cells import Cells
from torchfilm.physics.walls import Plane
from torchfilm.scene import Scene
from torchfilm.signals.boundary_conditions import BoundaryConditions, Dirichlet, NoFlux, Periodic
from torchfilm.tools import checks


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
    cells; the voxels are `spacing` µm wide. length_drag: with the default the nutrient limits
    growth, and pressure does not.
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


# µm: how far below the top of the medium cells are carried away, the least space between the first
# cells, and the least width: cells grow up to 5.8 µm long, with their caps, at 1/h; with the 0.3 µm
# that contacts reach they must be shorter than half of it.
BELOW, APART, NARROWEST = 4.0, 5.0, 14.0


def biofilm(
    supply: float | Tensor = 1.0,
    half: float | Tensor = 0.1,
    diffusion: float | Tensor = 1e4,
    growth_yield: float | Tensor = 2e-3,
    rate: float | Tensor = 1.0,
    width: float = 60.0,
    height: float = 60.0,
    first: int = 6,
    layer: float | None = 10.0,
    spacing: float = 2.0,
    length_drag: float = 1e5,
    maintenance: float | Tensor | None = None,
    erosion: float | Tensor | None = None,
) -> Scene:
    """A slice of a biofilm on a floor, y = 0, fed from above: periodic along x, so that no edge
    shapes it (after Picioreanu et al. 1998 and Lardon et al. 2011).

    The nutrient is kept at `supply` at the distance `layer`, µm, above the centre of the highest
    cell, to a voxel: beyond, all is mixed. With layer=None it is kept so at `height`. Cells grow by
    `rate` (1/h) · s/(half + s), down to a depth of about √(2 · diffusion · s · growth_yield /
    (rate·φ)), with the s at the surface, and φ = 0.66 the share of the slice that cells fill. Where
    that is many cells the film is flat; where it is one or two, bumps shade what lies lower and
    become fingers. Cells whose centre comes within 4 µm of `height` are carried away.

    Only the product of diffusion, supply and yield matters, while the nutrient that is there at
    first is little: it feeds a film of supply · growth_yield · its own height.

    maintenance: 1/h, what cells need of their growth to live, see `Monod`. erosion: 1/(µm·h), the
    film loses erosion · h² µm/h where it is h high, see `Erosion`.

    width: µm. first: how many cells lie on the floor at the start, in each colony at places of its
    own, 5 µm apart or more. growth_yield: µm³ of cell from one unit of concentration × µm³. The
    slice is 1 µm deep, like the cells; the voxels are `spacing` µm wide. The film grows freely
    (length_drag 1e5).
    """
    _check_slice(width, height, first, spacing)
    top = height
    if layer is not None:
        layer = checks.number("biofilm(layer)", layer, above=0.0)
        top = spacing * math.ceil((1.0 + layer) / spacing)
    return Scene(
        Monod("nutrient", rate=rate, half=half, growth_yield=growth_yield, maintenance=maintenance),
        Growth(),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(
            dim=2,
            walls=[Plane(y=0.0, facing="+y")],
            periodic={"x": (0.0, width)},
            length_drag=length_drag,
        ),
        Medium(
            nutrient=Signal(diffusion=diffusion, initial=supply),
            box=((0.0, 0.0), (width, top)),
            spacing=spacing,
            depth=1.0,
            boundary=BoundaryConditions(x=Periodic(), y=(NoFlux(), Dirichlet(supply))),
            outside="error" if layer is None else "grow",
            grows="xyz" if layer is None else "+y",
            margin=layer,
        ),
        Removal(high=(math.inf, height - BELOW)),
        *([] if erosion is None else [Erosion(erosion)]),
        founders=partial(_on_the_floor, first, width),
        dt=0.05,
    )


def _check_slice(width: float, height: float, first: int, spacing: float) -> None:
    """Raise InputError for a slice into which the voxels or the first cells do not fit."""
    checks.number("biofilm(width)", width, least=NARROWEST)
    checks.number("biofilm(height)", height, above=2 * BELOW)
    checks.number("biofilm(spacing)", spacing, above=0.0)
    for name, size in (("width", width), ("height", height)):
        if abs(size / spacing - round(size / spacing)) > 1e-6:
            rule = f"a whole number of voxels of {spacing:g} µm (spacing)"
            raise checks.input_error(f"biofilm({name})", size, rule)
    if checks.integer("biofilm(first)", first, least=1) * APART > width:
        rule = f"at most {int(width / APART)} on a floor {width:g} µm wide"
        raise checks.input_error("biofilm(first)", first, rule)


def _on_the_floor(count: int, width: float, seed: int) -> Cells:
    """Cells that lie on the floor, each somewhere in its share of the width."""
    share = width / count
    at = np.random.default_rng(seed).uniform(0.5 * APART, share - 0.5 * APART, count)
    x = share * np.arange(count) + at if share > APART else share * (np.arange(count) + 0.5)
    return Cells(
        position=np.stack([x, np.full(count, 0.5)], 1), axis=[[1.0, 0.0]] * count, length=2.0
    )

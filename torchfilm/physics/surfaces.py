"""The planes and spheres that walls consist of, and the distance of points to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.tools.vectors import safe_norm

if TYPE_CHECKING:
    from torchfilm.physics.walls import Wall

# A position or a direction of a wall, by its entries: each is one number or one per colony.
Vector = tuple[float | Tensor, ...]


@dataclass(frozen=True)
class FlatSurface:
    """A plane of a wall. normal · x = offset on the plane."""

    wall: Wall
    normal: Vector  # unit, towards the cells
    offset: float | Tensor  # µm; one number or one per colony

    def gap_of_points(self, points: Tensor, colony: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (P,) of points (P, d), float64, and the direction to the wall, (d, P)."""
        normal = _vectors(self.normal, colony, points)
        distance = (points * normal).sum(1) - per_cell(self.offset, colony, points)
        return distance, (-normal).expand(points.shape).T

    def deepest(self, position: Tensor, axis: Tensor, half: Tensor, colony: Tensor) -> Tensor:
        """Where each centreline is nearest to the wall, as an arc length from its centre, (P,) µm.

        half: (P,) half lengths, µm. The result is exact: an end of the centreline.
        """
        rise = (_vectors(self.normal, colony, position) * axis).sum(1)
        return torch.where(rise > 0, -half, half)


@dataclass(frozen=True)
class RoundSurface:
    """A sphere of a wall (a circle in 2-D), with cells inside or outside."""

    wall: Wall
    centre: Vector
    radius: float | Tensor
    inside: bool

    def gap_of_points(self, points: Tensor, colony: Tensor) -> tuple[Tensor, Tensor]:
        """As for a flat surface."""
        out = (points - _vectors(self.centre, colony, points)).T
        distance = safe_norm(out)
        radius = per_cell(self.radius, colony, points)
        # at the exact centre all directions lead equally far to the wall; the first axis is taken
        ahead = torch.zeros_like(out)
        ahead[0] = 1.0
        way = torch.where(distance > 1e-9, out / torch.where(distance > 1e-9, distance, 1.0), ahead)
        return (radius - distance, way) if self.inside else (distance - radius, -way)

    def deepest(self, position: Tensor, axis: Tensor, half: Tensor, colony: Tensor) -> Tensor:
        """As for a flat surface.

        From inside it is the outer end; from outside it is the point of the centreline nearest to
        the sphere's centre.
        """
        foot = self.foot(position, axis, colony)
        return (
            torch.where(foot > 0, -half, half)
            if self.inside
            else torch.minimum(torch.maximum(foot, -half), half)
        )

    def foot(self, position: Tensor, axis: Tensor, colony: Tensor) -> Tensor:
        """Where each cell's axis is nearest to the sphere's centre, from the cell's centre, (P,)
        µm.
        """
        return ((_vectors(self.centre, colony, position) - position) * axis).sum(1)


Surface = FlatSurface | RoundSurface


def as_data(surface: Surface) -> dict[str, Any]:
    """A surface as plain numbers, for a file.

    A flat surface has normal and offset (normal · x, µm); a round one has centre and radius, µm.
    Each entry is one number or a list of one per colony. soft: whether the wall yields.
    """
    number = lambda x: x.detach().cpu().tolist() if isinstance(x, Tensor) else float(x)
    soft = surface.wall.yields
    if isinstance(surface, FlatSurface):
        return {
            "normal": [number(n) for n in surface.normal],
            "offset": number(surface.offset),
            "soft": soft,
        }
    return {
        "centre": [number(c) for c in surface.centre],
        "radius": number(surface.radius),
        "soft": soft,
    }


def per_cell(given: float | Tensor, colony: Tensor, like: Tensor) -> Tensor | float:
    """The value of each cell's colony, (P,), or the number itself."""
    if not isinstance(given, Tensor):
        return given
    given = given.to(like)
    return given if given.dim() == 0 else given.index_select(0, colony)


def _vectors(entries: Vector, colony: Tensor, like: Tensor) -> Tensor:
    """(d,) if one vector holds for all cells, else one per cell, (P, d)."""
    if not any(isinstance(entry, Tensor) for entry in entries):
        return like.new_tensor(entries)
    found = [per_cell(entry, colony, like) for entry in entries]
    return torch.stack(
        torch.broadcast_tensors(
            *(f if isinstance(f, Tensor) else like.new_tensor(f) for f in found)
        ),
        -1,
    )

"""Walls: planes, spheres, boxes and channels, hard or soft. Positions in µm, absolute.

A wall is hard unless it is given a stiffness: it then yields, with a force of `stiffness` times overlap against the viscous
drag μ L v of a cell, in units of μ·µm/h. That is physics, and no accuracy setting changes it: its row weight follows as
D² = stiffness · α · Δt. `weight` gives D itself instead, the paper's way, which hardens as α is lowered.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.vectors import cross, dot, safe_norm

AXES = "xyz"


@dataclass(frozen=True)
class Wall:
    """What every wall has: `stiffness` (μ·µm/h, None = hard) or `weight` (D in 0 … 1, the paper's relative weight)."""

    stiffness: float | Tensor | None = field(default=None, kw_only=True)
    weight: float | Tensor | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.stiffness is not None and self.weight is not None:
            raise checks.refuse(f"{name}.weight", self.weight, "left out when a stiffness is given", "Give one of the two.")
        if self.stiffness is not None:
            object.__setattr__(self, "stiffness", checks.value(f"{name}.stiffness", self.stiffness, above=0.0))
        if self.weight is not None:
            object.__setattr__(self, "weight", checks.value(f"{name}.weight", self.weight, above=0.0, most=1.0))

    def surfaces(self, dim: int) -> list[Surface]:
        """The wall as planes and spheres in `dim` dimensions."""
        raise NotImplementedError


@dataclass(frozen=True)
class Plane(Wall):
    """A half space that cells stay in: `Plane(z=-0.5, facing="+z")` keeps them above z = −0.5 µm, or `Plane(point=…, normal=…)`.

    One of x, y, z (µm; one number or one per colony) with facing "+x" … "-z", or a point and a normal that points to the
    side of the cells.
    """

    x: float | Tensor | None = field(default=None, kw_only=True)
    y: float | Tensor | None = field(default=None, kw_only=True)
    z: float | Tensor | None = field(default=None, kw_only=True)
    facing: str | None = field(default=None, kw_only=True)
    point: Sequence[float] | None = field(default=None, kw_only=True)
    normal: Sequence[float] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [a for a in AXES if getattr(self, a) is not None]
        if (self.point is None) != (self.normal is None):
            raise checks.InputError("Plane needs both point and normal, or neither. Example: Plane(point=(0, 0), normal=(1, 1)).")
        if len(named) + (self.point is not None) != 1:
            raise checks.InputError(f'Plane got {named or "no place"}: give exactly one of x, y, z, or point and normal. Example: Plane(z=-0.5, facing="+z").')
        if self.point is not None:
            point, normal = checks.vector("Plane.point", self.point), checks.vector("Plane.normal", self.normal)
            if len(point) != len(normal):
                raise checks.refuse("Plane.normal", normal, f"as long as point ({len(point)} numbers)")
            if not any(n != 0 for n in normal):
                raise checks.refuse("Plane.normal", normal, "a direction that is not zero")
            return
        axis = named[0]
        checks.choice(f"Plane.facing (with {axis})", self.facing, ("+" + axis, "-" + axis))
        object.__setattr__(self, axis, checks.value(f"Plane.{axis}", getattr(self, axis)))

    def surfaces(self, dim: int) -> list[Surface]:
        if self.point is not None:
            if len(self.point) != dim:
                raise checks.refuse("Plane.point", tuple(self.point), f"of {dim} numbers in a {dim}-D scene")
            assert self.normal is not None
            size = math.sqrt(math.fsum(n * n for n in self.normal))
            normal = tuple(n / size for n in self.normal)
            return [_Flat(self, normal, math.fsum(float(p) * n for p, n in zip(self.point, normal, strict=True)))]
        axis = next(k for k, a in enumerate(AXES) if getattr(self, a) is not None)
        if axis >= dim:
            raise checks.refuse(f"Plane.{AXES[axis]}", getattr(self, AXES[axis]), f"a place along {AXES[:dim]} in a {dim}-D scene")
        sign = 1.0 if self.facing[0] == "+" else -1.0  # type: ignore[index]
        at = getattr(self, AXES[axis])
        return [_Flat(self, tuple(sign if k == axis else 0.0 for k in range(dim)), sign * at)]


@dataclass(frozen=True)
class Sphere(Wall):
    """A sphere (a circle in 2-D) that cells stay inside of, or outside of. center µm, radius µm."""

    center: Sequence[float]
    radius: float | Tensor
    inside: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.vector("Sphere.center", self.center)
        object.__setattr__(self, "radius", checks.value("Sphere.radius", self.radius, above=0.0))

    def surfaces(self, dim: int) -> list[Surface]:
        if len(tuple(self.center)) != dim:
            raise checks.refuse("Sphere.center", tuple(self.center), f"of {dim} numbers in a {dim}-D scene")
        return [_Round(self, tuple(map(float, self.center)), self.radius, self.inside)]


@dataclass(frozen=True)
class Box(Wall):
    """An axis-parallel box that cells stay inside of. low, high: opposite corners, µm, each entry one number or one per colony; ±inf leaves a side open."""

    low: Sequence[float | Tensor]
    high: Sequence[float | Tensor]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, corner in zip(("low", "high"), checks.corners("Box", self.low, self.high, "This box is inside out."), strict=True):
            object.__setattr__(self, name, corner)

    def surfaces(self, dim: int) -> list[Surface]:
        if len(tuple(self.low)) != dim:
            raise checks.refuse("Box.low", tuple(self.low), f"of {dim} numbers in a {dim}-D scene")
        out: list[Surface] = []
        for k, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            for sign, at in ((1.0, low), (-1.0, high)):
                if isinstance(at, Tensor) or math.isfinite(at):
                    out.append(_Flat(self, tuple(sign if m == k else 0.0 for m in range(dim)), sign * at))
        return out


@dataclass(frozen=True)
class Channel(Wall):
    """A growth channel along x: walls at y = ±width/2, in 3-D also at z = ±height/2; `low_end`, `high_end` close it at that x (None: open)."""

    width: float | Tensor
    height: float | Tensor | None = None
    low_end: float | Tensor | None = None
    high_end: float | Tensor | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, above in (("width", 0.0), ("height", 0.0), ("low_end", -math.inf), ("high_end", -math.inf)):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, checks.value(f"Channel.{name}", getattr(self, name), above=above))
        if self.low_end is not None and self.high_end is not None and not checks.below(self.low_end, self.high_end):
            raise checks.refuse("Channel.low_end, Channel.high_end", (self.low_end, self.high_end), "low_end < high_end", "This channel is inside out.")

    def surfaces(self, dim: int) -> list[Surface]:
        if self.height is not None and dim == 2:
            raise checks.refuse("Channel.height", self.height, "left out in a 2-D scene")
        half = (math.inf, self.width / 2, math.inf if self.height is None else self.height / 2)
        low = [-math.inf if self.low_end is None else self.low_end] + [-h for h in half[1:dim]]
        high = [math.inf if self.high_end is None else self.high_end] + [h for h in half[1:dim]]
        return Box(low, high, stiffness=self.stiffness, weight=self.weight).surfaces(dim)


@dataclass(frozen=True)
class _Flat:
    wall: Wall
    normal: tuple[float, ...]  # to the side of the cells
    offset: float | Tensor  # normal · x at the wall; one number or one per colony

    def gap_of_points(self, points: Tensor, colony: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (P,) of points (P, d), float64, and the direction to the wall (d, P)."""
        normal = points.new_tensor(self.normal)
        distance = (points * normal).sum(1) - _per_cell(self.offset, colony, points)
        return distance, -normal.unsqueeze(1).expand(-1, points.shape[0])


@dataclass(frozen=True)
class _Round:
    wall: Wall
    center: tuple[float, ...]
    radius: float | Tensor
    inside: bool

    def gap_of_points(self, points: Tensor, colony: Tensor) -> tuple[Tensor, Tensor]:
        out = (points - points.new_tensor(self.center)).T
        distance = safe_norm(out)
        radius = _per_cell(self.radius, colony, points)
        # at the very centre every direction leads to the wall, equally far
        ahead = torch.zeros_like(out)
        ahead[0] = 1.0
        way = torch.where(distance > 1e-9, out / torch.where(distance > 1e-9, distance, 1.0), ahead)
        return (radius - distance, way) if self.inside else (distance - radius, -way)


Surface = _Flat | _Round  # what a wall is made of


def _per_cell(given: float | Tensor, colony: Tensor, like: Tensor) -> Tensor | float:
    if not isinstance(given, Tensor):
        return given
    given = given.to(like)
    return given if given.dim() == 0 else given.index_select(0, colony)


@dataclass(frozen=True)
class WallContacts:
    """W rows of one cell and a wall: cell (W,), gap (W,) µm, row (W, D), surface (W,) number of the surface touched."""

    cell: Tensor
    gap: Tensor
    row: Tensor
    surface: Tensor

    def take(self, index: Tensor) -> WallContacts:
        """The rows at `index`."""
        return WallContacts(*(x.index_select(0, index) for x in (self.cell, self.gap, self.row, self.surface)))


def find_wall_contacts(surfaces: Sequence[Surface], position: Tensor, axis: Tensor, length: Tensor, radius: Tensor, colony_id: Tensor) -> WallContacts:
    """One row for each capsule end (and, at a sphere met from outside, for the nearest point between) that overlaps (gap < 0).

    position (N, d) float64 absolute; axis (N, d), length, radius (N,); colony_id (N,), by which a wall's value per colony is found.
    """
    found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    half = 0.5 * length
    for number, surface in enumerate(surfaces):
        reaches = [(half, 1.0), (-half, -1.0)]
        if isinstance(surface, _Round) and not surface.inside:
            to_center = position.new_tensor(surface.center) - position
            between = (to_center * axis).sum(1).to(half.dtype)
            reaches.append((torch.minimum(torch.maximum(between, -half), half), 0.0))
        for s, end in reaches:
            point = position + (s.unsqueeze(1) * axis).to(position.dtype)
            distance, way = surface.gap_of_points(point, colony_id)
            gap = distance.to(length.dtype) - radius
            near = gap < 0
            if end == 0.0:  # the ends have rows of their own
                near = near & (s.abs() < half)
            keep = torch.nonzero(near).squeeze(1)
            if keep.numel() == 0:
                continue
            n = way.index_select(1, keep).to(axis.dtype)
            a = axis.index_select(0, keep).T
            lever = s.index_select(0, keep) * a
            row = torch.cat([n, cross(lever, n), (0.5 * end * dot(n, a)).unsqueeze(0)]).T
            found.append((keep, gap.index_select(0, keep), row, torch.full_like(keep, number)))
    if not found:
        degrees = 4 if axis.shape[1] == 2 else 7
        none = colony_id.new_empty(0)
        return WallContacts(none, length.new_empty(0), length.new_empty(0, degrees), none)
    return WallContacts(*(torch.cat(part) for part in zip(*found, strict=True)))

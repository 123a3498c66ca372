"""Walls: planes, spheres, boxes and channels, hard or soft. Positions in µm, absolute.

A wall is hard unless it is given a stiffness: it then yields, with a force of `stiffness` times
overlap against the viscous drag μ L v of a cell, in units of μ·µm/h. That is physics, and no
accuracy setting changes it: its row weight follows as D² = stiffness · α · Δt. `weight` gives D
itself instead, the paper's way, which hardens as α is lowered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.contacts import NEAR
from torchfilm.tools import checks
from torchfilm.tools.vectors import cross, dot, safe_norm, safe_sqrt

AXES = "xyz"

# A place or a direction as walls keep it, by its entries: each one number or one per colony.
Vector = tuple[float | Tensor, ...]


@dataclass(frozen=True)
class Wall:
    """What every wall has: `stiffness` (μ·µm/h, None = hard) or `weight` (D in 0 … 1, the paper's
    relative weight)."""

    stiffness: float | Tensor | None = field(default=None, kw_only=True)
    weight: float | Tensor | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.stiffness is not None and self.weight is not None:
            raise checks.input_error(
                f"{name}.weight",
                self.weight,
                "left out when a stiffness is given",
                "Give one of the two.",
            )
        if self.stiffness is not None:
            object.__setattr__(
                self, "stiffness", checks.value(f"{name}.stiffness", self.stiffness, above=0.0)
            )
        if self.weight is not None:
            object.__setattr__(
                self, "weight", checks.value(f"{name}.weight", self.weight, above=0.0, most=1.0)
            )

    @property
    def yields(self) -> bool:
        """Whether cells may press into it: it is soft, or of less weight than a cell has."""
        return self.stiffness is not None or (
            self.weight is not None and bool((torch.as_tensor(self.weight).detach() < 1).any())
        )

    def surfaces(self, dim: int) -> list[Surface]:
        """The wall as planes and spheres in `dim` dimensions."""
        raise NotImplementedError


@dataclass(frozen=True)
class Plane(Wall):
    """A half space that cells stay in: `Plane(z=-0.5, facing="+z")` keeps them above z = −0.5 µm,
    or `Plane(point=…, normal=…)`.

    One of x, y, z (µm; one number or one per colony) with facing "+x" … "-z", or a point and a
    normal that points to the side of the cells, each one vector or one per colony, an array of
    shape (B, d).
    """

    x: float | Tensor | None = field(default=None, kw_only=True)
    y: float | Tensor | None = field(default=None, kw_only=True)
    z: float | Tensor | None = field(default=None, kw_only=True)
    facing: str | None = field(default=None, kw_only=True)
    point: Sequence[float | Tensor] | Tensor | None = field(default=None, kw_only=True)
    normal: Sequence[float | Tensor] | Tensor | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [a for a in AXES if getattr(self, a) is not None]
        if (self.point is None) != (self.normal is None):
            raise checks.InputError(
                "Plane needs both point and normal, or neither. Example: Plane(point=(0, 0),"
                " normal=(1, 1))."
            )
        if len(named) + (self.point is not None) != 1:
            raise checks.InputError(
                f"Plane got {named or 'no place'}: give exactly one of x, y, z, or point and"
                ' normal. Example: Plane(z=-0.5, facing="+z").'
            )
        if self.point is not None:
            point, normal = _vector("Plane.point", self.point), _vector("Plane.normal", self.normal)
            if len(point) != len(normal):
                raise checks.input_error(
                    "Plane.normal", normal, f"as long as point ({len(point)} numbers)"
                )
            if len(counts := _counts((*point, *normal))) > 1:
                raise checks.input_error(
                    "Plane.point, Plane.normal",
                    f"one for each of {' and of '.join(map(str, sorted(counts)))} colonies",
                    "one for each colony",
                )
            zero = sum(torch.as_tensor(n).detach().abs() for n in normal) == 0
            if bool(torch.as_tensor(zero).any()):
                raise checks.input_error("Plane.normal", normal, "a direction that is not zero")
            object.__setattr__(self, "point", point)
            object.__setattr__(self, "normal", normal)
            return
        axis = named[0]
        checks.choice(f"Plane.facing (with {axis})", self.facing, ("+" + axis, "-" + axis))
        object.__setattr__(self, axis, checks.value(f"Plane.{axis}", getattr(self, axis)))

    def surfaces(self, dim: int) -> list[Surface]:
        if self.point is not None:
            if len(self.point) != dim:
                raise checks.input_error(
                    "Plane.point", tuple(self.point), f"of {dim} numbers in a {dim}-D scene"
                )
            assert self.normal is not None
            point, normal = tuple(self.point), tuple(self.normal)
            size = _inner(normal, normal)
            # torch's root and Python's may differ in the last bit: one design must come out as it
            # does among many
            size = (
                size.sqrt()
                if isinstance(size, Tensor)
                else float(torch.tensor(size, dtype=torch.float64).sqrt())
            )
            normal = tuple(n / size for n in normal)
            return [_Flat(self, normal, _inner(point, normal))]
        axis = next(k for k, a in enumerate(AXES) if getattr(self, a) is not None)
        if axis >= dim:
            raise checks.input_error(
                f"Plane.{AXES[axis]}",
                getattr(self, AXES[axis]),
                f"a place along {AXES[:dim]} in a {dim}-D scene",
            )
        sign = 1.0 if self.facing[0] == "+" else -1.0  # type: ignore[index]
        at = getattr(self, AXES[axis])
        return [_Flat(self, tuple(sign if k == axis else 0.0 for k in range(dim)), sign * at)]


@dataclass(frozen=True)
class Sphere(Wall):
    """A sphere (a circle in 2-D) that cells stay inside of, or outside of. center µm, one place or
    one per colony, an array of shape (B, d); radius µm."""

    center: Sequence[float | Tensor] | Tensor
    radius: float | Tensor
    inside: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "center", _vector("Sphere.center", self.center))
        object.__setattr__(self, "radius", checks.value("Sphere.radius", self.radius, above=0.0))

    def surfaces(self, dim: int) -> list[Surface]:
        if len(tuple(self.center)) != dim:
            raise checks.input_error(
                "Sphere.center", tuple(self.center), f"of {dim} numbers in a {dim}-D scene"
            )
        return [_Round(self, tuple(self.center), self.radius, self.inside)]


@dataclass(frozen=True)
class Box(Wall):
    """An axis-parallel box that cells stay inside of. low, high: opposite corners, µm, each entry
    one number or one per colony; ±inf leaves a side open."""

    low: Sequence[float | Tensor]
    high: Sequence[float | Tensor]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, corner in zip(
            ("low", "high"),
            checks.corners("Box", self.low, self.high, "This box is inside out."),
            strict=True,
        ):
            object.__setattr__(self, name, corner)

    def surfaces(self, dim: int) -> list[Surface]:
        if len(tuple(self.low)) != dim:
            raise checks.input_error(
                "Box.low", tuple(self.low), f"of {dim} numbers in a {dim}-D scene"
            )
        out: list[Surface] = []
        for k, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            for sign, at in ((1.0, low), (-1.0, high)):
                if isinstance(at, Tensor) or math.isfinite(at):
                    out.append(
                        _Flat(self, tuple(sign if m == k else 0.0 for m in range(dim)), sign * at)
                    )
        return out


@dataclass(frozen=True)
class Channel(Wall):
    """A growth channel along x: walls at y = ±width/2, in 3-D also at z = ±height/2; `low_end`,
    `high_end` close it at that x (None: open)."""

    width: float | Tensor
    height: float | Tensor | None = None
    low_end: float | Tensor | None = None
    high_end: float | Tensor | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, above in (
            ("width", 0.0),
            ("height", 0.0),
            ("low_end", -math.inf),
            ("high_end", -math.inf),
        ):
            if getattr(self, name) is not None:
                object.__setattr__(
                    self, name, checks.value(f"Channel.{name}", getattr(self, name), above=above)
                )
        if (
            self.low_end is not None
            and self.high_end is not None
            and not checks.below(self.low_end, self.high_end)
        ):
            raise checks.input_error(
                "Channel.low_end, Channel.high_end",
                (self.low_end, self.high_end),
                "low_end < high_end",
                "This channel is inside out.",
            )

    def surfaces(self, dim: int) -> list[Surface]:
        if self.height is not None and dim == 2:
            raise checks.input_error("Channel.height", self.height, "left out in a 2-D scene")
        half = (math.inf, self.width / 2, math.inf if self.height is None else self.height / 2)
        low = [-math.inf if self.low_end is None else self.low_end] + [-h for h in half[1:dim]]
        high = [math.inf if self.high_end is None else self.high_end] + [h for h in half[1:dim]]
        return [
            replace(s, wall=self)
            for s in Box(low, high, stiffness=self.stiffness, weight=self.weight).surfaces(dim)
        ]


@dataclass(frozen=True)
class _Flat:
    wall: Wall
    normal: Vector  # unit, to the side of the cells
    offset: float | Tensor  # normal · x at the wall; one number or one per colony

    def gap_of_points(self, points: Tensor, colony: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (P,) of points (P, d), float64, and the direction to the wall (d, P)."""
        normal = _vectors(self.normal, colony, points)
        distance = (points * normal).sum(1) - _per_cell(self.offset, colony, points)
        return distance, (-normal).expand(points.shape).T

    def deepest(self, position: Tensor, axis: Tensor, half: Tensor, colony: Tensor) -> Tensor:
        """How far from its centre, µm (P,), each centreline of half length `half` (P,) comes
        nearest to the wall: exactly, at an end."""
        rise = (_vectors(self.normal, colony, position) * axis).sum(1)
        return torch.where(rise > 0, -half, half)


@dataclass(frozen=True)
class _Round:
    wall: Wall
    center: Vector
    radius: float | Tensor
    inside: bool

    def gap_of_points(self, points: Tensor, colony: Tensor) -> tuple[Tensor, Tensor]:
        """As of a flat wall."""
        out = (points - _vectors(self.center, colony, points)).T
        distance = safe_norm(out)
        radius = _per_cell(self.radius, colony, points)
        # at the very centre every direction leads to the wall, equally far
        ahead = torch.zeros_like(out)
        ahead[0] = 1.0
        way = torch.where(distance > 1e-9, out / torch.where(distance > 1e-9, distance, 1.0), ahead)
        return (radius - distance, way) if self.inside else (distance - radius, -way)

    def deepest(self, position: Tensor, axis: Tensor, half: Tensor, colony: Tensor) -> Tensor:
        """As of a flat wall: the end that is farther out, or, met from outside, the foot of the
        centre on the centreline."""
        foot = self.foot(position, axis, colony)
        return (
            torch.where(foot > 0, -half, half)
            if self.inside
            else torch.minimum(torch.maximum(foot, -half), half)
        )

    def foot(self, position: Tensor, axis: Tensor, colony: Tensor) -> Tensor:
        """How far from its own centre, µm (P,), each cell's line passes nearest to the sphere's."""
        return ((_vectors(self.center, colony, position) - position) * axis).sum(1)


Surface = _Flat | _Round  # what a wall is made of


def as_data(surface: Surface) -> dict[str, Any]:
    """A surface in numbers, for a file: normal and offset (normal · x there, µm) of a flat one,
    center and radius, µm, of a round one, each entry one number or a list of one per colony; and
    whether it is soft."""
    number = lambda x: x.detach().cpu().tolist() if isinstance(x, Tensor) else float(x)
    soft = surface.wall.yields
    if isinstance(surface, _Flat):
        return {
            "normal": [number(n) for n in surface.normal],
            "offset": number(surface.offset),
            "soft": soft,
        }
    return {
        "center": [number(c) for c in surface.center],
        "radius": number(surface.radius),
        "soft": soft,
    }


def _vector(name: str, given: object) -> Vector:
    """A vector, or one per colony as an array (B, d), by its entries, which keep a tensor's
    gradient and follow it when it is changed in place.

    A sequence with tensors in it is taken for such entries already, each one number or one per
    colony, as a Box's corners are.
    """
    allowed = "a sequence of numbers, or one per colony as an array of shape (colonies, dimensions)"
    if isinstance(given, (tuple, list)) and any(isinstance(entry, Tensor) for entry in given):
        entries = tuple(checks.value(f"{name}[{k}]", entry) for k, entry in enumerate(given))
        if len(_counts(entries)) > 1:
            raise checks.input_error(name, given, "as many values for each entry")
        return entries
    if isinstance(given, Tensor):
        seen = given if given.is_floating_point() else given.double()
    else:
        try:
            seen = torch.as_tensor(np.asarray(given, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise checks.input_error(name, given, allowed) from error
        if seen.dim() == 1:
            return checks.vector(name, given)
    if seen.dim() not in (1, 2) or seen.numel() == 0:
        raise checks.input_error(name, f"an array of shape {tuple(seen.shape)}", allowed)
    bad = torch.nonzero(~torch.isfinite(seen.detach()))
    if bad.numel():
        at = tuple(bad[0].tolist())
        raise checks.input_error(
            f"{name}[{', '.join(map(str, at))}]", float(seen.detach()[at]), "finite"
        )
    with torch.enable_grad():
        # views one by one: those that come from `unbind` forbid a change in place, such as an
        # optimiser's
        return tuple(seen.select(-1, k) for k in range(seen.shape[-1]))


def _counts(entries: Vector) -> set[int]:
    """For how many colonies each of the entries that differ between colonies is given."""
    return {entry.numel() for entry in entries if isinstance(entry, Tensor) and entry.dim() > 0}


def _inner(u: Vector, v: Vector) -> Any:
    """u · v in float64: a number, or a tensor where either has one, 0-dim or one value per colony
    (B,); the same bits either way."""
    wide = lambda x: x.double() if isinstance(x, Tensor) else x
    total = wide(u[0]) * wide(v[0])
    for a, b in zip(u[1:], v[1:], strict=True):
        total = total + wide(a) * wide(b)
    return total


def _per_cell(given: float | Tensor, colony: Tensor, like: Tensor) -> Tensor | float:
    if not isinstance(given, Tensor):
        return given
    given = given.to(like)
    return given if given.dim() == 0 else given.index_select(0, colony)


def _vectors(entries: Vector, colony: Tensor, like: Tensor) -> Tensor:
    """(d,) where there is one vector for all, else one for each cell, (P, d)."""
    if not any(isinstance(entry, Tensor) for entry in entries):
        return like.new_tensor(entries)
    found = [_per_cell(entry, colony, like) for entry in entries]
    return torch.stack(
        torch.broadcast_tensors(
            *(f if isinstance(f, Tensor) else like.new_tensor(f) for f in found)
        ),
        -1,
    )


Capsules = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class WallContacts:
    """W rows of one cell and a wall: cell (W,), gap (W,) µm, row (W, D), surface (W,) number of the
    surface touched.

    Where a contact is shared among rows (see `find_wall_contacts`), gap and row of each are
    multiplied by the root of its share.
    """

    cell: Tensor
    gap: Tensor
    row: Tensor
    surface: Tensor

    def take(self, index: Tensor) -> WallContacts:
        """The rows at `index`."""
        return WallContacts(
            *(x.index_select(0, index) for x in (self.cell, self.gap, self.row, self.surface))
        )


def find_wall_contacts(
    surfaces: Sequence[Surface],
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony_id: Tensor,
    push: bool = False,
    near: bool = False,
) -> WallContacts:
    """One row for each capsule end that overlaps (gap < 0), and at a sphere met from outside one
    for the nearest point, wherever it is.

    position (N, d) float64 absolute; axis (N, d), length, radius (N,); colony_id (N,), by which a
    wall's value per colony is found. push, near: as of `contacts_of`, of walls that are not soft.
    """
    found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    half = 0.5 * length
    for number, surface in enumerate(surfaces):
        for s, end, root in _reaches(surface, position, axis, half, colony_id):
            point = position + (s.unsqueeze(1) * axis).to(position.dtype)
            distance, way = surface.gap_of_points(point, colony_id)
            gap = distance.to(length.dtype) - radius
            margin = (
                NEAR * radius
                if near and surface.wall.stiffness is None
                else torch.zeros_like(radius)
            )
            keep = torch.nonzero((gap < margin) & (root > 0)).squeeze(1)
            if keep.numel() == 0:
                continue
            if near and not push:
                root, gap = (
                    root * (1.0 - gap / margin.clamp(min=1e-30)).clamp(min=0.0, max=1.0),
                    gap.clamp(max=0.0),
                )
            pick = lambda x, keep=keep: x.index_select(0, keep)
            n = way.index_select(1, keep).to(axis.dtype)
            a = pick(axis).T
            row = torch.cat([n, cross(pick(s) * a, n), (0.5 * pick(end) * dot(n, a)).unsqueeze(0)])
            found.append(
                (keep, pick(root) * pick(gap), (pick(root) * row).T, torch.full_like(keep, number))
            )
    if not found:
        degrees = 4 if axis.shape[1] == 2 else 7
        none = colony_id.new_empty(0)
        return WallContacts(none, length.new_empty(0), length.new_empty(0, degrees), none)
    return WallContacts(*(torch.cat(part) for part in zip(*found, strict=True)))


def _reaches(
    surface: Surface, position: Tensor, axis: Tensor, half: Tensor, colony_id: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """The points of each capsule that may touch a surface: how far from the centre, which end moves
    along as it grows (±1, or 0), and the root of the point's share; each (N,).

    Of a sphere met from outside the nearest point slides along the cell, with a whole row; the ends
    share another by how far it is from each. When it arrives at an end, that end has no share left
    and the other has it all, as at a plane: whatever a cell does, no force comes or goes all at
    once.
    """
    one = torch.ones_like(half)
    if isinstance(surface, _Flat) or surface.inside:
        return [(half, one, one), (-half, -one, one)]
    # −1 … 1 along the cell; a sphere, which is all ends, has its nearest point at one of them
    at = (surface.foot(position, axis, colony_id).to(half.dtype) / half.clamp(min=1e-9)).clamp(
        -1, 1
    )
    return [
        (at * half, torch.trunc(at.detach()), one),
        (half, one, safe_sqrt(0.5 * (1 - at))),
        (-half, -one, safe_sqrt(0.5 * (1 + at))),
    ]


# A ball in the way is looked for at so many places of a move; another wall, which has all cells on
# one side, at its end.
PLACES = 8


@torch.no_grad()
def share_to_walls(
    surfaces: Sequence[Surface], at: Callable[[float], Capsules], radius: Tensor, colony_id: Tensor
) -> Tensor:
    """How much of its move takes each cell no farther than its radius behind any wall, or behind
    where it was, (P,): contacts with a wall that a cell did not touch have no part in the solve.
    at: for a share of the move, position (P, d) float64, axis (P, d), half length (P,).
    """

    def gap(surface: Surface, share: float) -> Tensor:
        position, axis, half = at(share)
        deepest = surface.deepest(
            position, axis.to(position.dtype), half.to(position.dtype), colony_id
        )
        distance, _ = surface.gap_of_points(
            position + deepest.unsqueeze(1) * axis.to(position.dtype), colony_id
        )
        return distance.to(radius.dtype) - radius

    out = torch.ones_like(radius)
    for surface in surfaces:
        places = 1 if isinstance(surface, _Flat) or surface.inside else PLACES
        before = gap(surface, 0.0)
        limit = before.clamp(max=0.0) - radius
        for k in range(places):
            after = gap(surface, (k + 1) / places)
            through = (after < limit) & (out > k / places)
            part = (before - limit) / torch.where(through, before - after, 1.0)
            out = torch.where(through, torch.minimum(out, (k + part) / places), out)
            before = after
    return out

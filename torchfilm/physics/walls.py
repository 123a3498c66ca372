"""Walls: planes, spheres, boxes and channels, hard or soft. Positions in µm, absolute.

A wall without a stiffness is hard. A wall with a `stiffness` yields: its force is stiffness times
overlap, in units of μ·µm/h, against the viscous drag μ L v of a cell. This is physics, so no
accuracy setting changes it: the row weight follows as D² = stiffness · α · Δt. A `weight` gives D
itself instead, as in the paper; such a wall hardens as α is lowered.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, cast

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.surfaces import FlatSurface, RoundSurface, Surface, Vector
from torchfilm.tools import checks
from torchfilm.tools.one_per_colony import Kept


@dataclass(frozen=True)
class Wall(metaclass=checks.KnownKeywords):
    """The base of all walls.

    stiffness: μ·µm/h; None = hard. weight: D, the paper's relative weight, above 0. At most one of
    the two; each is one number, one per colony, one per cell type, or a distribution over cells.
    """

    stiffness: Any = field(default=None, kw_only=True)
    weight: Any = field(default=None, kw_only=True)

    # what to do about a first cell that lies behind it
    turn_hint: ClassVar[str] = "Move the cell, or the sides of the wall."

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.stiffness is not None and self.weight is not None:
            raise checks.input_error(
                f"{name}.weight",
                self.weight,
                "omitted when a stiffness is given",
                "Give only one of stiffness and weight.",
            )
        for which, most in (("stiffness", math.inf), ("weight", 1.0)):
            if (given := getattr(self, which)) is not None:
                made = checks.part_value(f"{name}.{which}", given, above=0.0, most=most)
                object.__setattr__(self, which, made)

    @property
    def yields(self) -> bool:
        """Whether cells may press into the wall: it is soft, or its weight is below 1."""
        return self.stiffness is not None or (
            self.weight is not None and any(_below_one(w) for w in _each(self.weight))
        )

    def surfaces(self, dim: int) -> list[Surface]:
        """The wall as planes and spheres in `dim` dimensions."""
        raise NotImplementedError


def depth_in_walls(
    walls: Sequence[Wall], position: Tensor, axis: Tensor, length: Tensor, radius: Tensor,
    ids: Tensor,
) -> Tensor:  # fmt: skip
    """How deep each cell lies in a wall, where it is deepest, (N,) float64 µm; 0 in none. position,
    axis: (N, d). ids: (N,), of the cells' colonies."""
    surfaces = [s for wall in walls for s in wall.surfaces(position.shape[1])]
    return depth_in_surfaces(surfaces, position, axis, length, radius, ids)


def depth_in_surfaces(
    surfaces: Sequence[Surface], position: Tensor, axis: Tensor, length: Tensor, radius: Tensor,
    ids: Tensor,
) -> Tensor:  # fmt: skip
    """As `depth_in_walls`, for the surfaces of walls."""
    deep, axis, half = torch.zeros_like(length.double()), axis.double(), 0.5 * length.double()
    for surface in surfaces:
        s = surface.deepest(position, axis, half, ids)
        distance, _ = surface.gap_of_points(position + s.unsqueeze(1) * axis, ids)
        deep = torch.maximum(deep, radius.double() - distance)
    return deep


def _each(given: Any) -> list[Any]:
    if isinstance(given, Tensor) or not hasattr(given, "values"):
        return [given]
    inner = given.values() if isinstance(given, Mapping) else given.values
    if isinstance(inner, Mapping):  # by cell type
        inner = inner.values()
    return [inner] if isinstance(inner, Tensor) else [x for part in inner for x in _each(part)]


def _below_one(given: Any) -> bool:
    if hasattr(given, "draw"):
        return True
    return bool((torch.as_tensor(given).detach() < 1).any())


@dataclass(frozen=True)
class Plane(Wall):
    """A half space that confines cells.

    `Plane(z=-0.5, facing="+z")` keeps cells above z = −0.5 µm. Give one of x, y, z (µm; one number
    or one per colony) with facing "+x" … "-z", or a point and a normal that points towards the
    cells. Point and normal are each one vector, or one per colony as an array of shape (B, d).
    stiffness, μ·µm/h: of a soft wall. weight: the paper's D, above 0, at most 1. Default: hard.
    """

    turn_hint = "Is the wall inside out? Turn it (facing or normal), or move the cell."

    x: checks.Value | None = field(default=None, kw_only=True)
    y: checks.Value | None = field(default=None, kw_only=True)
    z: checks.Value | None = field(default=None, kw_only=True)
    facing: str | None = field(default=None, kw_only=True)
    point: Sequence[float | Tensor] | Tensor | None = field(default=None, kw_only=True)
    normal: Sequence[float | Tensor] | Tensor | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [a for a in "xyz" if getattr(self, a) is not None]
        if (self.point is None) != (self.normal is None):
            raise checks.InputError(
                "Plane needs both point and normal, or neither. Example: Plane(point=(0, 0),"
                " normal=(1, 1))."
            )
        if len(named) + (self.point is not None) != 1:
            raise checks.InputError(
                f"Plane got {named or 'no position'}: give exactly one of x, y, z, or point and"
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
            # torch's root and Python's may differ in the last bit. One design alone must give the
            # same bits as the same design among many.
            size = (
                size.sqrt()
                if isinstance(size, Tensor)
                else float(torch.tensor(size, dtype=torch.float64).sqrt())
            )
            normal = tuple(n / size for n in normal)
            return [FlatSurface(self, normal, _inner(point, normal))]
        axis = next(k for k, a in enumerate("xyz") if getattr(self, a) is not None)
        if axis >= dim:
            raise checks.input_error(
                f"Plane.{'xyz'[axis]}",
                getattr(self, "xyz"[axis]),
                f"a position along {' or '.join('xyz'[:dim])}: the scene is {dim}-D",
            )
        sign = 1.0 if self.facing[0] == "+" else -1.0  # type: ignore[index]
        at = getattr(self, "xyz"[axis])
        return [FlatSurface(self, tuple(sign if k == axis else 0.0 for k in range(dim)), sign * at)]


@dataclass(frozen=True)
class Sphere(Wall):
    """A sphere (a circle in 2-D) that keeps cells inside, or outside with inside=False.

    centre: µm, one position or one per colony as an array of shape (B, d). radius: µm. stiffness,
    weight: as of `Plane`.
    """

    turn_hint = "Is the wall inside out? Change `inside`, or move the cell."

    centre: Sequence[float | Tensor] | Tensor
    radius: checks.Value
    inside: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "centre", _vector("Sphere.centre", self.centre))
        object.__setattr__(self, "radius", checks.value("Sphere.radius", self.radius, above=0.0))

    def surfaces(self, dim: int) -> list[Surface]:
        if len(tuple(self.centre)) != dim:
            raise checks.input_error(
                "Sphere.centre", tuple(self.centre), f"of {dim} numbers in a {dim}-D scene"
            )
        radius = cast("Kept", self.radius)
        return [RoundSurface(self, tuple(self.centre), radius, self.inside)]


@dataclass(frozen=True)
class Box(Wall):
    """An axis-parallel box that keeps cells inside.

    low, high: opposite corners, µm, each entry one number or one per colony; ±inf leaves a side
    open. stiffness, weight: as of `Plane`.
    """

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
        return _sides(self, self.low, self.high)


@dataclass(frozen=True)
class Channel(Wall):
    """A growth channel along x, with walls at y = ±width/2, and in 3-D also at z = ±height/2.

    `low_end` and `high_end` close the channel at that x (µm; None = open). height: None = no walls
    in z. stiffness, weight: as of `Plane`.
    """

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
            raise checks.input_error("Channel.height", self.height, "omitted in a 2-D scene")
        half = (math.inf, self.width / 2, math.inf if self.height is None else self.height / 2)
        low = [-math.inf if self.low_end is None else self.low_end] + [-h for h in half[1:dim]]
        high = [math.inf if self.high_end is None else self.high_end] + [h for h in half[1:dim]]
        return _sides(self, low, high)


def _sides(
    wall: Wall, low: Sequence[float | Tensor], high: Sequence[float | Tensor]
) -> list[Surface]:
    """The sides of an axis-parallel box, but for those at infinity. Tensors may have changed since
    the wall was made."""
    dim, out = len(low), list[Surface]()
    for k, pair in enumerate(zip(low, high, strict=True)):
        if any(isinstance(x, Tensor) for x in pair) and not checks.below(*pair):
            name = f"walls of {type(wall).__name__} along {'xyz'[k]}"
            raise checks.input_error(name, pair, "low < high", "This wall is inside out.")
        for sign, at in zip((1.0, -1.0), pair, strict=True):
            if isinstance(at, Tensor) or math.isfinite(at):
                normal = tuple(sign if m == k else 0.0 for m in range(dim))
                out.append(FlatSurface(wall, normal, sign * at))
    return out


def _vector(name: str, given: object) -> Vector:
    """A vector, or one per colony as an array (B, d), as a tuple of its entries.

    The entries keep a tensor's gradient and follow in-place changes of it. A sequence that contains
    tensors is read as entries already, each one number or one per colony, like the corners of a
    Box.
    """
    allowed = "a sequence of numbers, or one per colony as an array of shape (colonies, dimensions)"
    if isinstance(given, (tuple, list)) and any(isinstance(entry, Tensor) for entry in given):
        entries = tuple(checks.value(f"{name}[{k}]", entry) for k, entry in enumerate(given))
        if len(_counts(entries)) > 1:
            raise checks.input_error(name, given, "as many values for each entry")
        return entries
    if isinstance(given, Tensor):
        array = given if given.is_floating_point() else given.double()
    else:
        try:
            array = torch.as_tensor(np.asarray(given, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise checks.input_error(name, given, allowed) from error
        if array.dim() == 1:
            return checks.vector(name, given)
    if array.dim() not in (1, 2) or array.numel() == 0:
        raise checks.input_error(name, f"an array of shape {tuple(array.shape)}", allowed)
    bad = torch.nonzero(~torch.isfinite(array.detach()))
    if bad.numel():
        at = tuple(bad[0].tolist())
        raise checks.input_error(
            f"{name}[{', '.join(map(str, at))}]", float(array.detach()[at]), "finite"
        )
    with torch.enable_grad():
        # one view per entry: views from `unbind` forbid in-place changes of the tensor, such as an
        # optimiser's
        return tuple(array.select(-1, k) for k in range(array.shape[-1]))


def _counts(entries: Vector) -> set[int]:
    """The numbers of colonies of those entries that are given per colony."""
    return {entry.numel() for entry in entries if isinstance(entry, Tensor) and entry.dim() > 0}


def _inner(u: Vector, v: Vector) -> Any:
    """u · v in float64: a number, or a tensor, 0-dim or one value per colony (B,).

    The bits are the same in every case.
    """
    wide = lambda x: x.double() if isinstance(x, Tensor) else x
    total = wide(u[0]) * wide(v[0])
    for a, b in zip(u[1:], v[1:], strict=True):
        total = total + wide(a) * wide(b)
    return total

"""The boundary conditions at the six faces of a box of signal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self, cast

from torch import Tensor

from torchfilm.signals.schedule import Schedule, checked_values
from torchfilm.tools import checks
from torchfilm.tools.one_per_colony import Kept


@dataclass(frozen=True)
class Face(metaclass=checks.KnownKeywords):
    """The base of all faces."""

    def outside_value(self) -> Kept | Schedule:
        """The concentration beyond the face, or the given flux, one number or one per colony, or a
        schedule of them; 0 where none enters."""
        return 0.0

    def numbers(self) -> list[Any]:
        """The values that the exchange through the face depends on."""
        return [self.outside_value()]

    def take(self, colonies: Tensor) -> Face:
        """The face of these colonies of the batch, (b,) int64."""
        return self


@dataclass(frozen=True)
class NoFlux(Face):
    """No flux, neither by diffusion nor with the flow."""


@dataclass(frozen=True)
class Periodic(Face):
    """Molecules that leave here enter at the opposite face, which must be periodic too."""


@dataclass(frozen=True)
class _Valued(Face):
    """The base of faces with a value ≥ 0."""

    value: checks.Value | Schedule

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", _checked(f"{type(self).__name__}.value", self.value))

    def outside_value(self) -> Kept | Schedule:
        return cast("Kept | Schedule", self.value)

    def take(self, colonies: Tensor) -> Self:
        return replace(self, value=_take(self.value, colonies))


@dataclass(frozen=True)
class Dirichlet(_Valued):
    """The concentration at the face itself is `value` ≥ 0: one number or one per colony, or a
    `Schedule` of them.

    The face is half a voxel from the nearest centre.
    """


@dataclass(frozen=True)
class Robin(_Valued):
    """Through the face enters `transfer` · (`value` − concentration at the face): a boundary layer
    of still medium, a membrane, or a film beyond which the concentration is `value`.

    value: ≥ 0, one number or one per colony, or a `Schedule` of them. transfer: the mass-transfer
    coefficient or permeability, > 0, µm/h, one number or one per colony; K/L for a layer of
    thickness L µm. A flow passes the layer too.
    """

    transfer: checks.Value

    def __post_init__(self) -> None:
        super().__post_init__()
        made = checks.value("Robin.transfer", self.transfer, above=0.0)
        object.__setattr__(self, "transfer", made)

    def numbers(self) -> list[Any]:
        return [self.value, self.transfer]

    def take(self, colonies: Tensor) -> Self:
        return replace(super().take(colonies), transfer=_take(self.transfer, colonies))


@dataclass(frozen=True)
class Flux(_Valued):
    """`value` enters through the face, by diffusion and flow together, per area and hour,
    concentration · µm/h, wherever no obstacle closes it.

    value: ≥ 0, one number or one per colony, or a `Schedule` of them.
    """


@dataclass(frozen=True)
class Open(Face):
    """No diffusive flux; the flow carries the local concentration out, and `outside` in.

    outside: ≥ 0, one number or one per colony, or a `Schedule` of them.
    """

    outside: checks.Value | Schedule = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "outside", _checked("Open.outside", self.outside))

    def outside_value(self) -> Kept | Schedule:
        return cast("Kept | Schedule", self.outside)

    def take(self, colonies: Tensor) -> Face:
        return replace(self, outside=_take(self.outside, colonies))


@dataclass(frozen=True)
class BoundaryConditions(metaclass=checks.KnownKeywords):
    """The six faces of a box: for each axis one face for both ends, or (low, high). The faces of an
    axis that is left out are `NoFlux()`, or `Open()` where the medium flows.

    Example: `BoundaryConditions(x=(Dirichlet(1.0), Open()), y=Periodic())`.
    """

    x: Face | tuple[Face, Face] | None = None
    y: Face | tuple[Face, Face] | None = None
    z: Face | tuple[Face, Face] | None = None

    def __post_init__(self) -> None:
        for axis in "xyz":
            given = getattr(self, axis)
            if given is None:
                continue
            pair = (given, given) if isinstance(given, Face) else given
            if not (
                isinstance(pair, (tuple, list))
                and len(pair) == 2
                and all(isinstance(face, Face) for face in pair)
            ):
                raise checks.input_error(
                    f"BoundaryConditions.{axis}",
                    given,
                    "a face or a pair of faces (low, high)",
                    "Faces are NoFlux(), Periodic(), Dirichlet(value), Robin(value, transfer),"
                    " Flux(value) and Open(outside).",
                )
            if isinstance(pair[0], Periodic) != isinstance(pair[1], Periodic):
                raise checks.input_error(
                    f"BoundaryConditions.{axis}",
                    pair,
                    "periodic at both ends or at neither",
                    f"Write {axis}=Periodic().",
                )
            object.__setattr__(self, axis, tuple(pair))

    @property
    def pairs(self) -> tuple[tuple[Face, Face], tuple[Face, Face], tuple[Face, Face]]:
        """(low, high) along x, y and z, of a medium that does not flow."""
        of = lambda given: (NoFlux(), NoFlux()) if given is None else given
        return of(self.x), of(self.y), of(self.z)

    def in_flow(self) -> BoundaryConditions:
        """The same of a medium that flows."""
        of = lambda given: Open() if given is None else given
        return BoundaryConditions(of(self.x), of(self.y), of(self.z))

    @property
    def periodic(self) -> tuple[bool, bool, bool]:
        """Which axes are periodic."""
        x, y, z = (isinstance(low, Periodic) for low, _ in self.pairs)
        return x, y, z

    def take(self, colonies: Tensor) -> BoundaryConditions:
        """The faces of these colonies of the batch, (b,) int64."""
        x, y, z = ((low.take(colonies), high.take(colonies)) for low, high in self.pairs)
        return BoundaryConditions(x, y, z)


def _checked(name: str, given: Any) -> Any:
    return checked_values(name, given, partial(checks.value, least=0.0))


def _take(given: Any, colonies: Tensor) -> Any:
    return (
        given.to(colonies.device).index_select(0, colonies)
        if isinstance(given, Tensor) and given.dim() == 1
        else given
    )

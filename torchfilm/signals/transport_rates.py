"""Assembly of a signal's operator: rates of exchange from diffusion, flow and boundary conditions.

The flux between two centres is (K/h)[B(−Pe) u_left − B(Pe) u_right], with B(x) = x/(eˣ − 1) and Pe
= v h/K (Scharfetter and Gummel). One-dimensional steady profiles are exact at the centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    Face,
    Flux,
    NoFlux,
    Open,
    Periodic,
    Robin,
)
from torchfilm.signals.grid import Shape
from torchfilm.signals.schedule import Schedule
from torchfilm.signals.transport_operator import Exchange, Operator
from torchfilm.tools import checks

# Beyond this Péclet number of a voxel, diffusion against the flow is below 1e-33 of the flow, and
# is omitted.
STEEP_PECLET = 80.0
# Below this, x/(eˣ − 1) is summed as a series, since its derivative would suffer from cancellation.
# The first omitted term is x¹⁰/5e7 = 2e-18.
SERIES_LIMIT = 0.1


def build_operator(
    shape: Shape,
    spacing: Sequence[float],
    *,
    diffusion: float | Tensor,
    decay: float | Tensor = 0.0,
    velocity: Sequence[float] | Tensor | tuple[Tensor, Tensor, Tensor] | None = None,
    boundary: BoundaryConditions | None = None,
    mask: Tensor | None = None,
    source: float | Tensor | None = None,
    colonies: int = 1,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Operator:
    """The operator of one signal in `colonies` boxes of `shape` voxels and `spacing` µm.

    diffusion: µm²/h, one number or one per colony. decay: 1/h, likewise, or ([B,] nx, ny, nz).
    velocity: µm/h; None; uniform as (3,) or (B, 3); or on faces as three tensors ([B,] nx + 1, ny,
    nz), ([B,] nx, ny + 1, nz), ([B,] nx, ny, nz + 1), the velocity along x, y, z from the low face
    to the high. boundary: default no flux. mask: ([B,] nx, ny, nz) bool, False in an obstacle,
    whose faces let nothing pass. source: amount per volume and hour, a number, one per colony (B,),
    or ([B,] nx, ny, nz). B is `colonies`. Raises InputError for values or shapes that are not
    allowed.
    """
    spacing = checks.vector("spacing", spacing, 3)
    given = _OperatorInput(tuple(shape), spacing, colonies, device)  # type: ignore[arg-type]
    boundary = BoundaryConditions() if boundary is None else boundary
    rate = given.number("diffusion", diffusion, least=0.0)
    open_ = None if mask is None else given.grid("mask", mask, torch.bool)
    flows = given.flows(velocity)
    axes, inside = [], []
    for axis, (pair, flow, h) in enumerate(zip(boundary.pairs, flows, given.spacing, strict=True)):
        made, interior = _exchange(axis, given.shape[axis], pair, rate / h**2, flow / h, given)
        axes.append(made if open_ is None else _close_obstacle_faces(made, open_))
        inside.append(interior)
    uniform = all(flow.shape[1:] == (1, 1, 1) for flow in flows)
    made_source = None if source is None else given.source(source)
    if made_source is not None and open_ is not None:
        made_source = made_source * open_
    return Operator(
        given.shape,
        colonies,
        (axes[0], axes[1], axes[2]),
        given.rate("decay", decay),
        made_source,
        open_,
        tuple(inside) if uniform else None,
        velocity is None,
        dtype,
    )


def _exchange(
    axis: int,
    n: int,
    pair: tuple[Face, Face],
    diffusion: Tensor,
    flow: Tensor,
    given: _OperatorInput,
) -> tuple[Exchange, tuple[Tensor, Tensor]]:
    """The exchange along one axis, and its rates between two voxels.

    diffusion: (B or 1, 1, 1, 1), and flow, as `up` or uniform, both in 1/h.
    """
    dim = axis + 1
    uniform = flow.shape[dim] == 1
    low, high = (flow, flow) if uniform else (flow.narrow(dim, 0, 1), flow.narrow(dim, n, 1))
    if isinstance(pair[0], Periodic) and not uniform and not torch.equal(low, high):
        raise checks.input_error(
            f"velocity along {'xyz'[axis]}",
            "two velocities at one periodic face",
            "the same at the low and the high face",
        )
    interior = fitted_rates(diffusion, flow)
    ends = [
        _face_rates(face, diffusion, at, given, given.spacing[axis], inwards)
        for face, at, inwards in zip(pair, (low, high), (0, 1), strict=True)
    ]
    parts = []
    for k in range(2):
        middle = (
            interior[k].expand(*interior[k].shape[:dim], n - 1, *interior[k].shape[dim + 1 :])
            if uniform
            else interior[k].narrow(dim, 1, n - 1)
        )
        rows = torch.broadcast_shapes(*(x.shape[:1] for x in (ends[0][k], middle, ends[1][k])))
        whole = [x.expand(*rows, *x.shape[1:]) for x in (ends[0][k], middle, ends[1][k])]
        parts.append(torch.cat(whole, dim))
    name = f"value at a face along {'xyz'[axis]}"
    outside = [
        given.number(name, face.outside_value()) if _has_inflow(face) else None for face in pair
    ]
    return (
        Exchange(axis, parts[0], parts[1], outside[0], outside[1], isinstance(pair[0], Periodic)),
        interior,
    )


def _has_inflow(face: Face) -> bool:
    """Whether the concentration beyond the face may be above 0."""
    outside = face.outside_value()
    assert not isinstance(outside, Schedule)  # a medium gives what holds in a step
    return isinstance(outside, Tensor) or outside > 0


def _face_rates(
    face: Face, diffusion: Tensor, flow: Tensor, given: _OperatorInput, h: float, inwards: int
) -> tuple[Tensor, Tensor]:
    """(up, down) at a face of the box, 1/h. inwards: which of them leads into it."""
    if isinstance(face, Periodic):
        return fitted_rates(diffusion, flow)
    if isinstance(face, Dirichlet):
        return fitted_rates(2 * diffusion, flow)  # the face is half a voxel away
    if isinstance(face, Robin):
        # half a voxel and what is beyond the face, one after the other; the flow passes both
        half, beyond = 2 * diffusion, given.number("Robin.transfer", face.transfer) / h
        return fitted_rates(half * beyond / (half + beyond), flow)
    if isinstance(face, Open):
        return fitted_rates(torch.zeros_like(diffusion), flow)
    nothing = torch.zeros_like(diffusion + flow)
    if isinstance(face, Flux):
        enters = nothing + 1 / h  # times the flux, as that of other faces times a concentration
        return (nothing, enters) if inwards else (enters, nothing)
    assert isinstance(face, NoFlux)
    return nothing, nothing


def _close_obstacle_faces(axis: Exchange, mask: Tensor) -> Exchange:
    """The exchange with every face of an obstacle closed."""
    dim, n = axis.dim, axis.size
    first, last = mask.narrow(dim, 0, 1), mask.narrow(dim, n - 1, 1)
    ends = (first & last,) * 2 if axis.periodic else (first, last)
    between = mask.narrow(dim, 0, n - 1) & mask.narrow(dim, 1, n - 1)
    passable = torch.cat([ends[0], between, ends[1]], dim)
    return Exchange(
        axis.axis, axis.up * passable, axis.down * passable, axis.low, axis.high, axis.periodic
    )


def fitted_rates(diffusion: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """(up, down) ≥ 0 across a face: diffusion·B(∓flow/diffusion), with up − down = flow.

    Upwind where there is no diffusion. All in 1/h.
    """
    speed = flow.abs()
    steep = speed > STEEP_PECLET * diffusion
    x = torch.where(
        steep, STEEP_PECLET, speed / torch.where(steep | (diffusion == 0), 1.0, diffusion)
    )
    gentle = x < SERIES_LIMIT
    a = torch.where(gentle, x, 0.0)
    b = torch.where(gentle, 1.0, x)
    square = a * a
    series = 1 - a / 2 + square / 12 * (1 - square / 60 * (1 - square / 42 * (1 - square / 40)))
    against = torch.where(steep, 0.0, diffusion * torch.where(gentle, series, b / torch.expm1(b)))
    # (v + |v|)/2 instead of max(v, 0): at v = 0 its derivative is the correct one, ½
    return against + (flow + speed) / 2, against + (speed - flow) / 2


@dataclass(frozen=True)
class _OperatorInput:
    """Converts a user's values into float64 tensors (B or 1, …), or raises InputError."""

    shape: Shape
    spacing: tuple[float, ...]
    colonies: int
    device: torch.device | str

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise checks.input_error(
                "shape",
                self.shape,
                "three numbers of voxels, each at least 1",
                "In 2-D the third is 1.",
            )
        if min(self.spacing) <= 0:
            raise checks.input_error("spacing", self.spacing, "three numbers above 0")

    def number(self, name: str, given: object, *, least: float = -float("inf")) -> Tensor:
        """One number, or one per colony, as (B or 1, 1, 1, 1)."""
        found = torch.as_tensor(
            checks.value(name, given, least=least), dtype=torch.float64, device=self.device
        ).reshape(-1)
        if found.numel() not in (1, self.colonies):
            raise checks.input_error(
                name,
                f"{found.numel()} numbers",
                f"one number, or one for each of the {self.colonies} colonies",
            )
        return found.reshape(-1, 1, 1, 1)

    def grid(
        self, name: str, given: Tensor, dtype: torch.dtype = torch.float64, more: int | None = None
    ) -> Tensor:
        """Values on the voxels, or on the faces of axis `more`, as (B or 1, …)."""
        shape = tuple(n + (axis == more) for axis, n in enumerate(self.shape))
        whole = isinstance(given, Tensor) and given.shape in (
            shape,
            (1, *shape),
            (self.colonies, *shape),
        )
        if not whole or (given.dtype == torch.bool) != (dtype == torch.bool):
            shown = (
                (tuple(given.shape), given.dtype)
                if isinstance(given, Tensor)
                else type(given).__name__
            )
            raise checks.input_error(
                name,
                shown,
                f"a tensor of shape {shape} or {(self.colonies, *shape)}"
                + (", of bools" if dtype == torch.bool else ""),
            )
        if not bool(torch.isfinite(given.detach()).all()):
            raise checks.input_error(name, "a value that is not finite", "finite everywhere")
        return given.to(device=self.device, dtype=dtype).reshape(-1, *shape)

    def rate(self, name: str, given: float | Tensor) -> Tensor:
        """A rate ≥ 0: a number, one per colony, or one per voxel."""
        if not (isinstance(given, Tensor) and given.dim() >= 3):
            return self.number(name, given, least=0.0)
        found = self.grid(name, given)
        if bool((found.detach() < 0).any()):
            raise checks.input_error(name, float(found.detach().min()), "at least 0 everywhere")
        return found

    def source(self, given: float | Tensor) -> Tensor:
        """A source: a number, one per colony, or one per voxel."""
        return (
            self.grid("source", given)
            if isinstance(given, Tensor) and given.dim() >= 3
            else self.number("source", given)
        )

    def flows(
        self, given: Sequence[float] | Tensor | tuple[Tensor, Tensor, Tensor] | None
    ) -> list[Tensor]:
        """The velocity along each axis, µm/h: uniform, (B or 1, 1, 1, 1), or on faces."""
        if given is None:
            return [torch.zeros(1, 1, 1, 1, dtype=torch.float64, device=self.device)] * 3
        if (
            not isinstance(given, Tensor)
            and len(given) == 3
            and all(isinstance(v, Tensor) and v.dim() >= 3 for v in given)
        ):
            return [
                self.grid(f"velocity along {'xyz'[axis]}", v, more=axis)  # type: ignore[arg-type]
                for axis, v in enumerate(given)
            ]
        uniform = torch.as_tensor(given, dtype=torch.float64, device=self.device)
        if tuple(uniform.shape) not in ((3,), (1, 3), (self.colonies, 3)):
            raise checks.input_error(
                "velocity",
                tuple(uniform.shape),
                f"(3,), ({self.colonies}, 3), or three tensors on the faces of the voxels",
            )
        if not bool(torch.isfinite(uniform.detach()).all()):
            raise checks.input_error("velocity", uniform.tolist(), "finite")
        return [v.reshape(-1, 1, 1, 1) for v in uniform.reshape(-1, 3).unbind(1)]

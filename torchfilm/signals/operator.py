"""The spatial operator of one signal: diffusion, flow, decay and a constant source on a box of
voxels, as exchange across faces.

| model                             | here                                                                                        |
|-----------------------------------|---------------------------------------------------------------------------------------------|
| ∂s/∂t = K∇²s − v·∇s − k s + q     | du_i/dt = Σ_faces (rate in · u of the neighbour − rate out · u_i) − k u_i + q_i              |
| flux between two centres          | (K/h)[B(−Pe) u_left − B(Pe) u_right], B(x) = x/(eˣ − 1), Pe = v h/K (Scharfetter and Gummel) |

All rates are ≥ 0, so the matrix has no negative entry off its diagonal, and each column sums to
minus what leaves the box: whatever the flow, amount is conserved and nothing need become negative.
One-dimensional steady profiles are exact at the centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    Face,
    NoFlux,
    Open,
    Periodic,
)
from torchfilm.signals.grid import Shape
from torchfilm.tools import checks

AXES = "xyz"
# Beyond this Péclet number of a voxel diffusion against the flow is under 1e-33 of the flow, and
# left out.
STEEP = 80.0
# Below this x/(eˣ − 1) is summed as a series: its derivative would cancel. The first term left out
# is x¹⁰/5e7 = 2e-18.
GENTLE = 0.1


@dataclass(frozen=True, eq=False)
class Exchange:
    """What passes across the n + 1 faces of one axis, from the low face of the box to its high
    face.

    up, down: (B or 1, …) with n + 1 along the axis and one, or as many as there are voxels, along
    the others: up[i] is the rate, 1/h, at which voxel i − 1 gives to voxel i, down[i] that at which
    voxel i gives to voxel i − 1. low, high: (B or 1, 1, 1, 1), the concentration beyond the box, or
    None where none enters. Of a periodic axis, the first face and the last are one.
    """

    axis: int
    up: Tensor
    down: Tensor
    low: Tensor | None
    high: Tensor | None
    periodic: bool

    @property
    def size(self) -> int:
        """Voxels along the axis."""
        return self.up.shape[self.dim] - 1

    @property
    def dim(self) -> int:
        """The axis as a dimension of (B, nx, ny, nz)."""
        return self.axis + 1

    @property
    def own_neighbour(self) -> bool:
        """Whether all that leaves a voxel comes back to it: a periodic axis of one voxel."""
        return self.periodic and self.size == 1

    @cached_property
    def idle(self) -> bool:
        """Whether the axis has but one voxel, and nothing passes its faces but what comes back."""
        return self.size == 1 and (self.periodic or not bool(self.up.any() | self.down.any()))

    def out(self) -> Tensor:
        """Rate at which each voxel gives along this axis, 1/h, shaped as one voxel layer less than
        `up`."""
        n = self.size
        return self.up.narrow(self.dim, 1, n) + self.down.narrow(self.dim, 0, n)

    def to(self, dtype: torch.dtype) -> Exchange:
        low, high = (None if x is None else x.to(dtype) for x in (self.low, self.high))
        return Exchange(self.axis, self.up.to(dtype), self.down.to(dtype), low, high, self.periodic)


@dataclass(frozen=True, eq=False)
class Operator:
    """The operator of B colonies with grids of one shape; made by `operator`. Rates are held in
    float64, values advance in `dtype`.

    axes: the exchange along x, y, z; decay: (B or 1, 1, 1, 1) or (B or 1, nx, ny, nz), 1/h; source:
    None or (B or 1, …), concentration/h; mask: None or (B or 1, nx, ny, nz) bool, False in an
    obstacle. interior: (up, down) of each axis between two voxels of the medium, (B or 1,) each,
    where they are the same everywhere, else None. symmetric: nothing flows.
    """

    shape: Shape
    colonies: int
    axes: tuple[Exchange, Exchange, Exchange]
    decay: Tensor
    source: Tensor | None
    mask: Tensor | None
    interior: tuple[tuple[Tensor, Tensor], ...] | None
    symmetric: bool
    dtype: torch.dtype

    @property
    def separable(self) -> bool:
        """Whether the operator is a sum of one matrix for each axis."""
        return self.mask is None and self.interior is not None and self.decay.shape[1:] == (1, 1, 1)

    @property
    def device(self) -> torch.device:
        return self.decay.device

    @cached_property
    def working(self) -> tuple[tuple[Exchange, ...], Tensor, Tensor | None]:
        """The exchange, decay and gain (or None) in the dtype of the values."""
        gain = self.gain
        return (
            tuple(axis.to(self.dtype) for axis in self.axes),
            self._decay.to(self.dtype),
            None if gain is None else gain.to(self.dtype),
        )

    @cached_property
    def _decay(self) -> Tensor:
        return self.decay if self.mask is None else self.decay * self.mask

    @cached_property
    def loss(self) -> Tensor:
        """Minus the diagonal, 1/h: (B or 1, …), the rate at which each voxel loses what it has;
        float64."""
        out = self._decay
        for axis in self.axes:
            out = out if axis.own_neighbour else out + axis.out()
        return out

    @cached_property
    def gain(self) -> Tensor | None:
        """What is gained whatever is there, from the source and through the faces: None or (B or 1,
        nx, ny, nz), concentration/h; float64."""
        parts = [entering(axis) for axis in self.axes]
        if self.source is not None:
            parts.append(self.source)
        found = [part for part in parts if part is not None]
        if not found:
            return None
        out = found[0].expand(-1, *self.shape)
        for part in found[1:]:
            out = out + part
        return out


def entering(axis: Exchange) -> Tensor | None:
    """What enters through the two faces of one axis: None or (B or 1, …) with the voxels of the
    axis, concentration/h."""
    if axis.low is None and axis.high is None:
        return None
    n, dim = axis.size, axis.dim
    out = torch.zeros_like(axis.up.narrow(dim, 0, n))
    layers = []
    if axis.low is not None:
        layers.append((axis.low * axis.up.narrow(dim, 0, 1), (0, n - 1)))
    if axis.high is not None:
        layers.append((axis.high * axis.down.narrow(dim, n, 1), (n - 1, 0)))
    for layer, (before, after) in layers:
        blank = [torch.zeros_like(layer).repeat_interleave(k, dim) for k in (before, after)]
        out = out + torch.cat([blank[0], layer, blank[1]], dim)
    return out


def apply(operator: Operator, u: Tensor, *, gain: bool = True) -> Tensor:
    """du/dt of u (B, nx, ny, nz), concentration/h; without the part that does not depend on u if
    `gain` is False."""
    axes, decay, constant = operator.working
    if u.dtype != operator.dtype:
        axes, decay, constant = operator.axes, operator._decay, operator.gain
    out = -decay * u
    for axis in axes:
        if not axis.own_neighbour:
            out = out + _passing(axis, u)
    return out + constant if gain and constant is not None else out


def _passing(axis: Exchange, u: Tensor) -> Tensor:
    """What each voxel gains along one axis, less what it loses."""
    dim, n = axis.dim, axis.size
    first, last = u.narrow(dim, 0, 1), u.narrow(dim, n - 1, 1)
    below, above = (
        (last, first) if axis.periodic else (torch.zeros_like(first), torch.zeros_like(last))
    )
    up = axis.up * torch.cat([below, u], dim)
    flux = torch.addcmul(up, axis.down, torch.cat([u, above], dim), value=-1.0)
    return flux.narrow(dim, 0, n) - flux.narrow(dim, 1, n)


def fitted(diffusion: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """(up, down) ≥ 0 across a face: diffusion·B(∓flow/diffusion), with up − down = flow; upwind
    where there is no diffusion. All 1/h."""
    speed = flow.abs()
    steep = speed > STEEP * diffusion
    x = torch.where(steep, STEEP, speed / torch.where(steep | (diffusion == 0), 1.0, diffusion))
    gentle = x < GENTLE
    a = torch.where(gentle, x, 0.0)
    b = torch.where(gentle, 1.0, x)
    square = a * a
    series = 1 - a / 2 + square / 12 * (1 - square / 60 * (1 - square / 42 * (1 - square / 40)))
    against = torch.where(steep, 0.0, diffusion * torch.where(gentle, series, b / torch.expm1(b)))
    # (v + |v|)/2 instead of max(v, 0): at rest its derivative is the true one, ½
    return against + (flow + speed) / 2, against + (speed - flow) / 2


def operator(
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

    diffusion: µm²/h, one number or one per colony; decay: 1/h, likewise, or ([B,] nx, ny, nz).
    velocity: µm/h, None, uniform as (3,) or (B, 3), or on faces as three tensors ([B,] nx + 1, ny,
    nz), ([B,] nx, ny + 1, nz), ([B,] nx, ny, nz + 1) of the velocity along x, y, z, from the low
    face to the high. boundary: `BoundaryConditions`, no flux without. mask: ([B,] nx, ny, nz) bool, False in an
    obstacle, through whose faces nothing passes. source: amount per volume and hour, a number, one
    per colony (B,), or ([B,] nx, ny, nz). B is `colonies`.
    """
    given = _Given(tuple(shape), checks.vector("spacing", spacing, 3), colonies, device)  # type: ignore[arg-type]
    boundary = BoundaryConditions() if boundary is None else boundary
    rate = given.number("diffusion", diffusion, least=0.0)
    open_ = None if mask is None else given.grid("mask", mask, torch.bool)
    flows = given.flows(velocity)
    axes, inside = [], []
    for axis, (pair, flow, h) in enumerate(zip(boundary.pairs, flows, given.spacing, strict=True)):
        made, interior = _exchange(axis, given.shape[axis], pair, rate / h**2, flow / h, given)
        axes.append(made if open_ is None else _shut(made, open_))
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
    axis: int, n: int, pair: tuple[Face, Face], diffusion: Tensor, flow: Tensor, given: _Given
) -> tuple[Exchange, tuple[Tensor, Tensor]]:
    """The exchange along one axis, and its rates between two voxels; diffusion (B or 1, 1, 1, 1)
    and flow, as `up` or uniform, in 1/h."""
    dim = axis + 1
    uniform = flow.shape[dim] == 1
    low, high = (flow, flow) if uniform else (flow.narrow(dim, 0, 1), flow.narrow(dim, n, 1))
    if isinstance(pair[0], Periodic) and not uniform and not torch.equal(low, high):
        raise checks.input_error(
            f"velocity along {AXES[axis]}",
            "two velocities at one periodic face",
            "the same at the low and the high face",
        )
    interior = fitted(diffusion, flow)
    ends = [_end(face, diffusion, at) for face, at in zip(pair, (low, high), strict=True)]
    parts = []
    for k in range(2):
        middle = (
            interior[k].expand(*interior[k].shape[:dim], n - 1, *interior[k].shape[dim + 1 :])
            if uniform
            else interior[k].narrow(dim, 1, n - 1)
        )
        parts.append(torch.cat([ends[0][k], middle, ends[1][k]], dim))
    name = f"value beyond a face along {AXES[axis]}"
    outside = [given.number(name, face.outside_value()) if _enters(face) else None for face in pair]
    return (
        Exchange(axis, parts[0], parts[1], outside[0], outside[1], isinstance(pair[0], Periodic)),
        interior,
    )


def _enters(face: Face) -> bool:
    """Whether there may be something beyond the face."""
    outside = face.outside_value()
    return isinstance(outside, Tensor) or outside > 0


def _end(face: Face, diffusion: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """(up, down) at a face of the box."""
    if isinstance(face, Periodic):
        return fitted(diffusion, flow)
    if isinstance(face, Dirichlet):
        return fitted(2 * diffusion, flow)  # the face is half a voxel away
    if isinstance(face, Open):
        return fitted(torch.zeros_like(diffusion), flow)
    assert isinstance(face, NoFlux)
    nothing = torch.zeros_like(diffusion + flow)
    return nothing, nothing


def _shut(axis: Exchange, mask: Tensor) -> Exchange:
    """The exchange with every face of an obstacle closed."""
    dim, n = axis.dim, axis.size
    first, last = mask.narrow(dim, 0, 1), mask.narrow(dim, n - 1, 1)
    ends = (first & last,) * 2 if axis.periodic else (first, last)
    between = mask.narrow(dim, 0, n - 1) & mask.narrow(dim, 1, n - 1)
    passable = torch.cat([ends[0], between, ends[1]], dim)
    return Exchange(
        axis.axis, axis.up * passable, axis.down * passable, axis.low, axis.high, axis.periodic
    )


@dataclass(frozen=True)
class _Given:
    """Turns what was given into float64 tensors (B or 1, …), with a clear word where it does not
    fit."""

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
        return (
            self.grid("source", given)
            if isinstance(given, Tensor) and given.dim() >= 3
            else self.number("source", given)
        )

    def flows(
        self, given: Sequence[float] | Tensor | tuple[Tensor, Tensor, Tensor] | None
    ) -> list[Tensor]:
        """The velocity along each axis, uniform as (B or 1, 1, 1, 1) or on faces, µm/h."""
        if given is None:
            return [torch.zeros(1, 1, 1, 1, dtype=torch.float64, device=self.device)] * 3
        if (
            not isinstance(given, Tensor)
            and len(given) == 3
            and all(isinstance(v, Tensor) and v.dim() >= 3 for v in given)
        ):
            return [
                self.grid(f"velocity along {AXES[axis]}", v, more=axis)
                for axis, v in enumerate(given)
            ]  # type: ignore[arg-type]
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

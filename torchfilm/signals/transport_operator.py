"""The spatial operator of one signal on a box of voxels, as exchange across voxel faces.

It has diffusion, flow, decay and a constant source: ∂s/∂t = K∇²s − v·∇s − k s + q becomes

    du_i/dt = Σ_faces (rate in · u of the neighbour − rate out · u_i) − k u_i + q_i

All rates are ≥ 0, so the matrix has no negative entry off its diagonal, and each column sums to
minus the rate at which the voxel loses amount to the outside and to decay. Whatever the flow,
amount is conserved and no value need become negative. `transport_rates` computes the rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.signals.grid import Shape
from torchfilm.tools.tangents import tracked


@dataclass(frozen=True, eq=False)
class Exchange:
    """The exchange across the n + 1 faces of one axis, from the box's low face to its high face.

    up, down: (B or 1, …), with n + 1 along the axis, and one or the number of voxels along the
    others. up[i] is the rate, 1/h, at which voxel i − 1 gives to voxel i; down[i] is the reverse
    rate. low, high: (B or 1, 1, 1, 1), the concentration beyond the box, or None where none enters.
    Where a flux is given, they are that flux, at a rate of 1 over the width of a voxel, 1/µm. On a
    periodic axis the first face and the last are the same.
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
        """Whether a voxel is its own neighbour: a periodic axis of one voxel."""
        return self.periodic and self.size == 1

    @cached_property
    def still(self) -> bool:
        """Whether nothing moves along the axis."""
        return not (tracked(self.up, self.down) or bool(self.up.any() | self.down.any()))

    @cached_property
    def idle(self) -> bool:
        """Whether the axis has one voxel, and no amount leaves or enters through its faces."""
        if self.size > 1 or tracked(self.up, self.down):
            return False
        return self.periodic or self.still

    def out(self) -> Tensor:
        """The rate at which each voxel gives along this axis, 1/h; one layer less than `up`."""
        n = self.size
        return self.up.narrow(self.dim, 1, n) + self.down.narrow(self.dim, 0, n)

    def to(self, dtype: torch.dtype) -> Exchange:
        """The same exchange in another dtype."""
        low, high = (None if x is None else x.to(dtype) for x in (self.low, self.high))
        return Exchange(self.axis, self.up.to(dtype), self.down.to(dtype), low, high, self.periodic)


@dataclass(frozen=True, eq=False)
class Operator:
    """The operator of B colonies with grids of one shape; made by `transport_rates.build_operator`.

    Rates are float64; values advance in `dtype`. axes: the exchange along x, y, z. decay: (B or 1,
    1, 1, 1) or (B or 1, nx, ny, nz), 1/h. source: None or (B or 1, …), concentration/h. mask: None
    or (B or 1, nx, ny, nz) bool, False in an obstacle. interior: (up, down) of each axis between
    two voxels of the medium, (B or 1,) each, if uniform, else None. symmetric: whether there is no
    flow.
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
        """Minus the diagonal, 1/h, (B or 1, …) float64: the relative loss rate of each voxel."""
        out = self._decay
        for axis in self.axes:
            out = out if axis.own_neighbour else out + axis.out()
        return out

    @cached_property
    def gain(self) -> Tensor | None:
        """The gain that does not depend on u, from the source and through the faces.

        None or (B or 1, nx, ny, nz), concentration/h; float64.
        """
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


def mean(parts: Sequence[tuple[float, Operator]]) -> Operator:
    """The operator with the mean of the rates and sources of several, each with its share of a
    step. They differ in flow, source and what is beyond the faces, and in nothing else."""
    if len(parts) == 1:
        return parts[0][1]
    first = parts[0][1]
    sources = [share * x.source for share, x in parts if x.source is not None]
    axes = [_mean_exchange([(share, x.axes[k]) for share, x in parts]) for k in range(3)]
    inside = [(share, x.interior) for share, x in parts if x.interior is not None]
    rate = lambda k, way: _sum([share * each[k][way] for share, each in inside])
    uniform = len(inside) == len(parts)
    return replace(
        first,
        axes=(axes[0], axes[1], axes[2]),
        source=_sum(sources) if sources else None,
        interior=tuple((rate(k, 0), rate(k, 1)) for k in range(3)) if uniform else None,
        symmetric=all(x.symmetric for _, x in parts),
    )


def _mean_exchange(parts: Sequence[tuple[float, Exchange]]) -> Exchange:
    first = parts[0][1]
    up = _sum([share * x.up for share, x in parts])
    down = _sum([share * x.down for share, x in parts])
    into = [(share * x.up.narrow(x.dim, 0, 1), x.low) for share, x in parts]
    back = [(share * x.down.narrow(x.dim, x.size, 1), x.high) for share, x in parts]
    return replace(first, up=up, down=down, low=_mean_beyond(into), high=_mean_beyond(back))


def _mean_beyond(parts: Sequence[tuple[Tensor, Tensor | None]]) -> Tensor | None:
    """The concentration beyond a face with which as much enters as on average, from the rates at
    which it does, each times its share."""
    given = [rate * beyond for rate, beyond in parts if beyond is not None]
    if not given:
        return None
    rate = _sum([rate for rate, _ in parts])
    return _sum(given) / torch.where(rate > 0, rate, 1.0)


def _sum(parts: Sequence[Tensor]) -> Tensor:
    return sum(parts[1:], parts[0])


def entering(axis: Exchange) -> Tensor | None:
    """The inflow through the two faces of one axis.

    None, or (B or 1, …) with the voxels of the axis, concentration/h.
    """
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
    """du/dt of u (B, nx, ny, nz), concentration/h.

    gain: if False, without the part that does not depend on u.
    """
    axes, decay, constant = operator.working
    if u.dtype != operator.dtype:
        axes, decay, constant = operator.axes, operator._decay, operator.gain
    out = -decay * u
    for axis in axes:
        if not axis.own_neighbour:
            out = out + _net_gain(axis, u)
    return out + constant if gain and constant is not None else out


def _net_gain(axis: Exchange, u: Tensor) -> Tensor:
    """The gain minus the loss of each voxel along one axis."""
    dim, n = axis.dim, axis.size
    first, last = u.narrow(dim, 0, 1), u.narrow(dim, n - 1, 1)
    below, above = (
        (last, first) if axis.periodic else (torch.zeros_like(first), torch.zeros_like(last))
    )
    up = axis.up * torch.cat([below, u], dim)
    flux = torch.addcmul(up, axis.down, torch.cat([u, above], dim), value=-1.0)
    return flux.narrow(dim, 0, n) - flux.narrow(dim, 1, n)

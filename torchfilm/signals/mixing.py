"""One exchange of all voxels with their neighbours: P = I + T/λ of an operator T."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.grid import Shape
from torchfilm.signals.transport_operator import Operator

# λ over the greatest loss rate: each voxel keeps a part of its content larger than all roundings.
ABOVE = 1.01


@dataclass(frozen=True, eq=False)
class Mixing:
    """P = I + T/λ in float64, without its gain: stay (B or 1, nx, ny, nz), the part of its content
    that a voxel keeps; gains: for each axis with neighbours (dimension, from the voxel below, from
    the voxel above). A voxel at a face gets from the opposite one, with a part of 0 unless the axis
    is periodic."""

    stay: Tensor
    gains: tuple[tuple[int, Tensor, Tensor], ...]

    @property
    def numbers(self) -> list[Tensor]:
        return [self.stay, *(x for _, *both in self.gains for x in both)]

    @property
    def colonies(self) -> int:
        """1 where all share it."""
        return max(x.shape[0] for x in self.numbers)

    def of(self, v: Tensor) -> Tensor:
        """P v, for v (B, nx, ny, nz)."""
        out = self.stay * v
        for dim, up, down in self.gains:
            out = out + up * torch.roll(v, 1, dim)
            out = out + down * torch.roll(v, -1, dim)
        return out

    def transposed(self) -> Mixing:
        """Pᵀ: a voxel gets from each neighbour what P gives to it."""
        turn = lambda dim, up, down: (dim, torch.roll(down, 1, dim), torch.roll(up, -1, dim))
        return Mixing(self.stay, tuple(turn(*x) for x in self.gains))


def rate_above(fastest: Tensor) -> Tensor:
    """λ for the greatest loss rate of each colony."""
    return torch.where(fastest > 0, ABOVE * fastest, 1.0)


def mixing_of(operator: Operator, rate: Tensor) -> Mixing:
    """P of an operator; rate: λ, (B or 1, 1, 1, 1)."""
    gains = []
    for axis in operator.axes:
        if axis.size == 1:
            continue
        n, dim = axis.size, axis.dim
        up, down = axis.up.narrow(dim, 0, n) / rate, axis.down.narrow(dim, 1, n) / rate
        if not axis.periodic:
            inner = torch.ones(n, dtype=up.dtype, device=up.device)
            inner[0] = 0.0
            shape = [n if k == dim else 1 for k in range(4)]
            up, down = up * inner.reshape(shape), down * inner.flip(0).reshape(shape)
        gains.append((dim, up, down))
    return Mixing(1 - operator.loss / rate, tuple(gains))


def packed(*given: Tensor) -> tuple[np.ndarray, ...]:
    """As contiguous arrays."""
    return tuple(np.ascontiguousarray(x.numpy()) for x in given)


def mixing_arrays(mixing: Mixing, shape: Shape, count: int) -> tuple[np.ndarray, ...]:
    """strides, stay, ups, downs, wrap_to, wrap_from and wraps of P, as `kernels.transport.mix`
    takes them, of `count` colonies or 1."""
    number = torch.arange(shape[0] * shape[1] * shape[2]).view(shape)
    whole = lambda x: x.detach().expand(count, *shape).flatten(1).clone()
    ups: list[Tensor] = []
    downs: list[Tensor] = []
    to, source, parts = [], [], []
    for dim, up, down in mixing.gains:
        for part, shift, face, kept in ((up, 1, 0, ups), (down, -1, -1, downs)):
            at = number.select(dim - 1, face).reshape(-1)
            made = whole(part)
            to.append(at)
            source.append(torch.roll(number, shift, dim - 1).select(dim - 1, face).reshape(-1))
            parts.append(made[:, at])
            made[:, at] = 0.0
            kept.append(made)
    nothing = torch.zeros(count, 0, number.numel(), dtype=torch.float64)
    joined = lambda x: torch.stack(x, 1) if x else nothing
    wraps = torch.cat(parts, 1) if parts else nothing[:, 0:0, 0]
    there = (wraps > 0).any(0)  # elsewhere no face is periodic
    places = [torch.cat(x)[there] if x else number[:0, 0, 0] for x in (to, source)]
    strides = np.array([number.stride(dim - 1) for dim, _, _ in mixing.gains], np.int64)
    return strides, *packed(
        whole(mixing.stay), joined(ups), joined(downs), *places, wraps[:, there]
    )  # fmt: skip

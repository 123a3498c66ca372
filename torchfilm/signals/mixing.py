"""One exchange of all voxels with their neighbours: P = I + T/λ of an operator T."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.signals.transport_operator import Operator


@dataclass(frozen=True, eq=False)
class Mixing:
    """P = I + T/λ in float64, without its gain: stay (B or 1, nx, ny, nz), the part of its content
    that a voxel keeps; gains: for each axis with neighbours (dimension, from the voxel below, from
    the voxel above). A voxel at a face gets from the opposite one, with a part of 0 unless the axis
    is periodic."""

    stay: Tensor
    gains: tuple[tuple[int, Tensor, Tensor], ...]

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

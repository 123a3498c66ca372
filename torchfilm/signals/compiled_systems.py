"""Linear systems of transport by kernels, on the CPU: those of steps whose derivatives are wanted,
and of the derivatives themselves. Steps without derivatives are solved within their kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.mixing import mixing_arrays, mixing_of, packed, rate_above
from torchfilm.signals.transport_operator import Operator
from torchfilm.tools import subnormals
from torchfilm.tools.numba_calls import unavailable
from torchfilm.tools.tangents import no_derivatives
from torchfilm.tools.threads import Shared


@dataclass(frozen=True, eq=False)
class Systems:
    """(I − part · T) x = b of an operator T, or of Tᵀ, for each colony. arrays: as
    `kernels.transport_solve.solve_systems` takes them, to `many`."""

    arrays: tuple[np.ndarray, ...]
    symmetric: bool
    shared: Shared

    @staticmethod
    def of(operator: Operator, part: float, transposed: bool) -> Systems:
        with no_derivatives():
            # what voxels lose otherwise may be a million times as much: rounding would hide them
            exchanged = (operator.loss - operator.decay).flatten(1).amax(1)
            rate = rate_above(exchanged)
            mixing = mixing_of(operator, rate.reshape(-1, 1, 1, 1))
            mixing = mixing.transposed() if transposed else mixing
            count = max(rate.numel(), mixing.colonies)
            many = (part * rate).expand(count)
            arrays = mixing_arrays(mixing, operator.shape, count)
        return Systems((*arrays, *packed(many)), operator.symmetric, Shared())

    def solved(
        self, b: Tensor, start: Tensor, weight: Tensor | None, limits: tuple[float, float, int]
    ) -> tuple[Tensor, Tensor]:
        """The solutions, (B, nx, ny, nz) float64, and whether each converged, (B,). weight: as of
        `transport_iterative.krylov`. limits: the residual allowed, its rounding, and iterations
        before a restart."""
        from torchfilm.kernels.transport_solve import solve_systems

        right, found = b.flatten(1).contiguous(), start.flatten(1).contiguous().clone()
        good = torch.zeros(b.shape[0], dtype=torch.bool)
        each = torch.zeros(0, found.shape[1], dtype=b.dtype)
        if weight is not None:
            each = weight.expand(-1, *b.shape[1:]).flatten(1).contiguous()
        tolerance, rounding, most = limits
        given = *self.arrays, each.numpy(), tolerance, rounding, self.symmetric, most
        out = right.numpy(), found.numpy(), good.numpy()
        with subnormals.as_zero():
            self.shared(len(good), lambda begin, end: solve_systems(begin, end, *given, *out))
        return found.view(b.shape), good


def may_solve(operator: Operator) -> bool:
    """Whether kernels may solve systems of this operator."""
    return operator.device.type == "cpu" and not unavailable()

"""Transport by compiled kernels, on the CPU where no gradient is wanted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.compiled import may_run
from torchfilm.signals.grid import Shape
from torchfilm.signals.transport_exponential import Exponential
from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.threads import shares_of

# A thread is worth starting for as many voxels.
WORTH_A_THREAD = 1 << 17


@dataclass(frozen=True, eq=False)
class CompiledExponential:
    """`Exponential` for one shape of grid, in arrays as `kernels.transport.carry` takes them."""

    shape: Shape
    axes: np.ndarray
    factors: tuple[np.ndarray, ...]
    firsts: tuple[np.ndarray, ...]
    lasts: tuple[np.ndarray, ...]
    gained: np.ndarray

    def step(self, values: Tensor, starts: np.ndarray, out: Tensor) -> None:
        """Put the grids that begin at `starts` of values (voxels,) into out, one step later."""
        from torchfilm.kernels.transport import carry

        source, target = as_array(values, values.dtype), out.numpy()
        size = self.shape[0] * self.shape[1] * self.shape[2]
        shares_of(
            starts.size,
            max(1, WORTH_A_THREAD // size),
            lambda begin, end: carry(
                begin, end, starts, self.shape, self.axes, self.factors, self.firsts, self.lasts,
                self.gained, source, target,
            ),
        )  # fmt: skip


def compiled_exponential(stepper: Exponential, shape: Shape) -> CompiledExponential | None:
    """The same step compiled, or None where kernels may not run it."""
    given = [x for x in (*stepper.factors, stepper.gained) if x is not None]
    if not may_run(*given):
        return None
    last = max((k for k in range(3) if shape[k] > 1), default=0)
    dtype = given[0].dtype
    factors, firsts, lasts = [], [], []
    for k, factor in enumerate(stepper.factors):
        whole = torch.empty(0, 0, 0, dtype=dtype) if factor is None else factor.detach()
        whole = whole[:, : shape[k], : shape[k]]
        there = whole.transpose(1, 2) > 0
        number = torch.arange(1, there.shape[2] + 1)
        # from the first voxel that gives anything to a voxel, to the last
        ends = torch.where(there, number, 0).amax(2) if there.numel() else number.reshape(0, 0)
        begins = torch.where(there, number, shape[k] + 1)
        begins = begins.amin(2) - 1 if there.numel() else ends
        firsts.append(torch.minimum(begins, ends).numpy())
        lasts.append(ends.numpy())
        factors.append(as_array(whole if k == last else whole.transpose(1, 2), dtype))
    axes = np.array([k for k, f in enumerate(stepper.factors) if f is not None], np.int64)
    gained = torch.empty(0, 0, dtype=dtype) if stepper.gained is None else stepper.gained
    return CompiledExponential(
        shape, axes, tuple(factors), tuple(firsts), tuple(lasts),
        as_array(gained.flatten(1), dtype),
    )  # fmt: skip

"""Exchange between cells and grid by compiled kernels, on the CPU where no gradient is wanted."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.grid import Grid
from torchfilm.signals.stencil import SLACK, Stencil
from torchfilm.tools.numba_calls import as_array, unavailable
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import both, only_forward, tracked, with_tangent
from torchfilm.tools.threads import shares_of

WORTH_A_THREAD = 20_000  # cells for which another thread is worth to be woken


def may_run(*given: Tensor) -> bool:
    """Whether kernels may take these tensors."""
    if given[0].device.type != "cpu" or unavailable():
        return False
    return not tracked(*given)


def may_run_forward(*given: Tensor) -> bool:
    """Whether kernels may take these tensors without their tangents, which some of them carry."""
    return given[0].device.type == "cpu" and only_forward(*given) and not unavailable()


def stencil(
    grid: Grid,
    position: Tensor,
    colony: Tensor,
    periodic: tuple[bool, bool, bool],
    mask: Tensor | None,
    dtype: torch.dtype,
) -> Stencil:
    """As `exchange.stencil`."""
    from torchfilm.kernels.medium import put_stencil

    count = position.shape[0]
    used = (grid.shape > 1).any(0)
    node = torch.empty(count, 2 ** int(used.sum()), dtype=torch.int64)
    weight = torch.empty(node.shape, dtype=dtype)
    outside, blocked = torch.zeros(2, count, dtype=torch.bool)
    cells = as_array(position, torch.float64), as_array(colony, torch.int64)
    grids = (
        grid.origin.numpy(), grid.step.numpy(), grid.shape.numpy(), grid.offsets.numpy(),
        used.numpy(), torch.tensor(periodic).numpy(), SLACK,
        torch.empty(0, dtype=torch.bool).numpy() if mask is None else mask.numpy(),
    )  # fmt: skip
    out = [x.numpy() for x in (node, weight, outside, blocked)]
    shares_of(
        count,
        WORTH_A_THREAD,
        lambda a, b: put_stencil(*(x[a:b] for x in cells), *grids, *(x[a:b] for x in out)),
    )
    return Stencil(
        node, weight, outside, grid.voxel_volume, grid.nodes, None if mask is None else blocked
    )


def read(values: Tensor, stencil: Stencil) -> Tensor:
    """As `exchange.read`."""
    from torchfilm.kernels.medium import read as put

    dtype = values.dtype
    out = torch.empty(stencil.node.shape[0], dtype=dtype)
    weight = as_array(stencil.weight, dtype)
    found, of_cells = as_array(values, dtype), (stencil.node.numpy(), weight, out.numpy())
    shares_of(len(out), WORTH_A_THREAD, lambda a, b: put(found, *(x[a:b] for x in of_cells)))
    return out


def read_with_tangent(values: Tensor, stencil: Stencil) -> Tensor:
    """As `read`, of values with a tangent: what is read is linear in them."""
    value, moved = both(values)
    return with_tangent(
        read(value, stencil), None if moved is None else read(moved.contiguous(), stencil)
    )


def pool_volume(stencil: Stencil) -> Tensor:
    """As `exchange.pool_volume`."""
    from torchfilm.kernels.medium import pools

    weight = stencil.weight.detach()
    out, sums = torch.empty_like(weight[:, 0]), weight.new_zeros(stencil.nodes)
    volume = torch.tensor(stencil.voxel_volume, dtype=weight.dtype).numpy()[()]
    pools(stencil.node.numpy(), weight.numpy(), volume, sums.numpy(), out.numpy())
    return out


def write(values: Tensor, amount: Tensor, there: Tensor, stencil: Stencil, ulps: int) -> Tensor:
    """As `exchange.write`; there: what `read` gives."""
    from torchfilm.kernels.medium import write as put

    taken, given = torch.zeros(2, values.numel(), dtype=values.dtype)
    out = torch.empty_like(values)
    of_medium = _of_stencil(stencil, values.dtype, ulps)
    put(
        *(as_array(x, values.dtype) for x in (values, amount, there)), *of_medium, taken.numpy(),
        given.numpy(), out.numpy(),
    )  # fmt: skip
    return out


def write_with_tangent(
    values: Tensor, amount: Tensor, there: Tensor, stencil: Stencil, ulps: int
) -> Tensor:
    """As `write`, with the tangent of `exchange.write`."""
    from torchfilm.kernels.medium import write_moved as put

    dtype = values.dtype
    plain = [both(x) for x in (values, amount, there)]
    pairs = [(x, torch.zeros_like(x) if t is None else t) for x, t in plain]
    sums, moved = torch.zeros(3, values.numel(), dtype=dtype), torch.empty_like(plain[0][0])
    put(
        *(as_array(x, dtype) for pair in pairs for x in pair),
        *_of_stencil(stencil, dtype, ulps), sums.numpy(), moved.numpy(),
    )  # fmt: skip
    (value, _), (change, _), (found, _) = pairs
    return with_tangent(write(value, change, found, stencil, ulps), moved)


def _of_stencil(
    stencil: Stencil, dtype: torch.dtype, ulps: int
) -> tuple[np.ndarray, np.ndarray, Any, Any]:
    """Nodes, weights, the volume of a voxel, and the share up to which a voxel counts as emptied,
    as kernels take them."""
    near_one = torch.tensor(1 + ulps * torch.finfo(dtype).eps, dtype=dtype).numpy()[()]
    volume = torch.tensor(stencil.voxel_volume, dtype=dtype).numpy()[()]
    return stencil.node.numpy(), as_array(stencil.weight, dtype), volume, near_one


def spans(position: Tensor, groups: Groups) -> tuple[Tensor, Tensor]:
    """As `exchange.spans`."""
    from torchfilm.kernels.medium import spans as put

    low = torch.full((groups.size, 3), torch.inf, dtype=torch.float64)
    high = -low
    put(
        as_array(position, torch.float64), as_array(groups.owner, torch.int64), low.numpy(),
        high.numpy(),
    )  # fmt: skip
    return low, high


def beyond(
    grid: Grid, position: Tensor, groups: Groups, periodic: tuple[bool, bool, bool]
) -> tuple[Tensor, Tensor]:
    """As `exchange.beyond`."""
    from torchfilm.kernels.medium import beyond as put

    left = torch.zeros(groups.size, dtype=torch.int64)
    first = torch.full_like(left, position.shape[0])
    put(
        as_array(position, torch.float64), as_array(groups.owner, torch.int64), grid.origin.numpy(),
        grid.step.numpy(), grid.shape.numpy(), torch.tensor(periodic).numpy(), SLACK, left.numpy(),
        first.numpy(),
    )  # fmt: skip
    return left, first

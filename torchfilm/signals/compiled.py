"""Exchange between cells and grid by compiled kernels, on the CPU where no gradient is wanted."""

from __future__ import annotations

import threading
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

CLOSE = torch.contiguous_format
NO_MASK = np.zeros(0, bool)
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

    count, used = position.shape[0], grid.used
    node = torch.empty(count, 2 ** sum(used), dtype=torch.int64)
    weight = torch.empty(node.shape, dtype=dtype)
    outside, blocked = torch.zeros(2, count, dtype=torch.bool)
    cells = as_array(position, torch.float64), as_array(colony, torch.int64)
    grids = (
        grid.origin.numpy(), grid.step.numpy(), grid.shape.numpy(), grid.offsets.numpy(),
        np.array(used), np.array(periodic), SLACK, NO_MASK if mask is None else mask.numpy(),
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

    weight = as_array(stencil.weight, stencil.weight.dtype)
    out = torch.empty(len(weight), dtype=stencil.weight.dtype)
    volume = weight.dtype.type(stencil.voxel_volume)
    sums = _zeros(stencil.nodes, 1, weight.dtype).reshape(-1)
    pools(stencil.node.numpy(), weight, volume, sums, out.numpy())
    return out


def write(values: Tensor, amount: Tensor, there: Tensor, stencil: Stencil, ulps: int) -> Tensor:
    """As `exchange.write`; there: what `read` gives."""
    from torchfilm.kernels.medium import write as put

    out = values.detach().clone(memory_format=CLOSE)
    each = (as_array(x, values.dtype) for x in (amount, there))
    of_medium = _of_stencil(stencil, values.dtype, ulps)
    sums = _zeros(values.numel(), 2, of_medium[1].dtype)
    put(out.numpy(), *each, *of_medium, sums, _room(stencil.node.numel()))
    return out


def write_with_tangent(
    values: Tensor, amount: Tensor, there: Tensor, stencil: Stencil, ulps: int
) -> Tensor:
    """As `write`, with the tangent of `exchange.write`."""
    from torchfilm.kernels.medium import write_moved as put

    dtype = values.dtype
    (value, change), *pairs = [both(x) for x in (values, amount, there)]
    moved = torch.zeros_like(value) if change is None else change.clone(memory_format=CLOSE)
    (amount, _), (there, _) = pairs
    each = [y for x, t in pairs for y in (x, torch.zeros_like(x) if t is None else t)]
    of_medium = _of_stencil(stencil, dtype, ulps)
    put(
        *(as_array(x, dtype) for x in (value, moved, *each)), *of_medium,
        _zeros(value.numel(), 3, of_medium[1].dtype),
    )  # fmt: skip
    return with_tangent(write(value, amount, there, stencil, ulps), moved)


# of each type of numbers, what the last use left as 0
_kept = threading.local()
MOST_KEPT = 2**22  # numbers


def _zeros(rows: int, size: int, dtype: Any) -> np.ndarray:
    """(rows, size) of 0, for a kernel that leaves it so: setting all voxels to 0 takes longer than
    what is done where cells are."""
    if rows * size > MOST_KEPT:
        return np.zeros((rows, size), dtype)
    found = getattr(_kept, dtype.char, None)
    if found is None or len(found) < rows * size:
        found = np.zeros(rows * size, dtype)
        setattr(_kept, dtype.char, found)
    return found[: rows * size].reshape(rows, size)


def _room(size: int) -> np.ndarray:
    """(size,) int64 of anything."""
    if size > MOST_KEPT:
        return np.empty(size, np.int64)
    found = getattr(_kept, "room", None)
    if found is None or len(found) < size:
        found = _kept.room = np.empty(size, np.int64)
    return found


def _of_stencil(
    stencil: Stencil, dtype: torch.dtype, ulps: int
) -> tuple[np.ndarray, np.ndarray, Any, Any]:
    """Nodes, weights, the volume of a voxel, and the share up to which a voxel counts as emptied,
    as kernels take them."""
    weight, near_one = as_array(stencil.weight, dtype), 1 + ulps * torch.finfo(dtype).eps
    number = weight.dtype.type
    return stencil.node.numpy(), weight, number(stencil.voxel_volume), number(near_one)


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

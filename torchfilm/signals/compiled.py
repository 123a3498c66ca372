"""Exchange between cells and grid by compiled kernels, on the CPU where no gradient is wanted."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.grid import Grid
from torchfilm.signals.stencil import SLACK, Stencil
from torchfilm.tools.numba_calls import as_array, in_numpy, unavailable
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import both, only_forward, tracked, with_tangent
from torchfilm.tools.threads import Shared

CLOSE = torch.contiguous_format
NO_MASK = np.zeros(0, bool)
_put_stencils, _read_cells, _share_pools, _write_cells = (Shared() for _ in range(4))


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

    count, number = position.shape[0], in_numpy(dtype)
    shape = count, 2 ** sum(grid.used)
    node, weight = np.empty(shape, np.int64), np.empty(shape, number)
    outside, blocked = np.empty(count, bool), np.zeros(count, bool)
    cells = as_array(position, torch.float64), as_array(colony, torch.int64)
    fixed = np.array(periodic), SLACK, NO_MASK if mask is None else mask.numpy()
    out = node, weight, outside, blocked

    def work(a: int, b: int) -> None:
        put_stencil(*(x[a:b] for x in cells), *grid.arrays, *fixed, *(x[a:b] for x in out))

    _put_stencils(count, work)
    nodes, weights, away, within = map(torch.from_numpy, out)
    size = grid.voxel_volume, grid.nodes
    return Stencil(nodes, weights, away, *size, None if mask is None else within)


def read(values: Tensor, stencil: Stencil) -> Tensor:
    """As `exchange.read`."""
    from torchfilm.kernels.medium import read as put

    found = as_array(values, values.dtype)
    node, weight = _of_stencil(stencil, values.dtype)
    out = np.empty(len(node), found.dtype)
    work = lambda a, b: put(found, node[a:b], weight[a:b], out[a:b])
    _read_cells(len(out), work)
    return torch.from_numpy(out)


def read_with_tangent(values: Tensor, stencil: Stencil) -> Tensor:
    """As `read`, of values with a tangent: what is read is linear in them."""
    value, moved = both(values)
    return with_tangent(
        read(value, stencil), None if moved is None else read(moved.contiguous(), stencil)
    )


def pool_volume(stencil: Stencil) -> Tensor:
    """As `exchange.pool_volume`."""
    from torchfilm.kernels.medium import pools

    node, weight = stencil.arrays
    out, volume = np.empty(len(weight), weight.dtype), weight.dtype.type(stencil.voxel_volume)
    sums = _zeros(stencil.nodes, 1, weight.dtype).reshape(-1)

    def work(a: int, b: int) -> None:
        pools(node[a:b], weight[a:b], volume, sums, out[a:b])

    _in_parts(_share_pools, stencil, work)
    return torch.from_numpy(out)


def write(values: Tensor, amount: Tensor, there: Tensor, stencil: Stencil, ulps: int) -> Tensor:
    """As `exchange.write`; there: what `read` gives."""
    from torchfilm.kernels.medium import write as put

    out = values.detach().clone(memory_format=CLOSE)
    node, weight = _of_stencil(stencil, values.dtype)
    cells = *(as_array(x, values.dtype) for x in (amount, there)), node, weight
    rest = *_limits(stencil, values.dtype, ulps), _zeros(values.numel(), 2, weight.dtype)
    made, seen, size = out.numpy(), _room(node.size), node.shape[1]

    def work(a: int, b: int) -> None:
        put(made, *(x[a:b] for x in cells), *rest, seen[a * size : b * size])

    _in_parts(_write_cells, stencil, work)
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
    node, weight = _of_stencil(stencil, dtype)
    put(
        *(as_array(x, dtype) for x in (value, moved, *each)), node, weight,
        *_limits(stencil, dtype, ulps), _zeros(value.numel(), 3, weight.dtype),
    )  # fmt: skip
    return with_tangent(write(value, amount, there, stencil, ulps), moved)


def _in_parts(shared: Shared, stencil: Stencil, work: Callable[[int, int], object]) -> None:
    """Call work(a, b) for ranges of cells of whole colonies, which share no voxel."""
    ends = stencil.parts.tolist()
    shared(len(ends) - 1, lambda first, last: work(ends[first], ends[last]))


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


def _of_stencil(stencil: Stencil, dtype: torch.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Nodes, and weights of this type."""
    node, weight = stencil.arrays
    return node, weight.astype(in_numpy(dtype), copy=False)


def _limits(stencil: Stencil, dtype: torch.dtype, ulps: int) -> tuple[Any, Any]:
    """The volume of a voxel, and the share up to which a voxel counts as emptied, as kernels take
    them."""
    number = in_numpy(dtype)
    return number(stencil.voxel_volume), number(1 + ulps * torch.finfo(dtype).eps)


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
        as_array(position, torch.float64), as_array(groups.owner, torch.int64), *grid.arrays[:3],
        torch.tensor(periodic).numpy(), SLACK, left.numpy(),
        first.numpy(),
    )  # fmt: skip
    return left, first

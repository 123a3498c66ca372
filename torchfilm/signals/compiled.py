"""Exchange between cells and grid by compiled kernels, on the CPU where no gradient is wanted."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.grid import Grid
from torchfilm.signals.stencil import SLACK, Stencil
from torchfilm.tools.numba_calls import as_array, in_numpy, unavailable
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import both, only_forward, tracked, with_tangent
from torchfilm.tools.threads import Loop, Shared

# what does a range of cells
Work = Callable[[int, int], object]

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
    out, work = stencil_loop(grid, position, colony, periodic, mask, dtype)
    _put_stencils(len(out[0]), work)
    return as_stencil(grid, out, mask is not None)


# node, weight, outside and blocked of a stencil
StencilArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def as_stencil(
    grid: Grid, arrays: StencilArrays, masked: bool, ends: np.ndarray | None = None
) -> Stencil:
    nodes, weights, away, within = map(torch.from_numpy, arrays)
    size = grid.voxel_volume, grid.nodes
    return Stencil(nodes, weights, away, *size, within if masked else None, ends)


def stencil_loop(
    grid: Grid,
    position: Tensor,
    colony: Tensor,
    periodic: tuple[bool, bool, bool],
    mask: Tensor | None,
    dtype: torch.dtype,
) -> tuple[StencilArrays, Work]:
    """Arrays of a stencil, and what fills them for a range of cells."""
    from torchfilm.kernels.medium import put_stencil

    count, number = position.shape[0], in_numpy(dtype)
    shape = count, 2 ** sum(grid.used)
    node, weight = np.empty(shape, np.int64), np.empty(shape, number)
    outside, blocked = np.empty(count, bool), np.zeros(count, bool)
    out = node, weight, outside, blocked
    at, own = as_array(position, torch.float64), as_array(colony, torch.int64)
    fixed = *grid.arrays, periodic, SLACK, NO_MASK if mask is None else mask.numpy()

    def work(a: int, b: int) -> None:
        put_stencil(at[a:b], own[a:b], *fixed, *(x[a:b] for x in out))

    return out, work


def read(values: Tensor, stencil: Stencil) -> Tensor:
    """As `exchange.read`."""
    found = as_array(values, values.dtype)
    out, work = read_loop(found, *_of_stencil(stencil, values.dtype))
    _read_cells(len(out), work)
    return torch.from_numpy(out)


def read_loop(values: np.ndarray, node: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, Work]:
    """What `read` gives, and what fills it."""
    from torchfilm.kernels.medium import read as put

    out = np.empty(len(node), values.dtype)
    return out, lambda a, b: put(values, node[a:b], weight[a:b], out[a:b])


def read_with_tangent(values: Tensor, stencil: Stencil) -> Tensor:
    """As `read`, of values with a tangent: what is read is linear in them."""
    value, moved = both(values)
    return with_tangent(
        read(value, stencil), None if moved is None else read(moved.contiguous(), stencil)
    )


def pool_volume(stencil: Stencil) -> Tensor:
    """As `exchange.pool_volume`."""
    out, work = pool_loop(*stencil.arrays, stencil.voxel_volume, stencil.nodes)
    _share_pools(len(out), work, stencil.parts)
    return torch.from_numpy(out)


def pool_loop(
    node: np.ndarray, weight: np.ndarray, voxel_volume: float, nodes: int
) -> tuple[np.ndarray, Work]:
    """What `pool_volume` gives, and what fills it for a range of whole colonies."""
    from torchfilm.kernels.medium import pools

    out, volume = np.empty(len(weight), weight.dtype), weight.dtype.type(voxel_volume)
    sums = _zeros(nodes, 2, weight.dtype)
    return out, lambda a, b: pools(node[a:b], weight[a:b], volume, sums, out[a:b])


def write(values: Tensor, amount: Tensor, there: Tensor, stencil: Stencil, ulps: int) -> Tensor:
    """As `exchange.write`; there: what `read` gives."""
    given = as_array(amount, values.dtype), as_array(there, values.dtype)
    arrays = _of_stencil(stencil, values.dtype)
    out, work = write_loop(values, *given, *arrays, stencil.voxel_volume, ulps)
    _write_cells(len(amount), work, stencil.parts)
    return out


def write_loop(
    values: Tensor, amount: np.ndarray, there: np.ndarray, node: np.ndarray, weight: np.ndarray,
    voxel_volume: float, ulps: int,
) -> tuple[Tensor, Work]:  # fmt: skip
    """What `write` gives, so far only where no cell writes, and what puts the rest there for a
    range of whole colonies. All arrays are of one type."""
    from torchfilm.kernels.medium import write as put

    out = values.detach().clone(memory_format=CLOSE)
    # each colony has its own part of these, which all loops of an exchange use
    sums, seen = _zeros(values.numel(), 2, weight.dtype), _room(node.size)
    fixed, made, size = _limits(voxel_volume, values.dtype, ulps), out.numpy(), node.shape[1]

    def work(a: int, b: int) -> None:
        put(
            made, amount[a:b], there[a:b], node[a:b], weight[a:b], *fixed, sums,
            seen[a * size : b * size],
        )  # fmt: skip

    return out, work


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
        *_limits(stencil.voxel_volume, dtype, ulps), _zeros(value.numel(), 3, weight.dtype),
    )  # fmt: skip
    return with_tangent(write(value, amount, there, stencil, ulps), moved)


class Meeting:
    """Cells that meet the medium, and what they find there and give to it, by loops over cells
    side by side in their colonies. What it tells has its numbers when its loops have been run.

    ends: where the cells of each colony begin, and N. values: of each signal, (nodes,) by name; all
    of one type.
    """

    def __init__(
        self, grid: Grid, position: Tensor, colony: Tensor, ends: np.ndarray,
        periodic: tuple[bool, bool, bool], mask: Tensor | None, values: Mapping[str, Tensor],
        dtype: torch.dtype,
    ):  # fmt: skip
        self.values, self.ends, self._grid, self._masked = values, ends, grid, mask is not None
        self._arrays, find = stencil_loop(grid, position, colony, periodic, mask, dtype)
        node, weight, _, _ = self._arrays
        self.loops, self.found = [Loop(find)], {}
        for name, value in values.items():
            self.found[name], find = read_loop(as_array(value, dtype), node, weight)
            self.loops.append(Loop(find))
        self.pool, find = pool_loop(node, weight, grid.voxel_volume, grid.nodes)
        self.loops.append(Loop(find, whole=True))

    @cached_property
    def stencil(self) -> Stencil:
        return as_stencil(self._grid, self._arrays, self._masked, self.ends)

    def written(self, name: str, amount: np.ndarray, ulps: int) -> tuple[Tensor, Loop]:
        """Values (nodes,) of a signal after cells have given amounts (N,) to it, and the loop."""
        made = self.values[name], amount, self.found[name], *self._arrays[:2]
        out, work = write_loop(*made, self._grid.voxel_volume, ulps)
        return out, Loop(work, whole=True)


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


@lru_cache(16)
def _limits(voxel_volume: float, dtype: torch.dtype, ulps: int) -> tuple[Any, Any, Any]:
    """The volume of a voxel, and by how much more than its content rounding alone may take: a part
    of it, and the least; as kernels take them."""
    number, kind = in_numpy(dtype), torch.finfo(dtype)
    slack = ulps * kind.eps
    return number(voxel_volume), number(slack), number(slack * kind.tiny)


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
        periodic, SLACK, left.numpy(), first.numpy(),
    )  # fmt: skip
    return left, first

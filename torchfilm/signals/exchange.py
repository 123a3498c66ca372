"""Exchange between cells and grid: reading a concentration at a cell, and writing what a cell
secretes or takes up.

| model                         | here                                                                              |
|-------------------------------|-----------------------------------------------------------------------------------|
| trilinear interpolation       | `weight` (N, K) of the K voxels `node` (N, K) about each cell; they sum to 1      |
| reading                       | Σ_k weight·value                                                                  |
| secreting an amount a         | weight·a / voxel volume to each voxel: the adjoint of reading                     |
| taking up an amount a         | shared as weight·value, so that no voxel gives what it does not have              |

In a flat field the two ways to share are one.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.signals.grid import Grid
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups

# A cell this part of a voxel beyond a face still counts as inside. Places are float64: 1e5 µm from
# the origin they are rounded by 1e-11 µm, and so is the corner of a box that has been extended; a
# cell that really is outside is so by far more.
SLACK = 1e-6
# Of a voxel that several cells empty together, the parts add up to 1 but for rounding; this many
# units in the last place are taken for 1.
ULPS = 64


@dataclass(frozen=True, eq=False)
class Stencil:
    """Where N cells meet the grid.

    node: (N, K) int64 voxels, the nearest first; weight: (N, K) ≥ 0, with sum 1 (0 for a cell
    wholly inside an obstacle); outside: (N,) bool, cells beyond the box, which read and write at
    its edge, or wholly inside an obstacle, which read 0 and whose writing is lost: what to do with
    either is the caller's to say. blocked: (N,) bool, the latter alone, or None without obstacles.
    """

    node: Tensor
    weight: Tensor
    outside: Tensor
    voxel_volume: float
    nodes: int
    blocked: Tensor | None = None

    @cached_property
    def groups(self) -> Groups:
        """The voxel of each entry of `node`, row by row."""
        return Groups(self.node.reshape(-1), self.nodes)

    def gather(self, values: Tensor) -> Tensor:
        """Values (nodes,) at the stencil's voxels, (N, K)."""
        return values.index_select(0, self.node.reshape(-1)).view(self.node.shape)

    def sum(self, entry: Tensor) -> Tensor:
        """Entries (N, K) summed over each voxel, (nodes,)."""
        return self.groups.sum(entry.reshape(-1, 1)).squeeze(1)


def outside_box(
    grid: Grid, position: Tensor, colony: Tensor, periodic: tuple[bool, bool, bool]
) -> Tensor:
    """Which cells at position (N, 3) are beyond the box of their colony's grid, (N,) bool; a place
    that is not finite is."""
    return _beyond(
        (position - grid.origin.index_select(0, colony)) / grid.step,
        grid.shape.index_select(0, colony),
        periodic,
    )


def _beyond(scaled: Tensor, shape: Tensor, periodic: tuple[bool, bool, bool]) -> Tensor:
    """The same from places (N, 3) in voxels from the lower corner and numbers of voxels (N, 3)."""
    outside = torch.zeros_like(scaled[:, 0], dtype=torch.bool)
    for axis in range(3):
        at, size = scaled[:, axis], shape[:, axis]
        # written so that a NaN is outside
        outside |= (
            ~torch.isfinite(at) if periodic[axis] else ~((at >= -SLACK) & (at <= size + SLACK))
        )
    return outside


def stencil(
    grid: Grid,
    position: Tensor,
    colony: Tensor,
    *,
    periodic: tuple[bool, bool, bool] = (False, False, False),
    mask: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
) -> Stencil:
    """The stencil of cells at position (N, 3) float64, µm, of colonies (N,) int64; differentiable
    in the position.

    Between voxel centres the weights are trilinear; within half a voxel of a face that is not
    periodic, the outermost voxel stands for what is beyond its centre; periodic axes wrap. mask:
    (nodes,) bool, False where an obstacle is; its voxels get weight 0, and the others are scaled up
    to a sum of 1. K = 2^(axes with more than one voxel); weights come in `dtype`.
    """
    if position.dim() != 2 or position.shape[1] != 3:
        raise checks.input_error(
            "position",
            tuple(position.shape),
            "of shape (cells, 3)",
            "A 2-D colony has its cells at one height in its layer.",
        )
    if mask is not None and (mask.shape != (grid.nodes,) or mask.dtype != torch.bool):
        raise checks.input_error(
            "mask", (tuple(mask.shape), mask.dtype), f"bool of shape ({grid.nodes},)"
        )
    shape = grid.shape.index_select(0, colony)
    # in voxels from the lower corner
    scaled = (position - grid.origin.index_select(0, colony)) / grid.step
    used = [axis for axis in range(3) if any(s[axis] > 1 for s in grid.shapes)]
    outside = _beyond(scaled, shape, periodic)
    sides: list[tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]] = []
    for axis in range(3):
        if axis in used:
            sides.append(_two_voxels(scaled[:, axis] - 0.5, shape[:, axis], periodic[axis], dtype))
    node, weight = [], []
    strides = {0: shape[:, 1] * shape[:, 2], 1: shape[:, 2], 2: torch.ones_like(colony)}
    first = grid.offsets.index_select(0, colony)
    for corner in itertools.product((0, 1), repeat=len(used)):
        n, w = first, torch.ones_like(scaled[:, 0], dtype=dtype)
        for axis, side, pair in zip(used, corner, sides, strict=True):
            n = n + pair[side][0] * strides[axis]
            w = w * pair[side][1]
        node.append(n)
        weight.append(w)
    blocked = None
    if mask is not None:
        weight = [w * mask.index_select(0, n).to(dtype) for n, w in zip(node, weight, strict=True)]
        total = _add(weight)
        blocked = total <= 0
        outside |= blocked
        weight = [w / torch.where(total > 0, total, 1.0) for w in weight]
        node, weight = _heaviest_first(node, weight)
    # the heaviest takes what is left of 1, so that the sum is 1 to its last bit
    weight[0] = (
        torch.where(weight[0] > 0, 1 - _add(weight[1:]), 0.0) if len(weight) > 1 else weight[0]
    )
    return Stencil(
        torch.stack(node, 1),
        torch.stack(weight, 1),
        outside,
        grid.voxel_volume,
        grid.nodes,
        blocked,
    )


def _two_voxels(
    at: Tensor, size: Tensor, periodic: bool, dtype: torch.dtype
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The nearest voxel along one axis and the next one, each with its weight; `at` (N,) in voxels
    from the centre of the first."""
    at = torch.where(torch.isfinite(at), at, 0.0)
    at = torch.remainder(at, size) if periodic else torch.minimum(at, size - 1.0).clamp(min=0.0)
    near = at.detach().round()
    side = torch.where(at.detach() >= near, 1.0, -1.0)
    far_weight = ((at - near) * side).to(dtype)
    nearest, other = near.to(torch.int64), (near + side).to(torch.int64)
    if periodic:
        nearest, other = torch.remainder(nearest, size), torch.remainder(other, size)
    else:
        other = torch.minimum(other, size - 1).clamp(min=0)  # where its weight is 0
    return (nearest, 1 - far_weight), (other, far_weight)


def _add(columns: list[Tensor]) -> Tensor:
    """Column after column, in an order of its own for every row."""
    out = columns[0]
    for column in columns[1:]:
        out = out + column
    return out


def _heaviest_first(node: list[Tensor], weight: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    nodes, weights = torch.stack(node, 1), torch.stack(weight, 1)
    best = weights.detach().argmax(1, keepdim=True)
    order = torch.arange(nodes.shape[1], device=nodes.device).expand(nodes.shape).clone()
    order.scatter_(1, best, 0)
    order[:, :1] = best
    return list(nodes.gather(1, order).unbind(1)), list(weights.gather(1, order).unbind(1))


def read(values: Tensor, stencil: Stencil) -> Tensor:
    """The concentration at each cell, (N,), from values (nodes,); differentiable in values and
    position.

    Summed as differences from the nearest voxel, whose weight is at least 1/K: so a flat field is
    read exactly, and one that is nowhere negative reads so.
    """
    found, weight = stencil.gather(values).unbind(1), stencil.weight.to(values.dtype).unbind(1)
    nearest = torch.where(weight[0] > 0, found[0], 0.0)
    out = nearest
    for v, w in zip(found[1:], weight[1:], strict=True):
        out = torch.addcmul(out, w, v - nearest)
    return out


def pool_volume(stencil: Stencil) -> Tensor:
    """The volume, µm³, of which each cell may take up all that is there, (N,): voxel volume / W, W
    the greatest sum of weights at its voxels.

    However many cells share a voxel, uptake of at most `read` × this leaves nothing negative: of a
    voxel each takes at most weight / W of what is there. A cell off the middle of its voxel reads,
    and shares, more than one: then W is below 1 and its pool is larger than a voxel.
    """
    crowd = stencil.gather(stencil.sum(stencil.weight))
    worst = torch.where(stencil.weight > 0, crowd, 0.0).amax(1)
    return stencil.voxel_volume / torch.where(worst > 0, worst, 1.0)


def write(values: Tensor, amount: Tensor, stencil: Stencil) -> Tensor:
    """Values (nodes,) after each cell has secreted (amount > 0) or taken up (amount < 0) its amount
    (N,), concentration × µm³.

    Uptake must be at most `read` × `pool_volume`; then every value ≥ 0 stays so exactly. The sum of
    amounts is conserved to rounding: of a voxel that is emptied, what rounding would leave below 0
    (a few units in the last place of what it held) is set to 0. Taking more than that shows as a
    value below 0, or NaN where there was nothing to take. Uptake is taken from the values before
    anything is secreted.
    """
    weight = stencil.weight.to(values.dtype)
    volume = stencil.voxel_volume
    there = read(values, stencil)
    wanted = (-amount).clamp(min=0.0)
    # the part of each voxel's content that a cell with all its weight there takes
    part = wanted / (torch.where(there > 0, there, 1.0) * volume)
    part = torch.where((wanted > 0) & (there <= 0), torch.inf, part)
    taken = stencil.sum(weight * part.unsqueeze(1))
    taken = torch.where(
        (taken > 1) & (taken < 1 + ULPS * torch.finfo(values.dtype).eps), 1.0, taken
    )
    given = stencil.sum(weight * (amount.clamp(min=0.0) / volume).unsqueeze(1))
    return torch.addcmul(values, values, taken, value=-1.0) + given

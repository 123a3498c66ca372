"""Exchange between cells and grid: reading a concentration at a cell, secretion and uptake.

| model                   | here                                                             |
|-------------------------|------------------------------------------------------------------|
| trilinear interpolation | `weight` (N, K) of K voxels `node` (N, K) per cell, with sum 1   |
| reading                 | Σ_k weight·value                                                 |
| secretion of amount a   | weight·a / voxel volume to each voxel: the adjoint of reading    |
| uptake of amount a      | shared as weight·value: no voxel gives more than it has          |

In a uniform field the two ways to share are the same.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals import compiled
from torchfilm.signals.grid import Grid
from torchfilm.signals.stencil import SLACK, Stencil
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups

# Where several cells empty a voxel together, their parts add up to 1 except for rounding. A sum
# within this many units in the last place of the content counts as 1; below the least normal
# number, in the last place of that one.
ULPS = 64


def outside_box(
    grid: Grid, position: Tensor, colony: Tensor, periodic: tuple[bool, bool, bool]
) -> Tensor:
    """Which cells at position (N, 3) are beyond the box of their colony's grid, (N,) bool.

    A position that is not finite counts as outside.
    """
    return _outside_scaled(
        (position - grid.origin.index_select(0, colony)) / grid.step,
        grid.shape.index_select(0, colony),
        periodic,
    )


def spans(position: Tensor, groups: Groups) -> tuple[Tensor, Tensor]:
    """The least and the greatest coordinates of the cells of each colony, (B, 3) each, from
    position (N, 3); inf and −inf in a colony without cells, NaN where one is NaN."""
    if compiled.may_run(position):
        return compiled.spans(position, groups)
    high = torch.stack([groups.max(x, empty=-torch.inf) for x in position.unbind(1)], 1)
    low = -torch.stack([groups.max(-x, empty=-torch.inf) for x in position.unbind(1)], 1)
    return low, high


def beyond(
    grid: Grid, position: Tensor, groups: Groups, periodic: tuple[bool, bool, bool]
) -> tuple[Tensor, Tensor]:
    """How many cells of each colony are beyond the box of its grid, (B,), and the first of them;
    N where there is none."""
    if compiled.may_run(position):
        return compiled.beyond(grid, position, groups, periodic)
    return counted(outside_box(grid, position, groups.owner, periodic), groups)


def counted(away: Tensor, groups: Groups) -> tuple[Tensor, Tensor]:
    """How many rows of each group are `away`, (N,) bool, and the first of them; N without one."""
    number = torch.arange(away.numel(), 0, -1, device=away.device)
    first = away.numel() - groups.max(torch.where(away, number, 0))
    return groups.sum(away.double()).long(), first


def _outside_scaled(scaled: Tensor, shape: Tensor, periodic: tuple[bool, bool, bool]) -> Tensor:
    """As `outside_box`, for positions in voxels from the lower corner (N, 3).

    shape: (N, 3), the numbers of voxels.
    """
    outside = torch.zeros_like(scaled[:, 0], dtype=torch.bool)
    for axis in range(3):
        at, size = scaled[:, axis], shape[:, axis]
        # this form makes a NaN outside
        outside |= (
            ~torch.isfinite(at)
            if periodic[axis]
            else ~((at >= -SLACK) & (at <= size.to(at.dtype) + SLACK))
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
    """The stencil of cells at position (N, 3) float64, µm, of colonies (N,) int64.

    It is differentiable in the position. Between voxel centres the weights are trilinear. Within
    half a voxel of a face that is not periodic, the outermost voxel alone counts. Periodic axes
    wrap. mask: (nodes,) bool, False in an obstacle. Voxels of an obstacle get weight 0, and the
    other weights are scaled to a sum of 1. K = 2^(axes with more than one voxel). dtype: of the
    weights.
    """
    if position.dim() != 2 or position.shape[1] != 3:
        raise checks.input_error(
            "position",
            tuple(position.shape),
            "of shape (cells, 3)",
            "In a 2-D colony all cells have one height in the layer.",
        )
    if mask is not None and (mask.shape != (grid.nodes,) or mask.dtype != torch.bool):
        raise checks.input_error(
            "mask", (tuple(mask.shape), mask.dtype), f"bool of shape ({grid.nodes},)"
        )
    if compiled.may_run(position):
        return compiled.stencil(grid, position, colony, periodic, mask, dtype)
    shape = grid.shape.index_select(0, colony)
    # in voxels from the lower corner
    scaled = (position - grid.origin.index_select(0, colony)) / grid.step
    used = [axis for axis in range(3) if grid.used[axis]]
    outside = _outside_scaled(scaled, shape, periodic)
    node, weight = _corners(grid, scaled, shape, colony, used, periodic, dtype)
    blocked = None
    if mask is not None:
        weight = [w * mask.index_select(0, n).to(dtype) for n, w in zip(node, weight, strict=True)]
        total = _sum_in_order(weight)
        blocked = total <= 0
        outside |= blocked
        weight = [w / torch.where(total > 0, total, 1.0) for w in weight]
        node, weight = _heaviest_first(node, weight)
    # the greatest weight is 1 minus the others, so that the sum is 1 to its last bit
    weight[0] = (
        torch.where(weight[0] > 0, 1 - _sum_in_order(weight[1:]), 0.0)
        if len(weight) > 1
        else weight[0]
    )
    return Stencil(
        torch.stack(node, 1),
        torch.stack(weight, 1),
        outside,
        grid.voxel_volume,
        grid.nodes,
        blocked,
    )


def _corners(
    grid: Grid,
    scaled: Tensor,
    shape: Tensor,
    colony: Tensor,
    used: list[int],
    periodic: tuple[bool, bool, bool],
    dtype: torch.dtype,
) -> tuple[list[Tensor], list[Tensor]]:
    """The 2^len(used) voxels about each cell, (N,) each, the nearest first, and their weights.

    scaled: (N, 3) in voxels from the lower corner. shape: (N, 3). used: axes with more than one
    voxel.
    """
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
    return node, weight


def _two_voxels(
    at: Tensor, size: Tensor, periodic: bool, dtype: torch.dtype
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The nearest voxel along one axis and the next one, each with its weight.

    at: (N,) in voxels from the centre of the first.
    """
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


def _sum_in_order(columns: list[Tensor]) -> Tensor:
    """The sum of columns in their order, which fixes the bits of every row."""
    out = columns[0]
    for column in columns[1:]:
        out = out + column
    return out


def _heaviest_first(node: list[Tensor], weight: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """Each row with its greatest weight moved to the first column."""
    nodes, weights = torch.stack(node, 1), torch.stack(weight, 1)
    best = weights.detach().argmax(1, keepdim=True)
    order = torch.arange(nodes.shape[1], device=nodes.device).expand(nodes.shape).clone()
    order.scatter_(1, best, 0)
    order[:, :1] = best
    return list(nodes.gather(1, order).unbind(1)), list(weights.gather(1, order).unbind(1))


def read(values: Tensor, stencil: Stencil) -> Tensor:
    """The concentration at each cell, (N,), from values (nodes,).

    It is differentiable in values and position. The sum is of differences from the nearest voxel,
    whose weight is at least 1/K. So a uniform field is read exactly, and a non-negative field gives
    a non-negative value.
    """
    if compiled.may_run(values, stencil.weight):
        return compiled.read(values, stencil)
    if compiled.may_run_forward(values) and compiled.may_run(stencil.weight):
        return compiled.read_with_tangent(values, stencil)
    found, weight = stencil.gather(values).unbind(1), stencil.weight.to(values.dtype).unbind(1)
    nearest = torch.where(weight[0] > 0, found[0], 0.0)
    out = nearest
    for v, w in zip(found[1:], weight[1:], strict=True):
        out = torch.addcmul(out, w, v - nearest)
    return out


def pool_volume(stencil: Stencil) -> Tensor:
    """The volume whose whole content a cell may take up, (N,) µm³: voxel volume / W.

    W is the greatest sum of weights at the cell's voxels. However many cells share a voxel, uptake
    of at most `read` × this volume leaves nothing negative: from a voxel each cell takes at most
    weight / W of the content. A cell away from the middle of its voxel reads, and shares, more than
    one voxel. Then W may be below 1 and its pool larger than a voxel.
    """
    if compiled.may_run(stencil.weight):
        return compiled.pool_volume(stencil)
    weight_sums = stencil.gather(stencil.sum(stencil.weight))
    worst = torch.where(stencil.weight > 0, weight_sums, 0.0).amax(1)
    return stencil.voxel_volume / torch.where(worst > 0, worst, 1.0)


def write(values: Tensor, amount: Tensor, stencil: Stencil, there: Tensor | None = None) -> Tensor:
    """Values (nodes,) after secretion (amount > 0) or uptake (amount < 0) by each cell.

    amount: (N,), concentration × µm³. there: (N,), what `read` gives, if it is known. Uptake must
    be at most `read` × `pool_volume`; then every value ≥ 0 stays ≥ 0 exactly. The sum of amounts is
    conserved to rounding: in a voxel that is emptied, a negative rounding error (a few units in the
    last place of its content) is set to 0. A larger uptake shows as a value below 0, or as NaN
    where the voxel was empty. Uptake is taken from the values before secretion.
    """
    there = read(values, stencil) if there is None else there
    if compiled.may_run(values, amount, there):
        return compiled.write(values, amount, there, stencil, ULPS)
    if compiled.may_run_forward(values, amount, there) and compiled.may_run(stencil.weight):
        return compiled.write_with_tangent(values, amount, there, stencil, ULPS)
    weight = stencil.weight.to(values.dtype)
    volume = stencil.voxel_volume
    # halves of amount ± |amount|: at 0 the derivatives of both then add up to 1; but where there is
    # nothing to take all of it is given
    none = 0.5 * torch.where((amount == 0) & (there <= 0), amount, 0.0)
    wanted = 0.5 * (amount.abs() - amount) + none
    added = 0.5 * (amount.abs() + amount) + none
    # the part of a voxel's content that a cell takes if all its weight is there
    part = wanted / (torch.where(there > 0, there, 1.0) * volume)
    part = torch.where((wanted > 0) & (there <= 0), torch.inf, part)
    taken = stencil.sum(weight * part.unsqueeze(1))
    content, kind = values.abs(), torch.finfo(values.dtype)
    slack = ULPS * kind.eps
    rounding = slack * content + slack * kind.tiny
    taken = torch.where((taken > 1) & ((taken - 1) * content < rounding), 1.0, taken)
    given = stencil.sum(weight * (added / volume).unsqueeze(1))
    return torch.addcmul(values, values, taken, value=-1.0) + given


def turns_error(
    diffusion: float, decay: float, grid: Grid, dt: float, strang: bool = True
) -> float:
    """By how much a cell finds its own steady signal too low, relative to it, since cells and
    transport take turns of dt hours.

    diffusion: K, µm²/h. decay: 1/h. The cell is in the middle of the first colony's grid, whose
    faces let nothing pass. Its signal is a sum of cosines; one that relaxes at a rate a has at the
    end of a step (aΔt/2)/sinh(aΔt/2) of its value, or aΔt/(exp(aΔt) − 1) where transport comes last
    and in one piece (not `strang`). Of the mean over the grid, which without decay never rests, it
    takes what an hour brings.
    """
    if diffusion == 0:
        return 0.0
    rate, weight = np.full((1, 1, 1), decay), np.ones((1, 1, 1))
    for axis, (count, step) in enumerate(zip(grid.shapes[0], grid.spacing, strict=True)):
        count = min(count, 65)  # farther faces change nothing
        wave = np.arange(count)
        size = [1, 1, 1]
        size[axis] = count
        height = np.cos(np.pi * wave / count * (count // 2 + 0.5))
        share = np.where(wave == 0, 1, 2) / count * height**2
        rate = rate + (2 * diffusion / step**2 * (1 - np.cos(np.pi * wave / count))).reshape(size)
        weight = weight * share.reshape(size)
    rate[0, 0, 0] = max(decay, 1.0)
    turn = np.minimum(rate * dt, 500.0)
    found = turn / (2 * np.sinh(turn / 2)) if strang else turn / np.expm1(turn)
    return float((weight * found / rate).sum() / (weight / rate).sum() - 1)

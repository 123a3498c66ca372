"""One regular grid of voxels per colony. Grids of a batch may differ in size and grow.

The values of a signal are one flat tensor (nodes,), colony after colony, x slowest and z fastest:
voxel (i, j, k) of an (nx, ny, nz) grid has index (i·ny + j)·nz + k after the first voxel of its
colony. A value is the mean concentration of its voxel. There are always three axes; in 2-D the
third has one voxel, as thick as the layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.ragged import offsets

Shape = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class GridBatch:
    """Colonies with grids of one shape.

    colonies: (b,) int64, their indices in the batch. starts: (b,) int64, their first voxels. index:
    the positions of their values in a flat signal.
    """

    colonies: Tensor
    starts: Tensor
    shape: Shape
    index: Tensor | slice

    def of(self, values: Tensor) -> Tensor:
        """The values of these colonies, (b, nx, ny, nz); a view where they are contiguous."""
        part = (
            values[self.index]
            if isinstance(self.index, slice)
            else values.index_select(0, self.index)
        )
        return part.view(self.colonies.numel(), *self.shape)


@dataclass(frozen=True, eq=False)
class Grid:
    """The grids of B colonies.

    origin: (B, 3) float64, µm, the lower corner of each box. shape: (B, 3) int64, numbers of
    voxels. spacing: µm, the same for all colonies.
    """

    origin: Tensor
    shape: Tensor
    spacing: tuple[float, float, float]

    def __post_init__(self) -> None:
        if (
            self.origin.dim() != 2
            or self.origin.shape[1] != 3
            or self.origin.dtype != torch.float64
        ):
            raise checks.input_error(
                "Grid.origin",
                (tuple(self.origin.shape), self.origin.dtype),
                "a float64 tensor of shape (colonies, 3)",
            )
        if self.shape.shape != self.origin.shape or self.shape.dtype != torch.int64:
            raise checks.input_error(
                "Grid.shape",
                (tuple(self.shape.shape), self.shape.dtype),
                f"an int64 tensor of shape {tuple(self.origin.shape)}",
            )
        spacing = checks.vector("Grid.spacing", self.spacing, 3)
        if min(spacing) <= 0:
            raise checks.input_error("Grid.spacing", self.spacing, "three numbers above 0")
        if not bool((self.shape >= 1).all()):
            raise checks.input_error(
                "Grid.shape", self.shape.tolist(), "at least one voxel along every axis"
            )
        object.__setattr__(self, "spacing", spacing)

    @property
    def colonies(self) -> int:
        return self.origin.shape[0]

    def alike(self, other: Grid) -> bool:
        """Whether another grid has the same voxels."""
        return (
            self.spacing == other.spacing
            and torch.equal(self.shape, other.shape)
            and torch.equal(self.origin, other.origin)
        )

    @property
    def voxel_volume(self) -> float:
        """µm³."""
        return self.spacing[0] * self.spacing[1] * self.spacing[2]

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The shape of each colony's grid, as plain numbers."""
        return tuple((x, y, z) for x, y, z in self.shape.tolist())

    @cached_property
    def used(self) -> tuple[bool, bool, bool]:
        """Along which axes a colony has more than one voxel."""
        x, y, z = (self.shape > 1).any(0).tolist()
        return x, y, z

    @cached_property
    def counts(self) -> Tensor:
        """(B,) int64, voxels of each colony."""
        return self.shape[:, 0] * self.shape[:, 1] * self.shape[:, 2]

    @cached_property
    def offsets(self) -> Tensor:
        """(B + 1,) int64, the start of each colony's values, and the end."""
        return offsets(self.counts)

    @cached_property
    def nodes(self) -> int:
        """The number of voxels of all colonies."""
        return sum(x * y * z for x, y, z in self.shapes)

    @cached_property
    def owner(self) -> Tensor:
        """(nodes,) int64, the colony of each voxel."""
        return torch.repeat_interleave(
            torch.arange(self.colonies, device=self.shape.device),
            self.counts,
            output_size=self.nodes,
        )

    @cached_property
    def step(self) -> Tensor:
        """(3,) float64, the spacing as a tensor."""
        return self.origin.new_tensor(self.spacing)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """On the CPU, for kernels: origin, step, shape, offsets and used."""
        tensors = self.origin, self.step, self.shape, self.offsets
        return *(x.numpy() for x in tensors), np.array(self.used)

    @property
    def high(self) -> Tensor:
        """(B, 3) float64, µm, the upper corners."""
        return self.origin + self.shape * self.step

    @cached_property
    def ijk(self) -> Tensor:
        """(nodes, 3) int64, the indices (i, j, k) of each voxel in its colony's grid."""
        within = torch.arange(self.nodes, device=self.shape.device) - self.offsets.index_select(
            0, self.owner
        )
        ny, nz = (self.shape[:, k].index_select(0, self.owner) for k in (1, 2))
        return torch.stack([within // (ny * nz), within // nz % ny, within % nz], 1)

    def centres(self) -> Tensor:
        """(nodes, 3) float64, µm, the centre of each voxel."""
        return self.origin.index_select(0, self.owner) + (self.ijk + 0.5) * self.step

    @cached_property
    def batches(self) -> tuple[GridBatch, ...]:
        """The colonies grouped by the shape of their grids, each colony in one batch."""
        device = self.shape.device
        found: dict[Shape, list[int]] = {}
        for place, shape in enumerate(self.shapes):
            found.setdefault(shape, []).append(place)
        if len(found) == 1:
            everyone = torch.arange(self.colonies, device=device)
            whole = slice(0, self.nodes)
            return (GridBatch(everyone, self.offsets[:-1], self.shapes[0], whole),)
        out = []
        for shape, mine in found.items():
            here, size = torch.tensor(mine, device=device), shape[0] * shape[1] * shape[2]
            first = self.offsets.index_select(0, here)
            if mine == list(range(mine[0], mine[0] + len(mine))):
                begin = sum(x * y * z for x, y, z in self.shapes[: mine[0]])
                index: Tensor | slice = slice(begin, begin + size * len(mine))
            else:
                index = (first.unsqueeze(1) + torch.arange(size, device=device)).reshape(-1)
            out.append(GridBatch(here, first, shape, index))
        return tuple(out)

    def join(self, parts: Sequence[Tensor]) -> Tensor:
        """Values (nodes,) from those of the `batches`, (b, nx, ny, nz) each, in their order."""
        if len(parts) == 1:
            return parts[0].reshape(-1)
        return torch.cat([part.reshape(-1) for part in parts]).index_select(0, self._join_index)

    @cached_property
    def _join_index(self) -> Tensor:
        """The index that restores the order of voxels after `join` concatenates the batches."""
        everything = torch.arange(self.nodes, device=self.shape.device)
        order = torch.cat([batch.of(everything).reshape(-1) for batch in self.batches])
        return torch.empty_like(order).index_copy_(0, order, everything)

    def extended(
        self,
        values: Sequence[Tensor],
        low: Tensor,
        high: Tensor,
        *,
        block: int = 8,
        fill: Sequence[float | Tensor] | None = None,
    ) -> tuple[Grid, list[Tensor]]:
        """The grid enlarged by blocks of `block` voxels to cover a box, and the signals on it.

        values: signals (nodes,) each. low, high: (B, 3) float64, µm, the box; low = inf and high =
        −inf require nothing along that axis. fill: the value of new voxels for each signal, one
        number or one per colony; default 0. Returns self and the same signals if the grid already
        covers the box.
        """
        if low.shape != self.origin.shape or high.shape != self.origin.shape:
            raise checks.input_error(
                "low, high",
                (tuple(low.shape), tuple(high.shape)),
                f"of shape {tuple(self.origin.shape)}",
            )
        if bool(
            (low == -torch.inf).any()
            | (high == torch.inf).any()
            | low.isnan().any()
            | high.isnan().any()
        ):
            raise checks.input_error(
                "low, high",
                (low.tolist(), high.tolist()),
                "a finite box",
                "Is a cell's position not finite?",
            )
        width = block * self.step
        before, after = (
            torch.ceil(beyond / width).clamp(min=0).to(torch.int64) * block
            for beyond in (self.origin - low, high - self.high)
        )
        if not bool((before + after).any()):
            return self, list(values)
        larger = replace(
            self, origin=self.origin - before * self.step, shape=self.shape + before + after
        )
        at = self.ijk + before.index_select(0, self.owner)
        size = larger.shape.index_select(0, self.owner)
        target = (
            larger.offsets.index_select(0, self.owner)
            + (at[:, 0] * size[:, 1] + at[:, 1]) * size[:, 2]
            + at[:, 2]
        )
        out = []
        for value, new in zip(values, [0.0] * len(values) if fill is None else fill, strict=True):
            if isinstance(new, Tensor) and new.dim() == 1:
                start = new.to(value).index_select(0, larger.owner)
            else:
                start = torch.zeros(larger.nodes, dtype=value.dtype, device=value.device) + new
            out.append(start.index_copy(0, target, value))
        return larger, out

"""Where cells meet the grid: the voxels that each reads and writes, and their weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from torch import Tensor

from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.ragged import Groups

# A cell beyond a face by at most this part of a voxel counts as inside. Positions are float64: 1e5
# µm from the origin they are rounded by 1e-11 µm, and so is the corner of an extended box. A cell
# that really is outside is outside by far more.
SLACK = 1e-6


@dataclass(frozen=True, eq=False)
class Stencil:
    """The voxels at which N cells read and write.

    node: (N, K) int64 voxels, the nearest first. weight: (N, K) ≥ 0, with sum 1, or 0 for a cell
    that is wholly inside an obstacle. outside: (N,) bool, cells beyond the box or wholly inside an
    obstacle. Beyond the box a cell reads and writes at the edge. Inside an obstacle it reads 0 and
    its writing is lost. The caller decides what to do with either. blocked: (N,) bool, cells wholly
    inside an obstacle, or None without obstacles. ends: where the cells of each colony begin, and
    N, where those of one colony are known to be side by side.
    """

    node: Tensor
    weight: Tensor
    outside: Tensor
    voxel_volume: float
    nodes: int
    blocked: Tensor | None = None
    ends: np.ndarray | None = None

    @cached_property
    def parts(self) -> np.ndarray:
        """Where ranges of cells begin that share no voxel, and N."""
        return np.array([0, len(self.weight)]) if self.ends is None else self.ends

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """On the CPU, for kernels: node and weight."""
        return self.node.numpy(), as_array(self.weight, self.weight.dtype)

    @cached_property
    def groups(self) -> Groups:
        """The voxel of each entry of `node`, row by row."""
        # grids of more axes have more entries, of weight 0: sums must not depend on them
        zero = None if self.node.device.type == "cpu" else self.weight.detach().reshape(-1) == 0
        return Groups(self.node.reshape(-1), self.nodes, zero=zero)

    def gather(self, values: Tensor) -> Tensor:
        """Values (nodes,) at the stencil's voxels, (N, K)."""
        return values.index_select(0, self.node.reshape(-1)).view(self.node.shape)

    def sum(self, entry: Tensor) -> Tensor:
        """Entries (N, K) summed over each voxel, (nodes,)."""
        return self.groups.sum(entry.reshape(-1, 1)).squeeze(1)

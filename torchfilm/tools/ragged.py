"""Sums and maxima over ragged groups, each group in its own fixed order.

All scatter operations of the package are in this module. On the CPU a sum over groups is a product
with a sparse incidence matrix. It is six times faster than ``index_add_``. Every row of the product
is accumulated by itself in the order of its entries, so its bits do not depend on the rest of the
batch. (The matrix-vector product of the same library does *not* have that property: it picks a
kernel by the shape of the whole matrix. So it is the matrix-matrix product even for one column.)

Weighted float32 segment sums use ``torch.embedding_bag``: half the time of weighting and summing,
in a fixed order. On CUDA ``index_add_`` is fast, and ordered when torch's deterministic algorithms
are on.
"""

from __future__ import annotations

import math
import warnings
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

# Without fbgemm a plain loop sums the bags, many times slower.
FAST_BAGS = "fbgemm" in torch.backends.quantized.supported_engines

warnings.filterwarnings(
    "ignore", message="Sparse CSR tensor support is in beta", category=UserWarning
)


def csr(row_start: Tensor, column: Tensor, value: Tensor, size: tuple[int, int]) -> Tensor:
    """A sparse CSR matrix with 32-bit indices, which the CPU multiplies without conversion."""
    return torch.sparse_csr_tensor(
        row_start.int(), column.int(), value, size, check_invariants=False
    )


def offsets(counts: Tensor) -> Tensor:
    """Start of each group and the end of the last: (B,) counts -> (B + 1,) int64."""
    out = counts.new_zeros(counts.numel() + 1, dtype=torch.int64)
    torch.cumsum(counts, 0, out=out[1:])
    return out


def expand_ranges(start: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Write out ranges: for each i the numbers start[i] … start[i] + count[i] − 1.

    Returns (owner, value), each as long as the sum of the counts; owner is the i of each value.
    """
    owner = torch.repeat_interleave(torch.arange(count.numel(), device=count.device), count)
    shift = start - (torch.cumsum(count, 0) - count)
    value = torch.arange(owner.numel(), device=count.device) + shift.index_select(0, owner)
    return owner, value


class Groups:
    """Sums and maxima over groups of rows; rows may have any order.

    Rows 0 … K − 1 belong to groups 0 … size − 1.

    `owner`: (K,) int64, the group of each row.
    """

    def __init__(self, owner: Tensor, size: int):
        self.owner, self.size = owner, size
        self._matrix: dict[torch.dtype, Tensor] = {}

    @cached_property
    def counts(self) -> Tensor:
        """(size,) int64, rows in each group."""
        return torch.bincount(self.owner, minlength=self.size)

    @cached_property
    def order(self) -> tuple[Tensor, Tensor]:
        """The rows sorted by group, in their own order within each group.

        Returns the start of each group and the end of the last, (size + 1,), and the rows, (K,)
        int32.
        """
        count = self.owner.numel()
        if bool((self.owner[1:] >= self.owner[:-1]).all()):
            return offsets(self.counts).int(), torch.arange(count, dtype=torch.int32)
        # linear time and stable; a sort would cost more than all the sums of a solve
        entries = (
            np.ones(count, np.int8),
            self.owner.int().numpy(),
            np.arange(count + 1, dtype=np.int32),
        )
        from scipy.sparse import (
            csc_array,
        )  # imported where it is used: it takes longer to load than torchfilm itself

        found = csc_array(entries, shape=(self.size, count)).tocsr()
        return torch.from_numpy(found.indptr), torch.from_numpy(found.indices)

    def _incidence(self, dtype: torch.dtype) -> Tensor:
        """The (size, K) matrix of ones that sums rows into groups, on the CPU."""
        if dtype not in self._matrix:
            count = self.owner.numel()
            self._matrix[dtype] = csr(
                *self.order, torch.ones(count, dtype=dtype), (self.size, count)
            )
        return self._matrix[dtype]

    def sum(self, value: Tensor) -> Tensor:
        """Sum rows (K, …) into groups (size, …); differentiable."""
        flat = value.reshape(value.shape[0], math.prod(value.shape[1:]))
        return _GroupSum.apply(flat, self).reshape(self.size, *value.shape[1:])

    def sum_into(self, value: Tensor, out: Tensor) -> Tensor:
        """Like `sum` for (K, D) into (size, D), without gradient or allocation on the CPU."""
        if self.owner.numel() == 0 or value.device.type != "cpu":
            return out.zero_().index_add_(0, self.owner, value)
        return torch.mm(self._incidence(value.dtype), value, out=out)

    def max(self, value: Tensor, empty: float = 0.0) -> Tensor:
        """The maximum of each group, (K,) -> (size,); `empty` where a group has no row.

        It is exact, so the order of rows has no effect. No gradient.
        """
        if self.size == 1 and value.numel():
            return value.detach().amax(0, keepdim=True)
        out = torch.full((self.size,), empty, dtype=value.dtype, device=value.device)
        return out.scatter_reduce(0, self.owner, value.detach(), "amax", include_self=False)

    def any(self, flag: Tensor) -> Tensor:
        """Whether any flag of each group is set: (K,) bool -> (size,) bool."""
        return self.max(flag.to(torch.uint8)) > 0


def _bag(rows: Tensor, which: Tensor, start: Tensor, weight: Tensor) -> Tensor:
    """Σ weight · row over each bag.

    rows: (M, D). which: (K,) int32, the rows in the bags. start: of each bag, and the end of the
    last. weight: (K,).
    """
    return torch.embedding_bag(
        rows, which, start, mode=0, per_sample_weights=weight, include_last_offset=True
    )[0]


def _bags_are_fast(value: Tensor) -> bool:
    """Whether `_bag` is faster than a sum of products for this tensor."""
    return FAST_BAGS and value.device.type == "cpu" and value.dtype == torch.float32


class WeightedRows:
    """Rows `value` (K, D) of groups, for repeated sums with different weights. No gradient."""

    def __init__(self, value: Tensor, groups: Groups):
        self.groups, self.value = groups, value
        self.fast = _bags_are_fast(value)
        if self.fast:
            start, self.order = groups.order
            # sorted by group, so that reads are contiguous
            self.value = value.index_select(0, self.order)
            self._bags = torch.arange(value.shape[0], dtype=torch.int32), start

    def sum(self, weight: Tensor) -> Tensor:
        """Σ weight · row over each group, (size, D). weight: (K,), in the order of `self.value`."""
        if self.fast:
            return _bag(self.value, *self._bags, weight)
        return self.groups.sum_into(
            self.value * weight.unsqueeze(1),
            weight.new_empty(self.groups.size, self.value.shape[1]),
        )

    def sorted(self, given: Tensor) -> Tensor:
        """`given` (K,), in the order of the original rows, in the order of `self.value`."""
        return given.index_select(0, self.order) if self.fast else given


class Blocks:
    """Symmetric blocks `value` (N, D, D), for repeated products with rows (N, D). No gradient."""

    def __init__(self, value: Tensor):
        self.value, self.fast = value, _bags_are_fast(value)
        if self.fast:
            count, width = value.shape[:2]
            self._bags = (
                torch.arange(count * width, dtype=torch.int32),
                torch.arange(count + 1, dtype=torch.int32) * width,
            )

    def times(self, r: Tensor) -> Tensor:
        """Each block times its own row, (N, D) -> (N, D)."""
        if self.fast:  # a third of the time of many small products
            return _bag(self.value.reshape(-1, r.shape[1]), *self._bags, r.reshape(-1))
        return torch.bmm(self.value, r.unsqueeze(2)).squeeze(2)


class _GroupSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value: Tensor, groups: Groups) -> Tensor:
        ctx.groups = groups
        return groups.sum_into(value, value.new_empty(groups.size, value.shape[1]))

    @staticmethod
    def backward(ctx, grad: Tensor):
        return grad.index_select(0, ctx.groups.owner), None

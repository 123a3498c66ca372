"""Sums and maxima over ragged groups, each group in its own fixed order.

All scatter operations of the package are in this module. A group's sum has the same bits whatever
the other groups are and wherever its rows stand.

- Sums of weighted rows are bags of embeddings, on every device: one kernel picks, weights and sums
  the rows of a bag, one after the other.
- On the CPU a sum over groups is a product with a sparse incidence matrix: every row of the product
  is accumulated by itself in the order of its entries. (The matrix-vector product of the same
  library picks a kernel by the shape of the whole matrix. So it is the matrix-matrix product even
  for one column.)
- On CUDA a sum over groups is a tree of segmented reductions: sums of FAN rows of a group, then of
  FAN of these sums, and so on. Each is added up by one thread in order, without atomics.
"""

from __future__ import annotations

import math
import warnings
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.tools.tangents import tracked
from torchfilm.tools.threads import one_torch_thread

# The rows that one thread adds up in a sum over groups on CUDA.
FAN = 32

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


def order_within(group: Tensor, value: Tensor, *, descending: bool = False) -> Tensor:
    """The rows (N,) sorted by group, and within each by value; equal ones stay in their order."""
    order = torch.argsort(value, descending=descending, stable=True)
    return order[torch.argsort(group[order], stable=True)]


def repeated(value: Tensor, count: Tensor, total: int | None = None) -> Tensor:
    """Each integer (K,) as often as `count` (K,) says; total: how many that are, where the host
    knows it."""
    if value.device.type != "cpu" or value.dtype != torch.float32:
        return torch.repeat_interleave(value, count, output_size=total)
    # torch's own wakes all threads, even for a few numbers; on a busy machine it waits for them
    return torch.from_numpy(np.repeat(value.numpy(), count.numpy()))


def expand_ranges(start: Tensor, count: Tensor, total: int | None = None) -> tuple[Tensor, Tensor]:
    """Write out ranges: for each i the numbers start[i] … start[i] + count[i] − 1.

    Returns (owner, value), each as long as the sum of the counts, `total` where the host knows it;
    owner is the i of each value.
    """
    number = torch.arange(count.numel(), device=count.device)
    owner = repeated(number, count, total)
    shift = start - (torch.cumsum(count, 0) - count)
    value = torch.arange(owner.numel(), device=count.device) + shift.index_select(0, owner)
    return owner, value


def marked(count: int, index: Tensor, flag: Tensor) -> Tensor:
    """Which of `count` places some flagged entry points to, (count,) bool: index, flag (K,)."""
    mark = torch.zeros(count + 1, dtype=torch.bool, device=index.device)
    return mark.index_fill_(0, torch.where(flag, index, count), True)[:count]


class Groups:
    """Sums and maxima over groups of rows.

    Rows 0 … K − 1 belong to groups 0 … size − 1.

    `owner`: (K,) int64, the group of each row. `ordered`: rows are known to be sorted by group;
    else they may have any order. zero: (K,) bool, rows known to be 0. A GPU adds them up after the
    others of their group, so that a sum does not depend on their number.
    """

    def __init__(self, owner: Tensor, size: int, ordered: bool = False, zero: Tensor | None = None):
        self.owner, self.size, self.ordered, self.zero = owner, size, ordered, zero
        self._matrix: dict[torch.dtype, Tensor] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        # without what it has worked out: torch does not copy sparse matrices
        return (Groups, (self.owner, self.size, self.ordered, self.zero))

    @cached_property
    def counts(self) -> Tensor:
        """(size,) int64, rows in each group."""
        begin = self.begin
        if begin.device.type == "cpu":  # torch takes four times as long, in each step
            ends = begin.numpy()
            return torch.from_numpy(ends[1:] - ends[:-1])
        return begin.diff()

    @cached_property
    def begin(self) -> Tensor:
        """Where each group begins among the rows sorted by group, and the end of the last, (size +
        1,) int64."""
        if self.ordered and self.owner.device.type == "cpu":
            begin = np.searchsorted(self.owner.numpy(), np.arange(self.size + 1))
            return torch.from_numpy(begin)
        return self.order[0].long()

    @cached_property
    def ends(self) -> np.ndarray:
        """`begin` on the CPU, for kernels."""
        return self.begin.numpy()

    @cached_property
    def order(self) -> tuple[Tensor, Tensor]:
        """The rows sorted by group, in their own order within each group.

        Returns the start of each group and the end of the last, (size + 1,), and the rows, (K,);
        both int32.
        """
        owner, on_cpu = self.owner, self.owner.device.type == "cpu"
        if self.ordered or (on_cpu and bool((owner[1:] >= owner[:-1]).all())):
            rows = torch.arange(owner.numel(), dtype=torch.int32, device=owner.device)
        elif on_cpu:
            return self._order_in_linear_time()
        elif self.zero is None:
            owner, rows = torch.sort(owner, stable=True)
        else:
            both, rows = torch.sort(2 * owner + self.zero, stable=True)
            owner = both // 2
        group = torch.arange(self.size + 1, device=owner.device)
        return torch.searchsorted(owner, group, out_int32=True), rows.int()

    def _order_in_linear_time(self) -> tuple[Tensor, Tensor]:
        """`order` on the CPU, where a sort would cost more than all the sums of a solve."""
        # imported where it is used: it takes longer to load than torchfilm itself
        from scipy.sparse import csc_array

        count = self.owner.numel()
        entries = (
            np.ones(count, np.int8),
            self.owner.int().numpy(),
            np.arange(count + 1, dtype=np.int32),
        )
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

    def plain_sum(self, value: Tensor) -> Tensor:
        """Like `sum` for (K, D) into (size, D), without gradient."""
        if self.owner.numel() == 0:
            return value.new_zeros(self.size, value.shape[1])
        if value.device.type == "cpu":
            return torch.mm(self._incidence(value.dtype), value)
        value = self._sorted(value)
        for start in self._tree:
            value = torch.segment_reduce(value, "sum", offsets=start, unsafe=True)
        return value

    def spread(self, value: Tensor) -> Tensor:
        """The value of its group for each row, (size, …) -> (K, …); its gradient is a `sum`."""
        if torch.is_grad_enabled() and value.requires_grad:
            return _GroupSpread.apply(value, self)
        return value.index_select(0, self.owner)

    def _sorted(self, value: Tensor) -> Tensor:
        """The rows of `value` (K, …), sorted by group."""
        return value if self.ordered else value.index_select(0, self.order[1])

    @cached_property
    def _tree(self) -> list[Tensor]:
        """Starts of the segments that a sum adds up, level by level; those of the last are groups.

        Their number depends on all rows, but a group that is one sum already stays as it is. So its
        bits depend on its own rows only.
        """
        start, rows, levels = self.order[0].long(), self.owner.numel(), []
        most = rows  # of one group
        while most > FAN:
            sums = offsets((start.diff() + FAN - 1) // FAN)
            segments = rows // FAN + self.size  # at least; those left over are empty
            number = torch.arange(segments + 1, device=start.device)
            group = torch.searchsorted(sums, number, right=True) - 1
            own = start.index_select(0, group) + (number - sums.index_select(0, group)) * FAN
            levels.append(torch.where(group < self.size, own, start[-1]))
            start, rows, most = sums, segments, -(-most // FAN)
        return [*levels, start]

    def max(self, value: Tensor, empty: float = 0.0) -> Tensor:
        """The maximum of each group, (K,) -> (size,); `empty` where a group has no row.

        It is exact, so the order of rows has no effect. Its derivatives are those of the first row
        that has it.
        """
        if tracked(value):
            return self._tracked_max(value, empty)
        value = value.detach()
        if self.size == 1 and value.numel():
            return value.amax(0, keepdim=True)
        if value.device.type == "cpu":
            out = torch.full((self.size,), empty, dtype=value.dtype)
            return out.scatter_reduce(0, self.owner, value, "amax", include_self=False)
        # whole numbers are exact in float64
        of_kind = value if value.is_floating_point() else value.double()
        start = self.order[0].long()
        out = torch.segment_reduce(self._sorted(of_kind), "max", offsets=start, unsafe=True)
        return torch.where(self.counts == 0, empty, out).to(value.dtype)

    def _tracked_max(self, value: Tensor, empty: float) -> Tensor:
        most = self.max(value.detach(), empty)
        row, known = self.first(value.detach() == most.index_select(0, self.owner))
        return torch.where(known, value.index_select(0, row), most) if value.numel() else most

    def first(self, flag: Tensor) -> tuple[Tensor, Tensor]:
        """The place of the first flagged element of each group, (N,) bool -> (G,); and whether
        there is one, (G,) bool."""
        count = flag.numel()
        place = torch.arange(count, device=flag.device)
        first = count - self.max(torch.where(flag, count - place, 0))
        return first.clamp(max=max(count - 1, 0)), first < count

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


class WeightedRows:
    """Rows `value` (K, D) of groups, for repeated sums with different weights. No gradient."""

    def __init__(self, value: Tensor, groups: Groups):
        start, self.order = groups.order
        # sorted by group, so that reads are contiguous
        self.value = value.index_select(0, self.order)
        self._bags = torch.arange(len(self.order), dtype=torch.int32, device=value.device), start

    def sum(self, weight: Tensor) -> Tensor:
        """Σ weight · row over each group, (size, D). weight: (K,), in the order of `self.value`."""
        return _bag(self.value, *self._bags, weight)

    def sorted(self, given: Tensor) -> Tensor:
        """`given` (K,), in the order of the original rows, in the order of `self.value`."""
        return given.index_select(0, self.order)


class Blocks:
    """Symmetric blocks `value` (N, D, D), for repeated products with rows (N, D). No gradient.

    A product of many small matrices by a library may pick a kernel by their number. A bag does not,
    and takes a third of the time in float32.
    """

    def __init__(self, value: Tensor):
        self.value = value
        count, width = value.shape[:2]
        whole = lambda count: torch.arange(count, dtype=torch.int32, device=value.device)
        self._bags = whole(count * width), whole(count + 1) * width

    def times(self, r: Tensor) -> Tensor:
        """Each block times its own row, (N, D) -> (N, D)."""
        return _bag(self.value.reshape(-1, r.shape[1]), *self._bags, r.reshape(-1))


class _GroupSpread(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value: Tensor, groups: Groups) -> Tensor:
        ctx.groups = groups
        return value.index_select(0, groups.owner)

    @staticmethod
    def backward(ctx, grad: Tensor):
        with one_torch_thread():
            return ctx.groups.sum(grad), None

    @staticmethod
    def jvp(ctx, tangent: Tensor, _):
        return tangent.index_select(0, ctx.groups.owner)


def _exact_sum(groups: Groups, value: Tensor) -> Tensor:
    """On the CPU rows are added one after the other: in float32 the sum of a million would be 1e-3
    off."""
    if value.device.type != "cpu":
        return groups.plain_sum(value)
    return groups.plain_sum(value.double()).to(value.dtype)


class _GroupSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value: Tensor, groups: Groups) -> Tensor:
        ctx.groups = groups
        return _exact_sum(groups, value)

    @staticmethod
    def backward(ctx, grad: Tensor):
        return grad.index_select(0, ctx.groups.owner), None

    @staticmethod
    def jvp(ctx, tangent: Tensor, _):
        return _exact_sum(ctx.groups, tangent)

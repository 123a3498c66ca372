"""Preconditioned conjugate gradients for many independent systems at once.

Each system converges by itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.tools.ragged import Groups
from torchfilm.tools.reads import READ_EVERY, reads_are_free


@dataclass(frozen=True)
class CGResult:
    """The result of a CG solve.

    x: (N, D). iterations: (B,) int64 for each system. worst: (B,) the greatest preconditioned
    residual at the end, as recurred.
    """

    x: Tensor
    iterations: Tensor
    worst: Tensor


def worst_of(value: Tensor, groups: Groups) -> Tensor:
    """Greatest |entry| of (N, D) in each group, (B,); NaN where an entry is NaN."""
    if groups.size == 1 and value.numel():
        return value.detach().abs().amax().reshape(1)
    return groups.max(value.abs().amax(1))


def _dot(a: Tensor, b: Tensor, groups: Groups) -> Tensor:
    """a · b of (N, D) in each group, (B, 1)."""
    # sum over the rows of a group first: to sum each short row first takes twice as long
    return groups.sum(a * b).sum(1, keepdim=True)


def _for_rows(value: Tensor, groups: Groups, width: int) -> Tensor:
    """The number of each group (B, 1), repeated for each entry of (N, D), or (1, 1) for one group.

    It is written out in full width: a column that broadcasts would take six times as long.
    """
    return (
        value
        if groups.size == 1
        else value.expand(-1, width).contiguous().index_select(0, groups.owner)
    )


@torch.no_grad()
def conjugate_gradients(
    apply: Callable[[Tensor], Tensor],
    b: Tensor,
    precondition: Callable[[Tensor], Tensor],
    groups: Groups,
    target: Tensor,
    max_iterations: int | Tensor,
    by_energy: bool = False,
) -> CGResult:
    """Solve A x = b from x = 0 for symmetric positive definite A, one system per group.

    b: (N, D). `apply` and `precondition` map (N, D) to (N, D) and keep groups apart. A system stops
    when its greatest preconditioned residual is at most target (B,), or is not finite, or after
    `max_iterations`, one number or (B,); the others continue. by_energy: target is of residual ·
    preconditioned residual instead.
    """
    x = torch.zeros_like(b)
    r = b.clone()
    z = precondition(r)
    p = z.clone()
    rz = _dot(r, z, groups)
    measure = lambda: rz.squeeze(1) if by_energy else worst_of(z, groups)
    worst = measure()
    going = (worst > target) & (worst < torch.inf)  # neither holds for a NaN
    going = going & (torch.as_tensor(max_iterations, device=b.device) > 0)
    iterations = torch.zeros(groups.size, dtype=torch.int64, device=b.device)
    free = reads_are_free(b.device)
    zero, one = rz.new_zeros(()), rz.new_ones(())  # a GPU would copy a plain number each time
    for k in itertools.count(1):
        q = apply(p)
        curvature = _dot(p, q, groups)
        moves = going.unsqueeze(1) & (curvature > 0)
        step = torch.where(moves, rz / torch.where(moves, curvature, one), zero)
        step = _for_rows(step, groups, b.shape[1])
        x.addcmul_(step, p)
        r.addcmul_(step, q, value=-1)
        z = precondition(r)
        new = _dot(r, z, groups)
        iterations += going
        ratio = torch.where(moves, new / torch.where(rz == 0, one, rz), zero)
        ratio = _for_rows(ratio, groups, b.shape[1])
        p = torch.addcmul(z, ratio, p)
        rz = new
        worst = torch.where(going, measure(), worst)
        going = moves.squeeze(1) & (worst > target) & (worst < torch.inf)
        going = going & (iterations < max_iterations)
        if (free or k % READ_EVERY == 0) and not bool(going.any()):
            break
    return CGResult(x, iterations, worst)

"""Many small linear systems in parallel: W (S, S, M), right-hand sides (S, M), cells last.

With cells last, every operation of the elimination is one pass over contiguous memory for all
cells. For six species this takes a fifth of the time of a library call for each matrix. There is no
pivoting: `factor` reports where that was not safe. A circuit's matrix, 1/(γh) − J, needs none where
species decay or convert into one another, and it needs none at a small enough step h.
Products are rounded before they are subtracted, as in compiled functions: addcmul would not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.tools.tangents import refuse_second, tracked

# A pivot smaller than this share of its scale has lost half of its digits in a difference.
LEAST_PIVOT = 1e-8


def factor(matrix: Tensor, scale: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """L and U of (S, S, M) in one tensor of that shape.

    Also whether (M,) all pivots are safe relative to the diagonal's own `scale` (S, M), and whether
    (M,) the determinant is negative.
    """
    lu = matrix.clone()
    size = lu.shape[0]
    for k in range(size - 1):
        lu[k + 1 :, k].div_(lu[k, k])
        lu[k + 1 :, k + 1 :].sub_(lu[k + 1 :, k : k + 1] * lu[k : k + 1, k + 1 :])
    pivots = torch.diagonal(lu, dim1=0, dim2=1).t()
    odd = (pivots < 0).sum(0) % 2 == 1
    return lu, (pivots.abs() > LEAST_PIVOT * scale).all(0), odd


def substitute(lu: Tensor, b: Tensor) -> Tensor:
    """W⁻¹ b by forward and back substitution: (S, S, M), (S, M) -> (S, M)."""
    x = b.clone()
    size = x.shape[0]
    for k in range(size - 1):
        x[k + 1 :].sub_(lu[k + 1 :, k] * x[k])
    for k in range(size - 1, -1, -1):
        x[k].div_(lu[k, k])
        if k:
            x[:k].sub_(lu[:k, k] * x[k])
    return x


def substitute_transposed(lu: Tensor, b: Tensor) -> Tensor:
    """W⁻ᵀ b, shapes as in `substitute`."""
    x = b.clone()
    size = x.shape[0]
    for k in range(size):
        x[k].div_(lu[k, k])
        if k + 1 < size:
            x[k + 1 :].sub_(lu[k, k + 1 :] * x[k])
    for k in range(size - 1, 0, -1):
        x[:k].sub_(lu[k, :k] * x[k])
    return x


class _LinearSolve(torch.autograd.Function):
    """W⁻¹ b with its adjoint."""

    @staticmethod
    def forward(ctx, matrix: Tensor, lu: Tensor, b: Tensor) -> Tensor:
        x = substitute(lu, b)
        ctx.save_for_backward(lu, x)
        ctx.save_for_forward(lu, x)
        return x

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second("the stiff method of circuits", grad)
        lu, x = ctx.saved_tensors
        y = substitute_transposed(lu, grad)
        return -y.unsqueeze(1) * x.unsqueeze(0), None, y

    @staticmethod
    def jvp(ctx, matrix: Tensor | None, _, b: Tensor | None):
        lu, x = ctx.saved_tensors
        moved = torch.zeros_like(x) if b is None else b
        return substitute(lu, moved if matrix is None else moved - multiply(matrix, x))


def solve(matrix: Tensor, lu: Tensor, b: Tensor) -> Tensor:
    """W⁻¹ b, differentiable in the matrix and in b; `lu` is from `factor`."""
    if tracked(matrix, b):
        return _LinearSolve.apply(matrix, lu, b)
    return substitute(lu, b)


def multiply(matrix: Tensor, x: Tensor) -> Tensor:
    """Matrix times vector, (S, S, M), (S, M) -> (S, M), differentiable.

    The sum has a fixed order.
    """
    out = matrix[:, 0] * x[0]
    for k in range(1, x.shape[0]):
        out = out + matrix[:, k] * x[k]
    return out

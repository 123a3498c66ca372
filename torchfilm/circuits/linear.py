"""Many small linear systems side by side: W (S, S, M), right-hand sides (S, M), cells last.

Cells last makes every operation of the elimination one pass over contiguous memory for all cells:
for six species a fifth of the time of a library call for each matrix. There is no pivoting:
`factor` says where that was not safe. What a circuit gives, 1/(γh) − J, needs none where species
decay or convert into one another, and at a small enough step h it never does.
"""

from __future__ import annotations

import torch
from torch import Tensor

# A pivot this much smaller than what it is the difference of has lost half of its digits.
LEAST_PIVOT = 1e-8


def factor(matrix: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """L and U of (S, S, M) in one tensor of that shape, and whether (M,) all pivots are sound
    against the diagonal's own `scale` (S, M)."""
    lu = matrix.clone()
    size = lu.shape[0]
    for k in range(size - 1):
        lu[k + 1 :, k].div_(lu[k, k])
        lu[k + 1 :, k + 1 :].addcmul_(lu[k + 1 :, k : k + 1], lu[k : k + 1, k + 1 :], value=-1)
    pivots = torch.diagonal(lu, dim1=0, dim2=1).t()
    return lu, (pivots.abs() > LEAST_PIVOT * scale).all(0)


def substitute(lu: Tensor, b: Tensor) -> Tensor:
    """W⁻¹ b by forward and back substitution: (S, S, M), (S, M) -> (S, M)."""
    x = b.clone()
    size = x.shape[0]
    for k in range(size - 1):
        x[k + 1 :].addcmul_(lu[k + 1 :, k], x[k : k + 1], value=-1)
    for k in range(size - 1, -1, -1):
        x[k].div_(lu[k, k])
        if k:
            x[:k].addcmul_(lu[:k, k], x[k : k + 1], value=-1)
    return x


def substitute_transposed(lu: Tensor, b: Tensor) -> Tensor:
    """W⁻ᵀ b, shapes as in `substitute`."""
    x = b.clone()
    size = x.shape[0]
    for k in range(size):
        x[k].div_(lu[k, k])
        if k + 1 < size:
            x[k + 1 :].addcmul_(lu[k, k + 1 :], x[k : k + 1], value=-1)
    for k in range(size - 1, 0, -1):
        x[:k].addcmul_(lu[k, :k], x[k : k + 1], value=-1)
    return x


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(ctx, matrix: Tensor, lu: Tensor, b: Tensor) -> Tensor:
        x = substitute(lu, b)
        ctx.save_for_backward(lu, x)
        return x

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor):
        lu, x = ctx.saved_tensors
        y = substitute_transposed(lu, grad)
        return -y.unsqueeze(1) * x.unsqueeze(0), None, y


def solve(matrix: Tensor, lu: Tensor, b: Tensor) -> Tensor:
    """W⁻¹ b, with a gradient to the matrix and to b; `lu` from `factor`."""
    if torch.is_grad_enabled() and (matrix.requires_grad or b.requires_grad):
        return _Solve.apply(matrix, lu, b)
    return substitute(lu, b)


def multiply(matrix: Tensor, x: Tensor) -> Tensor:
    """Matrix times vector, (S, S, M), (S, M) -> (S, M), the sum in a fixed order;
    differentiable."""
    out = matrix[:, 0] * x[0]
    for k in range(1, x.shape[0]):
        out = out + matrix[:, k] * x[k]
    return out

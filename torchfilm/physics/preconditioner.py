"""Block Jacobi preconditioning: each cell's own block, inverted, with its length free or fixed."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import BLOCK_FLOOR
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.ragged import Blocks

Map = Callable[[Tensor], Tensor]
# The inverse block of a cell with a fixed length follows from a subtraction. The subtraction must
# leave this share of each diagonal entry.
LEAST_LEFT = 1e-3


def block_inverse(problem: ContactProblem) -> Tensor:
    """Block Jacobi: the inverse of each cell's own D × D block, (N, D, D)."""
    blocks = problem.rows.blocks()
    # A sum of products has an error of a few units in the last place of its diagonal. Where alpha
    # is smaller than that error, rounding alone can make a block indefinite. CG needs a positive
    # definite preconditioner, so each block is raised by more than the error.
    floor = BLOCK_FLOOR * torch.finfo(blocks.dtype).eps
    blocks.diagonal(dim1=1, dim2=2).mul_(1.0 + floor).add_(problem.alpha)
    # There is no check here: a colony with a non-finite inverse has a non-finite residual, which
    # reports it without stopping the others. The inversion is in float64, since float32 loses the
    # small eigenvalues of a block whose eigenvalues differ by a factor of a million.
    return symmetric_inverse(blocks.double()).to(blocks.dtype)


def symmetric_inverse(blocks: Tensor) -> Tensor:
    """The inverse of each symmetric positive definite block, (N, D, D).

    By sweeps over all blocks at once: a library may pick its method by their number.
    """
    x = blocks.permute(
        1, 2, 0
    ).contiguous()  # blocks last, so that a pass is over contiguous memory
    for k in range(len(x)):
        pivot, column = x[k, k].reciprocal(), x[:, k].clone()
        row = x[k] * pivot
        x.addcmul_(column.unsqueeze(1), row, value=-1)
        x[k], x[:, k], x[k, k] = row, column.mul_(-pivot), pivot
    x = x.permute(2, 0, 1)
    return (x + x.mT).mul_(0.5).contiguous()


class FreeDofPreconditioner:
    """The block preconditioner over the free degrees of freedom.

    It ignores its input for a fixed degree of freedom, and returns 0 there. Only the length, the
    last degree of freedom, can be fixed.
    """

    def __init__(self, inverse: Tensor):
        whole = inverse
        # This is the inverse of the block without the length. It is not a part of the whole block's
        # inverse, in which the length could still move: with that part, cells under pressure whose
        # length is fixed took three times as many iterations. Where rounding would leave nothing of
        # the difference, the part of the whole inverse is used.
        own = whole[:, -1:, -1]
        along = torch.where(own > 0, whole[:, :, -1] / torch.where(own > 0, own, 1.0).sqrt(), 0.0)
        diagonal = whole.diagonal(dim1=1, dim2=2)[:, :-1]
        along = along * (diagonal - along[:, :-1].square() > LEAST_LEFT * diagonal).all(
            1, keepdim=True
        )
        without = whole - along.unsqueeze(2) * along.unsqueeze(1)
        without[:, -1] = 0.0
        without[:, :, -1] = 0.0
        self._whole, self._without = whole, without

    def at(self, free: Tensor) -> Map:
        """The preconditioner for these free degrees of freedom, (N, D)."""
        fixed = (free[:, -1] == 0).reshape(-1, 1, 1)
        return Blocks(torch.where(fixed, self._without, self._whole)).times

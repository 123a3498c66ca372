"""The gradient of the contact solve, by the adjoint method: one more solve, the same operator."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.physics.newton import Iterate, system_matrix
from torchfilm.physics.preconditioner import FreeDofPreconditioner
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.cg import conjugate_gradients, worst_of


def attach_gradient(
    problem: ContactProblem, end: Iterate, tolerance: Tensor, max_iterations: int
) -> Tensor:
    """y as a differentiable function of the problem's parameters θ.

    r(y, θ) = 0 gives dy = −A⁻¹ dr, with active contacts and bounds as the solve found them.
    """
    at_bound = (end.free[:, -1] == 0) & ~problem.rigid
    length = torch.where(at_bound, problem.lower, end.y[:, -1])
    point = torch.cat([end.y[:, :-1], length.unsqueeze(1)], 1)
    residual = problem.gradient(point, problem.gap_after(point) * end.active) * end.free
    solve_again = _AdjointSolve(
        problem.detached(), end.active, end.free, end.inverse, tolerance, max_iterations
    )
    return point + _AdjointFunction.apply(residual, solve_again)


class _AdjointSolve:
    """A⁻¹ for a gradient (N, D), at the solution's active rows and free degrees of freedom."""

    def __init__(self, problem, active, free, inverse, tolerance, max_iterations):
        self.problem, self.active, self.free = problem, active, free
        self.inverse, self.tolerance, self.max_iterations = inverse, tolerance, max_iterations

    def __call__(self, grad: Tensor) -> Tensor:
        colonies, b = self.problem.colonies, grad * self.free
        precondition = FreeDofPreconditioner(self.inverse).at(self.free)
        # the forward tolerance is chosen for overlaps; a gradient needs a smaller one
        tolerance = self.tolerance.clamp(max=1e-4 if grad.dtype == torch.float32 else 1e-8)
        target = tolerance * worst_of(precondition(b), colonies)
        return conjugate_gradients(
            system_matrix(self.problem, self.active),
            b,
            precondition,
            colonies,
            target,
            self.max_iterations,
        ).x


class _AdjointFunction(torch.autograd.Function):
    """Zero in the forward pass; −A⁻¹ of the incoming gradient in the backward pass."""

    @staticmethod
    def forward(ctx, residual: Tensor, solve_again: _AdjointSolve) -> Tensor:
        ctx.solve_again = solve_again
        return torch.zeros_like(residual)

    @staticmethod
    def backward(ctx, grad: Tensor):
        return -ctx.solve_again(grad.contiguous()), None

"""The gradient of the contact solve, by the adjoint method: one more solve, the same operator."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.physics.newton import Iterate
from torchfilm.physics.one_sided_solve import Minimum
from torchfilm.physics.preconditioner import FreeDofPreconditioner
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.cg import CGResult, conjugate_gradients, worst_of
from torchfilm.tools.checks import SimulationError
from torchfilm.tools.tangents import refuse_second
from torchfilm.tools.threads import one_torch_thread


def attach_gradient(
    problem: ContactProblem,
    end: Iterate | Minimum,
    tolerance: Tensor,
    max_iterations: int,
    colony_ids: Tensor | None = None,
) -> Tensor:
    """y as a differentiable function of the problem's parameters θ.

    r(y, θ) = 0 gives dy = −A⁻¹ dr, with active contacts and bounds as the solve found them.
    colony_ids: (B,), for messages; default: 0 … B − 1. A backward pass whose solve does not
    converge raises a SimulationError that names the colonies.
    """
    at_bound = (end.free[:, -1] == 0) & ~problem.rigid
    length = torch.where(at_bound, problem.lower, end.y[:, -1])
    point = torch.cat([end.y[:, :-1], length.unsqueeze(1)], 1)
    residual = problem.gradient(point, problem.gap_after(point) * end.active) * end.free
    solve_again = _AdjointSolve(
        problem.detached(), end.active, end.free, end.inverse, tolerance, max_iterations, colony_ids
    )
    return point + _AdjointFunction.apply(residual, solve_again)


class _AdjointSolve:
    """A⁻¹ for a gradient (N, D), at the solution's active rows and free degrees of freedom."""

    def __init__(self, problem, active, free, inverse, tolerance, max_iterations, colony_ids):
        self.colony_ids = colony_ids
        self.problem, self.active, self.free = problem, active, free
        self.inverse, self.tolerance, self.max_iterations = inverse, tolerance, max_iterations

    def __call__(self, grad: Tensor) -> Tensor:
        colonies, b = self.problem.colonies, grad * self.free
        precondition = FreeDofPreconditioner(self.inverse).at(self.free)
        # the forward tolerance is chosen for overlaps; a gradient needs a smaller one
        tolerance = self.tolerance.clamp(max=1e-4 if grad.dtype == torch.float32 else 1e-8)
        target = tolerance * worst_of(precondition(b), colonies)
        result = conjugate_gradients(
            self.problem.system(self.active), b, precondition, colonies, target, self.max_iterations
        )
        self._check(result, target)
        return result.x

    def _check(self, result: CGResult, target: Tensor) -> None:
        """Raises where the solve has not converged."""
        failed = torch.nonzero(~(result.worst <= target)).squeeze(1)
        if not failed.numel():
            return
        ids = failed if self.colony_ids is None else self.colony_ids.index_select(0, failed)
        left = float((result.worst / target).index_select(0, failed)[0])
        raise SimulationError(
            f"the gradient through the contacts of colony {', '.join(map(str, ids.tolist()[:5]))}"
            f" has not converged after {int(result.iterations[failed[0]])} iterations (residual"
            f" {left:.3g} times what it should be). More Mechanics.max_iterations or a larger alpha"
            " may help.",
            ids.tolist(),
        )


class _AdjointFunction(torch.autograd.Function):
    """Zero in the forward pass; −A⁻¹ of the incoming gradient in the backward pass."""

    @staticmethod
    def forward(ctx, residual: Tensor, solve_again: _AdjointSolve) -> Tensor:
        ctx.solve_again = solve_again
        return torch.zeros_like(residual)

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second("contacts")
        with one_torch_thread():  # its many small operations would wait for others
            return -ctx.solve_again(grad.contiguous()), None

"""The gradient of the contact solve, by the adjoint method: one more solve, the same operator."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchfilm.physics import compiled_solve
from torchfilm.physics.newton import Iterate
from torchfilm.physics.one_sided_solve import Minimum, inverse_blocks
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.cg import CGResult, conjugate_gradients, worst_of
from torchfilm.tools.checks import SimulationError
from torchfilm.tools.ragged import Blocks
from torchfilm.tools.segments import keep, kept
from torchfilm.tools.tangents import refuse_second
from torchfilm.tools.threads import one_torch_thread


def attach_gradient(
    problem: ContactProblem,
    end: Iterate | Minimum,
    tolerance: Tensor,
    max_iterations: int,
    colony_ids: Tensor | None = None,
    compiled: bool = False,
) -> Tensor:
    """y as a differentiable function of the problem's parameters θ.

    r(y, θ) = 0 gives dy = −A⁻¹ dr, with active contacts and bounds as the solve found them.
    colony_ids: (B,), for messages; default: 0 … B − 1. compiled: by kernels. A backward pass whose
    solve does not converge raises a SimulationError that names the colonies.
    """
    at_bound = (end.free[:, -1] == 0) & ~problem.rigid
    length = torch.where(at_bound, problem.lower, end.y[:, -1])
    point = torch.cat([end.y[:, :-1], length.unsqueeze(1)], 1)
    residual = problem.gradient(point, problem.gap_after(point) * end.active) * end.free
    solve_again = _AdjointSolve(
        problem.detached(), end.active, end.free, tolerance, max_iterations, colony_ids, compiled
    )
    return point + _AdjointFunction.apply(residual, solve_again)


class _AdjointSolve:
    """A⁻¹ for a gradient (N, D), at the solution's active rows and free degrees of freedom."""

    def __init__(self, problem, active, free, tolerance, max_iterations, colony_ids, compiled):
        self.colony_ids, self.compiled = colony_ids, compiled
        self.problem, self.active, self.free = problem, active, free
        self.tolerance, self.max_iterations = tolerance, max_iterations

    def __call__(self, grad: Tensor) -> Tensor:
        # the forward tolerance is chosen for overlaps; a gradient needs a smaller one
        tolerance = self.tolerance.clamp(max=1e-4 if grad.dtype == torch.float32 else 1e-8)
        solve = compiled_solve.solve_again if self.compiled else solve_again
        result = solve(
            self.problem, self.active, self.free, grad * self.free, tolerance, self.max_iterations
        )
        self._check(result)
        return result.x

    def _check(self, result: CGResult) -> None:
        """Raises where the solve has not converged."""
        failed = torch.nonzero(~(result.worst <= 1.0)).squeeze(1)
        if not failed.numel():
            return
        ids = failed if self.colony_ids is None else self.colony_ids.index_select(0, failed)
        left = float(result.worst.index_select(0, failed)[0])
        raise SimulationError(
            f"the gradient through the contacts of colony {', '.join(map(str, ids.tolist()[:5]))}"
            f" has not converged after {int(result.iterations[failed[0]])} iterations (residual"
            f" {left:.3g} times what it should be). More Mechanics.max_iterations or a larger alpha"
            " may help.",
            ids.tolist(),
        )


def solve_again(
    problem: ContactProblem, active: Tensor, free: Tensor, b: Tensor, tolerance: Tensor, limit: int
) -> CGResult:
    """(JᵀAJ + α)⁻¹ b, (N, D), over the free degrees of freedom, to a share of the greatest
    preconditioned residual. tolerance: (B,). The residuals are relative to what is allowed."""
    inverse, _ = inverse_blocks(problem, active, free[:, -1] == 0)
    precondition = Blocks(inverse).times
    target = tolerance * worst_of(precondition(b), problem.colonies)
    result = conjugate_gradients(
        problem.system(active), b, precondition, problem.colonies, target, limit
    )
    allowed = torch.where(target > 0, target, 1.0)
    return replace(result, worst=result.worst / allowed)


class _AdjointFunction(torch.autograd.Function):
    """Zero in the forward pass; −A⁻¹ of the incoming gradient in the backward pass."""

    @staticmethod
    def forward(ctx, residual: Tensor, solve_again: _AdjointSolve) -> Tensor:
        keep(ctx, solve_again)
        return torch.zeros_like(residual)

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second("contacts", grad)
        solve_again, _ = kept(ctx)
        with one_torch_thread():  # its many small operations would wait for others
            return -solve_again(grad.contiguous()), None

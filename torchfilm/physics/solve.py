"""The contact solve: minimise ‖D(Jx − g)‖² + α xᵀMx, every colony converged by itself.

| paper, model        | here                                                                  |
|---------------------|-----------------------------------------------------------------------|
| x = (Δc, Δθ, Δl)    | `x`, (N, 7), or (N, 4) in strict 2-D                                  |
| M                   | diagonal: `drag` (N, D). A contact on a centreline exerts no torque about it, so the one direction in which |
|                     | rotational drag differs (about the axis) is never entered             |
| D J M^(−½)          | `ContactRows`, so that the system is JᵀJ + α and x = M^(−½) y         |
| bilateral           | every row holds: one linear system                                    |
| unilateral          | only rows with g − Jx < 0 push: semismooth Newton with a line search  |
| Δl ≥ −growth        | projected Newton: a cell at its bound leaves the system               |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.physics.rows import ContactRows
from torchfilm.tools.cg import conjugate_gradients, worst_of
from torchfilm.tools.ragged import Groups

Map = Callable[[Tensor], Tensor]

CONVERGED, ITERATION_LIMIT, NOT_FINITE, TOO_FAST = 0, 1, 2, 3
STATUS = {
    CONVERGED: "converged",
    ITERATION_LIMIT: "reached its iteration limit",
    NOT_FINITE: "is not finite",
    TOO_FAST: "would have to follow too much growth in one step",
}

# The share of the present residual that one Newton step's CG is asked to leave, where contacts may switch.
FORCING = 0.1
NEWTON_LIMIT = 40
HALVINGS = 8


@dataclass(frozen=True)
class SolveReport:
    """For each colony, (B,): `status` (see STATUS), CG `iterations`, and the true `residual`, recomputed from x: the worst
    preconditioned residual over the worst at x = 0 (or, where opposing forces cancel, over the least that rounding resolves)."""

    status: Tensor
    iterations: Tensor
    residual: Tensor


@dataclass(frozen=True)
class ContactProblem:
    """One linearised contact problem, R rows over N cells in B colonies.

    rows: J scaled by weights and drag. gap: (R,) D g. held: (R,) force of each row already spent in this step (soft rows in
    later passes), D min(0, g) or 0. alpha: (N, 1) or (N, D). lower: (N,) least scaled Δl. scale: (N, D) M^(−½).
    """

    rows: ContactRows
    gap: Tensor
    held: Tensor
    alpha: Tensor
    lower: Tensor
    scale: Tensor
    colonies: Groups
    unilateral: bool

    def after(self, y: Tensor) -> Tensor:
        """The scaled gap of each row after the move y, (R,)."""
        return self.gap - self.rows.apply(y)

    def acting(self, after: Tensor) -> Tensor:
        """1 for each row that acts, (R,): all, or if contacts only push, those that overlap after the move."""
        return (after < 0).to(after.dtype) if self.unilateral else torch.ones_like(after)

    def gradient(self, y: Tensor, violation: Tensor) -> Tensor:
        """Of the function that is minimised, (N, D); violation (R,): the gap after the move of the rows that act, else 0."""
        return self.alpha * y - self.rows.apply_transpose(violation - self.held)

    def energy(self, y: Tensor, after: Tensor) -> Tensor:
        """The function that is minimised, per colony (B,), in float64 so that a line search can compare; after (R,): the gap left."""
        rows = self.rows
        violation = (after.clamp(max=0) if self.unilateral else after).double()
        spring = 0.5 * violation * violation + self.held * (self.gap - after)
        owner = Groups(self.colonies.owner.index_select(0, rows.row_owner), self.colonies.size)
        drag = (0.5 * self.alpha * y * y).sum(1, keepdim=True).double()
        return (owner.sum(spring.unsqueeze(1)) + self.colonies.sum(drag)).squeeze(1)


def solve(problem: ContactProblem, start: Tensor | None, tolerance: float, max_iterations: int) -> tuple[Tensor, SolveReport]:
    """Solve for x (N, D) from `start` (an earlier x, or None for 0). Differentiable by the adjoint: one more solve with the same operator.

    A colony has converged when its worst preconditioned residual is at most `tolerance` times the worst at x = 0.
    """
    with torch.no_grad():
        y, free, active, report, precondition = _minimise(_detached(problem), start, tolerance, max_iterations)
    tracked = (problem.gap, problem.rows.row_first, problem.rows.row_wall, problem.alpha, problem.lower, problem.scale)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tracked):
        y = _attach_gradient(problem, y, free, active, precondition, tolerance, max_iterations)
    return y * problem.scale, report


def _detached(p: ContactProblem) -> ContactProblem:
    r = p.rows
    if not torch.is_grad_enabled() and not r.row_first.requires_grad:
        return p
    rows = ContactRows(r.first, r.second, r.row_first.detach(), r.row_second.detach(), r.at_wall, r.row_wall.detach(), r.cells)
    return ContactProblem(rows, p.gap.detach(), p.held.detach(), p.alpha.detach(), p.lower.detach(), p.scale.detach(), p.colonies, p.unilateral)


def _minimise(problem: ContactProblem, start: Tensor | None, tolerance: float, max_iterations: int):
    colonies, owner = problem.colonies, problem.colonies.owner
    zero = torch.zeros_like(problem.scale)
    active = problem.acting(problem.gap)
    precondition = _block_inverse(problem, active)
    scale = worst_of(precondition(problem.gradient(zero, problem.gap * active)), colonies)
    still = scale == 0  # nothing pushes: such a colony does not move at all
    y, after = zero, problem.gap
    if start is not None:
        y = torch.where(still.index_select(0, owner).unsqueeze(1), zero, start / problem.scale)
        y[:, -1] = torch.maximum(y[:, -1], problem.lower)
        after = problem.after(y)
        active = problem.acting(after)
    target = tolerance * scale
    iterations = torch.zeros(colonies.size, dtype=torch.int64, device=y.device)
    previous = torch.full_like(scale, torch.inf)
    for number in range(NEWTON_LIMIT + 1):
        gradient = problem.gradient(y, after * active)
        free = _free(y, gradient, problem.lower)
        worst = worst_of(precondition(gradient * free) * free, colonies)
        going = (worst > target) & (worst < torch.inf) & (iterations < max_iterations)
        stalled = going & (worst > 0.9 * previous)
        if bool(stalled.any()):
            # opposing forces on a cell may leave less at rest than rounding lets anyone resolve
            least = _rounding(problem, precondition, y) / tolerance
            scale = torch.where(stalled, torch.maximum(scale, least), scale)
            target = tolerance * scale
            going = going & (worst > target)
        if number == NEWTON_LIMIT or not bool(going.any()):
            break
        previous = worst
        least = torch.maximum(0.5 * target, FORCING * worst) if problem.unilateral else 0.5 * target
        inner = torch.where(going, least, torch.inf)
        result = conjugate_gradients(_operator(problem, active, free), -gradient * free, _within(free, precondition), colonies, inner, max_iterations)
        iterations += result.iterations
        y, after = _line_search(problem, y, after, gradient, result.x, going)
        active = problem.acting(after)
    status = torch.where(worst <= target, CONVERGED, ITERATION_LIMIT)
    status = torch.where(worst < torch.inf, status, NOT_FINITE)
    residual = worst / torch.where(still, 1.0, scale)
    return y, free, active, SolveReport(status, iterations, residual), precondition


def _rounding(problem: ContactProblem, precondition: Map, y: Tensor) -> Tensor:
    """The residual that rounding alone may leave in each colony, (B,): a few units in the last place of the forces on a cell, opposing ones not set off."""
    forces = problem.rows.transpose_of_sizes(problem.gap.abs() + problem.rows.sizes_of(y)) + problem.alpha * y.abs()
    return 2 * torch.finfo(y.dtype).eps * worst_of(precondition(forces), problem.colonies)


def _within(free: Tensor, precondition: Map) -> Map:
    """The preconditioner among the degrees of freedom that are free."""
    return lambda r: precondition(r * free) * free


def _operator(problem: ContactProblem, active: Tensor, free: Tensor):
    rows, alpha = problem.rows, problem.alpha

    def apply(v: Tensor) -> Tensor:
        out = rows.apply_transpose(active * rows.apply(v))
        return out.addcmul_(alpha, v).mul_(free)

    return apply


def _free(y: Tensor, gradient: Tensor, lower: Tensor) -> Tensor:
    """1 for every degree of freedom that may move, 0 for a length at its bound that is pushed further down. (N, D)"""
    free = torch.ones_like(y)
    free[:, -1] = (~((y[:, -1] <= lower) & (gradient[:, -1] > 0))).to(y.dtype)
    return free


def _line_search(problem: ContactProblem, y, after, gradient, direction, going):
    """Take the full step; halve it in the colonies where the energy does not fall enough.

    Where every row holds and no length is cut short by its bound, the full step is the minimum and needs no looking at.
    """
    owner = problem.colonies.owner
    length = going.to(y.dtype)

    def move(share: Tensor):
        new = torch.addcmul(y, share.index_select(0, owner).unsqueeze(1), direction)
        cut = problem.colonies.any(new[:, -1] < problem.lower)
        new[:, -1] = torch.maximum(new[:, -1], problem.lower)
        return new, problem.after(new), cut

    new, then, cut = move(length)
    # asked of each colony by itself: one that needs no looking at must not change because another does
    going = going & (cut | problem.unilateral)
    if not bool(going.any()):
        return new, then
    before = problem.energy(y, after)
    for _ in range(HALVINGS):
        decrease = problem.colonies.sum((gradient * (new - y)).double().sum(1, keepdim=True)).squeeze(1)
        bad = going & (problem.energy(new, then) > before + 1e-4 * decrease + 1e-6 * before.abs())
        if not bool(bad.any()):
            break
        length = torch.where(bad, 0.5 * length, length)
        new, then, _ = move(length)
    return new, then


def _block_inverse(problem: ContactProblem, active: Tensor):
    """Block Jacobi: each cell's own D × D block, inverted."""
    blocks = problem.rows.blocks(active)
    blocks.diagonal(dim1=1, dim2=2).add_(problem.alpha)
    # no check here: where a colony is not finite so is its inverse, and its residual says so without stopping the others
    inverse = torch.linalg.inv_ex(blocks).inverse
    return lambda r: torch.bmm(inverse, r.unsqueeze(2)).squeeze(2)


def _attach_gradient(problem, y, free, active, precondition, tolerance, max_iterations):
    """y as a differentiable function of the problem: r(y, θ) = 0 gives dy = −A⁻¹ dr, with contacts and bounds as they were found."""
    at_bound = free[:, -1] == 0
    length = torch.where(at_bound, problem.lower, y[:, -1])
    held = torch.cat([y[:, :-1], length.unsqueeze(1)], 1)
    residual = problem.gradient(held, problem.after(held) * active) * free
    solve_again = _AdjointSolve(_detached(problem), active, free, precondition, tolerance, max_iterations)
    return held + _Implicit.apply(residual, solve_again)


class _AdjointSolve:
    def __init__(self, problem, active, free, precondition, tolerance, max_iterations):
        self.problem, self.active, self.free = problem, active, free
        self.precondition, self.tolerance, self.max_iterations = precondition, tolerance, max_iterations

    def __call__(self, grad: Tensor) -> Tensor:
        free, colonies = self.free, self.problem.colonies
        precondition = _within(free, self.precondition)
        b = grad * free
        # the forward solve's tolerance is a matter of overlaps; a gradient wants more
        tolerance = min(self.tolerance, 1e-4 if grad.dtype == torch.float32 else 1e-8)
        target = tolerance * worst_of(precondition(b), colonies)
        return conjugate_gradients(_operator(self.problem, self.active, free), b, precondition, colonies, target, self.max_iterations).x


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx, residual: Tensor, solve_again: _AdjointSolve) -> Tensor:
        ctx.solve_again = solve_again
        return torch.zeros_like(residual)

    @staticmethod
    def backward(ctx, grad: Tensor):
        return -ctx.solve_again(grad.contiguous()), None

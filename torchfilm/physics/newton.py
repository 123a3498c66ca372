"""Rounds of projected semismooth Newton for the contact problem, each solved by CG.

One round: find the free degrees of freedom, solve (JᵀAJ + α) Δy = −gradient by CG, where A marks
the rows that act, then search along Δy. Bilateral problems are linear; they need more than one
round only where lengths reach their bounds or the residual has drifted.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchfilm.physics.line_search import search_line
from torchfilm.physics.preconditioner import FreeDofPreconditioner, Map, block_inverse
from torchfilm.physics.problem import (
    CONVERGED,
    ITERATION_LIMIT,
    NOT_FINITE,
    ContactProblem,
    Selection,
    SolveReport,
)
from torchfilm.tools.cg import conjugate_gradients, worst_of
from torchfilm.tools.ragged import Blocks

# The share of the current residual that the CG of one Newton step may leave while contacts may
# switch. Measured: a sixth to a fifth fewer rounds than with 0.1, for about as many iterations.
FORCING = 0.02
# The share of its target that CG must reach where contacts cannot switch. It is below 1, since
# lengths that meet their bound undo part of the progress, and the true residual differs by rounding
# from the recurred one. Measured: 0.5 costs as much as 0.8, in fewer rounds of more iterations, and
# leaves a smaller residual.
FINISH = 0.5
# A solve is limited by its CG iterations, and each round takes at least one. This many rounds is
# the last resort.
NEWTON_LIMIT = 200


@dataclass(frozen=True)
class Iterate:
    """The current point of Newton's method.

    y: (N, D) the scaled move. after: (R,) each row's gap after it. active: (R,) 1 for rows that
    act. free: (N, D) 1 for free degrees of freedom. inverse: (N, D, D) the inverse blocks of the
    rows that act. Per colony, (B,): scale and worst of its residual, and the CG iterations so far.
    """

    y: Tensor
    after: Tensor
    active: Tensor
    free: Tensor
    inverse: Tensor
    scale: Tensor
    worst: Tensor
    iterations: Tensor

    def part(self, which: Selection) -> Iterate:
        """The iterate of the selected colonies."""
        return Iterate(
            *(
                getattr(self, f.name).index_select(0, index)
                for f, index in zip(fields(self), which.by_field(), strict=True)
            )
        )

    def with_part(self, part: Iterate, which: Selection) -> Iterate:
        """This iterate with the selected colonies replaced."""
        return Iterate(
            *(
                getattr(self, f.name).index_copy(0, index, getattr(part, f.name))
                for f, index in zip(fields(self), which.by_field(), strict=True)
            )
        )


def minimise(problem: ContactProblem, start: Tensor | None, tolerance: Tensor, max_iterations: int):
    """Minimise from `start`, an earlier x, or None for 0.

    Returns the last iterate and the report.
    """
    colonies = problem.colonies
    zero = torch.zeros_like(problem.scale)
    active = problem.acting(problem.gap)
    inverse = block_inverse(problem, active)
    scale = worst_of(Blocks(inverse).times(problem.gradient(zero, problem.gap * active)), colonies)
    still = scale == 0  # no row exerts a force: such a colony does not move at all
    y, after = zero, problem.gap
    if start is not None:
        y = torch.where(
            still.index_select(0, colonies.owner).unsqueeze(1), zero, start / problem.scale
        )
        y[:, -1] = torch.where(problem.rigid, 0.0, torch.maximum(y[:, -1], problem.lower))
        after = problem.gap_after(y)
        active = problem.acting(after)
        inverse = block_inverse(problem, active) if problem.unilateral else inverse
    unknown = torch.full_like(scale, torch.inf)
    begun = Iterate(
        y,
        after,
        active,
        torch.ones_like(y),
        inverse,
        scale,
        unknown,
        torch.zeros_like(scale, dtype=torch.int64),
    )
    end = _newton_rounds(problem, begun, tolerance, max_iterations, 0)
    status = torch.where(end.worst <= tolerance * end.scale, CONVERGED, ITERATION_LIMIT)
    status = torch.where(end.worst < torch.inf, status, NOT_FINITE)
    residual = end.worst / torch.where(still, 1.0, end.scale)
    return end, SolveReport(status, end.iterations, residual)


def _newton_rounds(
    problem: ContactProblem, at: Iterate, tolerance: Tensor, max_iterations: int, rounds: int
) -> Iterate:
    """Rounds of Newton's method from the iterate `at` until every colony has converged.

    rounds: the rounds of rounds already done.
    """
    colonies = problem.colonies
    y, after, active, inverse, scale, previous, iterations = (
        at.y,
        at.after,
        at.active,
        at.inverse,
        at.scale,
        at.worst,
        at.iterations,
    )
    preconditioner, gradient = FreeDofPreconditioner(inverse), problem.gradient(y, after * active)
    while True:
        free = _free_dofs(y, gradient, problem)
        precondition = preconditioner.at(free)
        worst = worst_of(precondition(gradient), colonies)
        target = tolerance * scale
        going = (worst > target) & (worst < torch.inf) & (iterations < max_iterations)
        stalled = going & (worst > 0.9 * previous)
        if bool(stalled.any()):
            # where opposing forces on a cell cancel, rounding limits the residual that can be
            # reached
            least = _rounding_residual(problem, precondition, y) / tolerance
            scale = torch.where(stalled, torch.maximum(scale, least), scale)
            target = tolerance * scale
            going = going & (worst > target)
        here = Iterate(y, after, active, free, inverse, scale, worst, iterations)
        if rounds == NEWTON_LIMIT or not bool(going.any()):
            return here
        which = _minority(problem, going)
        if which is not None:  # a few colonies go on without the cost of the others
            part = replace(here.part(which), worst=previous.index_select(0, which.colonies))
            end = _newton_rounds(
                problem.part(which),
                part,
                tolerance.index_select(0, which.colonies),
                max_iterations,
                rounds,
            )
            return here.with_part(end, which)
        previous = worst
        least = (
            torch.maximum(0.5 * target, FORCING * worst) if problem.unilateral else FINISH * target
        )
        inner = torch.where(going, least, torch.inf)
        result = conjugate_gradients(
            system_matrix(problem, active), -gradient, precondition, colonies, inner, max_iterations
        )
        iterations = iterations + result.iterations
        y, after, active, gradient = search_line(problem, y, after, gradient, result.x, going)
        if problem.unilateral:
            # The block of a cell that nothing touched before is α alone. If it were kept, it would
            # weight the cell's new contact 1/α times too much, and hide all else.
            inverse = block_inverse(problem, active)
            preconditioner = FreeDofPreconditioner(inverse)
        rounds += 1


def _minority(problem: ContactProblem, going: Tensor) -> Selection | None:
    """The colonies that still iterate, if they have less than half of the cells; else None."""
    owner = problem.colonies.owner
    moving = going.index_select(0, owner)
    cells = torch.nonzero(moving).squeeze(1)
    if 2 * cells.numel() >= owner.numel():
        return None
    rows = torch.nonzero(moving.index_select(0, problem.rows.row_owner)).squeeze(1)
    return Selection(torch.nonzero(going).squeeze(1), cells, rows)


def _rounding_residual(problem: ContactProblem, precondition: Map, y: Tensor) -> Tensor:
    """The residual that rounding alone may leave in each colony, (B,).

    It is a few units in the last place of the sum of the absolute forces on a cell.
    """
    forces = (
        problem.rows.transpose_of_sizes(problem.gap.abs() + problem.rows.sizes_of(y))
        + problem.alpha * y.abs()
    )
    return 2 * torch.finfo(y.dtype).eps * worst_of(precondition(forces), problem.colonies)


def system_matrix(problem: ContactProblem, active: Tensor) -> Map:
    """The map v -> (JᵀAJ + α) v, where A marks the active rows.

    The preconditioner discards its output for degrees of freedom that are not free.
    """
    rows, alpha, unilateral = problem.rows, problem.alpha, problem.unilateral

    def apply(v: Tensor) -> Tensor:
        change = rows.apply(v)
        return rows.apply_transpose(active * change if unilateral else change).addcmul_(alpha, v)

    return apply


def _free_dofs(y: Tensor, gradient: Tensor, problem: ContactProblem) -> Tensor:
    """1 for every degree of freedom that may move, else 0, (N, D).

    A length is not free if its cell is rigid, or if it is at its bound and the gradient pushes it
    further down.
    """
    free = torch.ones_like(y)
    free[:, -1] = (~(((y[:, -1] <= problem.lower) & (gradient[:, -1] > 0)) | problem.rigid)).to(
        y.dtype
    )
    return free

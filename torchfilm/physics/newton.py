"""Rounds of projected Newton for the contact problem of bilateral rows, each solved by CG.

One round: find the free degrees of freedom, solve (JᵀJ + α) Δy = −gradient by CG, then search along
Δy. The problem is linear; it needs more than one round only where lengths reach their bounds or the
residual has drifted.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import FINISH, NEWTON_LIMIT, ROUNDING_UNITS, STALLED
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
from torchfilm.tools.reads import known_rows_where, numbers


@dataclass(frozen=True)
class Iterate:
    """The current point of Newton's method.

    y: (N, D) the scaled move. after: (R,) each row's gap after it. free: (N, D) 1 for free degrees
    of freedom. inverse: (N, D, D) the inverse blocks. Per colony, (B,): scale and worst of its
    residual, and the CG iterations so far.
    """

    y: Tensor
    after: Tensor
    free: Tensor
    inverse: Tensor
    scale: Tensor
    worst: Tensor
    iterations: Tensor

    @property
    def active(self) -> Tensor:
        """1 for each row, (R,): all act."""
        return torch.ones_like(self.after)

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
    inverse = block_inverse(problem)
    scale = worst_of(Blocks(inverse).times(problem.gradient(zero, problem.gap)), colonies)
    still = scale == 0  # no row exerts a force: such a colony does not move at all
    y, after = zero, problem.gap
    if start is not None:
        y = torch.where(
            still.index_select(0, colonies.owner).unsqueeze(1), zero, start / problem.scale
        )
        y[:, -1] = torch.where(problem.rigid, 0.0, torch.maximum(y[:, -1], problem.lower))
        after = problem.gap_after(y)
    unknown = torch.full_like(scale, torch.inf)
    begun = Iterate(
        y,
        after,
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
    y, after, inverse, scale, previous, iterations = (
        at.y,
        at.after,
        at.inverse,
        at.scale,
        at.worst,
        at.iterations,
    )
    preconditioner, gradient = FreeDofPreconditioner(inverse), problem.gradient(y, after)
    while True:
        free = _free_dofs(y, gradient, problem)
        precondition = preconditioner.at(free)
        worst = worst_of(precondition(gradient), colonies)
        target = tolerance * scale
        going = (worst > target) & (worst < torch.inf) & (iterations < max_iterations)
        stalled = going & (worst > STALLED * previous)
        some_stalled, *left = numbers(stalled.any(), *_sizes(problem, going))
        if some_stalled:
            # where opposing forces on a cell cancel, rounding limits the residual that can be
            # reached
            least = _rounding_residual(problem, precondition, y) / tolerance
            scale = torch.where(stalled, torch.maximum(scale, least), scale)
            target = tolerance * scale
            going = going & (worst > target)
            left = numbers(*_sizes(problem, going))
        here = Iterate(y, after, free, inverse, scale, worst, iterations)
        if rounds == NEWTON_LIMIT or not left[0]:
            return here
        which = _minority(problem, going, *left)
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
        inner = torch.where(going, FINISH * target, torch.inf)
        result = conjugate_gradients(
            problem.system(), -gradient, precondition, colonies, inner, max_iterations
        )
        iterations = iterations + result.iterations
        y, after, gradient = search_line(problem, y, after, gradient, result.x, going)
        rounds += 1


def _sizes(problem: ContactProblem, going: Tensor) -> tuple[Tensor, ...]:
    """How many colonies still iterate, (B,) bool, and how many cells, rows of two cells and rows at
    walls they have."""
    of_rows = going.index_select(0, problem.of_rows.owner)
    pairs = problem.rows.pairs
    cells = going.index_select(0, problem.colonies.owner)
    return going.sum(), cells.sum(), of_rows[:pairs].sum(), of_rows[pairs:].sum()


def _minority(
    problem: ContactProblem, going: Tensor, colonies: int, cells: int, pairs: int, walls: int
) -> Selection | None:
    """The colonies that still iterate, if they have less than half of the cells; else None. Their
    sizes are those of `_sizes`."""
    owner = problem.colonies.owner
    if 2 * cells >= owner.numel():
        return None
    of_rows = going.index_select(0, problem.of_rows.owner)
    return Selection(
        known_rows_where(going, colonies),
        known_rows_where(going.index_select(0, owner), cells),
        known_rows_where(of_rows, pairs + walls),
        pairs,
    )


def _rounding_residual(problem: ContactProblem, precondition: Map, y: Tensor) -> Tensor:
    """The residual that rounding alone may leave in each colony, (B,).

    It is some units in the last place of the sum of the absolute forces on a cell.
    """
    forces = (
        problem.rows.transpose_of_sizes(problem.gap.abs() + problem.rows.sizes_of(y))
        + problem.alpha * y.abs()
    )
    rounding = ROUNDING_UNITS * torch.finfo(y.dtype).eps
    return rounding * worst_of(precondition(forces), problem.colonies)


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

"""The contact solve: minimise ‖D(Jx − g)‖² + α xᵀMx, every colony converged by itself.

| paper, model        | here                                                                  |
|---------------------|-----------------------------------------------------------------------|
| x = (Δc, Δθ, Δl)    | `x`, (N, 7), or (N, 4) in strict 2-D                                  |
| M                   | diagonal: `drag` (N, D). A contact on a centreline exerts no torque about it, so the one direction in which |
|                     | rotational drag differs (about the axis) is never entered             |
| D J M^(−½)          | `ContactJacobian`, so that the system is JᵀJ + α and x = M^(−½) y         |
| bilateral           | every row holds: one linear system                                    |
| unilateral          | only rows with g − Jx < 0 push: semismooth Newton with a line search  |
| Δl ≥ −growth        | projected Newton: a cell at its bound leaves the system               |
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.tools.cg import conjugate_gradients, worst_of
from torchfilm.tools.ragged import Blocks, Groups

Map = Callable[[Tensor], Tensor]

CONVERGED, ITERATION_LIMIT, NOT_FINITE, TOO_FAST = 0, 1, 2, 3
STATUS = {
    CONVERGED: "converged",
    ITERATION_LIMIT: "reached its iteration limit",
    NOT_FINITE: "is not finite",
    TOO_FAST: "would have to follow too much growth in one step",
}

# The share of the present residual that one Newton step's CG is asked to leave, where contacts may
# switch: measured, a sixth to a fifth fewer rounds than with 0.1, for about as many iterations.
FORCING = 0.02
# The share of its target that CG is asked for where they may not: less than the whole, since
# lengths that meet their bound take some of it back, and the true residual differs by rounding from
# the recurred one. Measured, half costs as much as 0.8, in fewer rounds of more iterations, and
# leaves less.
FINISH = 0.5
# What bounds a solve is its CG iterations, of which a round takes at least one; this many rounds is
# the last resort.
NEWTON_LIMIT = 200
# A line search leaves at most LEVEL of the slope that it began with; a full step that leaves no
# more than STEEP of it, upwards, is not looked at closer.
STEEP, LEVEL = 0.5, 0.1
MAX_LINE_SEARCH = 12
# The inverse block of a cell whose length is held comes of a subtraction that must leave this share
# of each diagonal entry.
LEAST_LEFT = 1e-3
# Units in the last place of its diagonal by which each cell's block is raised before it is
# inverted.
BLOCK_FLOOR = 64
# Lengths stopped at their bounds must leave DOWNHILL of a step's slope, or the step is halved; it
# is made shorter so many times at most.
DOWNHILL, MAX_HALVINGS = 0.01, 30
# A solve to no more than this is taken for exact by its adjoint without a word.
LOOSE = 1e-4


@dataclass(frozen=True)
class SolveReport:
    """For each colony, (B,): `status` (see STATUS), CG `iterations`, and the true `residual`,
    recomputed from x: the worst preconditioned residual (by the rows that act) over the worst at x
    = 0 (or, where opposing forces cancel, over the least that rounding resolves).
    """

    status: Tensor
    iterations: Tensor
    residual: Tensor


@dataclass(frozen=True)
class ContactProblem:
    """One linearised contact problem, R rows over N cells in B colonies.

    rows: J scaled by weights and drag. gap: (R,) D g. held: (R,) force of each row already spent in
    this step (soft rows in later passes), D min(0, g) or 0. alpha: (N, D). lower: (N,) least scaled
    Δl. scale: (N, D) M^(−½). rigid: (N,) bool, cells that do not grow: their length is no degree of
    freedom, so contacts that hold cannot draw it out.
    """

    rows: ContactJacobian
    gap: Tensor
    held: Tensor
    alpha: Tensor
    lower: Tensor
    scale: Tensor
    rigid: Tensor
    colonies: Groups
    unilateral: bool

    def after(self, y: Tensor) -> Tensor:
        """The scaled gap of each row after the move y, (R,)."""
        return self.gap - self.rows.apply(y)

    def acting(self, after: Tensor) -> Tensor:
        """1 for each row that acts, (R,): all, or if contacts only push, those that overlap after
        the move."""
        return (after < 0).to(after.dtype) if self.unilateral else torch.ones_like(after)

    def gradient(self, y: Tensor, violation: Tensor) -> Tensor:
        """Of the function that is minimised, (N, D); violation (R,): the gap after the move of the
        rows that act, else 0."""
        return self.alpha * y - self.rows.apply_transpose(violation - self.held)

    def among(self, moving: Tensor) -> ContactProblem:
        """The problem of the cells that move, (N,) bool, while the others stay where they are;
        colonies keep their numbers."""
        cells = torch.nonzero(moving).squeeze(1)
        rows, places = self.rows.among(moving)
        of_rows, of_cells = (
            lambda x, index=index: x.index_select(0, index) for index in (places, cells)
        )
        return ContactProblem(
            rows,
            of_rows(self.gap),
            of_rows(self.held),
            of_cells(self.alpha),
            of_cells(self.lower),
            of_cells(self.scale),
            of_cells(self.rigid),
            Groups(of_cells(self.colonies.owner), self.colonies.size),
            self.unilateral,
        )

    def part(self, which: Selection) -> ContactProblem:
        """The problem of some of its colonies."""
        cells, rows = which.cells, which.rows
        number = torch.empty(self.rows.cells, dtype=torch.int64, device=cells.device)
        number[cells] = torch.arange(cells.numel(), device=cells.device)
        place = torch.empty(self.colonies.size, dtype=torch.int64, device=cells.device)
        place[which.colonies] = torch.arange(which.colonies.numel(), device=cells.device)
        owner = place.index_select(0, self.colonies.owner.index_select(0, cells))
        return ContactProblem(
            self.rows.part(rows, number, cells.numel()),
            self.gap.index_select(0, rows),
            self.held.index_select(0, rows),
            self.alpha.index_select(0, cells),
            self.lower.index_select(0, cells),
            self.scale.index_select(0, cells),
            self.rigid.index_select(0, cells),
            Groups(owner, which.colonies.numel()),
            self.unilateral,
        )

    @cached_property
    def of_rows(self) -> Groups:
        """The rows of each colony."""
        return Groups(self.colonies.owner.index_select(0, self.rows.row_owner), self.colonies.size)


def solve(
    problem: ContactProblem, start: Tensor | None, tolerance: float | Tensor, max_iterations: int
) -> tuple[Tensor, SolveReport]:
    """Solve for x (N, D) from `start` (an earlier x, or None for 0). Differentiable by the adjoint:
    one more solve with the same operator.

    A colony has converged when its worst preconditioned residual is at most `tolerance`, one or one
    per colony (B,), times the worst at x = 0.
    """
    tolerance = torch.as_tensor(
        tolerance, dtype=problem.scale.dtype, device=problem.scale.device
    ).expand(problem.colonies.size)
    with torch.no_grad():
        end, report = _minimise(_detached(problem), start, tolerance, max_iterations)
    tracked = (
        problem.gap,
        problem.rows.row_first,
        problem.rows.row_wall,
        problem.alpha,
        problem.lower,
        problem.scale,
    )
    y = end.y
    if torch.is_grad_enabled() and any(t.requires_grad for t in tracked):
        loosest = float(tolerance.max())
        if loosest > LOOSE:
            warnings.warn(
                f"a gradient is asked through contacts that are solved to {loosest:g} only, a"
                " matter of overlaps: it may even have the wrong sign. Give Mechanics a tolerance"
                " of 1e-6 or less (1e-8 in float64), or run under torch.no_grad().",
                RuntimeWarning,
                stacklevel=2,
            )
        y = _attach_gradient(problem, end, tolerance, max_iterations)
    return y * problem.scale, report


def _detached(p: ContactProblem) -> ContactProblem:
    r = p.rows
    if not torch.is_grad_enabled() and not r.row_first.requires_grad:
        return p
    rows = ContactJacobian(
        r.first,
        r.second,
        r.row_first.detach(),
        r.row_second.detach(),
        r.at_wall,
        r.row_wall.detach(),
        r.cells,
    )
    return ContactProblem(
        rows,
        p.gap.detach(),
        p.held.detach(),
        p.alpha.detach(),
        p.lower.detach(),
        p.scale.detach(),
        p.rigid,
        p.colonies,
        p.unilateral,
    )


def _minimise(
    problem: ContactProblem, start: Tensor | None, tolerance: Tensor, max_iterations: int
):
    colonies = problem.colonies
    zero = torch.zeros_like(problem.scale)
    active = problem.acting(problem.gap)
    inverse = _block_inverse(problem, active)
    scale = worst_of(Blocks(inverse).times(problem.gradient(zero, problem.gap * active)), colonies)
    still = scale == 0  # nothing pushes: such a colony does not move at all
    y, after = zero, problem.gap
    if start is not None:
        y = torch.where(
            still.index_select(0, colonies.owner).unsqueeze(1), zero, start / problem.scale
        )
        y[:, -1] = torch.where(problem.rigid, 0.0, torch.maximum(y[:, -1], problem.lower))
        after = problem.after(y)
        active = problem.acting(after)
        inverse = _block_inverse(problem, active) if problem.unilateral else inverse
    unknown = torch.full_like(scale, torch.inf)
    begun = _Iterate(
        y,
        after,
        active,
        torch.ones_like(y),
        inverse,
        scale,
        unknown,
        torch.zeros_like(scale, dtype=torch.int64),
    )
    end = _newton(problem, begun, tolerance, max_iterations, 0)
    status = torch.where(end.worst <= tolerance * end.scale, CONVERGED, ITERATION_LIMIT)
    status = torch.where(end.worst < torch.inf, status, NOT_FINITE)
    residual = end.worst / torch.where(still, 1.0, end.scale)
    return end, SolveReport(status, end.iterations, residual)


@dataclass(frozen=True)
class _Iterate:
    """Where Newton's method stands: the move y and which of it is free (N, D), each row's gap after
    it and whether the row acts (R,), the inverse blocks of the rows that act (N, D, D); per colony
    (B,) the scale and the worst of its residual, and the CG iterations spent.
    """

    y: Tensor
    after: Tensor
    active: Tensor
    free: Tensor
    inverse: Tensor
    scale: Tensor
    worst: Tensor
    iterations: Tensor

    def part(self, which: Selection) -> _Iterate:
        return _Iterate(
            *(
                getattr(self, f.name).index_select(0, index)
                for f, index in zip(fields(self), which.by_field(), strict=True)
            )
        )

    def with_part(self, part: _Iterate, which: Selection) -> _Iterate:
        return _Iterate(
            *(
                getattr(self, f.name).index_copy(0, index, getattr(part, f.name))
                for f, index in zip(fields(self), which.by_field(), strict=True)
            )
        )


@dataclass(frozen=True)
class Selection:
    """Some colonies of a problem: their places, their cells and their rows."""

    colonies: Tensor
    cells: Tensor
    rows: Tensor

    def by_field(self) -> tuple[Tensor, ...]:
        """What indexes each field of an _Iterate."""
        return (
            self.cells,
            self.rows,
            self.rows,
            self.cells,
            self.cells,
            self.colonies,
            self.colonies,
            self.colonies,
        )


def _newton(
    problem: ContactProblem, at: _Iterate, tolerance: Tensor, max_iterations: int, number: int
) -> _Iterate:
    """Rounds of Newton's method from the iterate `at`, the round `number` first, until every colony
    has converged."""
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
    within, gradient = FreeDofPreconditioner(inverse), problem.gradient(y, after * active)
    while True:
        free = _free(y, gradient, problem)
        precondition = within.at(free)
        worst = worst_of(precondition(gradient), colonies)
        target = tolerance * scale
        going = (worst > target) & (worst < torch.inf) & (iterations < max_iterations)
        stalled = going & (worst > 0.9 * previous)
        if bool(stalled.any()):
            # opposing forces on a cell may leave less at rest than rounding lets anyone resolve
            least = _rounding(problem, precondition, y) / tolerance
            scale = torch.where(stalled, torch.maximum(scale, least), scale)
            target = tolerance * scale
            going = going & (worst > target)
        here = _Iterate(y, after, active, free, inverse, scale, worst, iterations)
        if number == NEWTON_LIMIT or not bool(going.any()):
            return here
        which = _minority(problem, going)
        if which is not None:  # the few that go on need not carry the others along
            part = replace(here.part(which), worst=previous.index_select(0, which.colonies))
            end = _newton(
                problem.part(which),
                part,
                tolerance.index_select(0, which.colonies),
                max_iterations,
                number,
            )
            return here.with_part(end, which)
        previous = worst
        least = (
            torch.maximum(0.5 * target, FORCING * worst) if problem.unilateral else FINISH * target
        )
        inner = torch.where(going, least, torch.inf)
        result = conjugate_gradients(
            _operator(problem, active), -gradient, precondition, colonies, inner, max_iterations
        )
        iterations = iterations + result.iterations
        y, after, active, gradient = _line_search(problem, y, after, gradient, result.x, going)
        if problem.unilateral:
            # a cell that nothing touched before has blocks of α alone: kept, they would weigh its
            # new contact 1/α times too much and hide all else
            inverse = _block_inverse(problem, active)
            within = FreeDofPreconditioner(inverse)
        number += 1


def _minority(problem: ContactProblem, going: Tensor) -> Selection | None:
    """The colonies that go on, if they hold less than half of the cells."""
    owner = problem.colonies.owner
    moving = going.index_select(0, owner)
    cells = torch.nonzero(moving).squeeze(1)
    if 2 * cells.numel() >= owner.numel():
        return None
    rows = torch.nonzero(moving.index_select(0, problem.rows.row_owner)).squeeze(1)
    return Selection(torch.nonzero(going).squeeze(1), cells, rows)


def _rounding(problem: ContactProblem, precondition: Map, y: Tensor) -> Tensor:
    """The residual that rounding alone may leave in each colony, (B,): a few units in the last
    place of the forces on a cell, opposing ones not set off."""
    forces = (
        problem.rows.transpose_of_sizes(problem.gap.abs() + problem.rows.sizes_of(y))
        + problem.alpha * y.abs()
    )
    return 2 * torch.finfo(y.dtype).eps * worst_of(precondition(forces), problem.colonies)


class FreeDofPreconditioner:
    """The preconditioner among the degrees of freedom that are free: what it is given elsewhere it
    does not look at, and leaves at 0."""

    def __init__(self, inverse: Tensor):
        self._inverse, self._blocks = inverse, Blocks(inverse.clone())
        # of the length, the only one that may be held
        self._free = torch.ones_like(inverse[:, -1, -1])

    def at(self, free: Tensor) -> Map:
        """With these free, (N, D). It holds until the next are asked for: from one round to the
        next few are others."""
        cells = torch.nonzero(free[:, -1] != self._free).squeeze(1)
        self._free = free[:, -1]
        whole, held = self._inverse.index_select(0, cells), self._free.index_select(0, cells) == 0
        # The inverse of the block without it, and not a part of the whole block's inverse, in which
        # the length would still give way: with that, the cells whose length is held, where pressure
        # is, took three times as many iterations. Where rounding would leave nothing of it, the
        # part must do.
        own = whole[:, -1:, -1]
        along = torch.where(own > 0, whole[:, :, -1] / torch.where(own > 0, own, 1.0).sqrt(), 0.0)
        diagonal = whole.diagonal(dim1=1, dim2=2)[:, :-1]
        along = along * (diagonal - along[:, :-1].square() > LEAST_LEFT * diagonal).all(
            1, keepdim=True
        )
        without = whole - along.unsqueeze(2) * along.unsqueeze(1)
        without[:, -1] = 0.0
        without[:, :, -1] = 0.0
        self._blocks.value.index_copy_(
            0, cells, torch.where(held.reshape(-1, 1, 1), without, whole)
        )
        return self._blocks.times


def _operator(problem: ContactProblem, active: Tensor) -> Map:
    """The system's matrix. What it gives for a degree of freedom that is not free is for the
    preconditioner to drop."""
    rows, alpha, unilateral = problem.rows, problem.alpha, problem.unilateral

    def apply(v: Tensor) -> Tensor:
        change = rows.apply(v)
        return rows.apply_transpose(active * change if unilateral else change).addcmul_(alpha, v)

    return apply


def _free(y: Tensor, gradient: Tensor, problem: ContactProblem) -> Tensor:
    """1 for every degree of freedom that may move, 0 for a rigid length and for one at its bound
    that is pushed further down. (N, D)"""
    free = torch.ones_like(y)
    free[:, -1] = (~(((y[:, -1] <= problem.lower) & (gradient[:, -1] > 0)) | problem.rigid)).to(
        y.dtype
    )
    return free


def _line_search(problem: ContactProblem, y, after, gradient, direction, going):
    """Take the full step, its lengths stopped at their bounds; in the colonies where the energy
    would rise again on the way, one that ends at its least.

    Anything less exact lets two sets of contacts take turns: each step ends where the other's
    begins, and the energy falls by next to nothing. A step is made shorter before its lengths are
    stopped, not after: else those next to their bound would come nearer each time and never be
    there. Where every row holds and no length is stopped, the full step is the minimum and needs no
    looking at. Returns where it ends, the rows' gaps there, which of them act, and the gradient.
    """
    colonies, owner = problem.colonies, problem.colonies.owner
    length = going.to(y.dtype)
    for _ in range(MAX_HALVINGS):
        new = torch.addcmul(y, length.index_select(0, owner).unsqueeze(1), direction)
        stopped = colonies.any(new[:, -1] < problem.lower)
        new[:, -1] = torch.maximum(new[:, -1], problem.lower)
        then = problem.after(new)
        active = problem.acting(then)
        ahead = problem.gradient(new, then * active)
        # asked of each colony by itself: one that needs no looking at must not change because
        # another does
        going = going & (stopped | problem.unilateral)
        if not bool(going.any()):
            break
        step = new - y
        terms = [gradient * step, gradient * direction, ahead * step]
        slope, whole, end = colonies.sum(torch.stack([x.sum(1) for x in terms], 1)).unbind(1)
        steep, uphill = (
            going & stopped & (slope > DOWNHILL * length * whole),
            going & (end > STEEP * slope.abs()),
        )
        going = steep | uphill
        if not bool(going.any()):
            break
        share = _least(problem, after, then, step, slope, uphill)
        share = torch.where(steep, 0.5, share)
        # the way to a step that is stopped is not the one that leads there: on that, the first of
        # the lengths comes to its bound at the least
        free_run = _to_bound(problem, y, direction)
        length = torch.where(
            going,
            torch.maximum(share * length, torch.where(free_run < length, free_run, 0.0)),
            length,
        )
    return new, then, active, ahead


def _to_bound(problem: ContactProblem, y: Tensor, direction: Tensor) -> Tensor:
    """The share of a direction at which the first length that was above its bound is just at it,
    (B,); infinite where none comes to be."""
    room, way = y[:, -1] - problem.lower, direction[:, -1]
    shrinks = (room > 0) & (way < 0)
    # a hair more, so that it is stopped there, and not short of there
    share = torch.where(shrinks, room / torch.where(shrinks, -way, 1.0), torch.inf) * (1 + 1e-5)
    return -problem.colonies.max(-share, empty=-torch.inf)


def _least(
    problem: ContactProblem, after: Tensor, then: Tensor, step: Tensor, slope: Tensor, going: Tensor
) -> Tensor:
    """The share of a step at which the energy is least, (B,), to LEVEL of its slope, in the
    colonies where it rises at the end; 1 in others.

    after, then: (R,) the gaps before the step and after it. slope: (B,) of the energy where the
    step begins. The energy is convex, so its slope only grows, and by terms that are none of them
    negative: no digits are lost, as they would be in a difference of energies.
    """
    rows, before, change = (
        problem.of_rows,
        after.clamp(max=0) if problem.unilateral else after,
        after - then,
    )
    # the curvature that the rows do not give
    drag = problem.colonies.sum((problem.alpha * step * step).sum(1, keepdim=True)).squeeze(1)

    def look(share: Tensor):
        left = after - share.index_select(0, rows.owner) * change
        acting = problem.acting(left)
        terms = torch.stack([(before - left * acting) * change, acting * change * change], 1)
        grown, curvature = rows.sum(terms).unbind(1)
        return slope + share * drag + grown, curvature + drag

    share = torch.ones_like(slope)
    here, curvature = look(share)
    low, high = torch.zeros_like(share), torch.ones_like(share)
    for _ in range(MAX_LINE_SEARCH):
        if not bool(going.any()):
            break
        low, high = torch.where(here > 0, low, share), torch.where(here > 0, share, high)
        tangent = share - here / torch.where(curvature > 0, curvature, 1.0)
        better = torch.where((tangent > low) & (tangent < high), tangent, 0.5 * (low + high))
        share = torch.where(going, better, share)
        here, curvature = look(share)
        going = going & (here.abs() > LEVEL * slope.abs())
    return share


def _block_inverse(problem: ContactProblem, active: Tensor) -> Tensor:
    """Block Jacobi: each cell's own D × D block, inverted, (N, D, D)."""
    blocks = problem.rows.blocks(active if problem.unilateral else None)
    # A sum of products is off by a few units in the last place of its diagonal. Where alpha is
    # smaller than that, rounding alone makes a block indefinite, and CG needs a positive definite
    # preconditioner: so each block is raised by more.
    floor = BLOCK_FLOOR * torch.finfo(blocks.dtype).eps
    blocks.diagonal(dim1=1, dim2=2).mul_(1.0 + floor).add_(problem.alpha)
    # No check here: a colony that is not finite has such an inverse, and its residual says so
    # without stopping the others. Inverted in float64, since float32 loses the small eigenvalues of
    # a block whose eigenvalues differ by a million.
    inverse = torch.linalg.inv_ex(blocks.double()).inverse
    return (inverse + inverse.mT).mul_(0.5).to(blocks.dtype).contiguous()


def _attach_gradient(
    problem: ContactProblem, end: _Iterate, tolerance: Tensor, max_iterations: int
) -> Tensor:
    """y as a differentiable function of the problem: r(y, θ) = 0 gives dy = −A⁻¹ dr, with contacts
    and bounds as they were found."""
    at_bound = (end.free[:, -1] == 0) & ~problem.rigid
    length = torch.where(at_bound, problem.lower, end.y[:, -1])
    held = torch.cat([end.y[:, :-1], length.unsqueeze(1)], 1)
    residual = problem.gradient(held, problem.after(held) * end.active) * end.free
    solve_again = _AdjointSolve(
        _detached(problem), end.active, end.free, end.inverse, tolerance, max_iterations
    )
    return held + _AdjointFunction.apply(residual, solve_again)


class _AdjointSolve:
    def __init__(self, problem, active, free, inverse, tolerance, max_iterations):
        self.problem, self.active, self.free = problem, active, free
        self.inverse, self.tolerance, self.max_iterations = inverse, tolerance, max_iterations

    def __call__(self, grad: Tensor) -> Tensor:
        colonies, b = self.problem.colonies, grad * self.free
        precondition = FreeDofPreconditioner(self.inverse).at(self.free)
        # the forward solve's tolerance is a matter of overlaps; a gradient wants more
        tolerance = self.tolerance.clamp(max=1e-4 if grad.dtype == torch.float32 else 1e-8)
        target = tolerance * worst_of(precondition(b), colonies)
        return conjugate_gradients(
            _operator(self.problem, self.active),
            b,
            precondition,
            colonies,
            target,
            self.max_iterations,
        ).x


class _AdjointFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx, residual: Tensor, solve_again: _AdjointSolve) -> Tensor:
        ctx.solve_again = solve_again
        return torch.zeros_like(residual)

    @staticmethod
    def backward(ctx, grad: Tensor):
        return -ctx.solve_again(grad.contiguous()), None

"""Minimise the energy of one-sided contacts: semismooth Newton, each colony by itself.

The rules are those of `kernels.solve`, for tensors of many colonies, on any device: Newton steps
are projected on the bounds of the lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.kernels.scheme import (
    CREEP,
    EASY_ROUNDS,
    FORCING,
    FORCING_LATE,
    LEVEL,
    MOST_LOOKS,
    MOST_ROUNDS,
    RAISED,
    ROUNDING,
)
from torchfilm.physics.preconditioner import symmetric_inverse
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.cg import conjugate_gradients
from torchfilm.tools.ragged import Blocks, Groups
from torchfilm.tools.reads import numbers, reads_are_free

# Looks of a line search between two reads whether all colonies have found their place: most need
# fewer.
LOOKS = 4


@dataclass(frozen=True)
class Minimum:
    """The end of a minimisation.

    y (N, D) the scaled move. after (R,) the gaps after it. active (R,) 1 for rows that push. free
    (N, D) 1 where no bound holds. error (B,): see `minimise`. iterations (B,) of CG.
    """

    y: Tensor
    after: Tensor
    active: Tensor
    free: Tensor
    error: Tensor
    iterations: Tensor

    def where(self, colonies: Tensor, other: Minimum, problem: ContactProblem) -> Minimum:
        """This one in some colonies, (B,) bool, and the other elsewhere."""
        of = {
            "of cells": colonies.index_select(0, problem.colonies.owner),
            "of rows": colonies.index_select(0, problem.of_rows.owner),
            "of colonies": colonies,
        }
        kinds = ["of cells", "of rows", "of rows", "of cells"] + 2 * ["of colonies"]
        both = zip(kinds, vars(self).values(), vars(other).values(), strict=True)
        return Minimum(
            *(torch.where(of[kind].reshape(-1, *[1] * (a.dim() - 1)), a, b) for kind, a, b in both)
        )


def minimise(
    problem: ContactProblem, y: Tensor, tolerance: float, cap: Tensor, limit: int
) -> Minimum:
    """Minimise from y (N, D).

    A colony stops when the error that is left, estimated by the fall of the energy in the last
    round and by the residual, is at most `tolerance` of its contacts' overlap: root mean square,
    overlaps counted up to `cap` (B,) µm, so that what has not converged does not loosen the rule.
    """
    colonies, owner = problem.colonies, problem.colonies.owner
    pushes = problem.of_rows.any(problem.gap < 0).index_select(0, owner).unsqueeze(1)
    y = torch.where(pushes, y, 0.0)  # where nothing pushes, nothing moves at all
    y[:, -1] = torch.maximum(y[:, -1], problem.lower)
    fall = torch.full((colonies.size,), torch.inf, dtype=torch.float64, device=y.device)
    iterations = torch.zeros(colonies.size, dtype=torch.int64, device=y.device)
    here = _Point(
        y, problem.gap_after(y), torch.zeros_like(problem.rigid), fall, torch.zeros_like(iterations)
    )
    at = _look(problem, here, cap)
    going = at.goes_on(tolerance) & (limit > 0)
    goes_on = bool(going.any())
    for round_ in range(MOST_ROUNDS):
        if not goes_on:
            break
        forcing = FORCING if round_ < EASY_ROUNDS else FORCING_LATE
        target = torch.where(going, forcing**2 * at.residual, torch.inf)
        result = conjugate_gradients(
            problem.system(at.active),
            -at.gradient,
            Blocks(at.inverse).times,
            colonies,
            target,
            limit - iterations,
            by_energy=True,
        )
        iterations = iterations + result.iterations
        search, searches = _LineSearch(problem, here, at, result.x, going), True
        while searches:
            search.look()
            there = search.end()
            found = _look(problem, there, cap)
            # who has stopped stays as it is, whatever the others of the batch do
            left = going & found.goes_on(tolerance) & (iterations < limit) & (there.stuck < 2)
            searches, goes_on = map(bool, numbers(search.looking.any(), left.any()))
        here, at, going = there, found, left
    free = torch.ones_like(y)
    free[:, -1] = (~at.held & ~problem.rigid).to(y.dtype)
    return Minimum(here.y, here.after, at.active, free, at.error, iterations)


@dataclass(frozen=True)
class _Point:
    """Where a round begins: the scaled move (N, D), the gaps after it (R,), lengths that step alone
    (N,); and, (B,), how far the energy fell in the last round, and for how many rounds it has not.
    """

    y: Tensor
    after: Tensor
    alone: Tensor
    fall: Tensor
    stuck: Tensor


@dataclass(frozen=True)
class _Look:
    """What a round finds at y: rows that push (R,), lengths that are held (N,), the gradient
    (N, D), inverse blocks (N, D, D), the steps down the slope of lengths alone (N,), and, (B,), the
    residual of the others and the error."""

    active: Tensor
    held: Tensor
    gradient: Tensor
    inverse: Tensor
    downhill: Tensor
    residual: Tensor
    error: Tensor

    def goes_on(self, tolerance: float) -> Tensor:
        """Which colonies have not converged but still may, (B,) bool."""
        return (self.error > tolerance) & (self.residual < torch.inf)


def _look(problem: ContactProblem, here: _Point, cap: Tensor) -> _Look:
    colonies, rows = problem.colonies, problem.of_rows
    y, after, alone, fall = here.y, here.after, here.alone, here.fall
    active = (after < 0).to(after.dtype)
    gradient = problem.gradient(y, after * active)
    at_bound = (y[:, -1] <= problem.lower) & (gradient[:, -1] >= 0)
    alone = alone & ~at_bound
    inverse, own = inverse_blocks(problem, active, at_bound | alone)
    z = Blocks(inverse).times(gradient)
    limits = cap.index_select(0, rows.owner).square()
    squares = torch.minimum((after * active).square().double(), limits)
    overlap = rows.sum(squares)
    residual = colonies.sum((gradient * z).double().sum(1, keepdim=True)).squeeze(1)
    downhill = torch.where(alone, gradient[:, -1] / own, 0.0)
    of_alone = (downhill * gradient[:, -1]).double().unsqueeze(1)
    whole = residual + colonies.sum(of_alone).squeeze(1)
    left = torch.maximum(fall, whole)
    # where nothing overlaps any more, relative to contacts as deep as counted
    error = (left / torch.where(overlap > 0, overlap, cap.square())).clamp(min=0.0).sqrt()
    error = torch.where(whole == 0, 0.0, error)  # solved exactly
    error = torch.where(whole < torch.inf, error, torch.inf)  # also where it is NaN
    return _Look(active, at_bound | alone, gradient, inverse, downhill, residual, error)


def inverse_blocks(problem: ContactProblem, active: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of each cell's own block of the system, (N, D, D), without its last row and
    column where the length is held, (N,) bool; and the diagonal of the lengths, (N,)."""
    blocks = problem.rows.blocks(active).double()
    diagonal = blocks.diagonal(dim1=1, dim2=2)
    diagonal.mul_(1.0 + RAISED).add_(problem.alpha)
    own = blocks[:, -1, -1].to(active.dtype)
    free = (~held).double().unsqueeze(1)
    blocks[:, -1, :-1] *= free
    blocks[:, :-1, -1] *= free
    inverse = symmetric_inverse(blocks)
    inverse[:, -1, -1] *= free.squeeze(1)
    return inverse.to(active.dtype), own


def _stopped_at_bounds(
    y: Tensor, step: Tensor, low: Tensor, colonies: Groups
) -> tuple[Tensor, Tensor]:
    """The step (N, D), shorter for lengths that would pass their bound, and how far each colony may
    go along it, (B,)."""
    room = low - y[:, -1]
    length = torch.maximum(step[:, -1], room)
    falls = length < 0
    most = torch.where(falls, room / torch.where(falls, length, 1.0), torch.inf).double()
    return torch.cat([step[:, :-1], length.unsqueeze(1)], 1), -colonies.max(-most, -torch.inf)


class _LineSearch:
    """How far each colony goes along its step: until the slope is at most LEVEL of that at the
    start, and no farther than its lengths may."""

    def __init__(
        self, problem: ContactProblem, here: _Point, at: _Look, direction: Tensor, going: Tensor
    ):
        rows, colonies = problem.of_rows, problem.colonies
        self.problem, self.here, self.going = problem, here, going
        wanted = torch.where(here.alone, -at.downhill, direction[:, -1])
        wanted = torch.cat([direction[:, :-1], wanted.unsqueeze(1)], 1)
        self.step, self.most = _stopped_at_bounds(here.y, wanted, problem.lower, colonies)
        self.stopped = self.step[:, -1] > wanted[:, -1]
        self.change = problem.rows.apply(self.step)
        self.e, self.q = here.after.double(), self.change.double()
        alpha, step = problem.alpha, self.step
        drag = torch.stack([(alpha * here.y * step).sum(1), (alpha * step**2).sum(1)], 1)
        pushed = (problem.applied_force * self.change).double().unsqueeze(1)
        self.first, self.second = colonies.sum(drag.double()).unbind(1)
        self.first = self.first + rows.sum(pushed).squeeze(1)
        zero = torch.zeros_like(self.first)
        self.start, curvature = self._slope(zero)
        self.looking = going & (self.start < 0) & (curvature > 0)
        share = -self.start / torch.where(self.looking, curvature, 1.0)
        self.share = torch.minimum(torch.where(self.looking, share, 0.0), self.most)
        self.low, self.high, self.looks = zero, torch.full_like(zero, torch.inf), 0
        self.one = zero.new_ones(())  # a GPU would copy a plain number each time

    def _slope(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """The slope and the curvature of the energy at a share of the step, (B,)."""
        rows = self.problem.of_rows
        left = (self.e - share.index_select(0, rows.owner) * self.q).clamp(max=0.0)
        both = rows.sum(torch.stack([-left * self.q, (left < 0) * self.q * self.q], 1))
        return both[:, 0] + self.first + self.second * share, both[:, 1] + self.second

    def look(self) -> None:
        """Look at LOOKS more places; where a read is free, only until all have found theirs."""
        free = reads_are_free(self.share.device)
        for _ in range(LOOKS):
            here, curvature = self._slope(self.share)
            flat = here.abs() <= -LEVEL * self.start
            looking = self.looking & ~flat & ~((here < 0) & (self.share == self.most))
            self.low = torch.where(looking & (here < 0), self.share, self.low)
            self.high = torch.where(looking & (here >= 0), self.share, self.high)
            new = self.share - here / torch.where(curvature > 0, curvature, self.one)
            between = torch.where(
                self.high < torch.inf, 0.5 * (self.low + self.high), 2.0 * self.share
            )
            new = torch.where((new > self.low) & (new < self.high), new, between)
            self.share = torch.where(looking, torch.minimum(new, self.most), self.share)
            self.looks += 1
            self.looking = looking & (self.looks < MOST_LOOKS)
            if free and not bool(self.looking.any()):
                break

    def end(self) -> _Point:
        """Where the colonies that were going are then; the others stay."""
        here, going, owner = self.here, self.going, self.problem.colonies.owner
        mine, row_owner = going.index_select(0, owner), self.problem.of_rows.owner
        stuck = torch.where(going, torch.where(self.share == 0, here.stuck + 1, 0), here.stuck)
        creeps = (self.share < CREEP).index_select(0, owner)
        alone = torch.where(mine, (here.alone | self.stopped) & creeps, here.alone)
        fall = torch.where(going, -0.5 * self.start * self.share, here.fall)
        share, step, low = self.share.to(here.y.dtype), self.step, self.problem.lower
        y = here.y + share.index_select(0, owner).unsqueeze(1) * step
        near = low + ROUNDING * (low.abs() + step[:, -1].abs())
        y[:, -1] = torch.where(y[:, -1] <= near, low, y[:, -1])
        y = torch.where(mine.unsqueeze(1), y, here.y)
        after = here.after - share.index_select(0, row_owner) * self.change
        return _Point(y, after, alone, fall, stuck)


@dataclass(frozen=True)
class Solved:
    """A solve of a pass; by colony α, all iterations, and where only softer contacts converged."""

    problem: ContactProblem
    end: Minimum
    hardness: Tensor
    spent: Tensor
    fell: Tensor

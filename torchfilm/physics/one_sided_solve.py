"""Minimise the energy of one-sided contacts: semismooth Newton, each colony by itself.

The rules are those of `kernels.solve`, for tensors of many colonies, on any device: Newton steps
are projected on the bounds of the lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.kernels.scheme import CREEP, FORCING, LEVEL, MOST_LOOKS, MOST_ROUNDS, ROUNDING
from torchfilm.physics.preconditioner import BLOCK_FLOOR
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.cg import conjugate_gradients
from torchfilm.tools.ragged import Blocks, Groups


@dataclass(frozen=True)
class Minimum:
    """The end of a minimisation.

    y (N, D) the scaled move. after (R,) the gaps after it. active (R,) 1 for rows that push. free
    (N, D) 1 where no bound holds. inverse (N, D, D) of the blocks of the rows that push. error
    (B,): see `minimise`. iterations (B,) of CG.
    """

    y: Tensor
    after: Tensor
    active: Tensor
    free: Tensor
    inverse: Tensor
    error: Tensor
    iterations: Tensor

    def where(self, colonies: Tensor, other: Minimum, problem: ContactProblem) -> Minimum:
        """This one in some colonies, (B,) bool, and the other elsewhere."""
        of = {
            "of cells": colonies.index_select(0, problem.colonies.owner),
            "of rows": colonies.index_select(0, problem.of_rows.owner),
            "of colonies": colonies,
        }
        kinds = ["of cells", "of rows", "of rows", "of cells", "of cells"] + 2 * ["of colonies"]
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
    low = problem.lower
    y[:, -1] = torch.maximum(y[:, -1], low)
    after = problem.gap_after(y)
    fall = torch.full((colonies.size,), torch.inf, dtype=torch.float64, device=y.device)
    iterations = torch.zeros(colonies.size, dtype=torch.int64, device=y.device)
    stuck = torch.zeros_like(iterations)
    alone = torch.zeros_like(problem.rigid)  # lengths that step alone
    going = torch.ones_like(iterations, dtype=torch.bool)
    for number in range(MOST_ROUNDS + 1):
        at = _look(problem, y, after, alone, fall, cap)
        alone = alone & at.held
        # who has stopped stays as it is, whatever the others of the batch do
        going = going & (at.error > tolerance) & (at.residual < torch.inf)
        going = going & (iterations < limit) & (stuck < 2)
        if number == MOST_ROUNDS or not bool(going.any()):
            break
        target = torch.where(going, FORCING**2 * at.residual, torch.inf)
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
        wanted = torch.where(alone, -at.downhill, result.x[:, -1])
        wanted = torch.cat([result.x[:, :-1], wanted.unsqueeze(1)], 1)
        step, most = _stopped_at_bounds(y, wanted, low, colonies)
        change = problem.rows.apply(step)
        share, lost = _search_line(problem, after, change, y, step, most, going)
        fall = torch.where(going, lost, fall)
        stuck = torch.where(going, torch.where(share == 0, stuck + 1, 0), stuck)
        stopped = step[:, -1] > wanted[:, -1]
        creeps = (share < CREEP).index_select(0, owner)
        alone = torch.where(going.index_select(0, owner), (alone | stopped) & creeps, alone)
        share = share.to(y.dtype)
        y = y + share.index_select(0, owner).unsqueeze(1) * step
        near = low + ROUNDING * (low.abs() + step[:, -1].abs())
        y[:, -1] = torch.where(y[:, -1] <= near, low, y[:, -1])
        after = after - share.index_select(0, problem.of_rows.owner) * change
    free = torch.ones_like(y)
    free[:, -1] = (~at.held & ~problem.rigid).to(y.dtype)
    inverse, _ = _inverse_blocks(problem, at.active, torch.zeros_like(at.held))
    return Minimum(y, after, at.active, free, inverse, at.error, iterations)


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


def _look(
    problem: ContactProblem, y: Tensor, after: Tensor, alone: Tensor, fall: Tensor, cap: Tensor
) -> _Look:
    colonies, rows = problem.colonies, problem.of_rows
    active = (after < 0).to(after.dtype)
    gradient = problem.gradient(y, after * active)
    at_bound = (y[:, -1] <= problem.lower) & (gradient[:, -1] >= 0)
    alone = alone & ~at_bound
    inverse, own = _inverse_blocks(problem, active, at_bound | alone)
    z = Blocks(inverse).times(gradient)
    limits = cap.index_select(0, rows.owner).square()
    squares = torch.minimum((after * active).square().double(), limits)
    overlap = rows.sum(squares.unsqueeze(1)).squeeze(1)
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


def _inverse_blocks(problem: ContactProblem, active: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of each cell's own block of the system, (N, D, D), without its last row and
    column where the length is held, (N,) bool; and the diagonal of the lengths, (N,)."""
    blocks = problem.rows.blocks(active).double()
    diagonal = blocks.diagonal(dim1=1, dim2=2)
    diagonal.mul_(1.0 + BLOCK_FLOOR * torch.finfo(active.dtype).eps).add_(problem.alpha)
    own = blocks[:, -1, -1].to(active.dtype)
    free = (~held).double().unsqueeze(1)
    blocks[:, -1, :-1] *= free
    blocks[:, :-1, -1] *= free
    inverse = torch.linalg.inv_ex(blocks).inverse
    inverse = (inverse + inverse.mT).mul_(0.5)
    inverse[:, -1, -1] *= free.squeeze(1)
    return inverse.to(active.dtype).contiguous(), own


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


def _search_line(
    problem: ContactProblem,
    after: Tensor,
    change: Tensor,
    y: Tensor,
    step: Tensor,
    most: Tensor,
    going: Tensor,
) -> tuple[Tensor, Tensor]:
    """How far each colony goes along its step, at most `most` (B,), until the slope is at most
    LEVEL of that at the start, and how far the energy falls, (B,)."""
    rows, colonies = problem.of_rows, problem.colonies
    e, q = after.double(), change.double()
    drag = torch.stack([(problem.alpha * y * step).sum(1), (problem.alpha * step**2).sum(1)], 1)
    pushed = rows.sum((problem.applied_force * change).double().unsqueeze(1)).squeeze(1)
    first, second = colonies.sum(drag.double()).unbind(1)
    first = first + pushed

    def slope(share: Tensor) -> tuple[Tensor, Tensor]:
        left = (e - share.index_select(0, rows.owner) * q).clamp(max=0.0)
        both = rows.sum(torch.stack([-left * q, (left < 0) * q * q], 1))
        return both[:, 0] + first + second * share, both[:, 1] + second

    zero = torch.zeros_like(first)
    start, curvature = slope(zero)
    going = going & (start < 0) & (curvature > 0)
    share = torch.where(going, -start / torch.where(going, curvature, 1.0), 0.0)
    share = torch.minimum(share, most)
    low, high, looking = zero, torch.full_like(zero, torch.inf), going
    for _ in range(MOST_LOOKS):
        here, curvature = slope(share)
        looking = looking & ~(here.abs() <= -LEVEL * start) & ~((here < 0) & (share == most))
        if not bool(looking.any()):
            break
        low = torch.where(looking & (here < 0), share, low)
        high = torch.where(looking & (here >= 0), share, high)
        new = share - here / torch.where(curvature > 0, curvature, 1.0)
        between = torch.where(high < torch.inf, 0.5 * (low + high), 2.0 * share)
        new = torch.where((new > low) & (new < high), new, between)
        share = torch.where(looking, torch.minimum(new, most), share)
    return share, -0.5 * start * share

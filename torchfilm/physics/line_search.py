"""The line search of a Newton step, for all colonies at once."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.physics.problem import ContactProblem

# A line search stops when the slope is at most LEVEL of the slope at the start. A full step is kept
# without a search if its upward slope at the end is at most STEEP of the slope at the start.
STEEP, LEVEL = 0.5, 0.1
MAX_LINE_SEARCH = 12
# With lengths stopped at their bounds, a step must keep DOWNHILL of its slope, or it is halved. A
# step is shortened at most MAX_HALVINGS times.
DOWNHILL, MAX_HALVINGS = 0.01, 30


def search_line(problem: ContactProblem, y, after, gradient, direction, going):
    """Take the full step with lengths stopped at their bounds, or a shorter one if the energy
    rises.

    In colonies where the energy would rise again along the step, the step ends where the energy is
    least. With a less exact search two sets of contacts can alternate: each step ends where the
    other begins, and the energy hardly falls. The step is shortened before its lengths are stopped,
    not after. Otherwise lengths near their bound would approach it each time and never reach it.
    Where every row acts and no length is stopped, the full step is the minimum and needs no search.

    Returns the end point (N, D), the rows' gaps there (R,), which of them act (R,), and the
    gradient there (N, D).
    """
    colonies, owner = problem.colonies, problem.colonies.owner
    length = going.to(y.dtype)
    for _ in range(MAX_HALVINGS):
        new = torch.addcmul(y, length.index_select(0, owner).unsqueeze(1), direction)
        stopped = colonies.any(new[:, -1] < problem.lower)
        new[:, -1] = torch.maximum(new[:, -1], problem.lower)
        then = problem.gap_after(new)
        active = problem.acting(then)
        ahead = problem.gradient(new, then * active)
        # decided for each colony by itself: a colony that needs no search must not change because
        # another one does
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
        share = _share_of_least_energy(problem, after, then, step, slope, uphill)
        share = torch.where(steep, 0.5, share)
        # A step with stopped lengths does not follow the straight line to its end. On that line the
        # step must at least be long enough for the first length to reach its bound.
        free_run = _share_to_bound(problem, y, direction)
        length = torch.where(
            going,
            torch.maximum(share * length, torch.where(free_run < length, free_run, 0.0)),
            length,
        )
    return new, then, active, ahead


def _share_to_bound(problem: ContactProblem, y: Tensor, direction: Tensor) -> Tensor:
    """The share of a direction at which the first length above its bound reaches it, (B,).

    Infinite where no length reaches its bound.
    """
    room, way = y[:, -1] - problem.lower, direction[:, -1]
    shrinks = (room > 0) & (way < 0)
    # slightly more, so that the length is stopped at the bound and not just before it
    share = torch.where(shrinks, room / torch.where(shrinks, -way, 1.0), torch.inf) * (1 + 1e-5)
    return -problem.colonies.max(-share, empty=-torch.inf)


def _share_of_least_energy(
    problem: ContactProblem, after: Tensor, then: Tensor, step: Tensor, slope: Tensor, going: Tensor
) -> Tensor:
    """The share of a step at which the energy is least, (B,), to LEVEL of its slope.

    The search covers the colonies in `going`, where the energy rises at the end; others get 1.
    after, then: (R,) the gaps before and after the step. slope: (B,) of the energy where the step
    begins. The energy is convex, so its slope only grows, by terms that are never negative.
    Therefore no digits are lost, unlike in a difference of energies.
    """
    rows, before, change = (
        problem.of_rows,
        after.clamp(max=0) if problem.unilateral else after,
        after - then,
    )
    # the curvature of the drag term; the rows add theirs below
    drag = problem.colonies.sum((problem.alpha * step * step).sum(1, keepdim=True)).squeeze(1)

    def slope_at(share: Tensor):
        left = after - share.index_select(0, rows.owner) * change
        acting = problem.acting(left)
        terms = torch.stack([(before - left * acting) * change, acting * change * change], 1)
        grown, curvature = rows.sum(terms).unbind(1)
        return slope + share * drag + grown, curvature + drag

    share = torch.ones_like(slope)
    here, curvature = slope_at(share)
    low, high = torch.zeros_like(share), torch.ones_like(share)
    for _ in range(MAX_LINE_SEARCH):
        if not bool(going.any()):
            break
        low, high = torch.where(here > 0, low, share), torch.where(here > 0, share, high)
        tangent = share - here / torch.where(curvature > 0, curvature, 1.0)
        better = torch.where((tangent > low) & (tangent < high), tangent, 0.5 * (low + high))
        share = torch.where(going, better, share)
        here, curvature = slope_at(share)
        going = going & (here.abs() > LEVEL * slope.abs())
    return share

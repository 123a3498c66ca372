"""The line search of a Newton step, for all colonies at once."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import BEYOND_BOUND, DOWNHILL, MAX_HALVINGS, STEEP
from torchfilm.physics.problem import ContactProblem


def search_line(problem: ContactProblem, y, after, gradient, direction, going):
    """Take the full step with lengths stopped at their bounds, or a shorter one if the energy
    rises.

    In colonies where the energy would rise again along the step, the step ends where the energy is
    least. The step is shortened before its lengths are stopped, not after. Otherwise lengths near
    their bound would approach it each time and never reach it. Where no length is stopped, the full
    step is the minimum and needs no search.

    Returns the end point (N, D), the rows' gaps there (R,), and the gradient there (N, D).
    """
    colonies, owner = problem.colonies, problem.colonies.owner
    length = going.to(y.dtype)
    for _ in range(MAX_HALVINGS):
        new = torch.addcmul(y, length.index_select(0, owner).unsqueeze(1), direction)
        stopped = colonies.any(new[:, -1] < problem.lower)
        new[:, -1] = torch.maximum(new[:, -1], problem.lower)
        then = problem.gap_after(new)
        ahead = problem.gradient(new, then)
        # decided for each colony by itself: a colony that needs no search must not change because
        # another one does
        going = going & stopped
        step = new - y
        terms = [gradient * step, gradient * direction, ahead * step]
        slope, whole, end = colonies.sum(torch.stack([x.sum(1) for x in terms], 1)).unbind(1)
        steep = going & (slope > DOWNHILL * length * whole)
        going = steep | (going & (end > STEEP * slope.abs()))
        if not bool(going.any()):
            break
        share = torch.where(steep, 0.5, _share_of_least_energy(problem, after, then, step, slope))
        # A step with stopped lengths does not follow the straight line to its end. On that line the
        # step must at least be long enough for the first length to reach its bound.
        free_run = _share_to_bound(problem, y, direction)
        length = torch.where(
            going,
            torch.maximum(share * length, torch.where(free_run < length, free_run, 0.0)),
            length,
        )
    return new, then, ahead


def _share_to_bound(problem: ContactProblem, y: Tensor, direction: Tensor) -> Tensor:
    """The share of a direction at which the first length above its bound reaches it, (B,).

    Infinite where no length reaches its bound.
    """
    room, way = y[:, -1] - problem.lower, direction[:, -1]
    shrinks = (room > 0) & (way < 0)
    share = torch.where(shrinks, room / torch.where(shrinks, -way, 1.0), torch.inf)
    share = share * (1 + BEYOND_BOUND)
    return -problem.colonies.max(-share, empty=-torch.inf)


def _share_of_least_energy(
    problem: ContactProblem, after: Tensor, then: Tensor, step: Tensor, slope: Tensor
) -> Tensor:
    """The share of a step at which the energy is least, (B,).

    after, then: (R,) the gaps before and after the step. slope: (B,) of the energy where the step
    begins. Every row acts, so the slope grows in proportion to the share, by terms that are never
    negative. Therefore no digits are lost, unlike in a difference of energies.
    """
    change = after - then
    end = after - change  # `then`, as rounding leaves it
    drag = problem.colonies.sum((problem.alpha * step * step).sum(1, keepdim=True)).squeeze(1)
    terms = torch.stack([(after - end) * change, change * change], 1)
    grown, curvature = problem.of_rows.sum(terms).unbind(1)
    return 1.0 - (slope + drag + grown) / (curvature + drag)

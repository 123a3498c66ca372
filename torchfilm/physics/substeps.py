"""Sub-steps of colonies whose cells grow far in one step, and colonies that cannot be stepped."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.kernels.scheme import (
    BAD_DRAG,
    BAD_LENGTH,
    CONVERGED,
    MOST_SUBSTEPS,
    NOT_FINITE,
    ROUNDING,
    TOO_FAST,
)
from torchfilm.tools.ragged import Groups


@torch.no_grad()
def substeps(
    groups: Groups,
    position: Tensor,
    axis: Tensor,
    move: Tensor,
    length: Tensor,
    elongation: Tensor,
    viscosity: Tensor,
    length_drag: Tensor,
    *,
    longest: float,
) -> tuple[Tensor, Tensor]:
    """How many sub-steps each colony takes, (B,), so that no cell grows by more than `longest` (µm)
    in one; and the status (B,) of colonies that cannot be stepped.

    position, axis (N, d), move (N, D), the others (N,).
    """
    columns = [length.unsqueeze(1), elongation.unsqueeze(1)]
    every = torch.cat([position, axis, move, *columns], 1)
    broken = groups.any(~torch.isfinite(every).all(1))
    drags = torch.stack([x.to(length.dtype) for x in (viscosity, length_drag)])
    no_drag = groups.any(~(torch.isfinite(drags) & (drags > 0)).all(0))
    steps = torch.ceil(groups.max(elongation.detach()).double() / longest * (1 - ROUNDING))
    status = torch.where(steps > MOST_SUBSTEPS, TOO_FAST, CONVERGED)
    status = torch.where(broken, NOT_FINITE, status)
    status = torch.where(no_drag, BAD_DRAG, status)
    status = torch.where(groups.any((length < 0) & (length > -torch.inf)), BAD_LENGTH, status)
    return torch.where(status == CONVERGED, steps.clamp(min=1), 1).long(), status

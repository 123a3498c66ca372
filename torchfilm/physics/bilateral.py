"""Steps of bilateral contacts, in torch: the reference of the compiled ones, and the path of
gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import CLOSE, DEEP, PENALTY
from torchfilm.physics.contact_records import CellProperties, ContactReport, ContactSettings, Moved
from torchfilm.physics.contact_step import contact_step
from torchfilm.physics.step_records import StepInput, StepResult


def contact_steps(given: StepInput[ContactSettings]) -> StepResult:
    """Grow by given.growth and part what overlaps, in given.steps (B,) sub-steps."""
    groups, steps, settings = given.groups, given.steps, given.settings
    first = groups.begin[:-1].clamp(max=given.position.shape[0] - 1)
    reference = given.position.detach().index_select(0, first).index_select(0, groups.owner)
    alpha = given.alpha
    assert alpha is not None
    soften = lambda kind, value: value * alpha if kind == "stiffness" else value
    cells = CellProperties(
        settings,
        given.radius,
        given.viscosity,
        given.length_drag,
        alpha,
        _overlap(given, alpha),
        given.colony_ids,
        reference,
        given.start,
        groups,
        given.surfaces,
        [(kind, soften(kind, value)) for kind, value in given.walls],
    )
    none = torch.zeros_like(groups.counts)
    report = ContactReport(
        none, none, torch.zeros_like(none, dtype=given.length.dtype), none, none, none,
        torch.zeros_like(given.hardness),
    )  # fmt: skip
    clipped = torch.zeros_like(groups.owner, dtype=torch.bool)
    reach = torch.zeros_like(given.radius)
    at = Moved(given.position, given.axis, given.length, clipped, reach, given.start)
    passes = torch.where(steps > 1, settings.coarse_passes, settings.passes)
    share = given.growth / steps.clamp(min=1).index_select(0, groups.owner)
    for k in range(int(steps.max())):
        at, report = contact_step(cells, at, report, share, k < steps, passes)
    return StepResult(
        at.position, at.axis, at.length, at.first_move, given.hardness, report.status,
        report.iterations, report.residual.double(), report.passes, report.clipped,
        report.deeply_overlapping, report.alpha,
    )  # fmt: skip


@torch.no_grad()
def _overlap(given: StepInput[ContactSettings], alpha: Tensor) -> Tensor:
    """How deep a contact of each cell may be left, (N,) µm."""
    if given.settings.overlap is not None:
        return torch.full_like(given.radius, given.settings.overlap)
    coarse = (given.steps > 1).index_select(0, given.groups.owner)
    usual = torch.where(coarse, CLOSE, DEEP * given.radius)
    return usual * (alpha * given.length_drag / PENALTY).clamp(max=1.0)

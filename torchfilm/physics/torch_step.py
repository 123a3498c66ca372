"""A step of mechanics in tensors: the reference of the compiled one, for gradients and for CUDA."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import PENALTY
from torchfilm.kernels.scheme import BURIED, COLLAPSED, COMPRESSION, CONVERGED, LONG, MANY
from torchfilm.physics import bilateral, one_sided
from torchfilm.physics.contact_records import ContactReport, ContactSettings
from torchfilm.physics.step_records import MechanicsInput, MechanicsResult, StepInput, StepResult
from torchfilm.physics.substeps import substeps


def step(given: MechanicsInput) -> MechanicsResult:
    """Grow the cells, in sub-steps where one grows far, and part what overlaps."""
    viscosity = given.viscosity if given.drag is None else given.viscosity * given.drag
    count = given.length.numel()
    drags = viscosity.expand(count), given.length_drag.expand(count)
    steps, status = substeps(
        given.groups, given.position, given.axis, given.move, given.length, given.elongation,
        *drags, longest=given.longest,
    )  # fmt: skip
    base = given.length - given.elongation
    contacts = _contacts(given, base, drags, torch.where(status == CONVERGED, steps, 0))
    bilateral_ones = isinstance(given.settings, ContactSettings)
    found = (bilateral if bilateral_ones else one_sided).contact_steps(contacts)
    alpha = compression = None
    if given.compression is not None:
        alpha = contacts.alpha  # where it is given
        alpha = given.groups.spread(found.hardness.to(base.dtype)) if alpha is None else alpha
        compression = (given.compression + (base - found.length)).clamp(min=0.0)
    status = torch.maximum(status, found.status)
    collapsed = _collapsed_steps(given, found)
    lasting = (collapsed >= LONG) & (status == CONVERGED)
    return MechanicsResult(
        found.position, found.axis, found.length, found.move, found.length - base,
        given.groups.spread(collapsed), alpha, compression,
        ContactReport(
            torch.where(lasting, COLLAPSED, status), found.iterations, found.error, found.passes,
            found.clipped, found.deeply_overlapping, found.alpha,
        ), steps,
    )  # fmt: skip


def _contacts(
    given: MechanicsInput, base: Tensor, drags: tuple[Tensor, Tensor], steps: Tensor
) -> StepInput:
    """What the contact steps need. base: lengths before growth, (N,)."""
    own_dt = given.dt / steps.clamp(min=1).index_select(0, given.groups.owner).to(base.dtype)
    alpha = given.alpha if given.stiffness is None else 1.0 / (given.stiffness * own_dt)
    shortest = base
    if given.compression is None or given.contact_alpha is None:
        hardness = torch.zeros_like(steps, dtype=torch.float64)
        alpha = PENALTY / drags[1] if alpha is None else alpha
    else:
        hardness = given.groups.max(given.contact_alpha).double()
        left = COMPRESSION * (base + 2 * given.radius) - given.compression
        shortest = (base - left.clamp(min=0.0)).clamp(min=0.0)
    walls: list[tuple[str, Tensor | None]] = []
    for kind, value in given.walls:
        of_step = value * own_dt if value is not None and kind == "stiffness" else value
        walls.append((kind, None if of_step is None else of_step.expand(base.numel())))
    return StepInput(
        given.settings, given.groups, given.position, given.axis, base, given.elongation,
        given.radius, *drags, steps, given.move, hardness,
        None if alpha is None else alpha.expand(base.numel()),
        given.groups.spread(given.colony_id), given.surfaces, walls, shortest,
        None if given.bonds is None else given.bonds.over(own_dt), given.drift,
    )  # fmt: skip


def _collapsed_steps(given: MechanicsInput, found: StepResult) -> Tensor:
    """For how many steps in a row, this one included, the contacts of each colony have not held its
    cells apart, (B,)."""
    deep = found.deeply_overlapping > BURIED * given.groups.counts.clamp(min=MANY)
    return torch.where(deep, given.groups.max(given.collapsed) + 1, 0)

"""Contact mechanics of a batch: its walls on the device, its settings, and who computes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.effect import Binding, BoundEffect
from torchfilm.effects.mechanics_report import BURIED, LONG, MANY, MechanicsReport
from torchfilm.kernels.bilateral_scheme import PENALTY
from torchfilm.kernels.scheme import COMPRESSION
from torchfilm.physics import bilateral, compiled, one_sided, substeps
from torchfilm.physics.contact_records import ContactReport, ContactSettings
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.problem import COLLAPSED, CONVERGED
from torchfilm.physics.step_records import StepInput, StepResult
from torchfilm.physics.surfaces import Surface
from torchfilm.resolver import snapshot
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import has_tangent, tracked

if TYPE_CHECKING:
    from torchfilm.effects.mechanics import Mechanics


class BoundMechanics(BoundEffect):
    """Mechanics with its walls on the batch's device and its settings resolved."""

    effect: Mechanics

    def __init__(self, effect: Mechanics, binding: Binding):
        super().__init__(effect, binding)
        self.settings: OneSidedSettings | ContactSettings = effect.settings
        # A surface is made in each step, so that a gradient to a wall's place passes through each
        # of several backward passes.
        self.walls = snapshot(effect.walls, "Mechanics.walls", binding.batch)
        self.kinds = [
            "stiffness" if w.stiffness is not None else "weight" if w.weight is not None else "hard"
            for w in self.walls
        ]
        self.compiled = effect.backend_on(binding.batch.device) == "compiled"

    @property
    def by_kernels(self) -> bool:
        return self.compiled

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        elongation = state.fields.get("elongation")
        elongation = torch.zeros_like(state.length) if elongation is None else elongation
        drags = self._drags(state)
        steps, status = (compiled if self.compiled else substeps).substeps(
            state.groups, state.position, state.axis, state.displacement, state.length,
            elongation, *drags, longest=self.effect.max_elongation,
        )  # fmt: skip
        own_dt = partial(self._own_dt, state, dt, steps)
        base = state.length - elongation
        given = self._input(state, base, elongation, drags, steps, status, own_dt)
        found = self._taken(given)
        report = ContactReport(
            torch.maximum(status, found.status), found.iterations, found.error, found.passes,
            found.clipped, found.deeply_overlapping,
        )  # fmt: skip
        fields = {"displacement": found.move}
        if "elongation" in state.fields:
            fields["elongation"] = found.length - base
        if self.effect.one_sided:
            fields["contact_alpha"] = state.groups.spread(found.hardness.to(state.dtype))
            lost = state.fields["compression"] + base - found.length
            fields["compression"] = lost.clamp(min=0.0)
        return self._placed(state, found, fields, report, steps)

    @staticmethod
    def _own_dt(state: State, dt: float, steps: Tensor) -> Tensor:
        """The sub-step of each cell, h, (N,)."""
        return dt / steps.index_select(0, state.colony).to(state.dtype)

    def _input(
        self,
        state: State,
        base: Tensor,
        elongation: Tensor,
        drags: tuple[Tensor, Tensor],
        steps: Tensor,
        status: Tensor,
        own_dt: Callable[[], Tensor],
    ) -> StepInput:
        surfaces, walls = self._surfaces(state, own_dt)
        alpha = self._alpha(state, own_dt)
        if self.effect.one_sided:
            hardness = _of_colonies(state.contact_alpha, state.groups).double()
        else:
            hardness = torch.zeros_like(state.counts, dtype=torch.float64)
            alpha = PENALTY / drags[1] if alpha is None else alpha
        return StepInput(
            self.settings, state.groups, state.position, state.axis, base, elongation,
            state.radius, *drags, torch.where(status == CONVERGED, steps, 0),
            state.displacement, hardness, alpha, state.own_colony_id, surfaces, walls,
            _shortest(state, base) if self.effect.one_sided else base,
        )  # fmt: skip

    def _taken(self, given: StepInput) -> StepResult:
        """The contact steps, by kernels or by torch."""
        if not _tracked(given) and self.compiled:
            return compiled.contact_steps(given)
        return (one_sided if self.effect.one_sided else bilateral).contact_steps(given)

    def _alpha(self, state: State, own_dt: Callable[[], Tensor]) -> Tensor | None:
        """α of each cell where it is given, (N,); else None."""
        if self.values.stiffness is not None:
            return 1.0 / (self.values.stiffness.of_cells(state) * own_dt())
        if self.values.alpha is not None:
            return self.values.alpha.of_cells(state).expand(state.cells)
        return None

    def _placed(
        self,
        state: State,
        found: StepResult,
        fields: dict[str, Tensor],
        report: ContactReport,
        steps: Tensor,
    ) -> State:
        """The state with cells at their new position, axis and length, and these fields."""
        collapsed = self._collapsed_steps(state, report)
        lasting = (collapsed >= LONG) & (report.status == CONVERGED)
        made = MechanicsReport(
            torch.where(lasting, COLLAPSED, report.status), report.iterations, report.residual,
            report.passes, report.clipped, report.deeply_overlapping, steps,
        )  # fmt: skip
        fields["collapsed_steps"] = state.groups.spread(collapsed)
        return state.with_fields(**fields).replace(
            position=found.position, axis=found.axis, length=found.length,
            reports={**state.reports, "mechanics": made},
        )  # fmt: skip

    @staticmethod
    def _collapsed_steps(state: State, report: ContactReport) -> Tensor:
        """For how many steps in a row, this one included, the contacts of each colony have not held
        its cells apart, (B,)."""
        deep = report.deeply_overlapping > BURIED * state.counts.clamp(min=MANY)
        return torch.where(deep, state.groups.max(state.collapsed_steps) + 1, 0)

    def _drags(self, state: State) -> tuple[Tensor, Tensor]:
        """Viscosity, with the field `drag`, and length drag of each cell, (N,)."""
        drag = state.fields.get("drag")
        viscosity = self.values.viscosity.of_cells(state) * (1.0 if drag is None else drag)
        length_drag = self.values.length_drag.of_cells(state)
        return viscosity.expand(state.cells), length_drag.expand(state.cells)

    def _surfaces(
        self, state: State, own_dt: Callable[[], Tensor]
    ) -> tuple[list[Surface], list[tuple[str, Tensor | None]]]:
        """The surfaces of all walls; the kind of each, and its stiffness · Δt or weight (N,)."""
        surfaces: list[Surface] = []
        walls: list[tuple[str, Tensor | None]] = []
        for k, (wall, kind) in enumerate(zip(self.walls, self.kinds, strict=True)):
            value = None
            if kind != "hard":
                value = self.values[f"walls[{k}].{kind}"].of_cells(state)
                value = value * own_dt() if kind == "stiffness" else value.expand(state.cells)
            made = wall.surfaces(self.effect.dim)
            surfaces += made
            walls += [(kind, value)] * len(made)
        return surfaces, walls


def _shortest(state: State, base: Tensor) -> Tensor:
    """The length below which pressure takes no cell, (N,) µm."""
    left = COMPRESSION * (base + 2 * state.radius) - state.fields["compression"]
    return (base - left.clamp(min=0.0)).clamp(min=0.0)


def _of_colonies(value: Tensor, groups: Groups) -> Tensor:
    """The greatest value in each colony, (N,) -> (B,), with its gradient; 0 without cells."""
    most = groups.max(value)
    if not tracked(value):
        return most
    place = torch.arange(value.numel(), device=value.device)
    first = groups.max(torch.where(value.detach() == most[groups.owner], place, -1), -1)
    return torch.where(first < 0, most, value.index_select(0, first.clamp(min=0)))


def _tracked(given: StepInput) -> bool:
    """Whether gradients are required through the step. Raises InputError for forward mode."""
    parts = [v for v in vars(given).values() if isinstance(v, Tensor)]
    parts += [value for _, value in given.walls if value is not None]
    for surface in given.surfaces:
        for entry in vars(surface).values():
            parts += entry if isinstance(entry, tuple) else [entry]
    tensors = [part for part in parts if isinstance(part, Tensor)]
    if has_tangent(*tensors):
        raise checks.InputError(
            "Mechanics: contacts have a backward pass and no forward mode. Use backward(), or"
            " recorded growth, which does not depend on what is differentiated."
        )
    return tracked(*tensors)

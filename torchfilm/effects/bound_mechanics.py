"""Contact mechanics of a batch: its walls on the device, its settings, and who computes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.effect import Binding, BoundEffect
from torchfilm.effects.mechanics_report import MechanicsReport
from torchfilm.physics import compiled, torch_step
from torchfilm.physics.contact_records import ContactSettings
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.step_records import MechanicsInput
from torchfilm.physics.surfaces import Surface
from torchfilm.resolver import snapshot
from torchfilm.state import State
from torchfilm.tools import checks
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
        given = self._given(state, dt)
        by_kernels = not _tracked(given) and self.compiled
        found = (compiled if by_kernels else torch_step).step(given)
        fields = {"displacement": found.move, "collapsed_steps": found.collapsed}
        if "elongation" in state.fields:
            fields["elongation"] = found.elongation
        if found.contact_alpha is not None and found.compression is not None:
            fields |= {"contact_alpha": found.contact_alpha, "compression": found.compression}
        report = MechanicsReport(**vars(found.report), substeps=found.substeps)
        return state.with_fields(**fields).replace(
            position=found.position, axis=found.axis, length=found.length,
            reports={**state.reports, "mechanics": report},
        )  # fmt: skip

    def _given(self, state: State, dt: float) -> MechanicsInput:
        fields, values = state.fields, self.values
        elongation = fields.get("elongation")
        of_cells = lambda value: None if value is None else value.of_cells(state)
        surfaces, walls = self._surfaces(state)
        return MechanicsInput(
            self.settings, dt, self.effect.max_elongation, state.groups, state.position, state.axis,
            state.length, torch.zeros_like(state.length) if elongation is None else elongation,
            state.radius, fields["displacement"], fields["collapsed_steps"],
            fields["contact_alpha"] if self.effect.one_sided else None,
            fields["compression"] if self.effect.one_sided else None,
            values.viscosity.of_cells(state), values.length_drag.of_cells(state),
            fields.get("drag"), of_cells(values.alpha), of_cells(values.stiffness),
            state.colony_id, surfaces, walls,
        )  # fmt: skip

    def _surfaces(self, state: State) -> tuple[list[Surface], list[tuple[str, Tensor | None]]]:
        """The surfaces of all walls; the kind of each, and its stiffness or weight, 0-dim or
        (N,)."""
        surfaces: list[Surface] = []
        walls: list[tuple[str, Tensor | None]] = []
        for k, (wall, kind) in enumerate(zip(self.walls, self.kinds, strict=True)):
            value = None if kind == "hard" else self.values[f"walls[{k}].{kind}"].of_cells(state)
            made = wall.surfaces(self.effect.dim)
            surfaces += made
            walls += [(kind, value)] * len(made)
        return surfaces, walls


def _tracked(given: MechanicsInput) -> bool:
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

"""Sloughing: parts of a biofilm that nothing holds are carried away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import SLOUGHING, Binding, BoundEffect, Effect
from torchfilm.physics.nearby import pairs_within
from torchfilm.physics.surfaces import Surface
from torchfilm.physics.walls import depth_in_surfaces
from torchfilm.reports import CellsLost
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.connected import components
from torchfilm.tools.row_checks import check_none_taken


@dataclass(frozen=True, eq=False)
class Sloughing(Effect):
    """Cells that nothing holds are carried away: those from which no chain of cells leads to a wall
    of Mechanics.

    gap: how far apart the surfaces of two cells, or of a cell and a wall, may be where one holds
    the other, µm: what slime spans.

    The lineage keeps the end of these cells, with the fate "sloughed"; `state.reports["sloughing"]`
    has their number and volume.
    """

    gap: float = 0.5

    stage = SLOUGHING
    title = "sloughing"
    by_kernels = True
    may_repeat = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "gap", checks.number("Sloughing.gap", self.gap, least=0.0))

    def reads(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "radius")

    def writes(self) -> tuple[str, ...]:
        return ("cells",)

    def bind(self, binding: Binding) -> tuple[BoundEffect, ...]:
        return (BoundSloughing(self, binding),)

    def numerics(self, dt: float, state: State) -> list[str]:
        return [f"at the end of the step: cells within {self.gap:g} µm of each other hang together"]


class BoundSloughing(BoundEffect):
    """Sloughing bound to a batch."""

    effect: Sloughing
    surfaces: Sequence[Surface] = ()

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        self.surfaces = [s for e in effects for s in e.effect.wall_surfaces()]
        if not self.surfaces:
            raise checks.InputError(
                "Sloughing removes cells that no wall holds, and the scene has no wall. Give its"
                " Mechanics one, such as walls=[tf.Plane(y=0.0, facing='+y')]."
            )

    def check(self, state: State) -> None:
        self.check_arrivals(state, torch.arange(state.cells, device=state.device))

    def check_arrivals(self, state: State, rows: Tensor) -> None:
        """Other cells may hold them."""
        loose = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        loose[rows] = self._loose(state)[rows]
        check_none_taken(
            "Sloughing", state, loose,
            f"from where no chain of cells less than {self.effect.gap:g} µm apart leads to a wall."
            " Move the cell, or raise the gap.",
        )  # fmt: skip

    def step(self, state: State, dt: float) -> State:
        loose = self._loose(state)
        report = CellsLost.of(state, loose)
        state = state.replace(reports={**state.reports, self.title: report})
        return state.remove(loose, "sloughed")

    @torch.no_grad()
    def _loose(self, state: State) -> Tensor:
        """The cells that nothing holds, (N,) bool."""
        gap, shape = self.effect.gap, (state.position, state.axis, state.length, state.radius)
        pairs = pairs_within(*shape, state.groups, gap, state.space)
        of = components(*pairs, state.cells)
        reach = state.radius.double() + gap
        at_walls = depth_in_surfaces(self.surfaces, *shape[:3], reach, state.own_colony_id) > 0
        held = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        held[of[at_walls]] = True
        return ~held.index_select(0, of)

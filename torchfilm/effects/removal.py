"""Removal: cells that leave a region are gone, and the lineage remembers them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import REMOVAL, Effect, per_cell
from torchfilm.state import State
from torchfilm.tools import checks


@dataclass(frozen=True)
class Removal(Effect):
    """Cells whose centre leaves the box from `low` to `high` are removed, as at a channel's open
    end.

    low, high: µm, each entry one number or one per colony; ±inf leaves a side out.
    """

    low: Sequence[float | Tensor]
    high: Sequence[float | Tensor]

    stage = REMOVAL
    title = "removal"

    def __post_init__(self) -> None:
        for name, corner in zip(
            ("low", "high"), checks.corners("Removal", self.low, self.high), strict=True
        ):
            object.__setattr__(self, name, corner)

    def reads(self) -> tuple[str, ...]:
        return ("position",)

    def writes(self) -> tuple[str, ...]:
        return ("cells",)

    def check(self, state: State) -> None:
        if len(self.low) != state.dim:
            raise checks.input_error(
                "Removal.low", self.low, f"of {state.dim} numbers in a {state.dim}-D scene"
            )
        outside = self._outside(state)
        if bool(outside.any()):
            k = int(torch.nonzero(outside)[0])
            raise checks.InputError(
                f"Removal would take cell {int(state.uid[k])} of colony"
                f" {int(state.own_colony_id[k])} before the first step: it starts at"
                f" {state.position[k].tolist()}, outside {self.low} to {self.high}. Move the cell"
                " or the region."
            )

    def _outside(self, state: State) -> torch.Tensor:
        outside = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        for k, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            x = state.position[:, k]
            outside = outside | (x < per_cell(low, state)) | (x > per_cell(high, state))
        return outside

    def step(self, state: State, dt: float) -> State:
        return state.remove(self._outside(state), "left")

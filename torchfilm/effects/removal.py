"""Removal: cells that leave a region are gone, and the lineage remembers them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from torchfilm.effect import REMOVAL, Effect
from torchfilm.state import State
from torchfilm.tools import checks


@dataclass(frozen=True)
class Removal(Effect):
    """Cells whose centre leaves the box from `low` to `high` (µm; ±inf leaves a side out) are removed, as at a channel's open end."""

    low: Sequence[float]
    high: Sequence[float]

    stage = REMOVAL
    title = "removal"

    def __post_init__(self) -> None:
        low, high = tuple(map(float, self.low)), tuple(map(float, self.high))
        if len(low) != len(high) or any(math.isnan(v) for v in low + high) or not all(a < b for a, b in zip(low, high, strict=False)):
            raise checks.refuse("Removal.low, Removal.high", (low, high), "two corners with low < high along every axis")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def reads(self) -> tuple[str, ...]:
        return ("position",)

    def writes(self) -> tuple[str, ...]:
        return ("cells",)

    def check(self, state: State) -> None:
        if len(self.low) != state.dim:
            raise checks.refuse("Removal.low", self.low, f"of {state.dim} numbers in a {state.dim}-D scene")
        outside = self._outside(state)
        if bool(outside.any()):
            k = int(torch.nonzero(outside)[0])
            raise checks.InputError(
                f"Removal would take cell {int(state.uid[k])} of colony {int(state.own_colony_id[k])} before the first step: it starts at "
                f"{state.position[k].tolist()}, outside {self.low} to {self.high}. Move the cell or the region."
            )

    def _outside(self, state: State) -> torch.Tensor:
        low, high = state.position.new_tensor(self.low), state.position.new_tensor(self.high)
        return ((state.position < low) | (state.position > high)).any(1)

    def step(self, state: State, dt: float) -> State:
        return state.remove(self._outside(state), "left")

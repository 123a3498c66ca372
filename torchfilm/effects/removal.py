"""Removal: cells that leave a region are removed; the lineage keeps their end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from torchfilm.effect import REMOVAL, Effect
from torchfilm.resolver import Values
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.row_checks import check_none_taken
from torchfilm.values import COLONY, Rule


def _or_no_limits(corner: Any, other: Any, value: float) -> Any:
    """The corner, or one of this value as long as the other where it was left out."""
    left_out = isinstance(corner, tuple) and not corner and hasattr(other, "__len__")
    return (value,) * len(other) if left_out else corner


@dataclass(frozen=True, eq=False)
class Removal(Effect):
    """Removes cells whose centre leaves the box from `low` to `high`, as at a channel's open end.

    low, high: corners, µm, each entry one number or one per colony; ±inf means no limit, and so
    does a corner that is left out.
    """

    low: Sequence[checks.Value] = ()
    high: Sequence[checks.Value] = ()

    stage = REMOVAL
    title = "removal"
    by_kernels = True

    def __post_init__(self) -> None:
        for name, corner in (("low", self.low), ("high", self.high)):
            if not hasattr(corner, "__len__") or getattr(corner, "ndim", 1) == 0:
                raise checks.input_error(
                    f"Removal.{name}", corner, "2 or 3 numbers, such as (20.0, math.inf)",
                    "±inf means no limit along that axis.",
                )  # fmt: skip
        low, high = _or_no_limits(self.low, self.high, -math.inf), self.high
        high = _or_no_limits(high, low, math.inf)
        if not len(low) and not len(high):
            raise checks.InputError("Removal() has no limits: give low, high, or both.")
        for name, corner in zip(("low", "high"), checks.corners("Removal", low, high), strict=True):
            object.__setattr__(self, name, corner)

    def reads(self) -> tuple[str, ...]:
        return ("position",)

    def writes(self) -> tuple[str, ...]:
        return ("cells",)

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        corners = {"low": self.low, "high": self.high}
        rule = Rule("µm", scope=COLONY)
        return {
            f"{n}[{k}]": (x, rule) for n, corner in corners.items() for k, x in enumerate(corner)
        }

    def numerics(self, dt: float, state: State) -> list[str]:
        return ["once a step, by the cell's centre"]

    def check(self, state: State, values: Values) -> None:
        if len(self.low) != state.dim:
            given = (
                "high" if all(isinstance(x, float) and x == -math.inf for x in self.low) else "low"
            )
            raise checks.input_error(
                f"Removal.{given}", getattr(self, given),
                f"of {state.dim} numbers in a {state.dim}-D scene",
            )  # fmt: skip
        why = f"outside {self.low} to {self.high}. Move the cell or the region."
        check_none_taken("Removal", state, self._outside(state, values), why)

    def _outside(self, state: State, values: Values) -> torch.Tensor:
        outside = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        for k in range(len(self.low)):
            x = state.position[:, k]
            low, high = (values[f"{name}[{k}]"].of_cells(state) for name in ("low", "high"))
            outside = outside | (x < low) | (x > high)
        return outside

    def step(self, state: State, dt: float, values: Values) -> State:
        return state.remove(self._outside(state, values), "left")

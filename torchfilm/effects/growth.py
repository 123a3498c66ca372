"""Growth: how much each cell wants to lengthen in a step. Contacts, where there are any, may then hold it back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import GROWTH, Distribution, Effect, draw, parameter
from torchfilm.state import Field, State
from torchfilm.tools import checks

LAWS = ("volume", "length", "linear")
UNITS = {"volume": "1/h", "length": "1/h of the length", "linear": "µm/h"}


@dataclass(frozen=True)
class Growth(Effect):
    """Cells lengthen.

    rate: 1/h (µm/h with law "linear"); one number, one per colony, or a distribution drawn at birth. None: cells grow at whatever
    rules write to `growth_rate`, at first 0.
    law: "volume", dV/dt = rate·V, so that ln 2/rate is the doubling time whatever the shape (the paper's wording); "length",
    dl/dt = rate·l of the centreline (the authors' program); "linear", dl/dt = rate. Exponentials are exact over a step.
    """

    rate: float | Tensor | Distribution | None = None
    law: str = "volume"

    stage = GROWTH
    title = "growth"

    def __post_init__(self) -> None:
        checks.choice("Growth.law", self.law, LAWS)
        if self.rate is not None:
            object.__setattr__(self, "rate", parameter("Growth.rate", self.rate, least=0.0))

    def declares(self, dim: int) -> tuple[Field, ...]:
        rate = 0.0 if self.rate is None else self.rate
        return (
            Field(
                "growth_rate", "relative growth rate" if self.law != "linear" else "growth of the centreline",
                UNITS[self.law],
                initial=lambda state, rows: draw("Growth.rate", rate, state, rows),
                at_division="reset" if isinstance(rate, Distribution) else "copy",
            ),
            Field("elongation", "growth wanted in this step, contained in length", "µm"),
        )  # fmt: skip

    def reads(self) -> tuple[str, ...]:
        return ("growth_rate", "length", "radius")

    def waits_for(self) -> tuple[str, ...]:
        return ("growth_rate",) if self.rate is None else ()

    def writes(self) -> tuple[str, ...]:
        return ("length", "elongation")

    def step(self, state: State, dt: float) -> State:
        wanted = state.growth_rate * dt
        if self.law == "volume":
            # V = π r² (l + 4r/3), so l + 4r/3 grows like V
            elongation = torch.expm1(wanted) * (state.length + state.radius * (4.0 / 3.0))
        elif self.law == "length":
            elongation = torch.expm1(wanted) * state.length
        else:
            elongation = wanted
        return state.replace(length=state.length + elongation).with_fields(elongation=elongation)

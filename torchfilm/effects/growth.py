"""Growth: how much each cell wants to lengthen in a step. Contacts, where there are any, may then
hold it back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import GROWTH, Distribution, Effect, draw, parameter
from torchfilm.state import Field, State
from torchfilm.tools import checks

LAWS = ("volume", "length", "linear")
UNITS = {"volume": "1/h", "length": "1/h of the length", "linear": "µm/h"}


@dataclass(frozen=True)
class GrowthReport:
    """Made only where a cell of some colony would grow past all numbers: `status` (B,), 1 for its
    colony, of which no cell grew, and the `rate` (B,) and `uid` (B,) of the first such cell."""

    status: Tensor
    uid: Tensor
    rate: Tensor
    hint = "A smaller dt or growth rate may help (rates are per hour, and dt is in hours)"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at this place of the batch."""
        return (
            f"cell {int(self.uid[place])} at a growth rate of {float(self.rate[place]):g} would be"
            " of no finite length"
        )


@dataclass(frozen=True)
class Growth(Effect):
    """Cells lengthen.

    rate: 1/h (µm/h with law "linear"); one number, one per colony, or a distribution drawn at
    birth. None: cells grow at whatever rules write to `growth_rate`, at first 0. law: "volume",
    dV/dt = rate·V, so that ln 2/rate is the doubling time whatever the shape (the paper's wording);
    "length", dl/dt = rate·l of the centreline (the authors' program); "linear", dl/dt = rate.
    Exponentials are exact over a step.
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
                "growth_rate",
                "relative growth rate" if self.law != "linear" else "growth of the centreline",
                UNITS[self.law],
                initial=lambda state, rows: draw("Growth.rate", rate, state, rows),
                at_division="reset" if isinstance(rate, Distribution) else "copy",
            ),
            Field("elongation", "growth wanted in this step, contained in length", "µm"),
        )

    def reads(self) -> tuple[str, ...]:
        return ("growth_rate", "length", "radius")

    def waits_for(self) -> tuple[str, ...]:
        return ("growth_rate",)

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
        length = state.length + elongation
        # one look at the longest: NaN is the greatest of all
        if state.cells and not length.max().item() < math.inf:
            report = _too_long(state, torch.isfinite(length))
            elongation = torch.where(
                (report.status == 0).index_select(0, state.colony), elongation, 0.0
            )
            state, length = (
                state.replace(reports={**state.reports, "growth": report}),
                state.length + elongation,
            )
        return state.replace(length=length).with_fields(elongation=elongation)


def _too_long(state: State, good: Tensor) -> GrowthReport:
    """The report of the cells that cannot be as long as they want, ~good (N,)."""
    number = torch.arange(state.cells, device=state.device)
    first = state.cells - state.groups.max(torch.where(good, 0, state.cells - number))
    row = first.clamp(max=state.cells - 1)
    return GrowthReport(
        (first < state.cells).long(),
        state.uid.index_select(0, row),
        state.growth_rate.detach().index_select(0, row),
    )

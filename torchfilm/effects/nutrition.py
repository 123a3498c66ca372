"""Nutrition: cells take up a signal of the medium and grow by what they get, so that a crowd
starves from the inside (Monod 1949)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.circuits.rosenbrock import rodas3
from torchfilm.effect import NUTRITION, Effect, per_cell
from torchfilm.signals.exchange import write
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks


@dataclass(frozen=True)
class NutritionReport:
    """`status` (B,): 1 where the uptake of a cell could not be stepped. `uptake` (B,): amount taken
    in this step, conc·µm³."""

    status: Tensor
    uptake: Tensor
    hint = "A smaller dt may help"

    def reason(self, place: int) -> str:
        return "the uptake of a cell could not be stepped"


@dataclass(frozen=True)
class Monod(Effect):
    """Growth on a nutrient: dV/dt = rate · s/(half + s) · V, and an amount dV/dt / yield is taken
    from the medium about the cell.

    signal: name of the nutrient in the Medium. rate: greatest growth, 1/h; half: concentration of
    half the growth; growth_yield: µm³ of cell made from one unit of concentration × µm³ of
    nutrient. Each one number or one per colony. Sets `growth_rate`, so the scene's Growth has no
    rate of its own. What is eaten is exactly what the medium loses, and cannot be more than there
    is; growth over the step follows from it, exponential where the food stays what it is. Where
    contacts hold that growth back, what was eaten for it is spent all the same, and so is the
    volume of the caps lost at division.
    """

    signal: str
    rate: float | Tensor = 1.0
    half: float | Tensor = 1.0
    growth_yield: float | Tensor = 1.0

    stage = NUTRITION
    title = "nutrition"

    def __post_init__(self) -> None:
        object.__setattr__(self, "rate", checks.value("Monod.rate", self.rate, least=0.0))
        for name in ("half", "growth_yield"):
            object.__setattr__(
                self, name, checks.value(f"Monod.{name}", getattr(self, name), above=0.0)
            )

    def declares(self, dim: int) -> tuple[Field, ...]:
        return (
            Field(
                f"{self.signal}_eaten",
                "nutrient taken up since birth",
                "conc·µm³",
                at_division="reset",
            ),
        )

    def reads(self) -> tuple[str, ...]:
        return ("position", "length", "radius", OUTSIDE + self.signal)

    def needs(self) -> tuple[str, ...]:
        return (OUTSIDE + self.signal, "growth_rate")

    def writes(self) -> tuple[str, ...]:
        return ("growth_rate", OUTSIDE + self.signal, f"{self.signal}_eaten")

    def check(self, state: State) -> None:
        unit = state.declared["growth_rate"].unit
        if unit != "1/h":
            raise checks.InputError(
                f"Monod sets growth of the volume, in 1/h, but Growth takes its rate in {unit!r}:"
                " use Growth() with law='volume'."
            )
        if bool((state.growth_rate != 0).any()):
            raise checks.InputError(
                "Monod sets the growth rate, but Growth has a rate of its own, which would be"
                " overwritten: write Growth()."
            )

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0 or state.layout is None:
            return state
        name = OUTSIDE + self.signal
        contact, volume = state.contact(), state.volume
        assert contact is not None
        there, in_reservoir = contact.found[self.signal], contact.in_reservoir
        greatest, half, gain = (
            per_cell(x, state).expand(state.cells)
            for x in (self.rate, self.half, self.growth_yield)
        )
        columns = (greatest, half, gain, volume, contact.pool)

        def rates(x: Tensor, rows: Tensor) -> Tensor:
            """Of what is left, and of what was eaten: kept apart, since where food abounds their
            sum would hide it from rounding."""
            rate, k, y, start, pool = (c.index_select(0, rows) for c in columns)
            eating = rate * (start / y + x[:, 1]) * x[:, 0] / (k + x[:, 0])
            return torch.stack([-eating / pool, eating], 1)

        end, report = rodas3(rates, torch.stack([there, torch.zeros_like(there)], 1), dt)
        eaten = end[:, 1]
        if in_reservoir is not None:  # a reservoir stays as it is
            eaten = torch.where(
                in_reservoir,
                volume / gain * torch.expm1(greatest * there / (half + there) * dt),
                eaten,
            )
        # dV/dt = growth · V over the step, from V to V + gain · eaten
        growth = torch.log1p(gain * eaten / volume) / dt
        inside = eaten if in_reservoir is None else torch.where(in_reservoir, 0.0, eaten)
        changed = {name: write(state.fields[name], -inside, contact.stencil)}
        if in_reservoir is not None:
            lost = state.groups.sum((inside - eaten).unsqueeze(1)).squeeze(1)
            changed[f"{self.signal}_reservoir"] = state.fields[f"{self.signal}_reservoir"] + lost
        changed |= {
            "growth_rate": growth,
            f"{self.signal}_eaten": state.fields[f"{self.signal}_eaten"] + eaten,
        }
        uptake = state.groups.sum(eaten.unsqueeze(1)).squeeze(1)
        note = NutritionReport(state.groups.any(report.status != 0).long(), uptake)
        return state.with_fields(**changed).replace(reports={**state.reports, "nutrition": note})

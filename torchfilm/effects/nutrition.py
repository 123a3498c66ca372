"""Nutrition: cells take up a signal of the medium and grow by what they get, so that a crowd starves from the inside (Monod 1949)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.circuits.rosenbrock import rosenbrock
from torchfilm.effect import NUTRITION, Effect, per_cell
from torchfilm.signals.exchange import pool_volume, read, write
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks


@dataclass(frozen=True)
class NutritionReport:
    """`status` (B,): 1 where the uptake of a cell could not be stepped. `uptake` (B,): amount taken in this step, conc·µm³."""

    status: Tensor
    uptake: Tensor
    mend = "A smaller dt may help"

    def reason(self, place: int) -> str:
        return "the uptake of a cell could not be stepped"


@dataclass(frozen=True)
class Monod(Effect):
    """Growth on a nutrient: dV/dt = rate · s/(half + s) · V, and an amount dV/dt / yield is taken from the medium about the cell.

    signal: name of the nutrient in the Medium. rate: greatest growth, 1/h; half: concentration of half the growth; growth_yield: µm³ of cell made from
    one unit of concentration × µm³ of nutrient. Each one number or one per colony. Sets `growth_rate`, so the scene's Growth has no rate of its own.
    What cells gain is exactly what the medium loses: growth over a step is computed from what was got, which cannot be more than there is.
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
            object.__setattr__(self, name, checks.value(f"Monod.{name}", getattr(self, name), above=0.0))

    def declares(self, dim: int) -> tuple[Field, ...]:
        return (Field(f"{self.signal}_eaten", "nutrient taken up since birth", "conc·µm³", at_division="reset"),)

    def reads(self) -> tuple[str, ...]:
        return ("position", "length", "radius", OUTSIDE + self.signal)

    def needs(self) -> tuple[str, ...]:
        return (OUTSIDE + self.signal, "growth_rate")

    def writes(self) -> tuple[str, ...]:
        return ("growth_rate", OUTSIDE + self.signal, f"{self.signal}_eaten")

    def check(self, state: State) -> None:
        unit = state.declared["growth_rate"].unit
        if unit != "1/h":
            raise checks.InputError(f"Monod sets growth of the volume, in 1/h, but Growth takes its rate in {unit!r}: use Growth() with law='volume'.")
        if bool((state.growth_rate != 0).any()):
            raise checks.InputError("Monod sets the growth rate, but Growth has a rate of its own, which would be overwritten: write Growth().")

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0 or state.layout is None:
            return state
        name = OUTSIDE + self.signal
        stencil = state.layout.stencil(state.position, state.colony, state.dtype)
        there, pool, volume = read(state.fields[name], stencil), pool_volume(stencil), state.volume
        beyond = None
        if state.layout.reservoir is not None and bool(stencil.outside.any()):
            beyond = stencil.outside
            there = torch.where(beyond, per_cell(state.layout.reservoir[self.signal], state), there)
        greatest, half, gain = (per_cell(x, state).expand(state.cells) for x in (self.rate, self.half, self.growth_yield))
        hunger = greatest * volume / (gain * pool)  # 1/h × conc

        def rates(s: Tensor, rows: Tensor) -> Tensor:
            x = s[:, 0]
            return (-hunger.index_select(0, rows) * x / (half.index_select(0, rows) + x)).unsqueeze(1)

        left, report = rosenbrock(rates, there.unsqueeze(1), dt)
        eaten = (there - left.squeeze(1)) * pool
        if beyond is not None:  # a reservoir stays as it is
            eaten = torch.where(beyond, hunger * pool * there / (half + there) * dt, eaten)
        # V grows like exp(rate · dt) over the step; what was got makes it grow to V + gain · eaten
        growth = torch.log1p(gain * eaten / volume) / dt
        changed = {name: write(state.fields[name], -(eaten if beyond is None else torch.where(beyond, 0.0, eaten)), stencil)}
        if beyond is not None:
            lost = state.groups.sum(torch.where(beyond, -eaten, 0.0).unsqueeze(1)).squeeze(1)
            changed[f"{self.signal}_beyond"] = state.fields[f"{self.signal}_beyond"] + lost
        changed |= {"growth_rate": growth, f"{self.signal}_eaten": state.fields[f"{self.signal}_eaten"] + eaten}
        uptake = state.groups.sum(eaten.unsqueeze(1)).squeeze(1)
        note = NutritionReport(state.groups.any(report.status != 0).long(), uptake)
        return state.with_fields(**changed).replace(reports={**state.reports, "nutrition": note})

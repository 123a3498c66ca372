"""Nutrition: cells take up a signal of the medium, and this uptake limits their growth, so that
dense colonies starve in the middle (Monod 1949)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.circuits.rosenbrock import rodas3
from torchfilm.effect import NUTRITION, Binding, BoundEffect, Effect
from torchfilm.medium_exchange import MediumExchange
from torchfilm.resolver import Values
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.doubling import check_doubling
from torchfilm.values import Value, is_drawn, numbers, physical


@dataclass(frozen=True)
class NutritionReport:
    """`status` (B,): 1 if the integration of a cell's uptake failed. `uptake` (B,): amount taken up
    in this step, conc·µm³."""

    status: Tensor
    uptake: Tensor
    hint = "A smaller dt may help"

    def reason(self, place: int) -> str:
        return "the integration of a cell's uptake failed"


@dataclass(frozen=True, eq=False)
class Monod(Effect):
    """Growth on a nutrient: dV/dt = rate · s/(half + s) · V. The cell takes dV/dt / yield per hour
    from the medium around it.

    signal: name of the nutrient in the Medium. rate: greatest growth rate, 1/h. half: concentration
    of half that rate. growth_yield: µm³ of cell per unit of concentration × µm³ of nutrient. Each
    is one number or one per colony. Monod sets `growth_rate`, so the scene's Growth must have no
    rate of its own.

    The medium loses exactly what the cells take up, and never more than it contains. The uptake
    determines growth over the step, which is exponential at constant concentration. If contacts
    slow this growth, the nutrient is consumed all the same. So is the nutrient for the volume of
    the caps lost at division.
    """

    signal: str
    rate: Value = physical(1.0, unit="1/h", least=0.0)
    half: Value = physical(1.0, unit="conc", above=0.0)
    growth_yield: Value = physical(1.0, unit="1/conc", above=0.0)

    stage = NUTRITION
    title = "nutrition"
    by_kernels = True
    may_repeat = False

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

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (_BoundMonod(self, binding),)

    def numerics(self, dt: float, state: State) -> list[str]:
        return [
            "each cell by the stiff solver, with its default tolerances; the medium loses what"
            " cells take up, to rounding"
        ]

    def check_step(self, dt: float, divides: bool) -> None:
        if divides:
            given = numbers(self.rate)
            check_doubling("Monod.rate", given.min() if is_drawn(self.rate) else given, dt)

    def check(self, state: State, values: Values) -> None:
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

    def step(self, state: State, dt: float, values: Values) -> State:
        medium = MediumExchange.of(state, (self.signal,))
        if state.cells == 0 or medium is None:
            return state
        volume, there, in_reservoir = state.volume, medium.found[self.signal], medium.in_reservoir
        greatest, half, gain = (
            x.of_cells(state).expand(state.cells)
            for x in (values.rate, values.half, values.growth_yield)
        )
        columns = (greatest, half, gain, volume, medium.pool)

        def rates(x: Tensor, rows: Tensor) -> Tensor:
            """Rates of the nutrient in the pool, and of the uptake. Both are variables: where
            nutrient abounds, the uptake as a difference would be lost in rounding."""
            rate, k, y, start, pool = (c.index_select(0, rows) for c in columns)
            eating = rate * (start / y + x[:, 1]) * x[:, 0] / (k + x[:, 0])
            return torch.stack([-eating / pool, eating], 1)

        end, report = rodas3(rates, torch.stack([there, torch.zeros_like(there)], 1), dt)
        eaten = end[:, 1]
        to_reservoir, inside = None, eaten
        if in_reservoir is not None:  # the concentration of a reservoir is constant
            there_for_good = volume / gain * torch.expm1(greatest * there / (half + there) * dt)
            eaten = torch.where(in_reservoir, there_for_good, eaten)
            inside = torch.where(in_reservoir, 0.0, eaten)
            to_reservoir = inside - eaten
        # dV/dt = growth · V over the step, from V to V + gain · eaten
        growth = torch.log1p(gain * eaten / volume) / dt
        medium.give(self.signal, -inside, to_reservoir)
        own = f"{self.signal}_eaten"
        state = medium.settle().with_fields(growth_rate=growth, **{own: state.fields[own] + eaten})
        uptake = state.groups.sum(eaten.unsqueeze(1)).squeeze(1)
        note = NutritionReport(state.groups.any(report.status != 0).long(), uptake)
        return state.replace(reports={**state.reports, "nutrition": note})


class _BoundMonod(BoundEffect):
    """Monod bound to a batch; it also reads and writes the reservoir's field, if there is one."""

    effect: Monod

    def _reservoir(self) -> tuple[str, ...]:
        name = f"{self.effect.signal}_reservoir"
        return (name,) if name in self.binding.declared else ()

    def reads(self) -> tuple[str, ...]:
        return (*super().reads(), f"{self.effect.signal}_eaten", *self._reservoir())

    def writes(self) -> tuple[str, ...]:
        return (*super().writes(), *self._reservoir())

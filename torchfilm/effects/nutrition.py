"""Nutrition: cells take up a signal of the medium, and this uptake limits their growth, so that
dense colonies starve in the middle (Monod 1949)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits import run
from torchfilm.circuits.compiled_stiff import CompiledStiff, compiled_stiff
from torchfilm.circuits.names import Names
from torchfilm.circuits.tracing import Untraceable
from torchfilm.effect import NUTRITION, Binding, BoundEffect, Effect
from torchfilm.medium_exchange import MediumExchange
from torchfilm.resolver import Values
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.backends import why_torch
from torchfilm.tools.doubling import check_doubling
from torchfilm.values import CONCENTRATION, Value, is_drawn, numbers, physical

CONSTANTS = ("rate", "half", "growth_yield")
STIFF = run.IntegrationSettings("rosenbrock", 1, 1e-4, 1e-9, 1.0)


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
    half: Value = physical(1.0, unit=CONCENTRATION, above=0.0)
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


class _BoundMonod(BoundEffect):
    """Monod bound to a batch; it also reads and writes the reservoir's field, if there is one."""

    effect: Monod

    def __init__(self, effect: Monod, binding: Binding):
        super().__init__(effect, binding)
        self.by_torch = why_torch("Monod", None, binding.batch.device)
        self.compiled: CompiledStiff | None = None

    @property
    def by_kernels(self) -> bool:
        return not self.by_torch

    def _reservoir(self) -> tuple[str, ...]:
        name = f"{self.effect.signal}_reservoir"
        return (name,) if name in self.binding.declared else ()

    def reads(self) -> tuple[str, ...]:
        return (*super().reads(), f"{self.effect.signal}_eaten", *self._reservoir())

    def writes(self) -> tuple[str, ...]:
        return (*super().writes(), *self._reservoir())

    def numerics(self, dt: float, state: State) -> list[str]:
        return [
            "each cell by the stiff solver, with its default tolerances; the medium loses what"
            " cells take up, to rounding",
            f"computed by torch: {self.by_torch}"
            if self.by_torch
            else "computed by compiled functions; by torch where gradients are required",
        ]

    def step(self, state: State, dt: float) -> State:
        signal = self.effect.signal
        medium = MediumExchange.of(state, (signal,))
        if state.cells == 0 or medium is None:
            return state
        medium.find()
        volume, there, in_reservoir = state.volume, medium.found[signal], medium.in_reservoir
        constants = {n: self.values[n].of_cells(state) for n in CONSTANTS}
        greatest, half, gain = constants.values()
        eaten, failed = self._eaten(state, medium, constants, dt)
        to_reservoir, inside = None, eaten
        if in_reservoir is not None:  # the concentration of a reservoir is constant
            there_for_good = volume / gain * torch.expm1(greatest * there / (half + there) * dt)
            eaten = torch.where(in_reservoir, there_for_good, eaten)
            inside = torch.where(in_reservoir, 0.0, eaten)
            to_reservoir = inside - eaten
        # dV/dt = growth · V over the step, from V to V + gain · eaten
        growth = torch.log1p(gain * eaten / volume) / dt
        medium.give(signal, -inside, to_reservoir)
        own = f"{signal}_eaten"
        state = medium.settle(growth_rate=growth, **{own: state.fields[own] + eaten})
        uptake = state.groups.sum(eaten.unsqueeze(1)).squeeze(1)
        note = NutritionReport(state.groups.any(failed).long(), uptake)
        return state.replace(reports={**state.reports, "nutrition": note})

    def _eaten(
        self, state: State, medium: MediumExchange, constants: Mapping[str, Tensor], dt: float
    ) -> tuple[Tensor, Tensor]:
        """What each cell takes from its pool, (N,) conc·µm³, and whether its integration failed.

        What is eaten is a variable beside the concentration in the pool: where nutrient abounds, it
        would be lost in the rounding of a difference."""
        signal = self.effect.signal
        cells = run.CircuitCells(
            partial(_uptake, signal), ("eaten",), (signal,),
            torch.arange(state.cells, device=state.device), {"volume": state.volume}, constants,
            medium.found, medium.pool, label=f"uptake of {signal}",
        )  # fmt: skip
        if self.compiled is None:
            with suppress(Untraceable):  # a gradient is wanted: torch finds the slopes, too
                self.compiled = compiled_stiff(cells)
        cells = dataclasses.replace(cells, compiled=self.compiled, by_torch=bool(self.by_torch))
        found = run.step(cells, torch.zeros_like(state.volume).unsqueeze(1), dt, STIFF)
        return found.concentrations[:, 0], found.failed


def _uptake(signal: str, u: Names, s: Names, p: Names, cell: Names) -> tuple[Any, Any]:
    """The rates of what a cell has eaten, and of the signal in its pool, conc·µm³/h."""
    there = s[signal]
    eating = p.rate * (cell.volume / p.growth_yield + u.eaten) * there / (p.half + there)
    return {"eaten": eating}, {signal: -eating}

"""Nutrition: cells take up a signal of the medium, and this uptake limits their growth, so that
dense colonies starve in the middle (Monod 1949)."""

from __future__ import annotations

import dataclasses
import math
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
from torchfilm.effect import NUTRITION, Binding, BoundEffect, Concern, Effect
from torchfilm.medium_exchange import MediumExchange
from torchfilm.resolver import Values
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.backends import why_torch
from torchfilm.tools.doubling import check_doubling
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread
from torchfilm.values import CONCENTRATION, Value, is_drawn, numbers, physical

CONSTANTS = ("rate", "half", "growth_yield")
STIFF = run.IntegrationSettings("rosenbrock", 1, 1e-4, 1e-9, 1.0)


# Of the turnover of pools: from which it is a concern, and what is fine. It is looked at in every
# eighth step, and lasts if five looks in a row find it.
TURNOVER, FINE = 0.65, 0.1
HUNGRY = 0.3  # of the greatest growth rate
LOOK, LASTING = 8, 5


@dataclass(frozen=True)
class NutritionReport:
    """`status` (B,): 1 if the integration of a cell's uptake failed. `uptake` (B,): amount taken up
    in this step, conc·µm³. taken, of_pool (N,): what each cell took in the last turn with
    transport, and how often it would have emptied its pool at the rate at which it began. share
    (N,): s/(half + s) as it began. groups: of the cells by colony. step: its number. takes_turns:
    whether it would take more of them."""

    status: Tensor
    uptake: Tensor
    taken: Tensor
    of_pool: Tensor
    share: Tensor
    groups: Groups
    step: int
    takes_turns: bool = True
    hint = "A smaller dt may help"

    def reason(self, place: int) -> str:
        return "the integration of a cell's uptake failed"

    def after(self, earlier: NutritionReport) -> NutritionReport:
        """With what failed, and what was taken up, earlier in the same step."""
        status = torch.maximum(earlier.status, self.status)
        return dataclasses.replace(self, status=status, uptake=earlier.uptake + self.uptake)

    @property
    def turnover(self) -> Tensor:
        """How often cells would empty their pools in a turn, (B,): a mean, weighted by what each
        takes. A pool is refilled only between turns, so that with a turnover of x uptake is too low
        by a factor of up to (1 − exp(−x))/x."""
        return self._mean(self.of_pool)

    def _mean(self, values: Tensor) -> Tensor:
        """The mean over each colony, (B,), weighted by what each cell takes."""
        taken = self.taken.double()
        sums = self.groups.sum(torch.stack([values.double() * taken, taken], 1))
        return sums[:, 0] / sums[:, 1].clamp(min=1e-300)

    def concerns(self) -> list[Concern]:
        """Colonies that are fed too little for long, since transport lags behind uptake."""
        if self.step % LOOK or not len(self.taken):
            return []
        with one_torch_thread():  # a sum over few numbers
            turnover, share = self.turnover, self._mean(self.share)
        # where nutrient is used up, growth is slow by the law itself
        where = (turnover > TURNOVER) & (share > HUNGRY)
        words = partial(_of_turnover, turnover, self.takes_turns)
        return [Concern("turnover", where, LASTING, words)]


def _too_low(turnover: float) -> float:
    """By which part uptake may be too low."""
    return 1.0 + math.expm1(-turnover) / turnover


def _remedy(times: int, takes_turns: bool) -> str:
    if takes_turns:
        return f"{times} times as many Medium(steps=…), or a dt smaller by as much"
    return (
        f"a dt {times} times smaller (a circuit uses the nutrient, too: nutrition takes one turn)"
    )


def _of_turnover(turnover: Tensor, takes_turns: bool, ids: Tensor, where: Tensor) -> str:
    worst = float(turnover[where].max())
    return (
        f"colony {', '.join(map(str, ids[where].tolist()[:5]))}: nutrition takes {worst:.2g} times"
        " what the medium at the cells holds, and transport refills it only afterwards: growth may"
        f" be up to {_too_low(worst):.0%} too low. It is at most {_too_low(FINE):.0%} with"
        f" {_remedy(math.ceil(worst / FINE), takes_turns)}."
    )


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
        return (BoundMonod(self, binding),)

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


class BoundMonod(BoundEffect):
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
            *self._cost_of_turns(dt, state),
            f"computed by torch: {self.by_torch}"
            if self.by_torch
            else "computed by compiled functions; by torch where gradients are required",
        ]

    def _cost_of_turns(self, dt: float, state: State) -> list[str]:
        """What it costs the first cells that uptake and transport take turns. A line, or none."""
        medium = MediumExchange.of(state, (self.effect.signal,))
        if not state.cells or medium is None:
            return []
        medium.find()
        constants = {n: self.values[n].of_cells(state) for n in CONSTANTS}
        most = float(self._of_pool(state.volume, medium, constants, dt / self.turns).max())
        if most <= FINE:
            return []
        return [
            f"in a turn with transport a cell takes up to {most:.2g} times what the medium at it"
            f" holds: where diffusion would refill it, growth is up to {_too_low(most):.0%} too"
            f" low; at most {_too_low(FINE):.0%} with"
            f" {_remedy(math.ceil(most / FINE), self.takes_turns)}"
        ]

    def exchanges(self) -> tuple[str, ...]:
        return (self.effect.signal,)

    def step(self, state: State, dt: float) -> State:
        return self.turn(state, dt, 0, 1)

    def turn(self, state: State, dt: float, done: int, number: int) -> State:
        """The state after dt hours of uptake, one of a `number` of turns with transport in a step
        of the scene, of which so many are `done`. Cells grow by it after the last."""
        signal = self.effect.signal
        medium = MediumExchange.of(state, (signal,))
        if state.cells == 0 or medium is None:
            return state
        medium.find()
        there, in_reservoir = medium.found[signal], medium.in_reservoir
        # with what it will grow by the turns that are done
        earlier = state.growth_rate if done else torch.zeros_like(state.growth_rate)
        volume = state.volume * torch.exp(earlier * (dt * number)) if done else state.volume
        constants = {n: self.values[n].of_cells(state) for n in CONSTANTS}
        greatest, half, gain = constants.values()
        eaten, failed = self._eaten(state, volume, medium, constants, dt)
        to_reservoir, inside = None, eaten
        if in_reservoir is not None:  # the concentration of a reservoir is constant
            there_for_good = volume / gain * torch.expm1(greatest * there / (half + there) * dt)
            eaten = torch.where(in_reservoir, there_for_good, eaten)
            inside = torch.where(in_reservoir, 0.0, eaten)
            to_reservoir = inside - eaten
        # dV/dt = growth · V over the step, from V to V + gain · eaten
        growth = earlier + torch.log1p(gain * eaten / volume) / (dt * number)
        medium.give(signal, -inside, to_reservoir)
        own = f"{signal}_eaten"
        of_pool = self._of_pool(volume, medium, constants, dt)
        state = medium.settle(growth_rate=growth, **{own: state.fields[own] + eaten})
        uptake = state.groups.sum(eaten.unsqueeze(1)).squeeze(1)
        note = NutritionReport(
            state.groups.any(failed).long(), uptake, inside.detach(), of_pool,
            (there / (half + there)).detach(), state.groups, state.step, self.takes_turns,
        )  # fmt: skip
        note = note.after(state.reports["nutrition"]) if done else note
        return state.replace(reports={**state.reports, "nutrition": note})

    @torch.no_grad()
    def _of_pool(
        self, volume: Tensor, medium: MediumExchange, constants: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        """How often each cell would empty its pool in dt, (N,)."""
        greatest, half, gain = constants.values()
        pool, there = medium.pool, medium.found[self.effect.signal]
        times = greatest * volume / gain / (half + there) * dt / pool
        if medium.in_reservoir is not None:  # nothing changes it
            times = torch.where(medium.in_reservoir, 0.0, times)
        return times

    def _eaten(
        self,
        state: State,
        volume: Tensor,
        medium: MediumExchange,
        constants: Mapping[str, Tensor],
        dt: float,
    ) -> tuple[Tensor, Tensor]:
        """What each cell takes from its pool, (N,) conc·µm³, and whether its integration failed.
        volume: (N,) µm³, as uptake begins.

        What is eaten is a variable beside the concentration in the pool: where nutrient abounds, it
        would be lost in the rounding of a difference."""
        signal = self.effect.signal
        cells = run.CircuitCells(
            partial(_uptake, signal), ("eaten",), (signal,),
            torch.arange(state.cells, device=state.device), {"volume": volume}, constants,
            medium.found, medium.pool, label=f"uptake of {signal}",
        )  # fmt: skip
        if self.compiled is None:
            with suppress(Untraceable):  # a gradient is wanted: torch finds the slopes, too
                self.compiled = compiled_stiff(cells)
        cells = dataclasses.replace(cells, compiled=self.compiled, by_torch=bool(self.by_torch))
        found = run.step(cells, torch.zeros_like(volume).unsqueeze(1), dt, STIFF)
        return found.concentrations[:, 0], found.failed


def _uptake(signal: str, u: Names, s: Names, p: Names, cell: Names) -> tuple[Any, Any]:
    """The rates of what a cell has eaten, and of the signal in its pool, conc·µm³/h."""
    there = s[signal]
    eating = p.rate * (cell.volume / p.growth_yield + u.eaten) * there / (p.half + there)
    return {"eaten": eating}, {signal: -eating}

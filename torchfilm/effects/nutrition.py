"""Nutrition: cells take up a signal of the medium, and this uptake limits their growth, so that
dense colonies starve in the middle (Monod 1949)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import GROWTH, NUTRITION, Binding, BoundEffect, Effect
from torchfilm.medium_exchange import MediumExchange
from torchfilm.resolver import Values
from torchfilm.signals import uptake
from torchfilm.signals.compiled_uptake import EVENTS
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.doubling import check_doubling
from torchfilm.tools.row_checks import check_variable
from torchfilm.tools.units import CONCENTRATION
from torchfilm.values import Value, is_drawn, numbers, physical

CONSTANTS = ("rate", "half", "growth_yield")
STARVATION = "starvation"


@dataclass(frozen=True)
class NutritionReport:
    """`status` (B,): 1 if the solve of uptake and transport failed. `uptake` (B,): amount taken up
    in this step, conc·µm³. `iterations` (B,): of the solve."""

    status: Tensor
    uptake: Tensor
    iterations: Tensor
    hint = "A smaller dt may help"

    def reason(self, place: int) -> str:
        return "the solve of uptake and transport did not converge"

    def after(self, earlier: NutritionReport) -> NutritionReport:
        """With what failed, and what was taken up, earlier in the same step."""
        return dataclasses.replace(
            self,
            status=torch.maximum(earlier.status, self.status),
            uptake=earlier.uptake + self.uptake,
            iterations=earlier.iterations + self.iterations,
        )


@dataclass(frozen=True, eq=False)
class Monod(Effect):
    """Growth on a nutrient: dV/dt = rate · s/(half + s) · V. The cell takes dV/dt / yield per hour
    from the medium around it.

    signal: name of the nutrient in the Medium. rate: greatest growth rate, 1/h. half: concentration
    of half that rate. growth_yield: µm³ of cell per unit of concentration × µm³ of nutrient. Each
    is a number, one per colony, one per cell type, or a distribution drawn at birth.

    Monod sets `growth_rate`, so the scene's Growth must have no rate of its own, and no rule may
    set it. What slows cells down, or stops them, goes into `factor`: the name of a variable of the
    cells, such as rules set or circuits compute, that multiplies the rate of growth and uptake.

    maintenance: 1/h, given as `rate` is: the part of what uptake lets a cell grow by that it needs
    to live (Pirt, Proc. R. Soc. B 163, 224, 1965). Then dV/dt = (rate · s/(half + s) −
    maintenance) · V, and 0 where that is below 0: cells do not shrink. What they lack is the field
    `starvation`, 1/h, by which tf.Lysis(when="starvation", …), rules and circuits may go.

    Uptake and transport of the nutrient are solved together: also where a cell would empty the
    voxels about it many times in a step, diffusion feeds it. The medium loses what the cells take
    up, to rounding (in float32 up to a hundredth of it over a run, of stocks hundreds of times as
    large), and never more than it contains. A cell grows over the step at the mean concentration
    that it finds. If contacts slow this growth, the nutrient is consumed all the same. So is the
    nutrient for the volume of the caps lost at division.
    """

    signal: str
    rate: Value = physical(1.0, unit="1/h", least=0.0)
    half: Value = physical(1.0, unit=CONCENTRATION, above=0.0)
    growth_yield: Value = physical(1.0, unit="1/conc", above=0.0)
    factor: str | None = None
    maintenance: Value | None = physical(None, unit="1/h", least=0.0)

    stage = NUTRITION
    title = "nutrition"
    may_repeat = False
    instead_of_two = (
        "Cells on several nutrients: let a circuit take them up, and pay for growth by a species of"
        " its own: tf.Growth(species=…)."
    )

    def declares(self, dim: int) -> tuple[Field, ...]:
        eaten = Field(
            f"{self.signal}_eaten", "nutrient taken up since birth", "conc·µm³", at_division="reset"
        )
        lacking = Field(STARVATION, "maintenance that uptake does not cover", "1/h")
        return (eaten,) if self.maintenance is None else (eaten, lacking)

    def reads(self) -> tuple[str, ...]:
        return ("position", "length", "radius", OUTSIDE + self.signal)

    def __post_init__(self) -> None:
        if not (isinstance(self.signal, str) and self.signal.isidentifier()):
            raise checks.input_error("Monod.signal", self.signal, "the name of one signal")
        named = isinstance(self.factor, str) and self.factor.isidentifier()
        if self.factor is not None and not named:
            raise checks.input_error(
                "Monod.factor", self.factor, "the name of a variable of the cells, or None"
            )

    def needs(self) -> tuple[str, ...]:
        return (OUTSIDE + self.signal, "growth_rate", *self.at_least_zero())

    def at_least_zero(self) -> tuple[str, ...]:
        return () if self.factor is None else (self.factor,)

    def writes(self) -> tuple[str, ...]:
        lacking = () if self.maintenance is None else (STARVATION,)
        return ("growth_rate", OUTSIDE + self.signal, f"{self.signal}_eaten", *lacking)

    def only_takes(self) -> tuple[str, ...]:
        return (OUTSIDE + self.signal,)

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
        if self.factor is not None:
            check_variable("Monod.factor", self.factor, state, at_least_zero=True)


class BoundMonod(BoundEffect):
    """Monod bound to a batch; it also reads and writes the reservoir's field, if there is one."""

    effect: Monod
    moves_signals = True
    begun = False  # whether it has set growth rates of a first state

    @property
    def transport(self) -> Any:
        """Of the medium."""
        return self.plan.transport

    @property
    def by_kernels(self) -> bool:
        return self.transport.compiled

    def _reservoir(self) -> tuple[str, ...]:
        return self.binding.reservoirs([self.effect.signal])

    def reads(self) -> tuple[str, ...]:
        # growth_rate must be there, but Monod sets it whatever it was
        read = [n for n in super().reads() if n != "growth_rate"]
        return (*read, f"{self.effect.signal}_eaten", *self._reservoir())

    def writes(self) -> tuple[str, ...]:
        return (*super().writes(), *self._reservoir())

    def numerics(self, dt: float, state: State) -> list[str]:
        signal, parts = self.effect.signal, self.transport.medium.steps
        over = f"{parts} parts of the step, each" if parts > 1 else "the step, in which"
        fastest = self.transport.exchanges_per_hour(signal, state) * dt / parts
        return [
            f"uptake and transport of {signal} in one equation over {over} cells grow at the mean"
            " concentration that they find; the medium loses what they take up, to rounding",
            "transport by backward Euler, order 1: voxels exchange"
            f" {fastest:.3g} times a step, over {EVENTS:g}"
            if fastest > EVENTS
            else "transport by a series, order 2 in dt",
            "computed by compiled functions; by torch where gradients are required"
            if self.by_kernels
            else f"computed by torch: {self.transport.by_torch}",
        ]

    def exchanges(self) -> tuple[str, ...]:
        return (self.effect.signal,)

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        for other in effects:
            after = (other.stage, other.place) > (self.stage, self.place)
            between = after and other.stage <= GROWTH  # it may change what Monod has set
            if other is not self and not between and "growth_rate" in other.writes():
                raise checks.InputError(
                    f"{other.title} sets growth_rate, which Monod sets again in every step. Let"
                    " cells grow more slowly, or stop, by a variable that multiplies their rate of"
                    " growth and uptake: tf.Rules(…, variables={'factor': 1.0}) and"
                    " tf.Monod(…, factor='factor')."
                )

    def ready(self, state: State) -> State:
        """With the growth rate at the first concentrations, which rules and frames find."""
        if self.transport is None:  # not yet bound to the others
            return state
        self.begun = True
        state = self.transport.covered(state)
        medium = MediumExchange(state, (self.effect.signal,))
        medium.find()
        found = medium.found[self.effect.signal].double()
        eaters = self._eaters(state, medium, torch.ones_like(found), 0.0)
        gross, needed = eaters.greatest * found / (eaters.half + found), self._maintenance(state)
        changed = {"growth_rate": gross}
        if needed is not None:
            changed = {
                "growth_rate": (gross - needed).clamp(min=0.0),
                STARVATION: (needed - gross).clamp(min=0.0),
            }
        return state.with_fields(**{n: x.to(state.fields[n].dtype) for n, x in changed.items()})

    def check(self, state: State) -> None:
        super().check(state)
        if not self.begun and bool((state.growth_rate != 0).any()):
            raise checks.InputError(
                "Monod sets the growth rate, but Growth has a rate of its own, or the founders or"
                " another effect bring one, which would be overwritten: write Growth(), and leave"
                " growth_rate out."
            )

    def step(self, state: State, dt: float) -> State:
        if dt == 0:
            return state
        parts = self.transport.medium.steps
        for done in range(parts):
            state = self._part(state, dt / parts, done, parts)
        return state

    def _part(self, state: State, dt: float, done: int, number: int) -> State:
        """The state after dt hours of uptake and transport, one of a `number` of parts of a step,
        of which so many are `done`. Cells grow by it after the last."""
        signal = self.effect.signal
        medium = MediumExchange(state, (signal,))
        medium.find()
        assert state.layout is not None
        # with what it will grow by the parts that are done
        earlier = (state.growth_rate if done else torch.zeros_like(state.growth_rate)).double()
        eaters = self._eaters(state, medium, torch.exp(earlier * (dt * number)), dt)
        needed = self._maintenance(state)
        if needed is not None:
            # in the middle of the part half of it is off, of cells that starve half of the growth
            found = medium.found[signal].double()
            gross = eaters.greatest * found / (eaters.half + found)
            off = torch.exp(-0.5 * dt * torch.minimum(needed, gross))
            eaters = dataclasses.replace(eaters, volume=eaters.volume * off)
        taken = uptake.solve(
            eaters, state.layout.grid, self.transport.with_uptake(signal, state),
            state.fields[OUTSIDE + signal], medium.found[signal],
        )  # fmt: skip
        grown = torch.log1p(eaters.gain * taken.amount / eaters.volume) / (dt * number)
        own = f"{signal}_eaten"
        changed = {
            OUTSIDE + signal: taken.end,
            "growth_rate": earlier + grown,
            own: state.fields[own] + taken.amount,
        }
        if needed is not None:
            left = grown - needed / number
            changed["growth_rate"] = earlier + left.clamp(min=0.0)
            lacking = (-left).clamp(min=0.0)
            changed[STARVATION] = state.fields[STARVATION] + lacking if done else lacking
        total = lambda amount: state.groups.sum(amount)
        for name in self._reservoir():
            changed[name] = state.fields[name] - total(torch.where(eaters.fed, 0.0, taken.amount))
        changed = {n: x.to(state.fields[n].dtype) for n, x in changed.items()}
        note = NutritionReport(taken.failed.long(), total(taken.amount), taken.iterations)
        note = note.after(state.reports["nutrition"]) if done else note
        return state.with_fields(**changed).replace(
            reports={**state.reports, "nutrition": note}
        )  # fmt: skip

    def _maintenance(self, state: State) -> Tensor | None:
        """Of each cell, (N,) float64 1/h; None where the scene asks for none."""
        if self.effect.maintenance is None:
            return None
        return self.values.maintenance.of_cells(state).double().expand(state.cells)

    def _eaters(
        self, state: State, medium: MediumExchange, growth: Tensor, dt: float
    ) -> uptake.Eaters:
        """The cells as they are after `growth`, (N,), of their volume in this step."""
        volume = state.volume.double() * growth
        rate, half, gain = (
            self.values[n].of_cells(state).double().expand_as(volume) for n in CONSTANTS
        )
        if self.effect.factor is not None:
            rate = rate * state.fields[self.effect.factor]
        outside = medium.in_reservoir
        fed = torch.ones_like(volume, dtype=torch.bool) if outside is None else ~outside
        return uptake.Eaters(
            volume, rate, half, gain, fed, medium.stencil, state.groups, dt
        )  # fmt: skip

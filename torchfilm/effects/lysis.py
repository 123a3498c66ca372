"""Lysis: cells burst, and what they hold goes to the medium about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import LYSIS, Binding, BoundEffect, Effect
from torchfilm.medium_exchange import MediumExchange
from torchfilm.resolver import Values
from torchfilm.state import CELL, OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.random import fine_uniform
from torchfilm.values import CONCENTRATION, Rule, Value, checked, physical

AMOUNT = Rule("conc·µm³", least=0.0)
VOLUME = "volume"


@dataclass(frozen=True, eq=False)
class Lysis(Effect):
    """Cells burst: they are removed, and what they hold goes to the medium about them.

    A cell bursts at the end of the step in which `when` exceeds `above`; with a `rate`, 1/h, it
    does so at that rate as long as it exceeds it. Without `when` all cells burst at the rate.

    when: name of a species of a circuit, or of another variable of the cells, such as rules set.
    above, rate: a number, one per colony, one per cell type, or a distribution drawn at birth.
    releases: what goes to each signal of the Medium, by the signal's name: the name of a species or
    variable (its concentration times the cell's volume is released), "volume" (one unit of
    concentration times the volume), a tuple of such names, or an amount per cell in conc·µm³.
    What it does not name is lost with the cell; `explain` lists the species that are.

    The lineage keeps the end of these cells, with the fate "lysed". Transport spreads what they
    released from the next step on.
    """

    when: str | None = None
    above: Value = physical(0.0)
    rate: Value | None = physical(None, unit="1/h", least=0.0)
    releases: Mapping[str, Any] | None = None

    stage = LYSIS
    title = "lysis"
    by_kernels = True

    def __post_init__(self) -> None:
        if self.when is None and self.rate is None:
            raise checks.InputError(
                "Lysis has neither `when` nor `rate`: it needs the name of a species or variable"
                ' that decides which cells burst, such as when="lysis_protein", or a rate, 1/h.'
            )
        if self.when is not None and not _is_name(self.when):
            raise checks.input_error(
                "Lysis.when", self.when, "the name of a species or a variable of the cells"
            )
        if not isinstance(self.releases, Mapping | None):
            raise checks.input_error(
                "Lysis.releases", self.releases,
                'a dict of what goes to each signal, such as {"colicin": "colicin"}',
            )  # fmt: skip
        kept = {}
        for signal, what in (self.releases or {}).items():
            path = f"Lysis.releases[{signal!r}]"
            if not _is_name(signal):
                raise checks.input_error("Lysis.releases", signal, "keys that name signals")
            names = what if isinstance(what, tuple | list) else (what,)
            if names and all(_is_name(n) for n in names):
                kept[signal] = tuple(names)
            elif isinstance(what, str | tuple | list):
                raise checks.input_error(
                    path, what, 'the name of a species, "volume", a tuple of names, or an amount'
                )
            else:
                kept[signal] = checked(path, what, AMOUNT)
        object.__setattr__(self, "releases", kept)

    @property
    def _named(self) -> dict[str, tuple[str, ...]]:
        """What each signal gets of the cell, by the signal's name."""
        assert self.releases is not None
        return {s: what for s, what in self.releases.items() if isinstance(what, tuple)}

    def _variables(self) -> tuple[str, ...]:
        """The species and variables that it reads."""
        decides = () if self.when is None else (self.when,)
        return tuple(dict.fromkeys((*decides, *self.at_least_zero())))

    def at_least_zero(self) -> tuple[str, ...]:
        return tuple(n for names in self._named.values() for n in names if n != VOLUME)

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        assert self.releases is not None
        amounts = {
            f"releases[{s!r}]": (x, AMOUNT)
            for s, x in self.releases.items()
            if not isinstance(x, tuple)
        }
        return {**self.physical_fields(), **amounts}

    def reads(self) -> tuple[str, ...]:
        return ("position", "length", "radius") if self.releases else ()

    def needs(self) -> tuple[str, ...]:
        assert self.releases is not None
        return (*self._variables(), *(OUTSIDE + s for s in self.releases))

    def writes(self) -> tuple[str, ...]:
        assert self.releases is not None
        return ("cells", *(OUTSIDE + s for s in self.releases))

    def bind(self, binding: Binding) -> tuple[BoundEffect, ...]:
        return (BoundLysis(self, binding),)

    def check(self, state: State, values: Values) -> None:
        for name in self._variables():
            declared = state.declared[name]
            if declared.scope != CELL or declared.shape:
                raise checks.input_error("Lysis", name, "variables with one number for each cell")


class BoundLysis(BoundEffect):
    """Lysis bound to a batch; it also writes the reservoirs' fields, if there are some."""

    effect: Lysis

    def _reservoirs(self) -> tuple[str, ...]:
        assert self.effect.releases is not None
        names = (f"{signal}_reservoir" for signal in self.effect.releases)
        return tuple(n for n in names if n in self.binding.declared)

    def reads(self) -> tuple[str, ...]:
        return (*super().reads(), *self._reservoirs())

    def writes(self) -> tuple[str, ...]:
        return (*super().writes(), *self._reservoirs())

    def numerics(self, dt: float, state: State) -> list[str]:
        effect = self.effect
        assert effect.releases is not None
        asked = "" if effect.when is None else f" in which {effect.when} exceeds its bound"
        chance = "" if effect.rate is None else ", by a draw of 1 − exp(−rate·dt)"
        named = [f"{s} gets {' and '.join(names)}" for s, names in effect._named.items()]
        given = [f"{s} gets an amount" for s in effect.releases if s not in effect._named]
        released = {n for names in effect._named.values() for n in names}
        lost = [
            n
            for n, field in state.declared.items()
            if field.scope == CELL and field.unit == CONCENTRATION and n not in released
        ]
        lines = [f"at the end of the step{asked}{chance}; before cells divide"]
        if effect.releases:
            lines.append(f"released at once, exactly: {'; '.join(named + given)}")
        if lost:
            lines.append(f"lost with the cells: {', '.join(lost)}")
        return lines

    def step(self, state: State, dt: float) -> State:
        """The state without the cells that burst, and with what they released."""
        bursts = self._bursts(state, dt)
        if not bool(bursts.any()):
            return state
        if self.effect.releases:
            state = self._released(state, bursts)
        return state.remove(bursts, "lysed")

    def _bursts(self, state: State, dt: float) -> Tensor:
        """Which cells burst in this step, (N,) bool."""
        effect, values = self.effect, self.values
        bursts = torch.ones(state.cells, dtype=torch.bool, device=state.device)
        if effect.when is not None:
            bursts = state.fields[effect.when] > values.above.of_cells(state)
        if effect.rate is None:
            return bursts
        rows = torch.arange(state.cells, device=state.device)
        coarse, fine = (state.uniform(rows, f"{effect.value_owner()} {k}") for k in range(2))
        chance = -torch.expm1(-values.rate.of_cells(state).double() * dt)
        return bursts & (fine_uniform(coarse, fine) < chance)

    def _released(self, state: State, bursts: Tensor) -> State:
        effect = self.effect
        assert effect.releases is not None
        burst = state.take(torch.nonzero(bursts).squeeze(1))
        medium = MediumExchange(burst, tuple(effect.releases))
        medium.find()
        away = medium.in_reservoir
        for signal, what in effect.releases.items():
            amount = self._amount(burst, signal, what).to(state.dtype).expand(burst.cells)
            if away is None:
                medium.give(signal, amount, None)
            else:
                near, far = (torch.where(there, amount, 0.0) for there in (~away, away))
                medium.give(signal, near, far)
        settled = medium.settle().fields
        return state.with_fields(**{n: settled[n] for n in self.writes() if n != "cells"})

    def _amount(self, state: State, signal: str, what: Any) -> Tensor:
        """What a cell that bursts releases to a signal, conc·µm³, (N,) or one number."""
        if not isinstance(what, tuple):
            return self.values[f"releases[{signal!r}]"].of_cells(state)
        volume = state.volume
        held = [volume if n == VOLUME else state.fields[n] * volume for n in what]
        return torch.stack(held).sum(0)


def _is_name(given: object) -> bool:
    return isinstance(given, str) and given.isidentifier()

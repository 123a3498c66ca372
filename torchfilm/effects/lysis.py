"""Lysis: cells burst, and what they hold goes to the medium about them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import LYSIS, Binding, BoundEffect, Effect
from torchfilm.medium_exchange import MediumExchange
from torchfilm.resolver import Values
from torchfilm.signals.schedule import warn_of_means
from torchfilm.state import OUTSIDE, State
from torchfilm.tools import checks, units
from torchfilm.tools.random import fine_uniform
from torchfilm.tools.read_only import read_only
from torchfilm.tools.row_checks import check_names, check_variable, is_name
from torchfilm.values import Rule, ScheduledValue, checked, physical

AMOUNT = Rule("conc·µm³", least=0.0, scheduled=True)
SHARE = Rule("", least=0.0, scheduled=True)
LENGTH, VOLUME = "length", "volume"
_NO_LEVELS = ("radius", "position", "axis", "area", "cells")
_OF_SHAPE = (
    "a species or a variable; of a cell's shape, `when` knows length and volume, `releases` volume"
)


@dataclass(frozen=True)
class LysisReport:
    """`burst` (B,): how many cells burst in this step. `released`: what they gave to each signal,
    (B,) float64 conc·µm³ by its name. `unknown`: by each `when`, (B,), 1 where it is not a number
    in a cell. `status` (B,): 1 where one of them is not."""

    burst: Tensor
    released: Mapping[str, Tensor]
    unknown: tuple[tuple[str | None, Tensor], ...]
    hint = "Let the rule, or the circuit, give it a number in every cell"

    @property
    def status(self) -> Tensor:
        return functools.reduce(torch.maximum, (status for _, status in self.unknown))

    def reason(self, place: int) -> str:
        when = next(name for name, status in self.unknown if status[place])
        return f"{when}, which decides which cells burst, is not a number in a cell"

    def after(self, earlier: LysisReport) -> LysisReport:
        """With what another Lysis did earlier in the same step."""
        both = dict(earlier.released)
        for name, amount in self.released.items():
            both[name] = both[name] + amount if name in both else amount
        return LysisReport(earlier.burst + self.burst, both, earlier.unknown + self.unknown)


@dataclass(frozen=True, eq=False)
class Lysis(Effect):
    """Cells burst: they are removed, and what they hold goes to the medium about them.

    A cell bursts at the end of the step in which `when` exceeds `above` (by default 0); with a
    `rate`, 1/h, it does so at that rate as long as it exceeds it. Without `when` all cells burst at
    the rate.

    when: name of a species of a circuit, or of a variable with a first value, such as
    tf.Rules(…, variables={"lysing": 0.0}) has; or "length" or "volume". above, rate: a number, one
    per colony, one per cell type, a distribution drawn at birth, or a Schedule.

    factor: name of a species or variable that multiplies the rate.

    hazard: in place of `rate` and `when`, the name of a species of a circuit that adds up the rate
    of death, such as {"dying": p.k * s.drug}, and that growth does not dilute (dilution=False, or
    the names of the others). At the end of a step a cell bursts by the chance 1 − exp(−dying); in
    those that live it begins again at 0. So cells die by what they met in the whole step, also
    where they take up what kills them. A variable of rules serves, too.

    releases: what goes to each signal of the Medium, by the signal's name: the name of a species
    (its concentration times the cell's volume is released) or of a variable of rules (its value, an
    amount in conc·µm³), "volume" (one unit of concentration times the volume), a tuple of such
    names, a dict of how much of each, such as {"volume": 2.0, "gfp": 1.0}, or an amount per cell
    in conc·µm³, given as `rate` is. What it does not name is lost with the cell; `explain` lists
    the species that are.

    The lineage keeps the end of these cells, with the fate "lysed"; `state.reports["lysis"]` counts
    them. Transport spreads what they released from the next step on.
    """

    when: str | None = None
    above: ScheduledValue | None = physical(None, scheduled=True)
    rate: ScheduledValue | None = physical(None, unit="1/h", least=0.0, scheduled=True)
    releases: Mapping[str, Any] | None = None
    factor: str | None = None
    hazard: str | None = None

    stage = LYSIS
    title = "lysis"
    by_kernels = True
    usual_first = 0.0

    def __post_init__(self) -> None:
        if self.when is None and self.rate is None and self.hazard is None:
            raise checks.InputError(
                "Lysis has none of `when`, `rate` and `hazard`: it needs the name of a species or"
                ' variable that decides which cells burst, such as when="lysis_protein", or a rate,'
                " 1/h."
            )
        check_names("Lysis", factor=self.factor, hazard=self.hazard)
        for name in ("when", "above", "rate", "factor") if self.hazard is not None else ():
            if getattr(self, name) is not None:
                raise checks.input_error(
                    f"Lysis.{name}", getattr(self, name), "left out with hazard, which is all"
                )
        if self.factor is not None and self.rate is None:
            raise checks.input_error(
                "Lysis.factor", self.factor, "given with rate, which it multiplies"
            )
        if self.when is None and self.above is not None:
            raise checks.input_error(
                "Lysis.above", self.above, "given with `when`, the name of what is to exceed it"
            )
        if self.when is not None and not is_name(self.when):
            raise checks.input_error(
                "Lysis.when", self.when, "the name of a species or a variable of the cells"
            )
        if not isinstance(self.releases, Mapping | None):
            raise checks.input_error(
                "Lysis.releases", self.releases,
                'a dict of what goes to each signal, such as {"colicin": "colicin"}',
            )  # fmt: skip
        if self.when in _NO_LEVELS:
            raise checks.input_error("Lysis.when", self.when, _OF_SHAPE)
        given = {s: self._checked_release(s, what) for s, what in (self.releases or {}).items()}
        object.__setattr__(self, "releases", read_only({s: given[s] for s in sorted(given)}))

    def _checked_release(self, signal: object, what: Any) -> Any:
        """A tuple of names, a dict of how much of each, or a checked amount."""
        path = f"Lysis.releases[{signal!r}]"
        if not is_name(signal):
            raise checks.input_error("Lysis.releases", signal, "keys that name signals")
        shares = _has_shares(what)
        names = tuple(what) if isinstance(what, tuple | list) or shares else (what,)
        if names and all(map(is_name, names)):
            if {LENGTH, *_NO_LEVELS} & {*names}:
                raise checks.input_error(path, what, _OF_SHAPE)
            if len(set(names)) < len(names):
                raise checks.input_error(path, what, "a tuple of different names")
            if shares:
                each = {n: checked(f"{path}[{n!r}]", x, SHARE) for n, x in what.items()}
                return read_only(each)
            return names
        if isinstance(what, str) or not names or any(isinstance(n, str) for n in names):
            raise checks.input_error(
                path,
                what,
                'the name of a species, "volume", a tuple of names, a dict of how much of each, or'
                " an amount",
            )
        return checked(path, what, AMOUNT)

    @property
    def _named(self) -> dict[str, tuple[str, ...]]:
        """What each signal gets of the cell, by the signal's name."""
        assert self.releases is not None
        return {s: tuple(what) for s, what in self.releases.items() if _is_named(what)}

    def at_least_zero(self) -> tuple[str, ...]:
        released = (n for names in self._named.values() for n in names if n != VOLUME)
        return (*released, *(n for n in (self.factor, self.hazard) if n is not None))

    def _variables(self) -> tuple[str, ...]:
        """The species and variables that it reads."""
        decides = () if self.when in (None, LENGTH, VOLUME) else (str(self.when),)
        return tuple(dict.fromkeys((*decides, *self.at_least_zero())))

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        assert self.releases is not None
        found = dict(self.physical_fields())
        for s, what in self.releases.items():
            if not _is_named(what):
                found[f"releases[{s}]"] = (what, AMOUNT)
            elif _has_shares(what):
                found |= {f"releases[{s}][{n}]": (x, SHARE) for n, x in what.items()}
        return found

    def reads(self) -> tuple[str, ...]:
        sized = self.releases or self.when in (LENGTH, VOLUME)
        return (*(["position"] if self.releases else []), *(["length", "radius"] if sized else []))

    def needs(self) -> tuple[str, ...]:
        assert self.releases is not None
        return (*self._variables(), *(OUTSIDE + s for s in self.releases))

    def writes(self) -> tuple[str, ...]:
        assert self.releases is not None
        spent = () if self.hazard is None else (self.hazard,)
        return ("cells", *(OUTSIDE + s for s in self.releases), *spent)

    def bind(self, binding: Binding) -> tuple[BoundEffect, ...]:
        return (BoundLysis(self, binding),)

    def check_scene(self, effects: Sequence[Effect], founders: Any) -> None:
        for other in effects:
            diluted = getattr(other, "diluted_fields", ())
            if self.hazard in diluted:
                of = f"{getattr(other, 'name', '')}_"  # fields of a named circuit begin with it
                others = tuple(n.removeprefix(of) for n in diluted if n != self.hazard)
                write = f"dilution={others}" if others else "dilution=False"
                raise checks.InputError(
                    f"Lysis.hazard = {self.hazard!r}: growth dilutes this species, so that fewer"
                    f" cells would die than it says. Write {write} in its circuit."
                )

    def check_step(self, dt: float, divides: bool) -> None:
        given = {name: value for name, (value, _) in self.physical_values().items()}
        warn_of_means("Lysis", given, dt)

    def check(self, state: State, values: Values) -> None:
        options = {getattr(self, n): f"Lysis.{n}" for n in ("factor", "hazard", "when")}
        for name in self._variables():
            option = options.get(name, "Lysis.releases")
            check_variable(option, name, state, at_least_zero=name in self.at_least_zero())
        own = None if self.hazard is None else state.declared[self.hazard]
        if own is not None and own.unit and not own.is_species:  # no species, no variable
            raise checks.input_error(
                "Lysis.hazard", self.hazard,
                "a species of a circuit, or a variable of rules, that is only for it",
                f"{self.hazard} is in {own.unit}, and would be 0 after each step.",
            )  # fmt: skip
        self._check_units(state)

    def _check_units(self, state: State) -> None:
        """Raise InputError where a species goes to a signal of another unit, without a share of it,
        which may convert it."""
        released = {s: names for s, names in self._named.items() if s in state.signals}
        for signal, names in released.items():
            there = state.declared[OUTSIDE + signal].unit
            for name in () if _has_shares((self.releases or {})[signal]) else names:
                if not _is_species(state, name):
                    continue
                own = state.declared[name].unit
                if units.differ(own, there):
                    raise checks.InputError(
                        f"Lysis.releases gives {name!r}, in {own}, to the signal {signal!r},"
                        f" which is in {there}: give both one unit, or the factor between them,"
                        f" {{{name!r}: …}}."
                    )


class BoundLysis(BoundEffect):
    """Lysis bound to a batch; it also writes the reservoirs' fields, if there are some."""

    effect: Lysis
    number = 0  # of those before it in the scene

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        alike = [e for e in effects if isinstance(e, BoundLysis)]
        self.number = alike.index(self)

    def reads(self) -> tuple[str, ...]:
        return (*super().reads(), *self.binding.reservoirs(self.effect.releases or ()))

    def writes(self) -> tuple[str, ...]:
        return (*super().writes(), *self.binding.reservoirs(self.effect.releases or ()))

    def _fields(self) -> tuple[str, ...]:
        """Those of the medium that get what is released."""
        signals = self.effect.releases or ()
        return (*(OUTSIDE + s for s in signals), *self.binding.reservoirs(signals))

    def numerics(self, dt: float, state: State) -> list[str]:
        effect = self.effect
        assert effect.releases is not None
        asked = "" if effect.when is None else f" in which {effect.when} exceeds its bound"
        rate = "rate·dt" if effect.factor is None else f"rate·{effect.factor}·dt"
        drawn = rate if effect.rate is not None else effect.hazard
        chance = "" if drawn is None else f", by a draw of 1 − exp(−{drawn})"
        named = [f"{s} gets {' and '.join(names)}" for s, names in effect._named.items()]
        given = [f"{s} gets an amount" for s in effect.releases if s not in effect._named]
        released = {n for names in effect._named.values() for n in names}
        lost = [n for n in state.fields if _is_species(state, n) and n not in released]
        lines = [f"at the end of the step{asked}{chance}; before cells divide"]
        if effect.releases:
            lines.append(f"released at once, exactly: {'; '.join(named + given)}")
        if lost:
            lines.append(f"lost with the cells: {', '.join(lost)}")
        return lines

    def step(self, state: State, dt: float) -> State:
        """The state without the cells that burst, and with what they released."""
        effect, (bursts, unknown) = self.effect, self._bursts(state, dt)
        assert effect.releases is not None
        none = torch.zeros(state.colonies, dtype=torch.float64, device=state.device)
        burst, released = none.long(), dict.fromkeys(effect.releases, none)
        gone = bool(bursts.any())
        if gone:
            burst = state.groups.sum(bursts.double()).long()
        if gone and effect.releases:
            state, released = self._released(state, bursts)
        if effect.hazard is not None:
            spent = torch.zeros_like(state.fields[effect.hazard])
            state = state.with_fields(**{effect.hazard: spent})
        report = LysisReport(burst, released, ((effect.when or effect.hazard, unknown),))
        earlier = state.reports.get(effect.title)
        if self.number and isinstance(earlier, LysisReport):
            report = report.after(earlier)
        state = state.replace(reports={**state.reports, effect.title: report})
        return state.remove(bursts, "lysed") if gone else state

    def _bursts(self, state: State, dt: float) -> tuple[Tensor, Tensor]:
        """Which cells burst in this step, (N,) bool, and in which colonies `when` is not a number,
        (B,) int64."""
        effect, values = self.effect, self.values
        bursts = torch.ones(state.cells, dtype=torch.bool, device=state.device)
        unknown = torch.zeros_like(state.counts)
        if effect.when is not None:
            level = _quantity(state, effect.when)
            unknown = state.groups.any(level.isnan()).long()
            bursts = level > (0.0 if effect.above is None else values.above.of_cells(state))
        if effect.rate is None and effect.hazard is None:
            return bursts, unknown
        if effect.hazard is not None:
            deaths = state.fields[effect.hazard].double()
            unknown = state.groups.any(deaths.isnan()).long()
        else:
            deaths = values.rate.of_cells(state).double() * dt
            if effect.factor is not None:
                deaths = deaths * state.fields[effect.factor]
        rows = torch.arange(state.cells, device=state.device)
        purpose = effect.value_owner() + (f" {self.number}" if self.number else "")
        coarse, fine = (state.uniform(rows, f"{purpose} {k}") for k in range(2))
        return bursts & (fine_uniform(coarse, fine) < -torch.expm1(-deaths)), unknown

    def _released(self, state: State, bursts: Tensor) -> tuple[State, dict[str, Tensor]]:
        """The state whose medium has what these cells release, and the sums by colony and
        signal."""
        effect = self.effect
        assert effect.releases is not None
        burst = state.take(torch.nonzero(bursts).squeeze(1))
        medium = MediumExchange(burst, tuple(effect.releases))
        medium.find()
        away, total = medium.in_reservoir, {}
        for signal, what in effect.releases.items():
            amount = self._amount(burst, signal, what).to(state.dtype).expand(burst.cells)
            total[signal] = burst.groups.sum(amount.detach().double())
            if away is None:
                medium.give(signal, amount, None)
            else:
                near, far = (torch.where(there, amount, 0.0) for there in (~away, away))
                medium.give(signal, near, far)
        settled = medium.settle().fields
        changed = {n: settled[n] for n in self._fields()}
        return state.with_fields(**changed), total

    def _amount(self, state: State, signal: str, what: Any) -> Tensor:
        """What a cell that bursts releases to a signal, conc·µm³, (N,) or one number."""
        if not _is_named(what):
            return self.values[f"releases[{signal}]"].of_cells(state)
        held = [
            _quantity(state, n) * (state.volume if _is_species(state, n) else 1.0) for n in what
        ]
        if _has_shares(what):
            shares = (self.values[f"releases[{signal}][{n}]"].of_cells(state) for n in what)
            held = [x * share for x, share in zip(held, shares, strict=True)]
        return functools.reduce(torch.add, held)  # in this order, whatever the batch


def _has_shares(what: Any) -> bool:
    """Whether a release says how much of each name; a dict by cell types is an amount."""
    return isinstance(what, Mapping) and any(isinstance(n, str) for n in what)


def _is_named(what: Any) -> bool:
    """Whether a release is of what a cell holds, and not an amount."""
    return isinstance(what, tuple) or _has_shares(what)


def _quantity(state: State, name: str) -> Tensor:
    return getattr(state, name) if name in (LENGTH, VOLUME) else state.fields[name]


def _is_species(state: State, name: str) -> bool:
    declared = state.declared.get(name)  # a cell's volume is not declared
    return declared is not None and declared.is_species

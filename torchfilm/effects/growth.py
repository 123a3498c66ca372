"""Growth: how much each cell elongates in a step. Contacts, where there are any, may then hold it
back."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import GROWTH, Binding, BoundEffect, Effect, is_own
from torchfilm.resolver import Values
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.doubling import check_doubling
from torchfilm.tools.row_checks import check_field, check_variable
from torchfilm.tools.warn_once import warn
from torchfilm.values import ByType, Value, is_drawn, is_inherited, numbers, physical

LAWS = ("volume", "length", "linear")
MOST_GROWN = 1.05  # of its size, that a cell may add in a step where cells divide
UNITS = {"volume": "1/h", "length": "1/h of the length", "linear": "µm/h"}


@dataclass(frozen=True)
class GrowthReport:
    """Made only where a cell would grow past all numbers, or to more than twice its size in a step
    of a scene in which cells divide: `status` (B,), 1 for its colony, in which no cell grew; and,
    (B,), the `uid` and `rate` of the first such cell, and how many times larger it would be,
    `grown`."""

    status: Tensor
    uid: Tensor
    rate: Tensor
    grown: Tensor
    hint = "A smaller dt or growth rate may help (rates are per hour, and dt is in hours)"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at this place of the batch."""
        cell, grown = f"cell {int(self.uid[place])}", float(self.grown[place])
        if grown < math.inf:
            return (
                f"{cell} would become {grown:.3g} times as large in one step. Cells that divide may"
                " at most double, or their numbers would be wrong"
            )
        return (
            f"{cell} at a growth rate of {float(self.rate[place]):g} would be of no finite length"
        )


@dataclass(frozen=True, eq=False)
class Growth(Effect):
    """Cells grow longer.

    rate: 1/h (µm/h with law "linear"): a number, one per colony, one per cell type, or a
    distribution drawn at birth. A rate by type follows the cell's type, and no rule may set
    `growth_rate` then; where a type's rate is drawn, a cell that a rule gives another type draws
    that one's anew. None: cells grow at whatever rules or nutrition write to
    `growth_rate`, at first 0. law: "volume", dV/dt = rate·V, so that a cell's volume doubles in
    ln 2/rate, whatever its shape (the paper's wording); "length", dl/dt = rate·l of the centreline
    (the authors' program); "linear", dl/dt = rate. Exponentials are exact over a step.

    species: in place of a rate, the name of a species of a circuit that is µm³ of growth per µm³ of
    cell. In each step a cell grows by all of it that there is, which is spent with that: by
    species · V, exactly. So a circuit may live on several nutrients and pay for growth. The law is
    "volume".

    factor: the name of a variable of the cells, such as rules set or circuits compute, that
    multiplies the rate: what slows cells down, or stops them. `growth_rate` stays as it is.

    The number of cells doubles more slowly. A division at the length l makes two new caps of radius
    r, so that daughters begin at (l − 2r)/2: by "volume" they divide again after ln((l + 4r/3)/(l/2
    + r/3))/rate, by "length" after ln(2l/(l − 2r))/rate. With l = 4 µm and r = 0.5 µm that is
    0.77/rate and 0.98/rate. From a measured doubling time of cells, find the rate by these.
    """

    rate: Value | None = physical(None, unit="1/h", least=0.0, drawn_by_effect=True)
    law: str = "volume"
    species: str | None = None
    factor: str | None = None

    stage = GROWTH
    title = "growth"
    by_kernels = True
    may_repeat = False

    def __post_init__(self) -> None:
        checks.choice("Growth.law", self.law, LAWS)
        named = isinstance(self.factor, str) and self.factor.isidentifier()
        if self.factor is not None and (not named or self.species is not None):
            rule = "left out with species" if named else "the name of a variable of the cells"
            raise checks.input_error("Growth.factor", self.factor, rule)
        if self.species is None:
            return
        if not (isinstance(self.species, str) and self.species.isidentifier()):
            raise checks.input_error("Growth.species", self.species, "the name of one species")
        if self.rate is not None:
            hint = "Leave rate out, or species."
            raise checks.input_error("Growth.rate", self.rate, "left out with species", hint)
        checks.choice("Growth.law, with species", self.law, ("volume",))

    @property
    def by_type(self) -> bool:
        """Whether the rate goes by the cell's type at each moment."""
        return isinstance(self.rate, ByType) and not self.rate.is_drawn

    def declares(self, dim: int) -> tuple[Field, ...]:
        drawn = self.rate is not None and is_drawn(self.rate)
        return (
            Field(
                "growth_rate",
                "growth rate that the cell has where nothing holds it back"
                if self.law != "linear"
                else "growth of the centreline where nothing holds it back",
                UNITS[self.law],
                initial=0.0 if self.rate is None else _first_rate,
                at_division="reset" if drawn and not is_inherited(self.rate) else "copy",
            ),
            Field(
                "elongation", "growth wanted in this step, contained in length", "µm", internal=True
            ),
        )

    def keeps(self) -> Mapping[str, str]:
        return {"rate": "growth_rate"}

    def at_least_zero(self) -> tuple[str, ...]:
        return ("growth_rate", *self._paid(), *self._slowed())

    def _paid(self) -> tuple[str, ...]:
        return () if self.species is None else (self.species,)

    def _slowed(self) -> tuple[str, ...]:
        return () if self.factor is None else (self.factor,)

    @property
    def sets_rate(self) -> bool:
        """Whether it sets growth_rate in each step."""
        return self.by_type or self.species is not None

    @property
    def is_plain(self) -> bool:
        """Whether growth_rate is all that it goes by."""
        return not self.sets_rate and self.factor is None

    @property
    def holds_back(self) -> bool:
        return not self.is_plain

    def needs(self) -> tuple[str, ...]:
        return (*self._paid(), *self._slowed())

    def reads(self) -> tuple[str, ...]:
        return (*(self._paid() or ("growth_rate",)), "length", "radius", *self._slowed())

    def waits_for(self) -> Mapping[str, str]:
        if self.species is not None:
            return {self.species: "a rate of it in a circuit"}
        slowed = dict.fromkeys(self._slowed(), "a factor above 0")
        return {"growth_rate": "a parameter above 0 (such as rate=1.0)", **slowed}

    def writes(self) -> tuple[str, ...]:
        rate = ("growth_rate",) if self.sets_rate else ()
        return ("length", "elongation", *rate, *self._paid())

    def check_scene(self, effects: Sequence[Effect], founders: Any) -> None:
        redrawn = self.rate is not None and is_drawn(self.rate) and not is_inherited(self.rate)
        own = "growth_rate" in founders.extra and self.rate is not None
        if own and self.by_type and not redrawn:
            warn(
                f"the first cells have a growth_rate of their own, which Growth.rate ="
                f" {self.rate!r} replaces by that of their types. Leave theirs out, or write"
                " Growth()."
            )
        kept = own and not self.by_type and not redrawn
        if kept and bool(numbers(self.rate).any()):
            warn(
                f"Growth.rate = {self.rate!r} has no effect: the first cells have a growth_rate of"
                " their own, which their descendants keep. Write Growth(), or leave theirs out"
                " (Cells.from_table takes the further columns that fields=[…] names)."
            )
        others = [e for e in effects if e is not self]
        sets = any(is_own(e) or e.writes_anything or "growth_rate" in e.writes() for e in others)
        for name in self._paid():
            self._check_species(name, others)
        if self.rate is None and not (sets or self.species or "growth_rate" in founders.extra):
            warn(
                "Growth() has no rate, and no rule or nutrition sets growth_rate: nothing grows."
                " Write tf.Growth(rate=1.0), in 1/h."
            )

    def _check_species(self, name: str, others: Sequence[Effect]) -> None:
        """Raise InputError where growth would not be what the species says."""
        for other in others:
            own = getattr(other, "own_fields", ())
            if name in own and name not in getattr(other, "diluted_fields", own):
                raise checks.InputError(
                    f"Growth.species = {name!r}: growth does not dilute this species, so that cells"
                    " would grow by more or less than was paid for. Leave out Circuit.dilution, or"
                    f" name {name!r} in it."
                )

    def check(self, state: State, values: Values) -> None:
        for option, names in (("species", self._paid()), ("factor", self._slowed())):
            for name in names:
                check_variable(f"Growth.{option}", name, state, at_least_zero=True)

    def check_step(self, dt: float, divides: bool) -> None:
        if self.rate is None or not divides or self.law == "linear":
            return
        each = self.rate.values if isinstance(self.rate, ByType) else {None: self.rate}
        for kind, rate in each.items():
            where = "" if kind is None else f" of cell type {kind}"
            # of a distribution the least, since its tail is rarely drawn
            given = numbers(rate)
            check_doubling(f"Growth.rate{where}", given.min() if is_drawn(rate) else given, dt)

    def numerics(self, dt: float, state: State) -> list[str]:
        held = "; what contacts hold back is taken off afterwards"
        by = "exact over a step" if self.species is None else f"by all {self.species} that there is"
        return [by + (held if "displacement" in state.fields else "")]

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (_BoundGrowth(self, binding),)

    def step(self, state: State, dt: float, values: Values) -> State:
        if self.by_type:
            state = state.with_fields(growth_rate=values.rate.of_cells(state))
        if self.species is not None and dt > 0:  # a step of no time spends nothing
            paid = state.fields[self.species]
            state = state.with_fields(
                growth_rate=(torch.log1p(paid) / dt).to(state.growth_rate.dtype),
                **{self.species: torch.zeros_like(paid)},
            )
        rate = state.growth_rate
        relative = (rate if self.factor is None else rate * state.fields[self.factor]) * dt
        if self.law != "linear":
            relative = torch.expm1(relative)
        elongation = wanted_elongation(self.law, relative, state.length, state.radius)
        length = state.length + elongation
        report = self._too_far(state, relative, elongation, length) if state.cells else None
        if report is not None:
            elongation = torch.where(
                (report.status == 0).index_select(0, state.colony), elongation, 0.0
            )
            state, length = (
                state.replace(reports={**state.reports, "growth": report}),
                state.length + elongation,
            )
        return state.replace(length=length).with_fields(elongation=elongation)

    def _too_far(
        self, state: State, relative: Tensor, elongation: Tensor, length: Tensor
    ) -> GrowthReport | None:
        """The report of cells that would grow too far, to these lengths (N,); None without any, by
        one read. relative: (N,) as `wanted_elongation` has it."""
        longest, most = length.max(), math.inf  # NaN is the largest of all
        if doubling_matters(self.law, state):
            relative = of_size(self.law, relative, elongation, state.length, state.radius)
            most = MOST_GROWN
            longest = torch.where(relative.max() <= most, longest, math.inf)
        if longest.item() < math.inf:
            return None
        finite = torch.isfinite(length)
        good = finite & (relative <= most)
        return _too_long(state, good, torch.where(finite, relative, math.inf))


class _BoundGrowth(BoundEffect):
    """The drawn rate is the field growth_rate itself."""

    effect: Growth
    setters: tuple[str, ...] = ()  # effects that set growth_rate, whatever it was

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        """Raise InputError where a rate by cell type would undo what another effect sets."""
        self.setters = tuple(
            e.title
            for e in effects
            if e is not self and "growth_rate" in e.writes() and "growth_rate" not in e.reads()
        )
        growth = self.effect
        for other in effects:
            if other is self or "growth_rate" not in other.writes():
                continue
            if growth.by_type:
                raise checks.InputError(
                    f"{other.title} sets growth_rate, but Growth.rate = {growth.rate!r} sets it"
                    " again by cell type in every step. Set cell_type instead, or give Growth one"
                    " rate, or none."
                )
            if growth.species is not None:
                raise checks.InputError(
                    f"{other.title} sets growth_rate, and Growth.species = {growth.species!r} sets"
                    " it again in each step. Keep one of them."
                )
            if growth.factor is not None and not other.effect.writes_anything:
                raise checks.InputError(
                    f"{other.title} sets growth_rate by what cells have taken up, and Growth.factor"
                    f" = {growth.factor!r} would let them grow by less. Give it the factor:"
                    f" tf.{type(other.effect).__name__}(…, factor={growth.factor!r})."
                )

    def check(self, state: State) -> None:
        super().check(state)
        self.warn_of_others()
        if self.effect.law == "linear" or self.effect.rate is None or not state.cells:
            return
        usual = float(state.growth_rate.detach().median())
        if 0 < usual < 0.05:
            warn(
                f"Growth.rate is {usual:g} per hour: a doubling takes"
                f" {math.log(2.0) / usual:.0f} h. Rates are per hour; a rate per minute is to"
                f" be multiplied by 60 ({60 * usual:g})."
            )

    def check_given(self, state: State, free: Container[str]) -> None:
        if "growth_rate" not in free:
            check_field(state.fields, "growth_rate", lambda x: x < 0, "at least 0 (1/h)")

    def warn_of_others(self) -> None:
        """Warn where a growth rate has no effect since an effect sets another one."""
        rate = self.effect.rate
        given = [] if rate is None or not bool(numbers(rate).any()) else ["Growth.rate"]
        sources = [*given, *self.setters]
        if len(sources) > 1:
            first = "Growth.rate is that of first cells only, and " if given else ""
            warn(
                f"{' and '.join(sources)} each set growth_rate, whatever it was before: {first}the"
                " one that acts last overrides the others, also in steps in which it does not set"
                " it. Keep one of them"
                + (" (such as Growth() without a rate)" if given else "")
                + ", or let the later one read growth_rate and change it (an effect of your own"
                " names what it reads in reads())."
            )


def doubling_matters(law: str, state: State) -> bool:
    """Whether a cell that more than doubles in a step would be wrong: cells divide, and, where they
    grow by "linear", by a threshold. (A rule may let such cells divide in each step.)"""
    return ("division_threshold" if law == "linear" else "divide_flag") in state.fields


def wanted_elongation(law: str, relative: Any, length: Any, radius: Any) -> Any:
    """How much longer cells become, (N,) µm, as tensors or arrays. relative: (N,) growth of what
    the law lets grow evenly; by "linear" in µm."""
    if law == "volume":
        return relative * _like_volume(length, radius)
    return relative * length if law == "length" else relative


def of_size(law: str, relative: Any, elongation: Any, length: Any, radius: Any) -> Any:
    """How much cells grow, (N,), relative to what the law lets grow evenly; by "linear" to their
    volume. The rest as for `wanted_elongation`."""
    return elongation / _like_volume(length, radius) if law == "linear" else relative


def _like_volume(length: Any, radius: Any) -> Any:
    """What grows as V = π r² (l + 4r/3) does, (N,) µm."""
    return length + radius * (4.0 / 3.0)


def _first_rate(state: State, rows: Tensor, values: Values) -> Tensor:
    return values.rate.of_rows(state, rows)


def _too_long(state: State, good: Tensor, relative: Tensor) -> GrowthReport:
    """The report of the cells that cannot be as long as they would be, ~good (N,), which grow by
    `relative` (N,)."""
    row, bad = state.groups.first(~good)
    pick = lambda x: x.detach().index_select(0, row)
    return GrowthReport(bad.long(), pick(state.uid), pick(state.growth_rate), 1 + pick(relative))

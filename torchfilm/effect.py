"""What an effect is: a frozen description of one process, and what binding makes of it.

An effect describes: its physical values, the fields that it declares, and what it reads and writes.
Binding a scene to a batch (`torchfilm.model`) makes a `BoundEffect` of each, once, with its values
resolved. A step calls `BoundEffect.step(state, dt)`. Effects never import each other; they meet
only through named fields.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial, wraps
from typing import TYPE_CHECKING, Any, ClassVar

from torchfilm import own_step
from torchfilm.parameters import summary
from torchfilm.resolver import (
    BoundBatch,
    DrawnValue,
    FirstValue,
    Resolved,
    Values,
    drawn_field,
    resolve,
)
from torchfilm.state import CELL_TYPE, Field, State
from torchfilm.tools import checks, hashing
from torchfilm.tools.threads import given_torch_threads, one_torch_thread
from torchfilm.tools.timing import Timings
from torchfilm.values import CELL, ByType, Rule, checked, is_drawn

if TYPE_CHECKING:
    from torch import Tensor

    from torchfilm.physics.space import PeriodicSpace
    from torchfilm.tools.hot_reload import HotReload

# The stages of a step; an effect says where it belongs. The order is the paper's, but for cells
# that divide at a threshold: they do so in the step in which they get there, not in the next one.
RULES, FLAGGED_DIVISION, FIRST_REACTIONS, BEFORE_CELLS, NUTRITION, MOTILITY = 10, 20, 21, 22, 25, 28
GROWTH, MECHANICS, GRID_COVERAGE, CIRCUIT, TRANSPORT, LAST_REACTIONS = 30, 40, 45, 50, 60, 65
LYSIS, DIVISION, REMOVAL, SLOUGHING = 70, 80, 90, 92

GEOMETRY = ("position", "axis", "length", "radius")
# Names that every state has and an effect may read or write beside declared fields.
BUILT_IN = (*GEOMETRY, "cells", "colony")


@dataclass(frozen=True)
class Binding:
    """What an effect sees while it is bound: the batch, the scene's step (h), its dimension, the
    titles of its effects by the names of the fields that they declare, and the stage at which its
    cells divide."""

    batch: BoundBatch
    dt: float
    dim: int
    declared: Mapping[str, str]
    division_stage: int

    def reservoirs(self, signals: Iterable[str]) -> tuple[str, ...]:
        """The fields of the reservoirs of these signals that there are."""
        return tuple(n for s in signals if (n := f"{s}_reservoir") in self.declared)


class Effect(metaclass=checks.KnownKeywords):
    """Base of all effects: a frozen dataclass with a `stage` and a `title`. Override `step`, and
    the rest where it applies.

    A physical value is a field made by `torchfilm.physical(default, unit=…, least=…)`. It may be
    given as `torchfilm.values` describes, and reaches `step` resolved:
    `values.NAME.of_cells(state)`.
    """

    stage: ClassVar[int]
    title: ClassVar[str]
    may_repeat: ClassVar[bool] = True  # may a scene list it more than once?
    instead_of_two: ClassVar[str] = "Put all of it into one."
    writes_anything: ClassVar[bool] = False  # what it reads and writes is seen as it is tried
    by_kernels: ClassVar[bool] = False  # its steps on the CPU, with few operations of torch between
    works_on_grid: ClassVar[bool] = False  # its cost depends on the voxels, not on the cells
    usual_first: ClassVar[float] = 1.0  # what hints suggest for a variable that it needs
    crowding: float = 0.0  # its cost for each cell grows as this power of a colony's cells

    def __init_subclass__(cls, **given: Any) -> None:
        """Have physical values checked before a `__post_init__` of the class's own, also where that
        does not call this one."""
        super().__init_subclass__(**given)
        own = cls.__dict__.get("__post_init__")
        if own is None:
            return

        @wraps(own)
        def checked_first(self: Effect, *given: Any) -> None:
            Effect.__post_init__(self)
            own(self, *given)

        cls.__post_init__ = checked_first  # type: ignore[method-assign]

    def __post_init__(self) -> None:
        for name, (given, rule) in self.physical_fields().items():
            if given is not None:
                made = checked(f"{type(self).__name__}.{name}", given, rule)
                object.__setattr__(self, name, made)

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and hashing.digest(self) == hashing.digest(other)

    def __hash__(self) -> int:
        return hash(hashing.digest(self))

    # --- what it describes ---------------------------------------------------------------

    def physical_fields(self) -> dict[str, tuple[Any, Rule]]:
        """Its own fields that hold physical values, with their rules."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        rules = {f.name: f.metadata["physical"] for f in fields if "physical" in f.metadata}
        return {name: (getattr(self, name), rule) for name, rule in rules.items()}

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        """All its physical values by name, with their rules."""
        return self.physical_fields()

    def value_owner(self) -> str:
        """Whose its physical values are, in errors and in the keys of their random numbers. Effects
        of one class that have titles of their own are distinguished."""
        kind = type(self)
        own = getattr(kind, "title", None) == self.title
        return kind.__name__ if own else f"{kind.__name__} {self.title!r}"

    def equations(self) -> dict[str, str]:
        """Its equations as text, by title; a notebook shows them below the scene."""
        return {}

    def kept_values(self) -> dict[str, Field]:
        """The field of each physical value that is drawn for a cell at its birth, by the value's
        name."""
        return {
            name: drawn_field(self.title, name, value)
            for name, (value, rule) in self.physical_values().items()
            if value is not None and is_drawn(value) and not rule.drawn_by_effect
        }

    def declares(self, dim: int) -> Sequence[Field]:
        """The fields that this effect adds to the state of a scene in `dim` dimensions. A field's
        `initial` may be a function (state, rows, values)."""
        return ()

    def reads(self) -> Sequence[str]:
        """What `step` reads: "position", "axis", "length", "radius", "cells" (how many, which),
        "colony" (the ids of colonies) or fields. Each must exist; what is used only where a scene
        has it, `BoundEffect.reads` adds."""
        return ()

    def needs(self) -> Sequence[str]:
        """Names that the scene must provide. They count as read: `reads` need not repeat them."""
        return ()

    def writes(self) -> Sequence[str]:
        """Names of what `step` changes."""
        return ()

    def keeps(self) -> Mapping[str, str]:
        """The declared fields in which cells keep a physical value of this effect, by the value's
        name; beside `kept_values`."""
        return {}

    def at_least_zero(self) -> Sequence[str]:
        """Fields and variables that it reads, and that must not be below 0."""
        return ()

    def waits_for(self) -> Mapping[str, str]:
        """Fields that must not be 0 everywhere in a colony if it is to have more cells; with what
        to give this effect then."""
        return {}

    def only_takes(self) -> tuple[str, ...]:
        """Of the fields that it writes, those that it can only make less."""
        return ()

    def idle_without(self, state: State) -> Mapping[str, str]:
        """Fields without whose change by another effect this one, or a part of it, does nothing
        from this first state on; with a warning of it."""
        return {}

    def clash_hint(self, name: str) -> str:
        """What to do where another effect declares a field of this name, too."""
        return ""

    def check_scene(self, effects: Sequence[Effect], founders: Any) -> None:
        """Raise InputError where this effect does not fit the other effects of a scene, or warn."""

    def check(self, state: State, values: Values) -> None:
        """Raise InputError if this effect cannot start from this first state."""

    def check_step(self, dt: float, divides: bool) -> None:
        """Raise InputError for a step of dt h that it cannot follow. divides: cells may."""

    def step(self, state: State, dt: float, values: Values) -> State:
        """The state after this effect has acted for dt hours."""
        raise NotImplementedError

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        """What acts in a step, in one part or several, made ready for a batch."""
        return (BoundEffect(self, binding),)

    # --- what explaining, tuning, recording and the command line need of it ---------------

    def numerics(self, dt: float, state: State) -> list[str]:
        """By which methods it is computed, in lines: for `explain`. state: a first state."""
        return []

    def with_settings(self, settings: Any) -> Effect:
        """The same effect computed by other accuracy settings (`torchfilm.Settings`)."""
        return self

    def accuracy_knobs(self) -> Mapping[str, float]:
        """The accuracy settings that it takes, with their usual values."""
        return {}

    def accuracy_parameters(self) -> Mapping[str, str]:
        """Its own parameters that accuracy settings change, with their values as text, defaults
        filled in."""
        return {}

    def without_noise(self) -> Effect:
        """The same effect without random events, for the measurement of numerical errors."""
        return self

    @property
    def divides_at_threshold(self) -> bool:
        """Whether it divides cells at a threshold, not only those that a rule has flagged."""
        return False

    @property
    def soft_contacts(self) -> bool:
        """Whether its cells are physically soft, so that an overlap is no error."""
        return False

    @property
    def holds_back(self) -> bool:
        """Whether it may keep colonies from growing at the rate of their cells."""
        return self.writes_anything

    def wall_surfaces(self) -> Sequence[Any]:
        """Surfaces that confine cells."""
        return ()

    @property
    def periodic_space(self) -> PeriodicSpace | None:
        """Where cells are, if periodic."""
        return None


@dataclass(frozen=True)
class ExchangePlan:
    """How an effect exchanges signals with the medium, as the medium decides at binding.

    transport: by which the effect moves these signals itself; None: the medium moves them. turns:
    of both in a step. shared, several: signals that nutrition, and that several circuits exchange.
    """

    transport: Any = None
    turns: int = 1
    shared: frozenset[str] = frozenset()
    several: frozenset[str] = frozenset()


class BoundEffect:
    """An effect made ready for one batch. `values`: its physical values, resolved.

    Most effects need nothing else: `step` calls the description's own. Others override what they
    need. Each of these calls is made for all effects before the next one:

    - `scene.bind()`: `lay`, then fields are declared, `trace` (by default `ready`), `check_others`,
      `check`. To bind to a state: `opened`, `trace`, `check_others`.
    - `model.start()`: `lay`, then fields are declared, `ready`.
    - `model.step(state)`: `opened`, `run_step`.

    What a step has to report it leaves in `state.reports`, by title: see `Report`. moves_signals:
    whether it always moves the signals that it exchanges.
    """

    moves_signals: ClassVar[bool] = False

    def __init__(self, effect: Effect, binding: Binding):
        self.effect, self.binding = effect, binding
        self.title, self.stage = effect.title, effect.stage
        self.by_type: tuple[str, ...] = ()  # what cells keep by their type, see `kept_by_type`
        self.plan, self.place = ExchangePlan(), 0  # the place of the effect in its scene
        self.values = Values(self._resolve(effect, binding.batch))

    @staticmethod
    def _resolve(effect: Effect, batch: BoundBatch) -> dict[str, Resolved | None]:
        owner, kept = effect.value_owner(), effect.kept_values()
        found = {}
        for name, (value, rule) in effect.physical_values().items():
            field = kept[name].name if name in kept else None
            keep = {"field": field, "kept": field or effect.keeps().get(name)}
            found[name] = resolve(f"{owner}.{name}", value, batch, **keep, typed=rule.scope == CELL)
        return found

    def declares(self) -> list[Field]:
        """Its fields with their first values bound, and one for each value drawn at birth."""
        own = map(self._bound, self.effect.declares(self.binding.dim))
        return [*own, *self._value_fields()]

    def _value_fields(self) -> list[Field]:
        kept = self.effect.kept_values()
        out = []
        for name, (value, _) in self.effect.physical_values().items():
            if isinstance(value, ByType) and CELL_TYPE not in out:
                out.append(CELL_TYPE)
            if name in kept:
                first = DrawnValue(self.values[name])
                out.append(dataclasses.replace(kept[name], initial=first))
        return out

    def _bound(self, field: Field) -> Field:
        if not callable(field.initial):
            return field
        return dataclasses.replace(field, initial=FirstValue(field.initial, self.values))

    def reads(self) -> tuple[str, ...]:
        """Names of what a step reads; the fields of its own drawn values are among them."""
        each = [v for v in vars(self.values).values() if v is not None]
        drawn = [v.field for v in each if v.field is not None]
        types = ("cell_type",) if any(v.types is not None for v in each) else ()
        return tuple(dict.fromkeys((*self.effect.reads(), *self.effect.needs(), *drawn, *types)))

    def writes(self) -> tuple[str, ...]:
        """Names of what a step changes."""
        return tuple(self.effect.writes())

    def lay(self, state: State) -> State:
        """The first cells made ready for this effect's fields, before any field is declared."""
        return state

    def trace(self, state: State) -> State:
        """Find out, once, what can only be found by trying; the state as `ready` makes it."""
        return self.ready(state)

    def ready(self, state: State) -> State:
        """A first state made ready for this effect, after all fields are declared."""
        return state

    def opened(self, state: State) -> State:
        """A state as a step begins, also where another model made it."""
        return state

    def check(self, state: State) -> None:
        """Raise InputError if this effect cannot start from this first state."""
        self.effect.check(state, self.values)

    def check_arrivals(self, state: State, rows: Tensor) -> None:
        """Raise InputError if it cannot go on with the cells `rows` (M,) that come to others."""
        self.check(state.take(rows))

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        """Raise InputError if this effect cannot act together with the others (all traced)."""

    def check_given(self, state: State, free: Container[str]) -> None:
        """Raise InputError if no run goes on with a state. free: set by a user's effects."""

    def warn_of_others(self) -> None:
        """Warn where this effect and the others, checked before, are probably not meant so."""

    def typed_values(self) -> dict[str, tuple[int, ...]]:
        """Its values that each cell takes by its type, by name, and the types that they have."""
        each = [v for v in vars(self.values).values() if v is not None]
        return {v.name: v.known_types for v in each if v.known_types}

    def check_step(self, dt: float, divides: bool) -> None:
        """Raise InputError for a step of dt h that it cannot follow. divides: cells may."""
        self.effect.check_step(dt, divides)

    def step(self, state: State, dt: float) -> State:
        """The state after this effect has acted for dt hours."""
        if not is_own(self.effect):
            return self.effect.step(state, dt, self.values)
        step, name = partial(self.effect.step, state, dt, self.values), type(self.effect).__name__
        return own_step.taken(name, step, state, self.writes(), self.by_type)

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """As `step`, with torch's `threads`, and timed."""
        with self.timed(state, timings), self.threads(state):
            return self.step(state, dt)

    def timed(self, state: State, timings: Timings | None) -> AbstractContextManager[object]:
        """The time of this effect, under its title."""
        return nullcontext() if timings is None else timings.of(self.title, state.device)

    def threads(self, state: State) -> AbstractContextManager[object]:
        """One torch thread where kernels compute, and else those that torch was given."""
        alone = self.by_kernels and state.device.type == "cpu"
        return one_torch_thread() if alone else given_torch_threads()

    def exchanges(self) -> tuple[str, ...]:
        """The signals that it makes cells exchange with the medium, as its `plan` says."""
        return ()

    @property
    def why_turns(self) -> str:
        """Why exchange and transport must take turns, in a sentence; empty where they need not."""
        return ""

    @property
    def by_kernels(self) -> bool:
        return self.effect.by_kernels

    def numerics(self, dt: float, state: State) -> list[str]:
        """By which methods it is computed, in lines."""
        return self.effect.numerics(dt, state)

    @property
    def works_on_grid(self) -> bool:
        return self.effect.works_on_grid

    @property
    def hot_reload(self) -> HotReload | None:
        """The user's functions that may be edited during a run."""
        return None

    def summary(self) -> str:
        """The effect with the parameters that differ from their defaults, in a line."""
        return summary(self.effect)


def is_own(effect: Effect) -> bool:
    """Whether the user has written the effect, which may do anything."""
    return not type(effect).__module__.startswith("torchfilm.")


def makes_longer(effect: Effect) -> bool:
    """Whether cells may become longer by this effect, or be flagged to divide at any length."""
    grows = any(f.name == "elongation" for f in effect.declares(3))
    return grows or effect.writes_anything or is_own(effect)

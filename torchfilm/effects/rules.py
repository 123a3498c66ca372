"""Rules, the paper's way: `update(cells)` and `divide(parent, daughter1, daughter2)` with Table 1's
names, on whole tensors.

    def update(cells):
        cells.growth_rate = 2.1
        cells.divide_flag = cells.volume > 3

Rules are the user's own Python. `update` is tried once on the first state, before anything runs:
names that it sets and that nothing declares become variables, and what it reads and writes is
noted, so that the scene knows who drives whom.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import DIVISION, RULES, Effect
from torchfilm.rule_views import KNOWN_FIELDS, MEANS, CellsView, DivisionView, RuleError
from torchfilm.state import Births, Field, State
from torchfilm.tools import checks
from torchfilm.tools.hot_reload import HotReload, load_functions

TRIAL_STEP = 0.025  # h, the step that a rule sees when it is tried


@dataclass(frozen=True)
class Rules(Effect):
    """The user's rules: `update(cells)` at the start of each step, `divide(parent, daughter1,
    daughter2)` after divisions.

    update: a function, or the path of a Python file that defines `update` and, if wanted, `divide`.
    variables: first values of variables of the user's own, one number each.
    """

    update: Callable[[CellsView], None] | str | Path | None = None
    divide: Callable[[DivisionView, DivisionView, DivisionView], None] | None = None
    variables: Mapping[str, float] = field(default_factory=dict)
    source: HotReload = field(init=False, repr=False, compare=False)
    noted: dict[str, tuple[str, ...]] = field(init=False, repr=False, compare=False)

    stage = RULES
    title = "rules"
    writes_anything = True

    def __post_init__(self) -> None:
        path = None
        functions: dict[str, Any] = {"update": self.update, "divide": self.divide}
        if isinstance(self.update, (str, Path)):
            # as given, or beside the scene file or wherever else Python looks for modules
            places = [Path(self.update), *(Path(p) / self.update for p in sys.path)]
            path = next((p for p in places if p.is_file()), places[0])
            if not path.is_file():
                raise checks.input_error(
                    "Rules.update",
                    str(path),
                    "a function or the path of a Python file",
                    "No such file.",
                )
            functions = load_functions(path, ("update", "divide"))
        for name, given in functions.items():
            if given is not None and not callable(given):
                raise checks.input_error(f"Rules.{name}", given, "a function")
        if not any(functions.values()):
            raise checks.InputError(
                "Rules() has neither update nor divide: give at least one, such as"
                " tf.Rules(update)."
            )
        for name, value in self.variables.items():
            checks.number(f"Rules.variables[{name!r}]", value)
        object.__setattr__(self, "source", HotReload(path, functions))
        object.__setattr__(
            self, "noted", {"reads": (), "writes": (), "divide reads": (), "divide writes": ()}
        )

    @property
    def hot_reload(self) -> HotReload:
        """The functions, and the file that they come from."""
        return self.source

    def parts(self) -> tuple[Effect, ...]:
        return (
            (self, DivisionRule(self))
            if self.source.functions["divide"] or self.source.path
            else (self,)
        )

    def declares(self, dim: int) -> tuple[Field, ...]:
        return tuple(
            Field(name, "variable of the user's rules", initial=value)
            for name, value in self.variables.items()
        )

    def reads(self) -> tuple[str, ...]:
        return self.noted["reads"]

    def writes(self) -> tuple[str, ...]:
        return self.noted["writes"]

    def prepare(self, state: State) -> State:
        """Try `update` once on the first state: new names become fields, and what is read and
        written is noted."""
        update = self.source.functions["update"]
        if update is not None:
            # one cell would let pass what fails with two, such as `if cells.length > 3`; where none
            # divides, there may never be two
            twice = state.cells == 1 and "divide_flag" in state.fields
            tried = (
                state.take(torch.zeros(2, dtype=torch.int64, device=state.device))
                if twice
                else state
            )
            view = CellsView(tried, TRIAL_STEP, _label(update), declaring=True)
            _act(update, view)
            for name, value in view._work.items():
                if name not in state.fields and name != "remove_flag":
                    new = KNOWN_FIELDS.get(name) or Field(
                        name,
                        "variable of the user's rules",
                        dtype=value.dtype,
                        shape=tuple(value.shape[1:]),
                    )
                    state, tried = state.declare(new), tried.declare(new)
            changed = [
                n
                for n, v in view._work.items()
                if n != "remove_flag" and not torch.equal(v, tried.fields[n])
            ]
            writes = view._written | set(changed)
            self.noted["reads"] = tuple(sorted(view._read))
            self.noted["writes"] = tuple(
                "cells" if n == "remove_flag" else n for n in sorted(writes)
            )
        divide = self.source.functions["divide"]
        if divide is not None and state.cells:
            self._try_division(divide, state)
        return state

    def _try_division(self, divide: Callable[..., None], state: State) -> None:
        """Try `divide` on a first cell and two copies of it, and note what it reads and writes."""
        one = torch.zeros(1, dtype=torch.int64, device=state.device)
        twice = state.take(torch.cat([one, one]))
        births = Births(one, one + 1, torch.cat([one, one]), state.take(one))
        views = _after_divide(divide, twice, births)
        self.noted["divide reads"] = tuple(
            sorted({MEANS.get(n, (n,))[0] for view in views for n in view._work})
        )
        self.noted["divide writes"] = tuple(sorted(views[1]._set | views[2]._set))

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        self.source.refresh(state.time)
        return self.source.call("update", lambda update: _apply(update, state, dt), state)


def _label(rule: Callable[..., None]) -> str:
    """What keeps the random draws of one rule apart from another's."""
    return (
        f"rule {getattr(rule, '__module__', '')}"
        f" {getattr(rule, '__qualname__', type(rule).__name__)}"
    )


def _act(rule: Callable[..., None], *views: CellsView | DivisionView) -> None:
    """Let a rule act on what it sees."""
    try:
        rule(*views)
    except (RuntimeError, ValueError) as error:
        if not any(
            words in str(error)
            for words in (
                "Boolean value of Tensor",
                "converted to Scalar",
                "only one element tensors",
            )
        ):
            raise
        # the first line is this one; the rule's may be called by torch's
        at = next(
            f
            for f in reversed(traceback.extract_tb(error.__traceback__))
            if "torch" not in Path(f.filename).parts
        )
        raise RuleError(
            f"{Path(at.filename).name}, line {at.lineno} ({at.line}): a rule sees all cells at"
            " once, so there is no one truth or number for `if` or `float`. Write"
            " torch.where(condition, a, b) with &, | and ~, or go through them one by one (slow):"
            " for cell in cells."
        ) from error
    for view in views:
        view.check_unharmed()


def _apply(update: Callable[[CellsView], None], state: State, dt: float) -> State:
    view = CellsView(state, dt, _label(update))
    _act(update, view)
    work = dict(view._work)
    if "drag" in work and not bool((work["drag"] > 0).all()):
        raise RuleError(f"cells.drag was set to {float(work['drag'].min()):g}: it must be above 0.")
    if "growth_rate" in work and bool((work["growth_rate"] < 0).any()):
        raise RuleError(
            f"cells.growth_rate was set to {float(work['growth_rate'].min()):g}: it must be at"
            " least 0. To let cells vanish, set remove_flag."
        )
    gone = work.pop("remove_flag", None)
    for name in work:
        if name not in state.fields:
            if name not in KNOWN_FIELDS:
                raise checks.SimulationError(
                    f"rules set the variable {name!r} for the first time in mid-run: give Rules(…,"
                    f" variables={{{name!r}: 0.0}})."
                )
            state = state.declare(KNOWN_FIELDS[name])
    state = state.with_fields(**work)
    return state if gone is None else state.remove(gone, "removed")


@dataclass(frozen=True)
class DivisionRule(Effect):
    """The part of Rules that acts after division: the user's `divide(parent, daughter1,
    daughter2)`."""

    rules: Rules

    stage = DIVISION + 1
    title = "rules at division"

    def reads(self) -> tuple[str, ...]:
        return ("cells", *self.rules.noted["divide reads"])

    def writes(self) -> tuple[str, ...]:
        return self.rules.noted["divide writes"]

    def step(self, state: State, dt: float) -> State:
        source = self.rules.source
        for births in state.births:
            state = source.call("divide", partial(_divide, state=state, births=births), state)
        return state


def _after_divide(
    act: Callable[..., None], state: State, births: Births
) -> tuple[DivisionView, DivisionView, DivisionView]:
    """Parent, first and second daughter as the rule leaves them."""
    views = (
        DivisionView(births.parents, None, "parent", "divide parent"),
        DivisionView(state, births.first, "daughter1", "divide first"),
        DivisionView(state, births.second, "daughter2", "divide second"),
    )
    _act(act, *views)
    return views


def _divide(act: Callable[..., None], state: State, births: Births) -> State:
    _, first, second = _after_divide(act, state, births)
    changed: dict[str, Tensor] = {}
    for daughter, rows in ((first, births.first), (second, births.second)):
        for name, value in daughter._work.items():
            if daughter._writable(name):
                changed[name] = changed.get(name, state.fields[name]).index_copy(0, rows, value)
    return state.with_fields(**changed)

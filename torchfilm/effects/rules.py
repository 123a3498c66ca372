"""Rules as in the paper: `update(cells)` and `divide(parent, daughter1, daughter2)` with the names
of Table 1, on whole tensors.

    def update(cells):
        cells.growth_rate = 2.1
        cells.divide_flag = cells.volume > 3

Rules are the user's own Python. Before the run, binding calls `update` once on the first state. New
names that it sets become variables. The model notes what it reads and writes, to know which effect
drives which.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import DIVISION, RULES, Binding, BoundEffect, Effect
from torchfilm.rule_views import KNOWN_FIELDS, MEANS, CellsView, DivisionView, RuleError
from torchfilm.state import Births, Field, State
from torchfilm.tools import checks
from torchfilm.tools.hot_reload import HotReload, load_functions

TRIAL_STEP = 0.025  # h, the step that a rule sees in its trial


@dataclass(frozen=True, eq=False)
class Rules(Effect):
    """The user's rules: `update(cells)` at the start of each step, `divide(parent, daughter1,
    daughter2)` after divisions.

    update: a function, or the path of a Python file that defines `update` and optionally `divide`.
    variables: initial values of the user's own variables, one number each.
    """

    update: Callable[[CellsView], None] | str | Path | None = None
    divide: Callable[[DivisionView, DivisionView, DivisionView], None] | None = None
    variables: Mapping[str, float] = field(default_factory=dict)
    path: Path | None = field(init=False, repr=False)
    functions: dict[str, Any] = field(init=False, repr=False)
    stamp: int = field(init=False, repr=False)  # of the file as it was loaded, ns

    stage = RULES
    title = "rules"
    writes_anything = True

    def __post_init__(self) -> None:
        path, stamp = None, 0
        functions: dict[str, Any] = {"update": self.update, "divide": self.divide}
        if isinstance(self.update, (str, Path)):
            # the path as given, else in a folder of sys.path, such as that of the scene file
            places = [Path(self.update), *(Path(p) / self.update for p in sys.path)]
            path = next((p for p in places if p.is_file()), places[0])
            if not path.is_file():
                raise checks.input_error(
                    "Rules.update",
                    str(path),
                    "a function or the path of a Python file",
                    "No such file.",
                )
            stamp = path.stat().st_mtime_ns
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
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "functions", functions)
        object.__setattr__(self, "stamp", stamp)

    def __reduce__(self) -> tuple[Any, ...]:
        # unpickling reads a rules file again
        return (Rules, (self.update, self.divide, dict(self.variables)))

    def declares(self, dim: int) -> tuple[Field, ...]:
        return tuple(
            Field(name, "variable of the user's rules", initial=value)
            for name, value in self.variables.items()
        )

    def numerics(self, dt: float, state: State) -> list[str]:
        return ["your own Python, once a step on whole tensors"]

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        source = HotReload(self.path, dict(self.functions), self.stamp)
        main = BoundRules(self, binding, source)
        divides = self.functions["divide"] is not None or self.path is not None
        return (main, DivisionRule(self, binding, source)) if divides else (main,)


class BoundRules(BoundEffect):
    """Rules after their trial: what they read and write, and the variables that they add."""

    effect: Rules

    def __init__(self, effect: Rules, binding: Binding, source: HotReload):
        super().__init__(effect, binding)
        self.source = source
        self.traced_reads: tuple[str, ...] = ()
        self.traced_writes: tuple[str, ...] = ()
        self.variables: tuple[Field, ...] = ()

    @property
    def hot_reload(self) -> HotReload:
        """The functions, which the user may edit during a run."""
        return self.source

    def reads(self) -> tuple[str, ...]:
        return self.traced_reads

    def writes(self) -> tuple[str, ...]:
        return self.traced_writes

    def ready(self, state: State) -> State:
        for new in self.variables:
            if new.name not in state.fields:
                state = state.declare(new)
        return state

    def trace(self, state: State) -> State:
        """Calls `update` once. New names become fields; reads and writes are noted."""
        update = self.source.functions["update"]
        if update is None:
            return state
        # two cells, since rules such as `if cells.length > 3` fail only with more than one; a cell
        # that cannot divide stays alone
        twice = state.cells == 1 and "divide_flag" in state.fields
        both = torch.zeros(2, dtype=torch.int64, device=state.device)
        tried = state.take(both) if twice else state
        view = CellsView(tried, TRIAL_STEP, _label(update), declaring=True)
        _act(update, view)
        new = [n for n in view._work if n not in state.fields and n != "remove_flag"]
        self.variables = tuple(_variable(name, view._work[name]) for name in new)
        for variable in self.variables:
            tried = tried.declare(variable)
        changed = [
            n
            for n, v in view._work.items()
            if n != "remove_flag" and not torch.equal(v, tried.fields[n])
        ]
        self.traced_reads = tuple(sorted(view._read))
        written = sorted(view._written | set(changed))
        self.traced_writes = tuple("cells" if n == "remove_flag" else n for n in written)
        return self.ready(state)

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        self.source.refresh(state.time)
        return self.source.call("update", lambda update: _apply(update, state, dt), state)


def _variable(name: str, value: Tensor) -> Field:
    """The field of a variable that a rule has set."""
    known = KNOWN_FIELDS.get(name)
    meaning, shape = "variable of the user's rules", tuple(value.shape[1:])
    return known or Field(name, meaning, dtype=value.dtype, shape=shape)


class DivisionRule(BoundEffect):
    """The part of Rules after division: the user's `divide(parent, daughter1, daughter2)`."""

    effect: Rules

    def __init__(self, effect: Rules, binding: Binding, source: HotReload):
        super().__init__(effect, binding)
        self.stage, self.title, self.source = DIVISION + 1, "rules at division", source
        self.traced_reads: tuple[str, ...] = ()
        self.traced_writes: tuple[str, ...] = ()

    def declares(self) -> list[Field]:
        return []

    def reads(self) -> tuple[str, ...]:
        return ("cells", *self.traced_reads)

    def writes(self) -> tuple[str, ...]:
        return self.traced_writes

    def trace(self, state: State) -> State:
        """Calls `divide` on a first cell and two copies of it, and notes its reads and writes."""
        divide = self.source.functions["divide"]
        if divide is None or not state.cells:
            return state
        one = torch.zeros(1, dtype=torch.int64, device=state.device)
        twice = state.take(torch.cat([one, one]))
        births = Births(one, one + 1, torch.cat([one, one]), state.take(one))
        views = _after_divide(divide, twice, births)
        read = {m for view in views for n in view._work for m in MEANS.get(n, (n,))}
        self.traced_reads = tuple(sorted(read))
        self.traced_writes = tuple(sorted(views[1]._set | views[2]._set))
        return state

    def step(self, state: State, dt: float) -> State:
        for births in state.births:
            act = partial(_divide, state=state, births=births)
            state = self.source.call("divide", act, state)
        return state

    def numerics(self, dt: float, state: State) -> list[str]:
        return ["your own Python, once for all divisions of a step"]


def _label(rule: Callable[..., None]) -> str:
    """A label that gives each rule its own random numbers."""
    return (
        f"rule {getattr(rule, '__module__', '')}"
        f" {getattr(rule, '__qualname__', type(rule).__name__)}"
    )


def _act(rule: Callable[..., None], *views: CellsView | DivisionView) -> None:
    """Calls a rule on its views. Raises RuleError if it uses a tensor as one number."""
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
        # the innermost frame outside torch is a line of the rule
        at = next(
            f
            for f in reversed(traceback.extract_tb(error.__traceback__))
            if "torch" not in Path(f.filename).parts
        )
        raise RuleError(
            f"{Path(at.filename).name}, line {at.lineno} ({at.line}): a rule sees all cells at"
            " once, so `if` or `float` has no single value to use. Write"
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
                    f"rules set the variable {name!r} for the first time during a run: give"
                    f" Rules(…, variables={{{name!r}: 0.0}})."
                )
            state = state.declare(KNOWN_FIELDS[name])
    state = state.with_fields(**work)
    return state if gone is None else state.remove(gone, "removed")


def _after_divide(
    act: Callable[..., None], state: State, births: Births
) -> tuple[DivisionView, DivisionView, DivisionView]:
    """The views of parent, first and second daughter, after the rule."""
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

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchfilm.effect import RULES, Binding, BoundEffect, Effect
from torchfilm.effects.bound_division_rule import DivisionRule
from torchfilm.effects.bound_rules import MEANING, BoundRules
from torchfilm.resolver import Values
from torchfilm.rule_values import near_name
from torchfilm.rule_views import OF_EFFECTS, CellsView, DivisionView
from torchfilm.signals.schedule import warn_of_means
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.code_names import names_in
from torchfilm.tools.hot_reload import HotReload, edited, load_functions
from torchfilm.tools.warn_once import warn
from torchfilm.values import CONSTANT, Rule, ScheduledValue, checked_constants


@dataclass(frozen=True, eq=False)
class Rules(Effect):
    """The user's rules: `update(cells)` at the start of each step, `divide(parent, daughter1,
    daughter2)` after divisions.

    update: a function, or the path of a Python file that defines `update` and optionally `divide`.
    variables: initial values of the user's own variables, one number each; without functions, those
    that only `state.with_fields` sets, from outside of the run. parameters: constants
    that rules read as `cells.p.k` (`parent.p.k`, …), one value for each cell: a number, one per
    colony, one per cell type, a distribution drawn at birth, or a Schedule.
    """

    update: Callable[[CellsView], None] | str | Path | None = None
    divide: Callable[[DivisionView, DivisionView, DivisionView], None] | None = None
    variables: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, ScheduledValue] = field(default_factory=dict)
    path: Path | None = field(init=False, repr=False)
    functions: dict[str, Any] = field(init=False, repr=False)
    stamp: tuple[int, int] = field(init=False, repr=False)  # of the file as it was loaded

    stage = RULES
    title = "rules"

    def __post_init__(self) -> None:
        path, stamp = None, (0, 0)
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
            stamp = edited(path)
            functions = load_functions(path, ("update", "divide"))
        for name, given in functions.items():
            if given is not None and not callable(given):
                raise checks.input_error(f"Rules.{name}", given, "a function")
        if not any(functions.values()) and not self.variables:
            raise checks.InputError(
                "Rules() has neither update nor divide: give at least one, such as"
                " tf.Rules(update); or variables, which state.with_fields sets."
            )
        for name, value in self.variables.items():
            if name == "remove_flag":
                allowed = "left out: update(cells) sets it without a first value"
                raise checks.input_error("Rules.variables: remove_flag", value, allowed)
            if name in OF_EFFECTS:
                raise checks.input_error(
                    f"Rules.variables: {name}",
                    value,
                    f"left to {OF_EFFECTS[name]}, which has it: list that beside Rules",
                )
            shown = f"{{{name!r}: {value!r}}}"
            hint = f"Founders have one by type: tf.inoculum(…, types=…, extra={shown})."
            by_type = isinstance(value, Mapping)
            checks.number(f"Rules.variables[{name!r}]", value, hint=hint if by_type else "")
        constants = checked_constants("Rules", self.parameters, CONSTANT)
        object.__setattr__(self, "parameters", constants)
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "functions", functions)
        object.__setattr__(self, "stamp", stamp)

    @property
    def writes_anything(self) -> bool:  # type: ignore[override]
        return any(self.functions.values())

    def __reduce__(self) -> tuple[Any, ...]:
        # unpickling reads a rules file again
        return (Rules, (self.update, self.divide, dict(self.variables), dict(self.parameters)))

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        return {name: (value, CONSTANT) for name, value in self.parameters.items()}

    def check(self, state: State, values: Values) -> None:
        if self.parameters and "p" in state.fields:
            raise checks.InputError(
                "Rules.parameters are what rules read as cells.p, but the cells have a field 'p':"
                " rename the field."
            )
        self._warn_of_unread()

    def _warn_of_unread(self) -> None:
        """Warn of constants that the code of no rule names."""
        named = names_in("p", *(f for f in self.functions.values() if f is not None))
        if named is None:
            return
        if unread := [name for name in self.parameters if name not in named]:
            near = [near_name(name, sorted(named)) for name in unread]
            warn(
                f"Rules: {', '.join(map(repr, unread))} of parameters is read by no rule: a rule"
                f" reads it as cells.p.{unread[0]}.{''.join(near)}"
            )

    def check_step(self, dt: float, divides: bool) -> None:
        warn_of_means("Rules", self.parameters, dt)

    def declares(self, dim: int) -> tuple[Field, ...]:
        return tuple(Field(name, MEANING, initial=value) for name, value in self.variables.items())

    def numerics(self, dt: float, state: State) -> list[str]:
        own = any(self.functions.values())
        return ["your own Python, once a step on whole tensors"] if own else []

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        source = HotReload(self.path, dict(self.functions), self.stamp)
        main = BoundRules(self, binding, source)
        divides = self.functions["divide"] is not None or self.path is not None
        return (main, DivisionRule(self, binding, source)) if divides else (main,)

"""Physical values: one way to give a parameter of any effect, and one way to look it up.

| given                        | meaning                                                           |
|------------------------------|-------------------------------------------------------------------|
| `1.0`                        | the same for all cells of all colonies                            |
| a list, array or 1-D tensor  | one value per colony, by the colony's id                          |
| `{0: 0.6, 1: 1.2}`           | one value per cell type                                           |
| `tf.LogNormal(1.0, 0.2)`     | drawn for each cell at birth, by random numbers keyed by the cell |
| `tf.PerColony([…])`          | one value per colony, where a list could also mean cell types     |

A description holds what was given, checked. Binding a scene to a batch resolves it once
(`torchfilm.resolver`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.schedule import Schedule, checked_values
from torchfilm.tools import checks
from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.resolver import Values
    from torchfilm.state import State

CELL, COLONY = "cell", "colony"
# The forms that a value of a cell may take, and the value of one cell type, for messages.
FORMS = (
    "Give one number, a list with one number per colony, a dict by cell type such as {0: 0.6, 1:"
    " 1.2}, or a distribution such as tf.Uniform(0.5, 1.5)."
)
FORMS_OF_TYPE = (
    "Give one number, a list with one number per colony, or a distribution such as"
    " tf.Uniform(0.5, 1.5)."
)


@dataclass(frozen=True, eq=False)
class PerColony(metaclass=checks.KnownKeywords):
    """One value per colony, stated: `tf.PerColony([0.6, 1.2])`."""

    values: Tensor | Sequence[float]

    @property
    def one_per_colony(self) -> Tensor | Sequence[float]:
        """What `checks.value` takes, for what is one per colony in any case."""
        return self.values


@dataclass(frozen=True, eq=False)
class ByType:
    """One value per cell type: a number, one per colony, or a distribution."""

    values: Mapping[int, Any]

    @property
    def is_drawn(self) -> bool:
        """Whether some type's value is drawn for each cell."""
        return any(isinstance(v, Distribution) for v in self.values.values())

    def __repr__(self) -> str:
        return repr(dict(self.values))


@dataclass(frozen=True)
class Rule:
    """What a physical value may be: its unit, its bounds, and whether it belongs to a cell or to a
    colony."""

    unit: str = ""
    above: float = -math.inf
    least: float = -math.inf
    most: float = math.inf
    scope: str = CELL
    # whether the effect itself draws from a distribution, and when; else each cell's value is a
    # field drawn at birth
    drawn_by_effect: bool = False
    # whether it may be a Schedule
    scheduled: bool = False


# of the constants that a user's own functions read, in circuits and rules
CONSTANT = Rule(scheduled=True)


def physical(default: Any = dataclasses.MISSING, **rule: Any) -> Any:
    """A field of an effect that holds a physical value: `rate: Value = physical(1.0, unit="1/h",
    least=0.0)`."""
    return field(default=default, metadata={"physical": Rule(**rule)})


def checked_constants(owner: str, given: object, rule: Rule) -> dict[str, Any]:
    """The constants that a user's own functions read, by name, as an effect keeps them. owner: the
    effect to whose `parameters` they were given. Raises InputError for what is no such dict."""
    if not isinstance(given, Mapping):
        raise checks.input_error(f"{owner}.parameters", given, 'a dict, {"k": 2.0}')
    for name in given:
        if not (isinstance(name, str) and name.isidentifier()):
            raise checks.input_error(f"{owner}.parameters", name, "a name, such as 'k'")
    return {n: checked(f"{owner}.{n}", v, rule) for n, v in given.items()}


def checked(name: str, given: object, rule: Rule, forms: str = FORMS) -> Any:
    """A physical value as an effect keeps it: a float, a 1-D tensor, `ByType`, `PerColony` or a
    `Distribution`.

    Raises InputError for what `rule` does not allow; forms: those that a value of a cell may take.
    """
    bounds: dict[str, Any] = {"above": rule.above, "least": rule.least, "most": rule.most}
    if isinstance(given, Schedule):
        if rule.scheduled:
            return checked_values(name, given, partial(_checked_in_schedule, rule))
        hint = (
            "A Schedule is for the source, flow, reservoir and faces of a Medium, the constants of"
            " Circuit, Rules and MediumReactions, Lysis, Erosion and Motility. A rule that reads it"
            " as a constant, cells.p.pace, sets what it should change."
        )
        raise checks.input_error(name, given, "constant", hint)
    if isinstance(given, ByType):
        given = given.values
    if isinstance(given, (Distribution, Mapping)) and rule.scope == COLONY:
        kind = (
            "a distribution over cells"
            if isinstance(given, Distribution)
            else "one value per cell type"
        )
        raise checks.input_error(
            name, given, f"one number, or one per colony; {kind} has no meaning for it"
        )
    if isinstance(given, Distribution):
        checks.number(f"smallest value of {name}", given.least(), hint=given.reach, **bounds)
        checks.number(f"largest value of {name}", given.greatest(), hint=given.reach, **bounds)
        return given
    if isinstance(given, Mapping):
        for kind in given:
            if isinstance(kind, bool) or not isinstance(kind, Integral) or kind < 0:
                raise checks.input_error(
                    f"{name}, cell type", kind, "an integer from 0", "Write {0: 0.6, 1: 1.2}."
                )
        if not given:
            each = "one value for each cell type, such as {0: 0.6, 1: 1.2}"
            raise checks.input_error(name, dict(given), each)
        _check_no_schedules(name, given, rule)
        by_type = ByType(
            {
                int(k): checked(f"{name}[{k}]", value, rule, FORMS_OF_TYPE)
                for k, value in sorted(given.items())
            }
        )
        drawn = [v for v in by_type.values.values() if isinstance(v, Distribution)]
        if len({v.inherited is True for v in drawn}) > 1:
            raise checks.input_error(
                name,
                by_type,
                "inherited for all cell types that it is drawn for, or for none",
                "Give each distribution inherited=True, or none of them.",
            )
        return by_type
    if isinstance(given, PerColony):
        inner = checks.value(name, given.values, **bounds)
        if not isinstance(inner, Tensor) or inner.dim() != 1:
            raise checks.input_error(name, given, "a list or 1-D tensor with one number per colony")
        return PerColony(inner)
    hint = forms if rule.scope == CELL else checks.ONE_OR_EACH
    if rule.scope == CELL:
        _warn_of_range(name, given)
    return checks.value(name, given, hint=hint, **bounds)


def _check_no_schedules(name: str, by_type: Mapping[int, Any], rule: Rule) -> None:
    """Raises InputError where the value of a cell type is a schedule, though a schedule of values
    by type may be."""
    for kind, value in by_type.items():
        if rule.scheduled and isinstance(value, Schedule):
            types = "{" + ", ".join(f"{k}: …" for k in by_type) + "}"
            raise checks.input_error(
                f"{name}[{kind}]", value, "constant in a dict by cell type",
                f"Put the types into the schedule: tf.Schedule({{0: {types}, 2.5: {types}}}).",
            )  # fmt: skip


def _checked_in_schedule(rule: Rule, name: str, given: Any) -> Any:
    value = checked(name, given, rule)
    if is_drawn(value):
        raise checks.input_error(name, given, "a number, one per colony, or one per cell type")
    return value


def _warn_of_range(name: str, given: Any) -> None:
    """Warn of values of two colonies that read like a range: a tuple, in order."""
    two = isinstance(given, tuple) and len(given) == 2 and all(isinstance(x, Real) for x in given)
    if two and given[0] < given[1]:
        low, high = (f"{x:g}" for x in given)
        warn(
            f"{name} = ({low}, {high}) is one value for each of two colonies. If it is a range from"
            f" which each cell draws, write tf.Uniform({low}, {high}); else [{low}, {high}]."
        )


def numbers(value: Any) -> Tensor:
    """All numbers of a checked value that is not drawn, float64 on the CPU: to find its smallest
    and largest, for checks."""
    if isinstance(value, ByType):
        return torch.cat([numbers(v).reshape(-1) for v in value.values.values()])
    if isinstance(value, Distribution):
        return torch.tensor([value.least(), value.greatest()], dtype=torch.float64)
    inner = value.values if isinstance(value, PerColony) else value
    return torch.as_tensor(inner, dtype=torch.float64, device="cpu").detach().reshape(-1)


def smallest(value: Any) -> float:
    """The smallest number that a checked value can be."""
    return float(numbers(value).min())


def largest(value: Any) -> float:
    """The largest number that a checked value can be."""
    return float(numbers(value).max())


def is_drawn(value: Any) -> bool:
    """Whether a checked value is drawn for each cell."""
    return isinstance(value, Distribution) or (isinstance(value, ByType) and value.is_drawn)


def is_inherited(value: Any) -> bool:
    """Whether daughters keep the value that was drawn for their parent."""
    drawn = (
        [value]
        if isinstance(value, Distribution)
        else [v for v in value.values.values() if isinstance(v, Distribution)]
    )
    return all(d.inherited is True for d in drawn)


def check_inherited(name: str, value: Any, kept: bool) -> None:
    """Raise InputError for a drawn value of which daughters are to inherit a share, but that no
    cell keeps."""
    if kept:
        return
    parts = value.values.values() if isinstance(value, ByType) else [value]
    for part in parts:
        if isinstance(part, Distribution) and not isinstance(part.inherited, bool):
            rule = "left out, since no cell keeps this value: it is drawn when it is needed"
            raise checks.input_error(f"{name}.inherited", part.inherited, rule)


@dataclass(frozen=True, eq=False)
class Distribution(metaclass=checks.KnownKeywords):
    """A random value, drawn once for each cell at its birth. Subclasses: Uniform, Normal,
    LogNormal.

    inherited: True: daughters keep their parent's value instead of drawing their own. Of a Normal
    or LogNormal also a number from 0 to 1, or one per colony: the correlation between parent and
    daughter. Of what the parent has more than the mean (of the logarithm), daughters have this
    share, and the rest is drawn, so that all cells have the same distribution; sisters share its
    square.
    """

    parameters: ClassVar[tuple[str, ...]] = ()
    reach: ClassVar[str] = ""  # how far it reaches, for messages, where that is not what was given
    inherited: bool | checks.Value = dataclasses.field(default=False, kw_only=True)

    def draw(self, state: State, rows: Tensor, purpose: str, values: Values) -> Tensor:
        """One value for each of the cells `rows` (M,) -> (M,); values: its own parameters,
        resolved."""
        raise NotImplementedError

    def draw_after(
        self, parents: Tensor, state: State, rows: Tensor, purpose: str, values: Values
    ) -> Tensor:
        """As `draw`, of daughters `rows` (M,) whose parents have these values, (M,), where
        `inherited` is a number."""
        raise NotImplementedError

    def least(self) -> float:
        """The smallest value that can be drawn."""
        raise NotImplementedError

    def greatest(self) -> float:
        """The largest value that can be drawn."""
        raise NotImplementedError

    def _check(self, **rules: Rule) -> None:
        if not isinstance(self.inherited, bool):
            name = f"{type(self).__name__}.inherited"
            if type(self).draw_after is Distribution.draw_after:
                hint = "A Normal or a LogNormal may also have the share that daughters inherit."
                raise checks.input_error(name, self.inherited, "True or False", hint)
            rules = {**rules, "inherited": Rule(scope=COLONY, least=0.0, most=1.0)}
        for name, rule in rules.items():
            made = checked(f"{type(self).__name__}.{name}", getattr(self, name), rule)
            object.__setattr__(self, name, made)


Value = float | Tensor | np.ndarray | Sequence[float] | Mapping[int, Any] | Distribution | PerColony
ScheduledValue = Value | Schedule


def quotient(number: float, value: Any) -> Any:
    """number / value, given in the way that the value is, one number or one per colony."""
    if isinstance(value, PerColony):
        return PerColony(number / torch.as_tensor(value.values))
    return number / value

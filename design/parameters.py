"""The parameters that a search changes, each with its bounds or its options, and the unit cube that
they span."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import torchfilm as tf
from torchfilm import checks

# The value of a parameter: a number, or one of the options of a choice.
Value = Any
Resolve = Callable[[Mapping[str, Value]], Mapping[str, Value]]


@dataclass(frozen=True)
class Parameter(metaclass=checks.KnownKeywords):
    """A number between two bounds: `Parameter("k3", 0.1, 10, log=True)`.

    name: of an argument of the scene function. log: use a logarithmic scale, for a parameter whose
    order of magnitude is unknown; both bounds above 0. whole: an integer, bounds included. Each
    value of a whole parameter makes its own scene, so it may set the structure of a circuit, such
    as the number of genes. Other parameters reach one scene as one value per colony. Raises
    InputError for bounds that are not allowed.
    """

    name: str
    low: float
    high: float
    log: bool = False
    whole: bool = False

    def __post_init__(self) -> None:
        _check_name("Parameter", self.name)
        for flag in ("log", "whole"):
            checks.choice(f"Parameter({self.name!r}).{flag}", getattr(self, flag), (True, False))
        for bound in ("low", "high"):
            object.__setattr__(
                self,
                bound,
                checks.number(f"Parameter({self.name!r}).{bound}", getattr(self, bound)),
            )
        if not self.low < self.high:
            raise checks.input_error(
                f"Parameter({self.name!r})",
                (self.low, self.high),
                "low < high",
                "A fixed value belongs in fixed={…}." if self.low == self.high else "Swap the two.",
            )
        if self.log and self.low <= 0:
            raise checks.input_error(
                f"Parameter({self.name!r}).low",
                self.low,
                "above 0 with log=True",
                "0 has no logarithm: raise the bound, or leave log out.",
            )
        if self.log and self.whole:
            raise checks.input_error(
                f"Parameter({self.name!r})",
                "log=True, whole=True",
                "one of the two",
                "All whole numbers have equal shares of the scale.",
            )
        if self.whole and not (self.low.is_integer() and self.high.is_integer()):
            raise checks.input_error(
                f"Parameter({self.name!r})", (self.low, self.high), "whole numbers with whole=True"
            )

    @property
    def structural(self) -> bool:
        """Whether each of its values makes a scene of its own."""
        return self.whole

    @property
    def levels(self) -> int | None:
        """The number of its values; None: continuous."""
        return int(self.high - self.low) + 1 if self.whole else None

    def value(self, unit: float) -> Value:
        """The value at a coordinate in [0, 1]. Whole numbers have equal shares of it."""
        if self.levels is not None:
            return int(self.low) + _level(unit, self.levels)
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        found = low + unit * (high - low)
        # rounding must not exceed a bound
        return min(max(math.exp(found) if self.log else found, self.low), self.high)

    def slope(self, unit: float) -> float:
        """The derivative of the value by the coordinate, for a parameter without levels."""
        if self.log:
            return float(self.value(unit)) * (math.log(self.high) - math.log(self.low))
        return self.high - self.low

    def coordinate(self, value: Value) -> float:
        """The coordinate, in [0, 1], of a value within the bounds."""
        number = checks.number(self.name, value, least=self.low, most=self.high)
        if self.whole:
            if not number.is_integer():
                raise checks.input_error(self.name, value, "a whole number")
            return (number - self.low + 0.5) / (self.high - self.low + 1)
        if self.log:
            return (math.log(number) - math.log(self.low)) / (
                math.log(self.high) - math.log(self.low)
            )
        return (number - self.low) / (self.high - self.low)

    def describe(self) -> str:
        kind = " whole" if self.whole else " log" if self.log else ""
        return f"{self.name}: {self.low!r} to {self.high!r}{kind}"


@dataclass(frozen=True, init=False)
class Choice(metaclass=checks.KnownKeywords):
    """One of several options, such as promoters: `Choice("promoter", ("weak", "strong"))`.

    name: of an argument of the scene function. options: at least two, all different, each a text, a
    number, True or False, so that a file can store it. per_colony: the scene function takes a list
    with one option for each colony, as it takes numbers, so that all designs share a batch. By
    default each option makes its own scene. resolve: where choices exclude each other, a function
    from the values of a design to those of these choices that stand; all of them share it. Raises
    InputError for other options.
    """

    name: str
    options: tuple[Value, ...]
    per_colony: bool
    resolve: Resolve | None = field(compare=False, repr=False)

    def __init__(
        self,
        name: str,
        options: Sequence[Value],
        *,
        per_colony: bool = False,
        resolve: Resolve | None = None,
    ):
        _check_name("Choice", name)
        if isinstance(options, np.ndarray):
            options = options.tolist()
        listed = isinstance(options, Sequence) and not isinstance(options, str)
        if listed:  # numbers of numpy are numbers
            options = tuple(o.item() if isinstance(o, np.generic) else o for o in options)
        odd = [o for o in options if not isinstance(o, (str, bool, int, float))] if listed else []
        if odd:
            raise checks.input_error(
                f"one of Choice({name!r}).options",
                odd[0],
                "a text, a number, True or False",
                "Give a name, and let the scene function look the object up.",
            )
        # 1 and True are equal, so that their values could not be distinguished
        if not listed or len(options) < 2 or len(set(options)) != len(options):
            raise checks.input_error(
                f"Choice({name!r}).options",
                options,
                "at least two different ones, such as ('weak', 'strong')",
            )
        checks.choice(f"Choice({name!r}).per_colony", per_colony, (True, False))
        if not (resolve is None or callable(resolve)):
            raise checks.input_error(
                f"Choice({name!r}).resolve",
                resolve,
                "a function from the values of a design, or None",
            )
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "options", tuple(options))
        object.__setattr__(self, "per_colony", per_colony)
        object.__setattr__(self, "resolve", resolve)

    @property
    def structural(self) -> bool:
        """Whether each of its options makes a scene of its own."""
        return not self.per_colony

    @property
    def levels(self) -> int:
        return len(self.options)

    def value(self, unit: float) -> Value:
        """The option at a coordinate in [0, 1]. All options have equal shares of it."""
        return self.options[_level(unit, len(self.options))]

    def coordinate(self, value: Value) -> float:
        """The coordinate in the middle of an option's share."""
        if value not in self.options:
            raise checks.input_error(
                self.name, value, "one of " + ", ".join(map(repr, self.options))
            )
        return (self.options.index(value) + 0.5) / len(self.options)

    def describe(self) -> str:
        return f"{self.name}: " + " or ".join(map(repr, self.options))


class Space(metaclass=checks.KnownKeywords):
    """The parameters of a search. Points are (n, D) coordinates in [0, 1], float64.

    size: D; names; levels: the number of values of each dimension, None where it is continuous.
    """

    def __init__(self, parameters: Sequence[Parameter | Choice]):
        if (
            not isinstance(parameters, Sequence)
            or not parameters
            or not all(isinstance(p, (Parameter, Choice)) for p in parameters)
        ):
            raise checks.input_error(
                "parameters", parameters, "a list of Parameter(…) and Choice(…), at least one"
            )
        self.parameters = tuple(parameters)
        self.names = tuple(p.name for p in self.parameters)
        twice = [n for n in self.names if self.names.count(n) > 1]
        if twice:
            raise checks.input_error("parameters", twice[0], "named once")
        self.size = len(self.parameters)
        self.levels = tuple(p.levels for p in self.parameters)
        self._resolving = dict.fromkeys(
            p.resolve for p in self.parameters if isinstance(p, Choice) and p.resolve is not None
        )

    @property
    def moving(self) -> list[int]:
        """The dimensions without levels, by which losses have derivatives."""
        return [k for k, levels in enumerate(self.levels) if levels is None]

    def values(self, point: np.ndarray) -> dict[str, Value]:
        """The values of one design by name, from its coordinates (D,)."""
        wanted = f"{self.size} coordinates in [0, 1]"
        if np.shape(point) != (self.size,):
            raise checks.input_error("point", point, wanted)
        far = [float(u) for u in point if not -1e-9 <= u <= 1 + 1e-9]  # rounding is none
        if far:
            raise checks.input_error("point", far[0], wanted)
        return self.resolved(
            {p.name: p.value(float(u)) for p, u in zip(self.parameters, point, strict=True)}
        )

    def resolved(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """The values of a design whose choices do not exclude each other."""
        found = dict(values)
        for resolve in self._resolving:
            found |= resolve(found)
        return found

    def point(self, values: Mapping[str, Value]) -> np.ndarray:
        """The coordinates (D,) of one design, from its values by name."""
        if not isinstance(values, Mapping):
            raise checks.input_error(
                "values", values, "a dictionary with one for each of " + ", ".join(self.names)
            )
        wrong = [n for n in (*values, *self.names) if n not in values or n not in self.names]
        if wrong:
            raise checks.input_error(
                "values",
                list(values),
                "one for each of " + ", ".join(self.names),
                f"{wrong[0]!r} is missing or unknown.",
            )
        return np.array([p.coordinate(values[p.name]) for p in self.parameters])

    def check(self, allowed: Sequence[str], scene: str) -> None:
        """Raises InputError for a parameter that the scene does not have."""
        for name in self.names:
            if name not in allowed:
                raise checks.input_error(
                    "Parameter",
                    name,
                    f"a parameter of {scene}: {', '.join(allowed)}",
                    checks.suggestion(name, allowed),
                )

    def describe(self) -> list[str]:
        return [p.describe() for p in self.parameters]

    @property
    def digest(self) -> str | None:
        """A word that differs where choices are resolved by other functions, or other choices are;
        None where none are."""
        found = [
            (p.name, p.resolve) for p in self.parameters if isinstance(p, Choice) and p.resolve
        ]
        return tf.digest(found) if found else None


def _level(unit: float, count: int) -> int:
    return min(int(unit * count), count - 1)


def _check_name(kind: str, name: Any) -> None:
    if not isinstance(name, str) or not name.isidentifier():
        raise checks.input_error(f"{kind}.name", name, "the name of an argument of the scene")


def show_value(value: Value) -> str:
    """A value in a table."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)

"""Reactions: what turns into what, and how fast. A list of them is a circuit that can run smoothly
or molecule by molecule.

Names are the cell's species; "out.ahl" is the signal ahl just outside the cell. Rates are
concentration per hour, referred to the cell's volume.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from torch import Tensor

from torchfilm.circuits.names import Names
from torchfilm.tools import checks

OUTSIDE = "out."
# of u, s, p, cell: (n,) conc/h, referred to the cell's volume
RateFunction = Callable[[Names, Names, Names, Names], Tensor]
# a number, one per colony (B,), or the name of a parameter
Constant = float | Tensor | str
PLACE = re.compile(r"(?:(\d+)\s*\*?\s*)?((?:out\.)?[A-Za-z_]\w*)")


@dataclass(frozen=True, eq=False)
class Reaction:
    """Molecules `consumes` turn into `produces`, name -> how many, at `rate`.

    rate: a constant (a number, one per colony, or a parameter's name) for mass action, rate × Π
    concentration^order over what is consumed; or a function (u, s, p, cell) -> (n,) conc/h. Its
    arguments are names for columns over cells: species, signals outside, parameters, geometry.
    """

    consumes: Mapping[str, int]
    produces: Mapping[str, int]
    rate: Constant | RateFunction
    name: str = ""
    # how steeply a function answers to what it reads: the highest power of a concentration in it
    order: int = field(default=2, kw_only=True)

    def __post_init__(self) -> None:
        label = f"Reaction({self.name!r})" if self.name else "Reaction"
        for side in ("consumes", "produces"):
            object.__setattr__(
                self, side, MappingProxyType(_side(f"{label}.{side}", getattr(self, side)))
            )
        if not callable(self.rate):
            object.__setattr__(self, "rate", constant(f"{label}.rate", self.rate))
        if isinstance(self.order, bool) or not isinstance(self.order, int) or self.order < 1:
            raise checks.input_error(f"{label}.order", self.order, "a whole number from 1")
        if not self.change():
            raise checks.input_error(
                label, str(self), "a reaction that changes something", "Both sides are the same."
            )

    @staticmethod
    def of(
        equation: str, rate: Constant | RateFunction, name: str = "", *, order: int = 2
    ) -> Reaction:
        """From an equation: `Reaction.of("2 a + b -> c", rate=0.1)`; an empty side or 0 stands for
        nothing."""
        sides = equation.split("->")
        if len(sides) != 2:
            raise checks.input_error(
                "equation", equation, 'two sides with an arrow, such as "2 a + b -> c"'
            )
        return Reaction(
            _parse(sides[0], equation), _parse(sides[1], equation), rate, name, order=order
        )

    def change(self) -> dict[str, int]:
        """Net change of each species and signal that one event makes; what does not change is left
        out."""
        names = [*self.consumes, *(n for n in self.produces if n not in self.consumes)]
        net = {n: self.produces.get(n, 0) - self.consumes.get(n, 0) for n in names}
        return {n: k for n, k in net.items() if k}

    def __str__(self) -> str:
        sides = (
            " + ".join(n if k == 1 else f"{k} {n}" for n, k in side.items()) or "0"
            for side in (self.consumes, self.produces)
        )
        return " -> ".join(sides)

    def __reduce__(self) -> tuple[Any, ...]:
        # read-only mappings do not pickle by themselves
        return (
            _restore,
            (dict(self.consumes), dict(self.produces), self.rate, self.name, self.order),
        )


def _restore(
    consumes: dict[str, int],
    produces: dict[str, int],
    rate: Constant | RateFunction,
    name: str,
    order: int,
) -> Reaction:
    return Reaction(consumes, produces, rate, name, order=order)


def constant(name: str, given: object, *, positive: bool = False) -> Constant:
    """A constant as given, checked: at least 0 (above 0 where `positive`), or a parameter's
    name."""
    if isinstance(given, str):
        if not given.isidentifier():
            raise checks.input_error(
                name, given, "a number, one number per colony, or a parameter's name"
            )
        return given
    return (
        checks.value(name, given, above=0.0) if positive else checks.value(name, given, least=0.0)
    )


def _side(name: str, given: object) -> dict[str, int]:
    if not isinstance(given, Mapping):
        raise checks.input_error(name, given, 'a mapping from names to how many, such as {"a": 2}')
    for key, count in given.items():
        if not isinstance(key, str) or not key.removeprefix(OUTSIDE).isidentifier():
            raise checks.input_error(
                name, key, 'the name of a species, or "out." and that of a signal'
            )
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise checks.input_error(f"{name}[{key!r}]", count, "a whole number from 1")
    return dict(given)


def _parse(side: str, equation: str) -> dict[str, int]:
    out: dict[str, int] = {}
    if side.strip() in ("", "0", "∅"):
        return out
    for term in side.split("+"):
        found = PLACE.fullmatch(term.strip())
        if not found:
            raise checks.input_error(
                "equation",
                equation,
                'terms such as "2 a" or "out.ahl", joined by +',
                f"This is not one: {term.strip()!r}.",
            )
        out[found[2]] = out.get(found[2], 0) + int(found[1] or 1)
    return out


def per_cell(given: Constant, p: Names, cell: Names, like: Tensor) -> Tensor | float:
    """A constant for each cell, (n,), or a single value: parameters by name, one per colony by the
    colony's id, `cell.colony`."""
    if isinstance(given, str):
        return p[given]
    if not isinstance(given, Tensor):
        return given
    given = given.to(dtype=like.dtype, device=like.device)
    return given if given.dim() == 0 else given.index_select(0, cell.colony)


def concentration(name: str, u: Names, s: Names) -> Tensor:
    """A species' concentration in the cell, or a signal's outside, (n,)."""
    return s[name.removeprefix(OUTSIDE)] if name.startswith(OUTSIDE) else u[name]


def falling(count: Tensor, order: int) -> Tensor:
    """n (n − 1) … (n − order + 1) for whole n ≥ 0 and an order from 1: 0 where there are too
    few."""
    out = count
    for k in range(1, order):
        out = out * (count - k).clamp(min=0.0)
    return out

"""Reactions: which species turn into which, and at which rate.

A list of reactions is a circuit. It can run deterministically or molecule by molecule. Names are
the cell's species; "out.ahl" is the signal ahl just outside the cell. Rates are concentration per
hour, relative to the cell's volume.
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
# rate(u, s, p, cell): (n,) conc/h, relative to the cell's volume
RateFunction = Callable[[Names, Names, Names, Names], Tensor]
# a number, one per colony (B,), or the name of a parameter
Constant = float | Tensor | str
TERM = re.compile(r"(?:(\d+)\s*\*?\s*)?((?:out\.)?[A-Za-z_]\w*)")


@dataclass(frozen=True, eq=False)
class Reaction(metaclass=checks.KnownKeywords):
    """Molecules `consumes` turn into `produces` at `rate`; both map names to numbers of molecules.

    rate: a constant (a number, one per colony, or a parameter's name) gives mass action, rate × Π
    concentration^order over the consumed species. A function (u, s, p, cell) -> (n,) gives conc/h.
    Its arguments are names for columns over cells: species, signals outside, parameters, geometry.
    order: the highest power of a concentration in such a function.
    """

    consumes: Mapping[str, int]
    produces: Mapping[str, int]
    rate: Constant | RateFunction
    name: str = ""
    order: int = field(default=2, kw_only=True)

    def __post_init__(self) -> None:
        label = f"Reaction({self.name!r})" if self.name else "Reaction"
        for side in ("consumes", "produces"):
            object.__setattr__(
                self, side, MappingProxyType(_side(f"{label}.{side}", getattr(self, side)))
            )
        if not callable(self.rate):
            object.__setattr__(self, "rate", constant(f"{label}.rate", self.rate))
        order = checks.integer(f"{label}.order", self.order, least=1)
        object.__setattr__(self, "order", order)
        if not self.change():
            raise checks.input_error(
                label, str(self), "a reaction that changes something", "Both sides are equal."
            )

    @staticmethod
    @checks.known_keywords
    def of(
        equation: str, rate: Constant | RateFunction, name: str = "", *, order: int = 2
    ) -> Reaction:
        """From an equation: `Reaction.of("2 a + b -> c", rate=0.1)`.

        An empty side or 0 means no molecules.
        """
        sides = equation.split("->")
        if len(sides) != 2:
            raise checks.input_error(
                "equation", equation, 'two sides with an arrow, such as "2 a + b -> c"'
            )
        return Reaction(
            _parse(sides[0], equation), _parse(sides[1], equation), rate, name, order=order
        )

    def change(self) -> dict[str, int]:
        """Net change of each species and signal per event, without those that do not change."""
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
        # read-only mappings cannot be pickled
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
    """Returns a checked constant: at least 0 (above 0 with `positive`), or a parameter's name."""
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
        raise checks.input_error(
            name, given, 'a mapping from names to numbers of molecules, such as {"a": 2}'
        )
    for key in given:
        if not isinstance(key, str) or not key.removeprefix(OUTSIDE).isidentifier():
            raise checks.input_error(
                name, key, 'the name of a species, or "out." and that of a signal'
            )
    return {k: checks.integer(f"{name}[{k!r}]", count, least=1) for k, count in given.items()}


def _parse(side: str, equation: str) -> dict[str, int]:
    out: dict[str, int] = {}
    if side.strip() in ("", "0", "∅"):
        return out
    for term in side.split("+"):
        found = TERM.fullmatch(term.strip())
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
    """A constant for each cell, (n,), or a single value.

    Parameters are found by name, constants per colony by the colony's id, `cell.colony`.
    """
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
    """n (n − 1) … (n − order + 1) for integer n ≥ 0 and order ≥ 1.

    It is 0 where there are too few molecules.
    """
    out = count
    for k in range(1, order):
        out = out * (count - k).clamp(min=0.0)
    return out

"""Equations as a rate function: expressions that were read or built, not written in Python.

`Equations` is called with (u, s, p, cell) like a user's rate function, and torch computes it, or
tracing notes it, in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits import kinetics
from torchfilm.circuits.expressions import LOGICAL, NAME, NUMBER, Builder, Expression, walk
from torchfilm.circuits.names import Names
from torchfilm.tools.hashing import digest

Term = float | bool | Expression  # an expression, or a number or truth value known already
Operand = float | bool | Tensor


def _divided(x: Operand, y: Operand) -> Tensor:
    one = isinstance(x, (int, float)) and x == 1
    return y.reciprocal() if one and isinstance(y, Tensor) else x / y  # type: ignore[return-value]


def _least(x: Operand, y: Operand) -> Tensor:
    x, y = (x, y) if isinstance(x, Tensor) else (y, x)
    assert isinstance(x, Tensor)
    return torch.minimum(x, y) if isinstance(y, Tensor) else x.clamp(max=y)


def _most(x: Operand, y: Operand) -> Tensor:
    x, y = (x, y) if isinstance(x, Tensor) else (y, x)
    assert isinstance(x, Tensor)
    return torch.maximum(x, y) if isinstance(y, Tensor) else x.clamp(min=y)


# By operation, on operands of which at least one is a tensor.
OPERATIONS: Mapping[str, Callable[..., Any]] = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": _divided,
    "pow": lambda x, y: x**y,
    "neg": lambda x: -x,
    "gt": lambda x, y: x > y,
    "ge": lambda x, y: x >= y,
    "lt": lambda x, y: x < y,
    "le": lambda x, y: x <= y,
    "eq": lambda x, y: x == y,
    "ne": lambda x, y: x != y,
    "and": torch.logical_and,
    "or": torch.logical_or,
    "not": torch.logical_not,
    "minimum": _least,
    "maximum": _most,
    **{n: getattr(torch.nn.functional, n) for n in ("softplus", "elu", "silu")},
    **{n: getattr(kinetics, n) for n in ("activation", "repression", "michaelis_menten")},
    **{
        n: getattr(torch, n)
        for n in (
            "abs", "exp", "expm1", "log", "log1p", "log2", "log10", "sqrt", "sin", "cos", "tan",
            "tanh", "atan", "floor", "sign", "sigmoid", "exp2", "sinh", "cosh", "atanh",
            "remainder", "where", "logaddexp", "hypot",
        )
    },
}  # fmt: skip
COLUMNS_ONLY = ("logaddexp", "hypot")  # torch takes no plain numbers here


def operate(builder: Builder, op: str, *args: Term) -> Term:
    """The operation on expressions; of numbers only, its value, in float64."""
    if op == "where" and not isinstance(args[0], Expression):
        return args[1] if args[0] else args[2]
    if any(isinstance(a, Expression) for a in args):
        return builder.make(op, *(a if isinstance(a, Expression) else float(a) for a in args))
    logical = op in ("and", "or", "not")
    dtype = torch.bool if logical else torch.float64
    found = OPERATIONS[op](*(torch.tensor(a, dtype=dtype) for a in args))
    return bool(found) if op in LOGICAL else float(found)


def truth(builder: Builder, x: Term) -> Term:
    """A condition: of a number, whether it is not 0."""
    if isinstance(x, Expression):
        return x if x.op in LOGICAL else builder.make("ne", x, 0.0)
    return bool(x)


def numeric(builder: Builder, x: Term) -> float | Expression:
    """A number: of a condition, 1 where it holds and 0 elsewhere."""
    if isinstance(x, Expression):
        return builder.make("where", x, 1.0, 0.0) if x.op in LOGICAL else x
    return float(x)


@dataclass(frozen=True, repr=False)
class Equations:
    """A rate function (u, s, p, cell) made of expressions.

    label: its name in messages. species: those of the circuit. steps: the operations in order, each
    ("number", value), ("name", "u.ahl") or (operation, places of its arguments). rates, releases:
    the places of the results by species, conc/h, and by signal, conc·µm³/h.
    """

    label: str
    species: tuple[str, ...]
    steps: tuple[tuple[Any, ...], ...]
    rates: tuple[tuple[str, int], ...]
    releases: tuple[tuple[str, int], ...]

    @staticmethod
    def of(
        label: str,
        species: tuple[str, ...],
        rates: Mapping[str, Expression],
        releases: Mapping[str, Expression],
    ) -> Equations:
        place: dict[Expression, int] = {}
        steps: list[tuple[Any, ...]] = []
        for node in walk([*rates.values(), *releases.values()]):
            own = {NUMBER: (NUMBER, node.value), NAME: (NAME, node.name)}
            steps.append(own.get(node.op) or (node.op, *(place[a] for a in node.args)))
            place[node] = len(steps) - 1
        both = (tuple((n, place[e]) for n, e in found.items()) for found in (rates, releases))
        return Equations(label, species, tuple(steps), *both)

    def __repr__(self) -> str:
        listed = ", ".join(name for name, _ in (*self.rates, *self.releases))
        return f"<equations {self.label}, of {listed} ({digest(self)[:8]})>"

    @property
    def __name__(self) -> str:
        return self.label

    def __call__(
        self, u: Names, s: Names, p: Names, cell: Names
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        like = u[self.species[0]]
        found: list[Operand] = []
        homes = {"u": u, "s": s, "p": p, "cell": cell}
        for op, *given in self.steps:
            if op == NUMBER:
                found.append(given[0])
            elif op == NAME:
                kind, _, name = given[0].partition(".")
                found.append(homes[kind][name])
            else:
                args = [found[k] for k in given]
                numbers = [k for k, a in enumerate(args) if not isinstance(a, Tensor)]
                # torch would give a column of two plain numbers its default type, not the cells'
                if op in COLUMNS_ONLY or (op == "where" and numbers == [1, 2]):
                    for k in numbers:
                        args[k] = torch.full_like(like, args[k])
                found.append(OPERATIONS[op](*args))
        of = lambda places: {n: found[k] for n, k in places}
        return of(self.rates), of(self.releases)

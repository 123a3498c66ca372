"""What torchfilm adds to the SBML that it writes, so that it reads the same circuit again.

SBML has one space of names, and no cell that grows. An annotation of the model says which ids are
signals outside, properties of the cell, or have other names. Operations that MathML lacks are
function definitions named torchfilm_NAME. Other programs need neither.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torchfilm.circuits.equations import Term
from torchfilm.circuits.expressions import Builder, Expression
from torchfilm.circuits.sbml.mathml import Formulas
from torchfilm.tools.checks import InputError

NAMESPACE = "urn:torchfilm:circuit"
PREFIX = "torchfilm_"

ARGUMENT = "argument."


def _bodies(b: Builder) -> dict[str, Callable[..., Expression]]:
    """Operations that MathML does not have, by torchfilm's name, in terms of those that it has."""
    m = b.make
    below = lambda x: m("add", 1, m("exp", m("neg", x)))  # of the logistic function
    sum_of = lambda k, x, n: m("add", m("pow", k, n), m("pow", x, n))
    return {
        "expm1": lambda x: m("sub", m("exp", x), 1),
        "log1p": lambda x: m("log", m("add", 1, x)),
        "log2": lambda x: m("div", m("log", x), math.log(2)),
        "exp2": lambda x: m("pow", 2, x),
        "sign": lambda x: m("where", m("gt", x, 0), 1, m("where", m("lt", x, 0), -1, 0)),
        "sigmoid": lambda x: m("div", 1, below(x)),
        "softplus": lambda x: m("log", m("add", 1, m("exp", x))),
        "silu": lambda x: m("div", x, below(x)),
        "elu": lambda x: m("where", m("gt", x, 0), x, m("sub", m("exp", x), 1)),
        "hypot": lambda x, y: m("sqrt", m("add", m("mul", x, x), m("mul", y, y))),
        "logaddexp": lambda x, y: m("log", m("add", m("exp", x), m("exp", y))),
        "remainder": lambda x, y: m("sub", x, m("mul", y, m("floor", m("div", x, y)))),
        "activation": lambda x, k, n: m("div", m("pow", x, n), sum_of(k, x, n)),
        "repression": lambda x, k, n: m("div", m("pow", k, n), sum_of(k, x, n)),
        "michaelis_menten": lambda x, k: m("div", x, m("add", k, x)),
    }


FUNCTIONS = tuple(_bodies(Builder()))


def definition(b: Builder, op: str) -> tuple[tuple[str, ...], Expression]:
    """An operation that MathML lacks: names of its arguments, and the formula of them."""
    body = _bodies(b)[op]
    names = tuple(inspect.signature(body).parameters)
    return names, body(*(b.name(ARGUMENT + n) for n in names))


@dataclass(frozen=True)
class Marks:
    """What an annotation says. names: by id, names in the circuit. signals, cell: by id, names of
    signals and of properties of the cell. undiluted: variables that growth does not dilute.
    cell_time: whether the time is that of the step's beginning."""

    names: Mapping[str, str] = field(default_factory=dict)
    signals: Mapping[str, str] = field(default_factory=dict)
    cell: Mapping[str, str] = field(default_factory=dict)
    undiluted: tuple[str, ...] = ()
    cell_time: bool = False
    found: bool = False

    def __bool__(self) -> bool:
        return self.found


def of(model: Any) -> Marks:
    """The marks of a model, none where torchfilm did not write it. Raises InputError for marks
    that are none of torchfilm's."""
    annotation = model.getAnnotation()
    if annotation is None:
        return Marks()
    for k in range(annotation.getNumChildren()):
        child = annotation.getChild(k)
        if child.getURI() == NAMESPACE and child.getName() == "circuit":
            return _read(child)
    return Marks()


def _read(node: Any) -> Marks:
    homes: dict[str, dict[str, str]] = {"u": {}, "p": {}, "s": {}, "cell": {}}
    undiluted, cell_time = [], False
    for k in range(node.getNumChildren()):
        child = node.getChild(k)
        kind, _, name = child.getAttrValue("name").partition(".")
        if kind not in homes or not name.isidentifier():
            raise InputError(f"torchfilm's annotation has the unknown name {kind + '.' + name!r}")
        if child.getName() == "time":
            cell_time = True
        elif child.getName() == "undiluted":
            undiluted.append(name)
        else:
            homes[kind][child.getAttrValue("id")] = name
    return Marks(
        {**homes["u"], **homes["p"]},
        homes["s"], homes["cell"], tuple(undiluted), cell_time, True,
    )  # fmt: skip


def operation(found: Any, formulas: Formulas) -> str:
    """torchfilm's operation that a function definition stands for; "" for any other function, and
    where its formula is not the one that torchfilm writes."""
    own = found.getId().removeprefix(PREFIX)
    if own == found.getId() or own not in FUNCTIONS:
        return ""
    names, wanted = definition(formulas.builder, own)
    arguments = {n: formulas.builder.name(ARGUMENT + n) for n in names}
    given = [found.getArgument(k).getName() for k in range(found.getNumArguments())]
    same = given == list(names) and formulas.of(found.getBody(), _Nothing(), arguments) is wanted
    return own if same else ""


class _Nothing:
    """What other names stand for in a definition: nothing."""

    def value(self, name: str) -> Term:
        raise InputError(f"a function reads {name!r}, which is not among its arguments")

    def time(self) -> Term:
        return self.value("time")

    def slope(self, name: str) -> Term:
        return self.value(name)

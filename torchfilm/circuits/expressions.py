"""Expressions: what a rate function computes, as a graph in which equal parts are one node."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

NUMBER, NAME = "number", "name"
COMPARISONS = ("gt", "ge", "lt", "le", "eq", "ne")
LOGICAL = (*COMPARISONS, "and", "or", "not")
QUIET = ("cast32", "cast64", "full32", "full64", "detach")  # operations on the type of a number


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Expression:
    """A node: an operation on others, a number, or a name such as "u.ahl", "p.k1"."""

    op: str
    args: tuple[Expression, ...] = ()
    value: float = 0.0
    name: str = ""

    def __repr__(self) -> str:
        from torchfilm.circuits.formulas import text  # which writes expressions

        return text(self)

    def _repr_latex_(self) -> str:
        from torchfilm.circuits.formulas import latex

        return f"${latex(self)}$"

    def is_number(self, value: float) -> bool:
        return self.op == NUMBER and self.value == value

    def walk(self) -> Iterator[Expression]:
        """All nodes below, each once, arguments before what uses them, then this one."""
        yield from walk([self])

    def names(self, kind: str = "") -> tuple[str, ...]:
        """The names that occur, in order; with a kind, such as "u", those behind its dot."""
        found = [node.name for node in self.walk() if node.op == NAME]
        mine = [n.partition(".") for n in found]
        return tuple(n for k, _, n in mine if k == kind) if kind else tuple(found)


def walk(roots: Iterable[Expression]) -> Iterator[Expression]:
    """All nodes of some expressions, each once, arguments before what uses them."""
    seen: set[int] = set()
    for root in roots:
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if id(node) in seen:
                continue
            if ready:
                seen.add(id(node))
                yield node
            else:
                stack.append((node, True))
                stack += [(a, False) for a in reversed(node.args) if id(a) not in seen]


class Builder:
    """Makes expressions; equal ones are the same object."""

    #: why the derivatives of what was traced are not those of its operations; "" where they are
    own_derivative = ""

    def __init__(self) -> None:
        self._made: dict[tuple, Expression] = {}

    def _node(self, op: str, args: tuple[Expression, ...], value: float, name: str) -> Expression:
        # a number by its bits: 0.0 and −0.0 differ
        key = (op, *map(id, args), float(value).hex(), name)
        if key not in self._made:
            self._made[key] = Expression(op, args, value, name)
        return self._made[key]

    def number(self, value: float) -> Expression:
        return self._node(NUMBER, (), float(value), "")

    def name(self, name: str) -> Expression:
        return self._node(NAME, (), 0.0, name)

    def make(self, op: str, *args: Expression | float) -> Expression:
        """The operation as it was written."""
        made = [a if isinstance(a, Expression) else self.number(a) for a in args]
        return self._node(op, tuple(made), 0.0, "")

    def simple(self, op: str, *args: Expression | float) -> Expression:
        """The operation without terms that are 0 and factors that are 1."""
        a, *rest = (x if isinstance(x, Expression) else self.number(x) for x in args)
        b = rest[0] if rest else a
        if op == "add":
            return b if a.is_number(0) else a if b.is_number(0) else self.make(op, a, b)
        if op == "sub":
            zero = a.is_number(0)
            return a if b.is_number(0) else self.simple("neg", b) if zero else self.make(op, a, b)
        if op == "mul":
            if a.is_number(0) or b.is_number(0):
                return self.number(0)
            if a.is_number(-1) or b.is_number(-1):
                return self.simple("neg", b if a.is_number(-1) else a)
            return b if a.is_number(1) else a if b.is_number(1) else self.make(op, a, b)
        if op == "div":
            return a if a.is_number(0) or b.is_number(1) else self.make(op, a, b)
        if op == "neg":
            if a.op == NUMBER:
                return self.number(-a.value)
            return a.args[0] if a.op == "neg" else self.make(op, a)
        if op == "where":
            return rest[0] if rest[0] is rest[1] else self.make(op, a, *rest)
        return self.make(op, a, *rest)


# By operation: the derivatives by each argument, given the builder, the node and its arguments.
# An argument without an entry has derivative 0.
Slopes = Callable[..., Mapping[int, Expression]]
DERIVATIVES: dict[str, Slopes] = {}


def _derivative(*names: str) -> Callable[[Slopes], Slopes]:
    def note(slopes: Slopes) -> Slopes:
        DERIVATIVES.update(dict.fromkeys(names, slopes))
        return slopes

    return note


_derivative("add")(lambda b, y, *_: {0: b.number(1), 1: b.number(1)})
_derivative("sub")(lambda b, y, *_: {0: b.number(1), 1: b.number(-1)})
_derivative("mul")(lambda b, y, u, v: {0: v, 1: u})
_derivative("div")(
    lambda b, y, u, v: {0: b.simple("div", 1, v), 1: b.simple("neg", b.simple("div", y, v))}
)
_derivative("neg")(lambda b, y, u: {0: b.number(-1)})
_derivative("abs")(lambda b, y, u: {0: b.make("sign", u)})
_derivative("exp")(lambda b, y, u: {0: y})
_derivative("expm1")(lambda b, y, u: {0: b.make("add", y, 1)})
_derivative("log")(lambda b, y, u: {0: b.make("div", 1, u)})
_derivative("log1p")(lambda b, y, u: {0: b.make("div", 1, b.make("add", u, 1))})
_derivative("log2")(lambda b, y, u: {0: b.make("div", 1 / math.log(2), u)})
_derivative("log10")(lambda b, y, u: {0: b.make("div", 1 / math.log(10), u)})
_derivative("tan")(lambda b, y, u: {0: b.make("add", 1, b.make("mul", y, y))})
_derivative("sqrt")(lambda b, y, u: {0: b.make("div", 0.5, y)})
_derivative("sin")(lambda b, y, u: {0: b.make("cos", u)})
_derivative("cos")(lambda b, y, u: {0: b.make("neg", b.make("sin", u))})
_derivative("tanh")(lambda b, y, u: {0: b.make("sub", 1, b.make("mul", y, y))})
_derivative("atan")(lambda b, y, u: {0: b.make("div", 1, b.make("add", b.make("mul", u, u), 1))})
_derivative("cast32", "cast64")(lambda b, y, u: {0: b.number(1)})
_derivative("minimum")(
    lambda b, y, u, v: {k: b.make("where", b.make("le", u, v), 1 - k, k) for k in (0, 1)}
)
_derivative("maximum")(
    lambda b, y, u, v: {k: b.make("where", b.make("ge", u, v), 1 - k, k) for k in (0, 1)}
)


_derivative("remainder")(
    lambda b, y, u, v: {0: b.number(1), 1: b.make("neg", b.make("floor", b.make("div", u, v)))}
)
_derivative("hypot")(lambda b, y, u, v: {0: b.make("div", u, y), 1: b.make("div", v, y)})
_derivative("logaddexp")(
    lambda b, y, u, v: {
        0: b.make("sigmoid", b.make("sub", u, v)),
        1: b.make("sigmoid", b.make("sub", v, u)),
    }
)
_derivative("exp2")(lambda b, y, u: {0: b.make("mul", y, math.log(2))})
_derivative("sinh")(lambda b, y, u: {0: b.make("cosh", u)})
_derivative("cosh")(lambda b, y, u: {0: b.make("sinh", u)})
_derivative("atanh")(lambda b, y, u: {0: b.make("div", 1, b.make("sub", 1, b.make("mul", u, u)))})
_derivative("sigmoid")(lambda b, y, u: {0: b.make("mul", y, b.make("sub", 1, y))})
_derivative("softplus")(lambda b, y, u: {0: b.make("sigmoid", u)})
_derivative("elu")(lambda b, y, u: {0: b.make("where", b.make("gt", u, 0), 1, b.make("exp", u))})


@_derivative("silu")
def _of_silu(b: Builder, y: Expression, u: Expression):
    s = b.make("sigmoid", u)
    return {0: b.make("mul", s, b.make("add", 1, b.make("mul", u, b.make("sub", 1, s))))}


def _less_one(b: Builder, x: Expression, n: Expression) -> Expression:
    """xⁿ⁻¹."""
    less = b.number(n.value - 1) if n.op == NUMBER else b.make("sub", n, 1)
    plain = {0.0: b.number(1), 1.0: x} if less.op == NUMBER else {}
    return plain.get(less.value) or b.make("pow", x, less)


def _log_or_0(b: Builder, x: Expression, of: Expression) -> Expression:
    """The logarithm in a derivative by an exponent: at x = 0 a power does not depend on it."""
    return b.make("where", b.make("eq", x, 0), 0, b.make("log", of))


@_derivative("pow")
def _of_power(b: Builder, y: Expression, u: Expression, n: Expression):
    log = b.make("log", u) if u.op == NUMBER else _log_or_0(b, u, u)
    return {0: b.simple("mul", n, _less_one(b, u, n)), 1: b.make("mul", y, log)}


def may_be_negative(x: Expression) -> bool:
    """Whether the argument of a law may lie below 0, as far as its form tells; concentrations do
    not, constants may."""
    if x.op in (NUMBER, NAME):
        return x.value < 0 or (x.op == NAME and not x.name.startswith(("u.", "s.")))
    if x.op in ("add", "mul", "div", "pow", "minimum", "where", *QUIET):
        return any(map(may_be_negative, x.args[1:] if x.op == "where" else x.args))
    return x.op not in ("abs", "exp", "sqrt")


@_derivative("activation", "repression", "michaelis_menten")
def _of_hill(b: Builder, y: Expression, x: Expression, half: Expression, *more: Expression):
    """Of xⁿ/(Kⁿ + xⁿ), or of 1 − that, which below 0 are what they are at 0."""
    n, given = more[0] if more else b.number(1), x
    x = b.make("maximum", x, 0) if may_be_negative(x) else x
    raised = lambda z: z if n.is_number(1) else b.make("pow", z, n)
    under = b.make("pow", b.make("add", raised(half), raised(x)), 2)
    sign = "neg" if y.op == "repression" else "pos"
    signed = lambda e, s: b.simple("neg", e) if s == sign else e
    by = lambda z, other: b.make(
        "div", b.simple("mul", b.simple("mul", n, raised(other)), _less_one(b, z, n)), under
    )
    found = {0: signed(by(x, half), "neg"), 1: signed(by(half, x), "pos")}
    if x is not given:
        found[0] = b.make("where", b.make("lt", given, 0), 0, found[0])
    if more:
        both = b.make("div", b.make("mul", raised(half), raised(x)), under)
        log = _log_or_0(b, x, b.make("div", x, half))
        found[2] = signed(b.make("mul", both, log), "neg")
    return found


def derivatives(
    b: Builder, roots: Iterable[Expression], by: Expression
) -> dict[Expression, Expression]:
    """∂/∂by of every node below the roots that has one other than 0."""
    return tangents(b, roots, {by: b.number(1)})


def tangents(
    b: Builder, roots: Iterable[Expression], of: Mapping[Expression, Expression]
) -> dict[Expression, Expression]:
    """The tangent of every node below the roots that has one other than 0: Σ ∂/∂x · tangent of x.

    of: the tangents of names.
    """
    found: dict[Expression, Expression] = {}
    for node in walk(roots):
        if node in of:
            found[node] = of[node]
            continue
        inner = [k for k, a in enumerate(node.args) if a in found]
        if not inner or node.op in ("detach", "floor", "sign", *LOGICAL):
            continue
        if node.op == "where":
            both = [found.get(a, b.number(0)) for a in node.args[1:]]
            found[node] = b.simple("where", node.args[0], *both)
            continue
        slopes, total = DERIVATIVES[node.op](b, node, *node.args), b.number(0)
        for k in inner:
            if k in slopes:
                total = b.simple("add", total, b.simple("mul", slopes[k], found[node.args[k]]))
        if not total.is_number(0):
            found[node] = total
    return found

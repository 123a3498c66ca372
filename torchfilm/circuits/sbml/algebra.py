"""Sums and quotients of terms, without parts that cancel."""

from __future__ import annotations

from torchfilm.circuits.equations import Term
from torchfilm.circuits.expressions import Builder, Expression
from torchfilm.circuits.sbml.mathml import calculate


def less(b: Builder, x: Term, y: Term) -> Term:
    """x − y, without a term that is 0."""
    if not isinstance(y, Expression) and y == 0:
        return x
    if not isinstance(x, Expression) and x == 0:
        return calculate(b, "neg", y)
    return calculate(b, "sub", x, y)


def over(b: Builder, x: Term, size: Term) -> Term:
    """x/size; where x is a product with the factor `size`, the other factors."""
    if not isinstance(size, Expression):
        return x if size == 1 else calculate(b, "div", x, size)
    if x is size:
        return 1.0
    if isinstance(x, Expression) and x.op == "neg":
        return calculate(b, "neg", over(b, x.args[0], size))
    rest = _without(b, x, size)
    if rest is not None:
        return rest
    zero = not isinstance(x, Expression) and x == 0
    return 0.0 if zero else calculate(b, "div", x, size)


def _without(b: Builder, x: Term, factor: Expression) -> Term | None:
    """A product without one of its factors, or None where it does not occur."""
    if not isinstance(x, Expression) or x.op not in ("mul", "div"):
        return None
    left, right = x.args
    if left is factor and x.op == "mul":
        return right
    if right is factor and x.op == "mul":
        return left
    inner = _without(b, left, factor)
    if inner is not None:
        return b.make(x.op, *(y if isinstance(y, Expression) else float(y) for y in (inner, right)))
    if left is factor:  # factor/right
        return calculate(b, "div", 1.0, right)
    inner = _without(b, right, factor) if x.op == "mul" else None
    return None if inner is None else calculate(b, "mul", left, inner)

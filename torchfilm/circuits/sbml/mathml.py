"""Formulas of SBML as expressions."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from torchfilm.circuits.equations import Term, numeric, operate, truth
from torchfilm.circuits.expressions import Builder, Expression
from torchfilm.circuits.sbml.document import needed
from torchfilm.tools.checks import InputError

AVOGADRO = 6.02214179e23  # 1/mol, as SBML Level 3 defines the symbol


class Symbols(Protocol):
    """What the names in a formula stand for."""

    def value(self, name: str) -> Term: ...
    def time(self) -> Term: ...
    def slope(self, name: str) -> Term: ...


@dataclass(frozen=True)
class Function:
    """A function definition: the names of its arguments, and its formula; or, with `own`, the
    operation of torchfilm that it stands for."""

    arguments: tuple[str, ...]
    body: Any
    own: str = ""


class Formulas:
    """Translates formulas of one model. functions: its definitions by id."""

    def __init__(self, builder: Builder, functions: Mapping[str, Function]):
        self.builder, self.functions = builder, functions

    def of(
        self, node: Any, symbols: Symbols, names: Mapping[str, Term] | None = None
    ) -> float | Expression:
        """A formula as a number or an expression. names: those that stand for something else here,
        such as arguments. Raises InputError for what circuits cannot compute."""
        return numeric(self.builder, self._of(node, symbols, names or {}))

    def _of(self, node: Any, symbols: Symbols, names: Mapping[str, Term]) -> Term:
        kind = _kinds().get(node.getType(), "")
        if kind in ("integer", "real", "real_e", "rational"):
            return float(node.getValue())
        if kind == "name":
            own = node.getName()
            return names[own] if own in names else symbols.value(own)
        if kind == "name_time":
            return symbols.time()
        if kind == "function_rate_of":
            own = node.getChild(0).getName()
            return 0.0 if own in names else symbols.slope(own)
        if kind in CONSTANTS:
            return CONSTANTS[kind]
        given = [self._of(child, symbols, names) for child in _operands(node)]
        if kind == "function":
            return self._called(node.getName(), given, symbols)
        if kind not in RULES:
            said = kind.replace("function_", "") or node.getName() or "an unknown element"
            raise InputError(f"the formula uses {said!r}, which torchfilm cannot compute")
        try:
            return RULES[kind](self.builder, *given)
        except TypeError as error:
            said = kind.replace("function_", "")
            raise InputError(f"the formula has {len(given)} operands of {said!r}") from error

    def _called(self, name: str, given: list[Term], symbols: Symbols) -> Term:
        if name not in self.functions:
            raise InputError(f"the formula uses the function {name!r}, which is not defined")
        function = self.functions[name]
        if len(given) != len(function.arguments):
            raise InputError(
                f"the function {name!r} takes {len(function.arguments)} arguments, and was given"
                f" {len(given)}"
            )
        if function.own:
            return operate(self.builder, function.own, *(numeric(self.builder, x) for x in given))
        return self._of(function.body, symbols, dict(zip(function.arguments, given, strict=True)))


def _operands(node: Any) -> list[Any]:
    """The operands of a formula. libsbml nests long sums and products to the left: all of them."""
    kind = node.getType()
    found: list[Any] = []
    while True:
        children = [node.getChild(k) for k in range(node.getNumChildren())]
        found = [*children[1:], *found]
        nested = _kinds().get(kind) in ("plus", "times") and len(children) > 1
        if not (nested and children[0].getType() == kind):
            return [*children[:1], *found]
        node = children[0]


@functools.cache
def _kinds() -> dict[int, str]:
    """Names of the kinds of formula by libsbml's numbers."""
    libsbml = needed("libsbml", "python-libsbml")
    found = [n for n in dir(libsbml) if n.startswith("AST_")]
    return {getattr(libsbml, n): n.removeprefix("AST_").lower() for n in found}


CONSTANTS: Mapping[str, Term] = {
    "constant_e": math.e, "constant_pi": math.pi, "constant_true": True, "constant_false": False,
    "name_avogadro": AVOGADRO,
}  # fmt: skip

# By kind of formula: the builder and the operands -> the term.
RULES: dict[str, Callable[..., Term]] = {}


def _rule(*kinds: str) -> Callable[[Callable[..., Term]], Callable[..., Term]]:
    def note(rule: Callable[..., Term]) -> Callable[..., Term]:
        RULES.update(dict.fromkeys(kinds, rule))
        return rule

    return note


def calculate(b: Builder, op: str, *given: Term) -> Term:
    """An operation on numbers; conditions among them count as 1 and 0."""
    return operate(b, op, *(numeric(b, x) for x in given))


# So many operands in one chain: expressions are walked by recursion.
LONG = 200


def _folded(op: str, empty: float | None = None) -> Callable[..., Term]:
    """An operation on any number of operands, from the left."""

    def rule(b: Builder, *given: Term) -> Term:
        if not given and empty is not None:
            return empty
        numbers: Sequence[Term] = [numeric(b, x) for x in given]
        while len(numbers) > LONG:  # in parts, or expressions would be nested too deeply
            parts = [numbers[k : k + LONG] for k in range(0, len(numbers), LONG)]
            numbers = [functools.reduce(lambda x, y: calculate(b, op, x, y), p) for p in parts]
        return functools.reduce(lambda x, y: calculate(b, op, x, y), numbers)

    return rule


def _logical(op: str, empty: bool) -> Callable[..., Term]:
    def rule(b: Builder, *given: Term) -> Term:
        parts: list[Term] = []
        for x in (truth(b, y) for y in given):
            if not isinstance(x, bool):
                parts.append(x)
            elif x != empty:  # one false part decides "and", one true part "or"
                return x
        return functools.reduce(lambda x, y: operate(b, op, x, y), parts) if parts else empty

    return rule


def _not(b: Builder, x: Term) -> Term:
    x = truth(b, x)
    return not x if isinstance(x, bool) else operate(b, "not", x)


def _chain(op: str) -> Callable[..., Term]:
    """a < b < c holds where both comparisons do."""

    def rule(b: Builder, *given: Term) -> Term:
        compared = (calculate(b, op, x, y) for x, y in itertools.pairwise(given))
        return RULES["logical_and"](b, *compared)

    return rule


RULES["plus"], RULES["times"] = _folded("add", 0.0), _folded("mul", 1.0)
RULES["function_min"], RULES["function_max"] = _folded("minimum"), _folded("maximum")
RULES["logical_and"], RULES["logical_or"] = _logical("and", True), _logical("or", False)
RULES["logical_not"] = _not
RULES["logical_implies"] = lambda b, x, y: RULES["logical_or"](b, _not(b, x), y)
for _kind in ("gt", "lt", "eq"):
    RULES[f"relational_{_kind}"] = _chain(_kind)
for _kind in ("ge", "le", "ne"):
    RULES[f"relational_{_kind[0]}eq"] = _chain(_kind)
_rule("divide")(lambda b, x, y: calculate(b, "div", x, y))
_rule("power", "function_power")(lambda b, x, y: calculate(b, "pow", x, y))
_rule("function_ln")(lambda b, x: calculate(b, "log", x))
for _kind in ("abs", "exp", "floor", "sin", "cos", "tan", "sinh", "cosh", "tanh"):
    RULES[f"function_{_kind}"] = functools.partial(lambda op, b, x: calculate(b, op, x), _kind)
_rule("function_arctan")(lambda b, x: calculate(b, "atan", x))
_rule("function_arctanh")(lambda b, x: calculate(b, "atanh", x))


@_rule("minus")
def _minus(b: Builder, x: Term, *y: Term) -> Term:
    return calculate(b, "sub", x, *y) if y else calculate(b, "neg", x)


@_rule("logical_xor")
def _xor(b: Builder, *given: Term) -> Term:
    """An odd number of parts hold."""
    and_, or_ = RULES["logical_and"], RULES["logical_or"]
    one = lambda x, y: or_(b, and_(b, x, _not(b, y)), and_(b, _not(b, x), y))
    parts: list[Term] = [False, *(truth(b, x) for x in given)]
    return functools.reduce(one, parts)


@_rule("function_piecewise")
def _piecewise(b: Builder, *given: Term) -> Term:
    """Pairs of a value and its condition, and what holds otherwise: NaN if nothing is given."""
    *pairs, last = given if len(given) % 2 else (*given, math.nan)
    found = last
    for value, condition in reversed(list(zip(pairs[::2], pairs[1::2], strict=True))):
        where = truth(b, condition)
        found = operate(b, "where", where, numeric(b, value), numeric(b, found))
    return found


@_rule("function_log")
def _log(b: Builder, base: Term, *x: Term) -> Term:
    """To a base; 10 where none is given."""
    if not x or base == 10:
        return calculate(b, "log10", x[0] if x else base)
    if base == 2:
        return calculate(b, "log2", *x)
    return calculate(b, "div", calculate(b, "log", *x), calculate(b, "log", base))


@_rule("function_root")
def _root(b: Builder, degree: Term, *x: Term) -> Term:
    """Of a degree; 2 where none is given."""
    if not x or degree == 2:
        return calculate(b, "sqrt", x[0] if x else degree)
    return calculate(b, "pow", x[0], calculate(b, "div", 1.0, degree))


@_rule("function_ceiling")
def _ceiling(b: Builder, x: Term) -> Term:
    return calculate(b, "neg", calculate(b, "floor", calculate(b, "neg", x)))


@_rule("function_quotient")
def _quotient(b: Builder, x: Term, y: Term) -> Term:
    """x/y without its fraction, towards 0."""
    ratio = calculate(b, "div", x, y)
    below = calculate(b, "lt", ratio, 0.0)
    return operate(b, "where", below, numeric(b, _ceiling(b, ratio)),
                   numeric(b, calculate(b, "floor", ratio)))  # fmt: skip


@_rule("function_rem")
def _rem(b: Builder, x: Term, y: Term) -> Term:
    return calculate(b, "sub", x, calculate(b, "mul", y, _quotient(b, x, y)))


@_rule("function_factorial")
def _factorial(b: Builder, x: Term) -> Term:
    if isinstance(x, Expression):
        raise InputError("the formula has the factorial of a variable: only a number has one here")
    try:
        return math.gamma(float(x) + 1)
    except (ValueError, OverflowError) as error:
        raise InputError(f"the formula has the factorial of {x:g}, which is no number") from error


@_rule("function_arcsin")
def _arcsin(b: Builder, x: Term) -> Term:
    beside = calculate(b, "sub", 1.0, calculate(b, "mul", x, x))
    return calculate(b, "atan", calculate(b, "div", x, calculate(b, "sqrt", beside)))


@_rule("function_arccos")
def _arccos(b: Builder, x: Term) -> Term:
    return calculate(b, "sub", math.pi / 2, _arcsin(b, x))


@_rule("function_arcsinh")
def _arcsinh(b: Builder, x: Term) -> Term:
    """Of |x| with the sign of x, since the sum below loses all digits of negative numbers."""
    size = calculate(b, "abs", x)
    root = calculate(b, "sqrt", calculate(b, "add", calculate(b, "mul", x, x), 1.0))
    found = calculate(b, "log", calculate(b, "add", size, root))
    return calculate(b, "mul", calculate(b, "sign", x), found)


@_rule("function_arccosh")
def _arccosh(b: Builder, x: Term) -> Term:
    root = calculate(b, "sqrt", calculate(b, "sub", calculate(b, "mul", x, x), 1.0))
    return calculate(b, "log", calculate(b, "add", x, root))


def _inverse(kind: str) -> Callable[..., Term]:
    return lambda b, x: calculate(b, "div", 1.0, RULES[kind](b, x))


def _of_inverse(kind: str) -> Callable[..., Term]:
    return lambda b, x: RULES[kind](b, calculate(b, "div", 1.0, x))


for _name, _other in {"sec": "cos", "csc": "sin", "cot": "tan"}.items():
    for _h in ("", "h"):
        RULES[f"function_{_name}{_h}"] = _inverse(f"function_{_other}{_h}")
        RULES[f"function_arc{_name}{_h}"] = _of_inverse(f"function_arc{_other}{_h}")

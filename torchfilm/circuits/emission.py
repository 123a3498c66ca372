"""Expressions as the text of compiled functions: rates, their derivatives, and the linear solves of
a circuit, each operation written out.

Numbers keep the type that torch would compute in, and operations their order, so that arithmetic
gives the same bits as torch. What does not depend on concentrations is worked out once a cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch

from torchfilm.circuits.expressions import (
    COMPARISONS,
    LOGICAL,
    NAME,
    NUMBER,
    Builder,
    Expression,
    derivatives,
    tangents,
    walk,
)
from torchfilm.circuits.tracing import CASTS, FULL, Kind, Untraceable, common_type, kind_of

# Numba's limit of tuples.
MOST_ENTRIES = 999

SIGNS = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "gt": ">", "ge": ">=", "lt": "<", "le": "<=",
    "eq": "==", "ne": "!=", "and": "&", "or": "|",
}  # fmt: skip
CALLS = {
    **{n: f"np.{n}" for n in ("exp", "expm1", "log", "log1p", "log2", "log10", "sqrt")},
    **{n: f"np.{n}" for n in ("sin", "cos", "tan", "tanh", "floor", "remainder")},
    "atan": "np.arctan", "abs": "abs", "sign": "_sign", "minimum": "_least", "maximum": "_most",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class RateExpressions:
    """du/dt of V variables, as simple operations.

    rates: V expressions. variables: the name of each variable. kinds: the kind of every name that
    occurs, None of a name for a plain number. builder: that made them.
    """

    rates: tuple[Expression, ...]
    variables: tuple[str, ...]
    kinds: Mapping[str, Kind | None]
    builder: Builder

    @cached_property
    def leaves(self) -> tuple[str, ...]:
        """The names that are no variables, in order."""
        found = [e.name for e in walk(self.rates) if e.op == NAME]
        return tuple(n for n in found if n not in self.variables)

    def slopes(self) -> dict[tuple[int, int], Expression]:
        """∂fᵢ/∂uₖ, without those that are 0, and without those that nothing depends on."""
        found: dict[tuple[int, int], Expression] = {}
        for k, name in enumerate(self.variables):
            of = derivatives(self.builder, self.rates, self.builder.name(name))
            found |= {(i, k): of[f] for i, f in enumerate(self.rates) if f in of}
        return found


class Emitter:
    """Writes expressions as lines of assignments, for numbers and for vectors (kernels.vectors)."""

    def __init__(self, equations: RateExpressions, roots: Iterable[Expression]):
        self.equations = equations
        # what is held in float64, whatever its own type
        self.held: frozenset[Expression] = frozenset()
        self.kinds: dict[Expression, Kind | None] = {}
        self.varies: dict[Expression, bool] = {}
        self.number: dict[Expression, int] = {}
        for node in walk(roots):
            if node.op == NUMBER:
                kind: Kind | None = None
            elif node.op == NAME:
                kind = equations.kinds[node.name]
            else:
                kind = kind_of(node.op, [self.kinds[a] for a in node.args])
                if node.op not in CASTS and all(self.kinds[a] is None for a in node.args):
                    kind = (torch.float64, 0)  # numbers alone, as Python computes them
            self.kinds[node] = kind
            own = node.op == NAME and node.name in equations.variables
            self.varies[node] = own or any(self.varies[a] for a in node.args)
            self.number[node] = len(self.number)

    def constants(self, roots: Iterable[Expression]) -> list[Expression]:
        """What does not depend on variables and is read by what does, or is a root."""
        read = {a for node in walk(roots) if self.varies[node] for a in node.args}
        read |= set(roots)
        return [
            n for n in walk(roots)
            if n in read and not self.varies[n] and n.op not in (NUMBER, *FULL)
        ]  # fmt: skip

    def lines(self, roots: Iterable[Expression], known: Iterable[Expression]) -> list[str]:
        """Assignments of all below the roots that is not known yet."""
        have, out = set(known), []
        for root in roots:
            stack = [(root, False)]
            while stack:
                node, ready = stack.pop()
                if node in have or node.op in (NUMBER, *FULL):
                    continue
                if ready:
                    have.add(node)
                    out.append(f"{self.of(node)} = {self._value(node)}")
                else:
                    stack += [(node, True), *((a, False) for a in reversed(node.args))]
        return out

    def of(self, node: Expression) -> str:
        """How to refer to a node."""
        if node.op == NUMBER:
            return _literal(node.value)
        if node.op in FULL:
            return self._as(node.args[0], CASTS[node.op])
        if node.op == NAME and node.name in self.equations.variables:
            return f"u{self.equations.variables.index(node.name)}"
        return f"x{self.number[node]}"

    def _as(self, node: Expression, dtype: torch.dtype) -> str:
        kind = self.kinds[node]
        if kind is None and dtype == torch.float64:
            return self.of(node)
        has = torch.float64 if node in self.held else kind and kind[0]
        names = {torch.float32: "narrow", torch.float64: "wide"}
        return self.of(node) if has == dtype else f"{names[dtype]}({self.of(node)})"

    def unpacked(self, nodes: Iterable[Expression], home: str) -> list[str]:
        """Assignments of nodes from a tuple of this name, which holds all in float64."""
        lines = []
        for place, node in enumerate(nodes):
            if node not in self.kinds:
                continue
            kind = self.kinds[node]
            is_bool = kind is not None and kind[0] == torch.bool
            self.held |= set() if is_bool else {node}
            lines.append(f"{self.of(node)} = {home}[{place}]{' != 0.0' * is_bool}")
        return lines

    def _value(self, node: Expression) -> str:
        op, args = node.op, node.args
        if op in ("and", "or"):
            return f"{self.of(args[0])} {SIGNS[op]} {self.of(args[1])}"
        if op == "not":
            return f"negated({self.of(args[0])})"
        if op == "detach" or op in CASTS:
            return self._as(args[0], kind_of(op, [self.kinds[args[0]]])[0])
        kind = self.kinds[node]
        assert kind is not None
        dtype = common_type([self.kinds[a] for a in args]) if op in COMPARISONS else kind[0]
        if op in LOGICAL and not any(_is_floating(self.kinds[a]) for a in args):
            dtype = torch.float64  # holds whole numbers as they are
        if op == "where":
            yes, no = (self._as(a, dtype) for a in args[1:])
            return f"where({self.of(args[0])}, {yes}, {no})"
        given = [self._as(a, dtype) for a in args]
        if op in SIGNS:
            return f"{given[0]} {SIGNS[op]} {given[1]}"
        if op == "neg":
            return f"-{given[0]}"
        if op not in CALLS:
            raise Untraceable(f"it uses {op}, which has no compiled form")
        call = f"{CALLS[op]}({', '.join(given)})"
        return f"narrow({call})" if dtype == torch.float32 else call


def _is_floating(kind: Kind | None) -> bool:
    return kind is not None and kind[0].is_floating_point


def _literal(value: float) -> str:
    if math.isnan(value):
        return "np.nan"
    if math.isinf(value):
        return "np.inf" if value > 0 else "-np.inf"
    return repr(value) if value >= 0 and math.copysign(1, value) > 0 else f"({value!r})"


def as_tuple(parts: Sequence[str]) -> str:
    return f"({', '.join(parts)}{',' * (len(parts) == 1)})" if parts else "(0.0,)"


def _function(name: str, given: str, lines: Sequence[str], result: str) -> str:
    body = "".join(f"    {line}\n" for line in lines)
    return f"@kernel\ndef {name}({given}):\n{body}    return {result}\n\n\n"


@dataclass(frozen=True)
class Pattern:
    """Where the matrix 2/h − J has entries, after elimination too."""

    size: int
    slopes: tuple[tuple[int, int], ...]
    filled: frozenset[tuple[int, int]]

    @staticmethod
    def of(size: int, slopes: Sequence[tuple[int, int]]) -> Pattern:
        filled = {*slopes, *((i, i) for i in range(size))}
        for k in range(size - 1):
            for i in range(k + 1, size):
                if (i, k) in filled:
                    filled |= {(i, j) for j in range(k + 1, size) if (k, j) in filled}
        return Pattern(size, tuple(slopes), frozenset(filled))


class Functions:
    """The text of the functions of some equations: `prepared`, and of variables u and what was
    prepared, `rates`. more: further expressions that functions return."""

    def __init__(self, equations: RateExpressions, more: Iterable[Expression] = ()):
        roots = [*equations.rates, *more]
        self.equations, self.emitter = equations, Emitter(equations, roots)
        self.hoisted = self.emitter.constants(roots)

    def _of(self, nodes: Iterable[Expression], dtype: torch.dtype) -> str:
        return as_tuple([self.emitter._as(e, dtype) for e in nodes])

    def values(self, dtype: torch.dtype = torch.float64) -> str:
        """The text of `prepared` and `rates`; dtype: of the rates."""
        leaves = [self.equations.builder.name(n) for n in self.equations.leaves]
        self.emitter.held = frozenset()
        lines = self.emitter.unpacked(leaves, "leaf") + self.emitter.lines(self.hoisted, leaves)
        text = _function("prepared", "leaf", lines, self._of(self.hoisted, torch.float64))
        rates = self.equations.rates
        return text + _function("rates", "u, c", self.lines(rates), self.rates_as_tuple(dtype))

    def rates_as_tuple(self, dtype: torch.dtype = torch.float64) -> str:
        """The rates in this type, after their `lines`."""
        return self._of(self.equations.rates, dtype)

    def lines(self, roots: Iterable[Expression]) -> list[str]:
        """Assignments of all below the roots, from u and c."""
        variables = [self.equations.builder.name(n) for n in self.equations.variables]
        own = [f"u{k}" for k in range(len(variables))]
        self.emitter.held = frozenset()
        unpack = [f"{as_tuple(own)} = u", *self.emitter.unpacked(self.hoisted, "c")]
        return unpack + self.emitter.lines(roots, [*self.hoisted, *variables])


def functions(equations: RateExpressions) -> tuple[str, int]:
    """The text of `prepared`, `rates`, `linearised`, `times_slopes`, `factored`, `solved`; how many
    numbers are prepared."""
    slopes = equations.slopes()
    order = sorted(slopes)
    made = Functions(equations, [*slopes.values()])
    wide = lambda e: made.emitter._as(e, torch.float64)
    lines = made.lines([*equations.rates, *(slopes[k] for k in order)])
    safe = as_tuple([f"_finite({wide(slopes[k])})" for k in order])
    values = as_tuple([wide(e) for e in equations.rates])
    text = made.values() + _function("linearised", "u, c", lines, f"{values}, {safe}")
    return text + _linear(Pattern.of(len(equations.variables), order)), len(made.hoisted)


def tangent_functions(equations: RateExpressions, moving: Sequence[str]) -> str:
    """The text of `rates_moved` and `linearised_moved`: the tangents of the rates, and of their
    slopes in the order of `linearised`, for the tangents t of the variables and `turn` of the
    leaves `moving`."""
    b, names, slopes = equations.builder, equations.variables, equations.slopes()
    named = {n: b.name(f"tangent.{n}") for n in (*names, *moving)}
    kinds = {**equations.kinds, **{e.name: equations.kinds[n] for n, e in named.items()}}
    of = {b.name(n): e for n, e in named.items()}
    at_rest = b.number(0)
    rates = [tangents(b, equations.rates, of).get(r, at_rest) for r in equations.rates]
    bent = tangents(b, slopes.values(), of)
    turned = [bent.get(slopes[k], at_rest) for k in sorted(slopes)]
    emitter = Emitter(RateExpressions(equations.rates, names, kinds, b), [*rates, *turned])
    lines = [f"{as_tuple([f'u{k}' for k in range(len(names))])} = u"]
    lines += emitter.unpacked([b.name(n) for n in equations.leaves], "leaf")
    lines += emitter.unpacked([named[n] for n in names], "t")
    lines += emitter.unpacked([named[n] for n in moving], "turn")
    known = [e for e in emitter.number if e.op == NAME]
    given, text = "u, leaf, t, turn", ""
    # slopes that are no numbers count as 0, in `linearised` too
    for name, roots, form in (("rates_moved", rates, "{}"),
                              ("linearised_moved", turned, "_finite({})")):  # fmt: skip
        body = [*lines, *emitter.lines(roots, known)]
        values = [form.format(emitter._as(e, torch.float64)) for e in roots]
        text += _function(name, given, body, as_tuple(values))
    return text


def _linear(pattern: Pattern) -> str:
    """The matrix 2/h − J: products with J, elimination without pivoting, and substitution, in the
    order of `circuits.linear`. Raises Untraceable where it has too many entries."""
    if len(pattern.filled) > MOST_ENTRIES:
        raise Untraceable(
            f"its matrix has {len(pattern.filled)} entries after elimination, more than the"
            f" {MOST_ENTRIES} that a kernel takes; method='rk4' needs no matrix"
        )
    size, at = pattern.size, {k: n for n, k in enumerate(pattern.slopes)}
    x = [f"b{i}" for i in range(size)]
    slopes = [f"j{i}_{k}" for i, k in pattern.slopes]
    unpack_j = [f"{as_tuple(slopes)} = j"] if slopes else []
    rows = []
    for i in range(size):
        terms = [f"j{i}_{k} * b{k}" for k in range(size) if (i, k) in at]
        rows.append(" + ".join(terms) if terms else "0.0")
    text = _function("times_slopes", "j, b", [*unpack_j, f"{as_tuple(x)} = b"], as_tuple(rows))
    lines = list(unpack_j)
    for i, k in sorted(pattern.filled):
        slope = f"-j{i}_{k}" if (i, k) in at else "0.0"
        lines.append(f"m{i}_{k} = {slope}" + (" + w" if i == k else ""))
    for k in range(size - 1):
        for i in range(k + 1, size):
            if (i, k) in pattern.filled:
                lines.append(f"m{i}_{k} /= m{k}_{k}")
                lines += [
                    f"m{i}_{n} -= m{i}_{k} * m{k}_{n}"
                    for n in range(k + 1, size) if (k, n) in pattern.filled
                ]  # fmt: skip
    sound = [
        f"(abs(m{k}_{k}) > LEAST_PIVOT * (w" + (f" + abs(j{k}_{k})))" if (k, k) in at else "))")
        for k in range(size)
    ]
    lines.append("sound = " + " & ".join(sound))
    plain = lambda k: (k, k) not in at and not any((k, i) in pattern.filled for i in range(k))
    signs = [f"_sign(m{k}_{k})" for k in range(size) if not plain(k)]  # the others are w
    lines.append("leaps = " + (" * ".join(signs) or "w") + " < 0.0")
    entries = as_tuple([f"m{i}_{k}" for i, k in sorted(pattern.filled)])
    text += _function("factored", "j, w", lines, f"{entries}, sound, leaps")
    lines = [f"{entries} = m", f"{as_tuple(x)} = b"]
    for k in range(size):
        lines += [
            f"b{i} -= m{i}_{k} * b{k}" for i in range(k + 1, size) if (i, k) in pattern.filled
        ]
    for k in range(size - 1, -1, -1):
        lines.append(f"b{k} /= m{k}_{k}")
        lines += [f"b{i} -= m{i}_{k} * b{k}" for i in range(k) if (i, k) in pattern.filled]
    return text + _function("solved", "m, b", lines, as_tuple(x))

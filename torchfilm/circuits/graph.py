"""A circuit as an object to look at: its equations, what each depends on, its derivatives, and what
it conserves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.expressions import (
    LOGICAL,
    NAME,
    NUMBER,
    Builder,
    Expression,
    derivatives,
    walk,
)
from torchfilm.circuits.formulas import latex, text
from torchfilm.circuits.names import Names, UnknownName, has_no, unknown
from torchfilm.circuits.network import Network, build_network
from torchfilm.circuits.reactions import OUTSIDE
from torchfilm.circuits.tracing import FULL, LAWS, Column, common_type, users_code
from torchfilm.tools import checks
from torchfilm.tools.deterministic_math import deterministic_functions
from torchfilm.tools.one_per_colony import by_position

F64 = torch.float64
PLACES = 64  # at which sums are looked for
Kinds = Callable[[str], tuple[torch.dtype, int] | None]


class Leaves(Names):
    """Columns by name, made when they are read.

    kinds: the type and the dimensions of a name, or None where there is no such name. known: those
    to tell of then.
    """

    __slots__ = ("_kinds", "_known", "_make", "_prefix")

    def __init__(
        self, prefix: str, label: str, builder: Builder, kinds: Kinds, known: Sequence[str]
    ):
        super().__init__((), (), label)
        for name, value in (
            ("_prefix", prefix), ("_kinds", kinds), ("_known", tuple(known)), ("_make", builder),
        ):  # fmt: skip
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        kind = self._kinds(name)
        if kind is None:
            raise UnknownName(has_no(self._label, name, list(self._known)))
        made = Column.of(self._make.name(f"{self._prefix}.{name}"), self._make, *kind)
        self.__dict__[name] = made
        return made

    def __contains__(self, name: str) -> bool:
        return self._kinds(name) is not None

    def __iter__(self):
        return iter(self._known)


@users_code()
def traced_rates(
    part: Any, names: tuple[Names, Names, Names, Names], species: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a rate function, or a network, gives for traced columns: rates of species, conc/h, and
    amounts released to signals, conc·µm³/h: columns or numbers."""
    if isinstance(part, Network):
        found = part.changes(part.concentration_rates(*names))
        split = len(species)
        released = zip(part.signals, (x * names[3].volume for x in found[split:]), strict=True)
        return dict(zip(species, found[:split], strict=True)), dict(released)
    return both_of(part(*names))


def both_of(returned: Any) -> tuple[Any, Any]:
    """What a rate function returned, as rates of species and amounts released."""
    pair = isinstance(returned, tuple) and len(returned) == 2
    return returned if pair else (returned, {})


def check_returned(found: object, label: str) -> None:
    if not isinstance(found, Mapping):
        raise checks.InputError(
            f"{label} returned {type(found).__name__}: it must return a dict of rates by species,"
            " and, for signals, a second one."
        )


@dataclass(frozen=True, eq=False)
class CircuitGraph:
    """The equations of a circuit in the cells of one type.

    rates: of each species, conc/h. releases: what a cell releases to each signal, conc·µm³/h.
    parameters: the constants that the circuit was given. note: what the equations leave out, in
    words. Printed, it shows its equations; a notebook shows them typeset.
    """

    species: tuple[str, ...]
    parameters: tuple[str, ...]
    rates: Mapping[str, Expression]
    releases: Mapping[str, Expression]
    builder: Builder
    note: str = ""

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals that the circuit reads or changes."""
        read = [n for e in self._all() for n in e.names("s")]
        return tuple(dict.fromkeys((*self.releases, *read)))

    def _all(self) -> list[Expression]:
        return [*self.rates.values(), *self.releases.values()]

    # --- to look at ----------------------------------------------------------------------------

    def __str__(self) -> str:
        return self.equations + (f"\n({self.note})" if self.note else "")

    @property
    def equations(self) -> str:
        """A line for each equation, without the note."""
        left = {n: f"d {n}/dt" for n in self.rates} | {
            f"out.{n}": f"to out.{n}" for n in self.releases
        }
        right = [text(e) for e in self._all()]
        width = max(map(len, left.values()), default=0)
        lines = [f"{a:<{width}} = {b}" for a, b in zip(left.values(), right, strict=True)]
        still = [n for n in self.species if n not in self.rates]
        lines += [f"{'d ' + n + '/dt':<{width}} = 0" for n in still]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)

    def _repr_latex_(self) -> str:
        tex = lambda n: rf"\mathrm{{{n.replace('_', chr(92) + '_')}}}"
        lines = [rf"\frac{{d\,{tex(n)}}}{{dt}} &= {latex(e)}" for n, e in self.rates.items()]
        still = [n for n in self.species if n not in self.rates]
        lines += [rf"\frac{{d\,{tex(n)}}}{{dt}} &= 0" for n in still]
        lines += [rf"{tex(n)} \to \mathrm{{out}} &= {latex(e)}" for n, e in self.releases.items()]
        lines += [rf"&\text{{({self.note})}}"] if self.note else []
        return "$$\\begin{aligned}\n" + " \\\\\n".join(lines) + "\n\\end{aligned}$$"

    # --- to work with --------------------------------------------------------------------------

    @property
    def reads(self) -> dict[str, tuple[str, ...]]:
        """What each rate depends on, by species, and by "out.name" for what is released."""
        found = {}
        for name, expression in [
            *self.rates.items(),
            *((f"out.{n}", e) for n, e in self.releases.items()),
        ]:
            found[name] = tuple(text(e) for e in expression.walk() if e.op == NAME)
        return found

    @property
    def unused(self) -> tuple[str, ...]:
        """Constants that nothing reads."""
        read = {n for e in self._all() for n in e.names("p")}
        return tuple(n for n in self.parameters if n not in read)

    def jacobian(self, by: str = "species") -> dict[tuple[str, str], Expression]:
        """∂ rate/∂ x for each rate and each x that it depends on: "species" (also signals outside,
        as "out.name"), or "parameters". Entries that are 0 are left out."""
        checks.choice("by", by, ("species", "parameters"))
        kinds = {"species": ("u", "s"), "parameters": ("p",)}[by]
        rows = {**self.rates, **{f"out.{n}": e for n, e in self.releases.items()}}
        leaves = [e for e in walk(rows.values()) if e.op == NAME and e.name.split(".")[0] in kinds]
        found: dict[tuple[str, str], Expression] = {}
        for leaf in leaves:
            slopes = derivatives(self.builder, rows.values(), leaf)
            found |= {(n, text(leaf)): slopes[e] for n, e in rows.items() if e in slopes}
        return found

    def diluted(self, species: Sequence[str], rate: float) -> CircuitGraph:
        """The same equations with −rate · x for each of some species."""
        make = self.builder.simple
        rates = dict(self.rates)
        for name in species:
            lost = make("mul", rate, self.builder.name(f"u.{name}"))
            rates[name] = make("sub", rates.get(name, 0.0), lost)
        return replace(self, rates={n: rates[n] for n in self.species if n in rates}, note="")

    def evaluate(self, values: Mapping[str, Any]) -> dict[str, Tensor]:
        """The rates, and as "out.name" what is released, at values by name: of species and
        constants by their own names, "out.name" for signals, "cell.volume" and the like. A constant
        with the name of a species is "p.name"."""
        given = self._values(values)
        found = evaluated(self._all(), lambda leaf: given[self._key(leaf)])
        return dict(zip([*self.rates, *(f"out.{n}" for n in self.releases)], found, strict=True))

    def _key(self, leaf: Expression) -> str:
        """Under which name `evaluate` is given a value."""
        kind, _, own = leaf.name.partition(".")
        return leaf.name if kind == "p" and own in self.species else text(leaf)

    def _keys(self) -> dict[str, None]:
        """The names of all that the rates read, in order."""
        return dict.fromkeys(self._key(e) for e in walk(self._all()) if e.op == NAME)

    def _values(self, values: Mapping[str, Any]) -> dict[str, Tensor]:
        """Values by name as tensors of one shape. Raises InputError for what is none, or for a name
        that is lacking or not known."""
        names, given = self._keys(), {}
        known = (*names, *self.species, *self.parameters)
        for name, value in values.items():
            if name not in known and not name.startswith((OUTSIDE, "cell.", "p.")):
                raise checks.InputError(unknown(f"values have {name!r}", name, list(names)))
            try:
                given[name] = torch.as_tensor(by_position(value), dtype=torch.float64)
            except (TypeError, ValueError, RuntimeError) as error:
                raise checks.input_error(f"values[{name!r}]", value, "numbers") from error
        for name in names:
            if name not in given:
                raise checks.InputError(unknown(f"values lack {name!r}", name, list(given)))
        try:
            torch.broadcast_shapes(*(x.shape for x in given.values()))
        except RuntimeError as error:
            shapes = ", ".join(f"{n} {tuple(x.shape)}" for n, x in given.items())
            raise checks.input_error("values", shapes, "of one shape, or single numbers") from error
        return given

    @property
    def conserved(self) -> list[dict[str, int]]:
        """Sums of amounts that never change, as numbers by species and "out.name": found at random
        values of all names between 0.2 and 2, and checked at others over eight decades. Where rates
        are not finite at any of them, no sum is found."""
        rows = [*self.rates, *(f"out.{n}" for n in self.releases)]
        near, far = self.at_random(0, 0.2, 2.0), self.at_random(1, 1e-4, 1e4)
        check = np.concatenate([self.at_random(2, 0.2, 2.0), far])
        still = [{n: 1} for n in self.species if n not in self.rates]
        found = []
        for weights in null_space(near if len(near) else far):
            parts = check * np.array(weights)
            # relative to what cancels, so that slow reactions count beside fast ones
            if len(parts) and (np.abs(parts.sum(1)) <= 1e-12 * np.abs(parts).max(1)).all():
                found.append({n: w for n, w in zip(rows, weights, strict=True) if w})
        return still + found

    def at_random(self, seed: int, low: float, high: float, known: Mapping = {}) -> np.ndarray:
        """Rates of amounts in a cell of volume 1 at PLACES random places, values but those `known`
        from low to high, even by their logarithms; (K, rows), of places where all are finite."""
        rng = np.random.default_rng(seed)
        draw = lambda: np.exp(rng.uniform(np.log(low), np.log(high), PLACES))
        values = {n: draw() for n in self._keys()} | {"cell.volume": np.ones(PLACES), **known}
        found = self.evaluate(values).values()
        columns = [np.broadcast_to(x.numpy(), (PLACES,)) for x in found]
        rates = np.stack(columns, 1) if columns else np.zeros((PLACES, 0))
        return rates[np.isfinite(rates).all(1)]


def evaluated(
    roots: Sequence[Expression], leaf: Callable[[Expression], Tensor], device: Any = "cpu"
) -> list[Tensor]:
    """Expressions as tensors on a device, each part once, by the functions of circuits."""
    made: dict[Expression, Any] = {}
    with deterministic_functions():
        for node in walk(roots):
            if node.op == NUMBER:
                made[node] = node.value
            elif node.op == NAME:
                made[node] = leaf(node)
            else:
                found = OPERATIONS[node.op](*_given(node.op, [made[a] for a in node.args]))
                made[node] = found.to(device) if node.op in FULL else found
    return [
        torch.as_tensor(made[r], dtype=None if isinstance(made[r], Tensor) else F64) for r in roots
    ]


def _given(op: str, args: list[Any]) -> list[Any]:
    """Arguments with numbers as tensors of the type that torch would give them; laws and powers
    take numbers as they are."""
    if op in ("add", "sub", "mul", "neg"):  # a slope of what is switched may be a switch
        args = [
            a.to(torch.get_default_dtype())
            if isinstance(a, Tensor) and a.dtype == torch.bool
            else a
            for a in args
        ]
    tensors = [a for a in (args[1:] if op == "where" else args) if isinstance(a, Tensor)]
    if len(tensors) == len(args) or (op in LAWS and tensors):
        return args
    whole = op in LOGICAL and not any(a.is_floating_point() for a in tensors)
    bare = not tensors and op != "where"
    dtype = F64 if whole or bare else common_type([(a.dtype, min(a.dim(), 1)) for a in tensors])
    return [a if isinstance(a, Tensor) else torch.tensor(a, dtype=dtype) for a in args]


OPERATIONS: dict[str, Callable[..., Tensor]] = {
    **{
        name: getattr(torch, name)
        for name in [
            "add",
            "sub",
            "mul",
            "div",
            "neg",
            "abs",
            "exp",
            "expm1",
            "log",
            "log1p",
            "log2",
            "log10",
            "sqrt",
            "sin",
            "cos",
            "tan",
            "tanh",
            "atan",
            "floor",
            "sign",
            "where",
            "minimum",
            "maximum",
            "remainder",
            "gt",
            "ge",
            "lt",
            "le",
            "eq",
            "ne",
        ]
    },
    **LAWS,
    "and": torch.logical_and,
    "or": torch.logical_or,
    "not": torch.logical_not,
    "detach": Tensor.detach,
    "cast32": Tensor.float,
    "cast64": Tensor.double,
    "full32": lambda x: x.float().reshape(1),
    "full64": lambda x: x.double().reshape(1),
}


def null_space(rates: np.ndarray) -> list[list[int]]:
    """Whole numbers w with rates @ w = 0, a basis: (K, n) -> vectors of n."""
    if rates.size == 0:
        return []
    scale = np.abs(rates).max(0)
    scale[scale == 0] = 1.0
    _, size, rows = np.linalg.svd(rates / scale, full_matrices=True)
    basis = rows[int((size > 1e-12).sum()) :].copy()
    done: list[int] = []  # reduced echelon form: one basis, whichever was found
    for column in range(basis.shape[1]):
        k = len(done)
        if k == len(basis):
            break
        best = k + int(np.abs(basis[k:, column]).argmax())
        if abs(basis[best, column]) < 1e-8:
            continue
        basis[[k, best]] = basis[[best, k]]
        basis[k] /= basis[k, column]
        for other in range(len(basis)):
            if other != k:
                basis[other] -= basis[other, column] * basis[k]
        done.append(column)
    # rounding, which the scale of a slow species would make large
    basis = np.where(np.abs(basis) < 1e-9, 0.0, basis) * (scale[done].reshape(-1, 1) / scale)
    found = []
    for row in basis:
        shares = [Fraction(float(x)).limit_denominator(1000) for x in row]
        least = np.lcm.reduce([s.denominator for s in shares])
        whole = [int(s * int(least)) for s in shares]
        common = np.gcd.reduce(whole)
        sign = -1 if sum(whole) < 0 else 1
        found.append([sign * w // max(int(common), 1) for w in whole])
    return found


def graph_of(
    part: Any, species: Sequence[str], parameters: Sequence[str], label: str, note: str = ""
) -> CircuitGraph:
    """The graph of a rate function, or of a list of reactions, that nobody has bound: any signal
    and any property of a cell may be read. Raises Untraceable."""
    builder = Builder()
    if not callable(part) and not isinstance(part, Network):
        part = build_network(part, species, _signals_in(part))
    any_name = lambda name: (torch.float64, 1)
    among = lambda names: lambda name: (torch.float64, 1) if name in names else None
    own = (
        Leaves("u", "u", builder, among(species), species),
        Leaves("s", "s", builder, any_name, ()),
        Leaves("p", "p", builder, among(parameters), parameters),
        Leaves("cell", "cell", builder, any_name, ()),
    )
    try:
        inside, outside = traced_rates(part, own, species)
    except UnknownName as error:
        raise UnknownName(f"{label}: {error}") from error

    def as_expression(name: str, x: Any) -> Expression:
        if type(x) is Column:
            return x.expression
        try:
            return builder.number(float(x))
        except (TypeError, ValueError) as error:
            what = f"{label}: the rate of {name!r}"
            raise checks.input_error(what, x, "a column or a number") from error

    of_names = lambda found: {n: as_expression(n, x) for n, x in found.items()}
    for found in (inside, outside):
        check_returned(found, label)
    for name in inside:
        if name not in species:
            what = f"{label} returned a rate for {name!r}, which is no species"
            raise checks.InputError(unknown(what, name, list(species)))
    made = of_names(inside)
    ordered = {n: made[n] for n in species if n in made}
    names = tuple(species), tuple(parameters)
    return CircuitGraph(*names, ordered, of_names(outside), builder, note)


def _signals_in(reactions: Any) -> tuple[str, ...]:
    """The signals that reactions name, in order."""
    found: dict[str, None] = {}
    stack = list(reversed(list(reactions)))
    while stack:
        entry = stack.pop()
        if isinstance(entry, (list, tuple)):
            stack += reversed(entry)
            continue
        names = (*entry.consumes, *entry.produces, *getattr(entry.rate, "reads", ()))
        found |= {n.removeprefix(OUTSIDE): None for n in names if n.startswith(OUTSIDE)}
    return tuple(found)

"""Circuits by compiled functions: traced once, then run cell by cell without torch."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.emission import Functions, RateExpressions, as_tuple
from torchfilm.circuits.expressions import NAME, NUMBER, Builder, Expression, walk
from torchfilm.circuits.graph import Leaves, traced_rates
from torchfilm.circuits.names import Names
from torchfilm.circuits.stiff_text import HEAD
from torchfilm.circuits.tracing import FULL, Column, Kind, Untraceable, apply, lowered
from torchfilm.tools import checks
from torchfilm.tools.threads import Shared

if TYPE_CHECKING:
    from torchfilm.circuits.run import CircuitCells

_compiled: set[str] = set()  # modules that this process has run


@dataclass(frozen=True, eq=False)
class Compiled:
    """Equations of a circuit in cells of one type, and the functions compiled from them."""

    equations: RateExpressions
    literals: Mapping[str, float]  # numbers in the rates, by the names that stand for them
    columns: tuple[str, ...]  # names that have a number for each cell
    numbers: tuple[str, ...]  # names that have one number
    label: str = field(default="", kw_only=True)  # of the circuit, for people

    how: ClassVar[str] = ""  # it is computed, in words that follow its name

    @property
    def text(self) -> str:
        """Of the module."""
        raise NotImplementedError

    @cached_property
    def module(self) -> ModuleType:
        return _module(self.text)

    def __deepcopy__(self, _: object) -> Compiled:
        """Itself: it never changes, and a module cannot be copied."""
        return self

    @property
    def free(self) -> int:
        """How many variables, the last ones, are sums that may be below 0."""
        return sum(n.startswith("own.") for n in self.equations.variables)

    def leaves(self) -> str:
        """The text of what `prepared` is given for the cell n."""
        return values_text(self.equations.leaves, self.columns, self.numbers)

    def head(self, constants: Mapping[str, object]) -> str:
        """The text with which the module begins. constants: by value: the text then says all that
        it depends on, and finds its compiled form."""
        names = ", ".join(self.equations.variables)
        listed = "\n".join(f"{n} = {x!r}" for n, x in constants.items())
        return HEAD.format(what=f"A circuit of {names}", constants=listed)

    @cached_property
    def _shared(self) -> Shared:
        return Shared()

    def run(self, count: int, work: Callable[[int, int], object]) -> None:
        """work(first, last) for all cells, in threads where each has enough to do."""
        self.compile(work)
        self._shared(count, work)

    def compile(self, work: Callable[[int, int], object]) -> None:
        """Before the first work(first, last), do it once without cells: it is compiled by one
        thread; and that is said where it takes time."""
        name = self.module.__name__
        if name not in _compiled:
            from torchfilm.kernels.compiling import first_call

            with first_call(name, self._described()):
                work(0, 0)
            _compiled.add(name)

    def _described(self) -> str:
        """What is compiled, for people: each name once."""
        read = (*self.equations.variables, *self.columns)
        named = lambda home, names: ", ".join(
            dict.fromkeys(n.partition(".")[2] for n in names if n.startswith(f"{home}."))
        )
        parts = {
            "species": named("u", read),
            "signals": named("s", read),
            "constants with a value for each cell": named("p", self.columns),
        }
        listed = "".join(f"; {what} {names}" for what, names in parts.items() if names)
        return f"the circuit {self.label}{self.how}{listed}; some seconds"

    @cached_property
    def constants(self) -> dict[str, Tensor]:
        """The literals by the names that `own` has for them, ()."""
        each = {n.partition(".")[2]: x for n, x in self.literals.items()}
        return {n: torch.tensor(x, dtype=torch.float64) for n, x in each.items()}

    @cached_property
    def _homes(self) -> list[tuple[str, ...]]:
        return [(n, *n.split(".", 1)) for n in (*self.columns, *self.numbers)]

    def sources(self, circuit: CircuitCells, own: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
        """The columns (N,) over all cells and the numbers () of the names that are no variables.
        own: those that no rate function reads."""
        homes: dict[str, Any] = {"s": circuit.signals, "p": circuit.p, "cell": circuit.cell}
        homes["own"] = {**own, **self.constants}
        return {name: torch.as_tensor(homes[kind][inner]) for name, kind, inner in self._homes}

    def values(
        self, circuit: CircuitCells, rows: Tensor, own: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """As `sources`, of the cells `rows` (M,) only, whose own columns are (M,)."""
        found = self.sources(circuit, own)
        all_cells = [n for n in found if not n.startswith("own.") and found[n].dim()]
        return found | {n: found[n].index_select(0, rows) for n in all_cells}

    def packed(self, values: Mapping[str, Tensor], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Columns (K, M) and numbers (L,) as compiled functions take them, float64."""
        return packed(values, self.columns, count), packed(values, self.numbers)


def packed(values: Mapping[str, Tensor], names: Sequence[str], *size: int) -> np.ndarray:
    """The values of these names, (names, *size) float64, where there are none of one."""
    wide = [values[n].detach().to(torch.float64) for n in names]
    return torch.stack(wide).numpy() if wide else np.zeros((1, *size))


def values_text(
    names: Sequence[str],
    columns: Sequence[str],
    numbers: Sequence[str],
    home: tuple[str, str] = ("columns", "numbers"),
) -> str:
    """The text of the values of these names in the cell n, as a tuple."""
    place = {n: f"{home[0]}[{k}, n]" for k, n in enumerate(columns)}
    place |= {n: f"{home[1]}[{k}]" for k, n in enumerate(numbers)}
    return as_tuple([place[n] for n in names])


def pools(circuit: CircuitCells, rows: Tensor) -> dict[str, Tensor]:
    """What the equations of an exchange read: the pool, and whether it is a reservoir, (M,); or how
    fast signals change."""
    found = {"pool": circuit.pool, "away": circuit.in_reservoir}
    found |= {f"ramp_{n}": x for n, (_, x) in (circuit.ramp or {}).items()}
    return {n: x.index_select(0, rows) for n, x in found.items() if x is not None}


class Trace:
    """A circuit in some cells, of which one is enough, called with columns that have no numbers."""

    def __init__(self, circuit: CircuitCells, variables: Sequence[str], dtype: torch.dtype):
        self.circuit, self.builder = circuit, Builder()
        self.variables = list(variables)
        self.kinds: dict[str, Kind | None] = {n: (dtype, 1) for n in variables}
        u, s, p, cell = circuit.names(torch.zeros(1, len(circuit.species)), circuit.rows[:1])
        homes = {"u": u, "s": s, "p": p, "cell": cell}
        #: u, s, p, cell
        self.names = tuple(
            Leaves(k, h._label, self.builder, partial(self._kind, k, h), list(h))
            for k, h in homes.items()
        )

    def _kind(self, prefix: str, home: Names, name: str) -> Kind | None:
        if f"{prefix}.{name}" not in self.kinds:
            if name not in home:
                return None
            value = torch.as_tensor(home[name])
            if value.dim() > 1:
                raise Untraceable(f"{prefix}.{name} has several numbers for each cell")
            self.kinds[f"{prefix}.{name}"] = (value.dtype, value.dim())
        return self.kinds[f"{prefix}.{name}"]

    def column(self, name: str, kind: Kind | None = None) -> Column:
        """The column of a name, of this kind if it is a new one."""
        if kind is not None:
            self.kinds[name] = kind
        found = self.kinds[name]
        assert found is not None
        return Column.of(self.builder.name(name), self.builder, *found)

    def called(self, function: Callable[[], Any]) -> Any:
        """What a function that calls the user's returns. Raises Untraceable."""
        try:
            return function()
        except (Untraceable, checks.InputError):
            raise
        except Exception as error:  # of a user's function, which has worked with numbers
            raise Untraceable(
                f"called with columns that have no numbers, it raised {error!r}"
            ) from error

    def spread(self, value: Any) -> Column:
        """A rate as a column, also one that is a number."""
        if type(value) is Column:
            return value
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            raise Untraceable("it returns a tensor that is made of no column")
        made = self.builder.make("full64", self.builder.number(value))
        return Column.of(made, self.builder, torch.float64)

    def simple(self, rates: Sequence[Column], dtype: torch.dtype) -> list[Column]:
        """The rates as simple operations, of this type."""
        kinds = {n: k for n, k in self.kinds.items() if k}
        columns = {self.builder.name(n): self.column(n) for n in kinds}
        simple = lowered([r.expression for r in rates], columns, self.builder)
        cast = "cast64" if dtype == torch.float64 else "cast32"
        return [x if x.dtype == dtype else apply(cast, x) for x in simple]

    def equations(
        self, rates: Sequence[Column]
    ) -> tuple[RateExpressions, dict[str, float], tuple[str, ...], tuple[str, ...]]:
        """As `Compiled` has them. Raises Untraceable where an operation has no compiled form."""
        literals, made = _without_literals([x.expression for x in rates], self.builder)
        kinds = self.kinds | dict.fromkeys(literals)
        read = {e.name for e in walk(made) if e.op == NAME} | set(self.variables)
        equations = RateExpressions(
            made, tuple(self.variables), {n: k for n, k in kinds.items() if n in read}, self.builder
        )
        Functions(equations).values()  # raises
        each = tuple(n for n in equations.leaves if (kinds[n] or (None, 0))[1] == 1)
        return equations, literals, each, tuple(n for n in equations.leaves if n not in each)


def rates_of(
    circuit: CircuitCells, dtype: torch.dtype
) -> tuple[RateExpressions, dict[str, float], tuple[str, ...], tuple[str, ...]]:
    """du/dt of all variables, as `CircuitCells.rates` has them, in a type. Raises Untraceable."""
    variables = [f"u.{n}" for n in circuit.species] + [f"s.{n}" for n in circuit.exchanged]
    trace = Trace(circuit, variables, dtype)
    inside, outside = trace.called(
        lambda: traced_rates(circuit.part, trace.names, circuit.species)  # type: ignore
    )
    rates = [trace.spread(inside.get(n, 0.0)) for n in circuit.species]
    flux = [trace.spread(outside.get(n, 0.0)) for n in circuit.exchanged]
    simple = trace.simple([*rates, *flux], dtype)
    final, given = simple[: len(rates)], simple[len(rates) :]
    if given:
        final += _exchange(given, circuit, trace)
        if circuit.sums_exchange:
            more = [f"own.released_{n}" for n in circuit.exchanged]
            trace.variables += more
            trace.kinds |= {n: (dtype, 1) for n in more}
    return trace.equations(final)


# Numbers that belong to the form of an equation.
PLAIN = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0)


def _is_plain(value: float) -> bool:
    return value in PLAIN or not np.isfinite(value)


def _without_literals(
    roots: Sequence[Expression], builder: Builder
) -> tuple[dict[str, float], tuple[Expression, ...]]:
    """The expressions with names in place of numbers, and the number of each name: so circuits that
    differ in numbers only are compiled once."""
    made: dict[Expression, Expression] = {}
    names: dict[str, float] = {}
    fixed = {a for node in walk(roots) if node.op in FULL for a in node.args}
    for node in walk(roots):
        if node.op == NUMBER and node not in fixed and not _is_plain(node.value):
            name = f"own.number{len(names)}"
            names[name] = node.value
            made[node] = builder.name(name)
        elif node.args:
            made[node] = builder.make(node.op, *(made[a] for a in node.args))
        else:
            made[node] = node
    return names, tuple(made[r] for r in roots)


def _exchange(flux: Sequence[Column], circuit: CircuitCells, trace: Trace) -> list[Column]:
    """Rates of the concentrations outside, and of what a reservoir, or the medium, is given, as
    `CircuitCells.rates` has them."""
    if circuit.ramp is not None:
        ramp = {n: (x.dtype, 1) for n, (_, x) in circuit.ramp.items()}
        changes = [trace.column(f"own.ramp_{n}", ramp[n]) for n in circuit.exchanged]
        return [*changes, *flux]
    assert circuit.pool is not None
    pool = trace.column("own.pool", (circuit.pool.dtype, 1))
    into = [apply("div", x, pool) for x in flux]
    if circuit.in_reservoir is None:
        return into
    away = trace.column("own.away", (torch.bool, 1))
    released = [apply("where", away, x, 0.0) for x in flux]
    return [*(apply("where", away, 0.0, x) for x in into), *released]


@cache
def _module(text: str) -> ModuleType:
    """The module of this text: from a file beside the compiled functions, so that they are found
    again; from memory where nothing can be written."""
    from torchfilm.kernels.compiling import FOLDER

    name = f"circuit_{hashlib.sha256(text.encode()).hexdigest()[:24]}"
    if FOLDER is None:
        module = ModuleType(name)
        exec(compile(text, name, "exec"), module.__dict__)
        return module
    file = FOLDER / f"{name}.py"
    if not file.exists() or file.read_text(encoding="utf-8") != text:
        draft = file.with_suffix(f".{os.getpid()}")
        draft.write_text(text, encoding="utf-8")
        draft.replace(file)
    spec = importlib.util.spec_from_file_location(f"torchfilm.kernels.{name}", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module

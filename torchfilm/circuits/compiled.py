"""Circuits by compiled functions: traced once, then run cell by cell without torch."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.emission import Equations, functions
from torchfilm.circuits.expressions import NAME, NUMBER, Builder, Expression, walk
from torchfilm.circuits.graph import Leaves, evaluated, traced_rates
from torchfilm.circuits.names import Names
from torchfilm.circuits.rosenbrock import MAX_STEPS, RosenbrockReport
from torchfilm.circuits.stiff_text import CONSTANTS, HEAD, method
from torchfilm.circuits.tracing import FULL, Column, Kind, Untraceable, apply, lowered
from torchfilm.tools import checks
from torchfilm.tools.threads import shares_of

if TYPE_CHECKING:
    from torchfilm.circuits.run import CircuitCells

# A thread takes this many cells at least.
WORTH_A_THREAD = 512


_compiled: set[str] = set()  # modules that this process has run


@dataclass(frozen=True, eq=False)
class CompiledCircuit:
    """The equations of a circuit in cells of one type, and the functions compiled from them."""

    equations: Equations
    literals: Mapping[str, float]  # numbers in the rates, by the names that stand for them
    slopes: Mapping[tuple[int, int], Expression]
    columns: tuple[str, ...]  # names that have a number for each cell
    numbers: tuple[str, ...]  # names that have one number

    @cached_property
    def module(self) -> ModuleType:
        return _module(source(self))

    def _compile(self, work: Callable[[int, int], object]) -> None:
        """By one thread, without cells; and say so where it takes time."""
        from torchfilm.kernels.compiling import announce, keep

        names = ", ".join(n.partition(".")[2] for n in self.equations.variables)
        said = announce(self.module.__name__, f"a circuit ({names}), some seconds")
        work(0, 0)
        _compiled.add(self.module.__name__)
        if said:
            keep(self.module.__name__)

    def values(self, circuit: CircuitCells, rows: Tensor) -> dict[str, Tensor]:
        """The columns (M,) and numbers () of the names that are no variables, of the cells `rows`
        (M,) among all."""
        _, s, p, cell = circuit.names(torch.empty(0, len(circuit.species)), rows)
        own = {"pool": circuit.pool, "away": circuit.in_reservoir}
        homes = {"s": s, "p": p, "cell": cell}

        def value(name: str) -> Tensor:
            if name in self.literals:
                return torch.tensor(self.literals[name], dtype=torch.float64)
            kind, _, inner = name.partition(".")
            if kind == "own":
                found = own[inner]
                assert found is not None
                return found.index_select(0, rows)
            return torch.as_tensor(homes[kind][inner])

        return {name: value(name) for name in self.equations.leaves}

    def slopes_by_torch(self, circuit: CircuitCells, u: Tensor, rows: Tensor) -> Tensor:
        """∂fᵢ/∂uₖ (V, V, M) at u (V, M) of the cells `rows` (M,) among all."""
        values = self.values(circuit, rows)
        values |= dict(zip(self.equations.variables, u, strict=True))
        found = evaluated(list(self.slopes.values()), lambda leaf: values[leaf.name])
        zero = torch.zeros_like(u[0])
        at = dict(zip(self.slopes, found, strict=True))
        count = u.shape[0]
        entry = lambda i, k: zero + at[i, k] if (i, k) in at else zero
        return torch.stack([torch.stack([entry(i, k) for k in range(count)]) for i in range(count)])

    def rodas3(
        self, circuit: CircuitCells, start: Tensor, dt: float, rtol: float, atol: float
    ) -> tuple[Tensor, RosenbrockReport] | None:  # fmt: skip
        """As `rosenbrock.rodas3`, of the cells `circuit.rows`; None where gradients are wanted, and
        over no time."""
        if dt == 0:
            return None
        values = self.values(circuit, circuit.rows)
        every = (start, *values.values())
        if torch.is_grad_enabled() and any(x.requires_grad for x in every):
            return None
        wide = lambda names: [values[n].detach().to(torch.float64) for n in names]
        count = start.shape[0]
        columns, numbers = wide(self.columns), wide(self.numbers)
        packed = torch.stack(columns).numpy() if columns else np.zeros((1, count))
        given = torch.stack(numbers).numpy() if numbers else np.zeros(1)
        # a copy, also of float64: the state must not change
        at = torch.empty(start.shape, dtype=torch.float64).copy_(start)
        report = torch.zeros(3, count, dtype=torch.int64)
        limits = torch.finfo(start.dtype)
        run, arrays = self.module.run, (at.numpy(), packed, given)
        rest = (dt, max(rtol, 4 * limits.eps), atol, limits.eps, limits.max, MAX_STEPS)
        counts = report.numpy()
        work = lambda first, last: run(first, last, *arrays, *rest, *counts)
        if self.module.__name__ not in _compiled:
            self._compile(work)
        shares_of(count, WORTH_A_THREAD, work)
        return at.to(start.dtype), RosenbrockReport(*report)


def compiled_circuit(circuit: CircuitCells) -> CompiledCircuit:
    """The circuit in these cells, of which one is enough. Raises Untraceable."""
    builder, one = Builder(), circuit.rows[:1]
    u, s, p, cell = circuit.names(torch.zeros(1, len(circuit.species)), one)
    variables = [f"u.{n}" for n in circuit.species] + [f"s.{n}" for n in circuit.given]
    kinds: dict[str, Kind | None] = {n: (torch.float64, 1) for n in variables}

    def kind_in(prefix: str, home: Names):
        def kind(name: str) -> Kind | None:
            if f"{prefix}.{name}" not in kinds:
                if name not in home:
                    return None
                value = torch.as_tensor(home[name])
                if value.requires_grad:
                    raise Untraceable(f"{prefix}.{name} requires a gradient")
                if value.dim() > 1:
                    raise Untraceable(f"{prefix}.{name} has several numbers for each cell")
                kinds[f"{prefix}.{name}"] = (value.dtype, value.dim())
            return kinds[f"{prefix}.{name}"]

        return kind

    homes = {"u": u, "s": s, "p": p, "cell": cell}
    leaves = [Leaves(k, h._label, builder, kind_in(k, h), list(h)) for k, h in homes.items()]
    try:
        inside, outside = traced_rates(circuit.part, tuple(leaves), circuit.species)  # type: ignore
    except (Untraceable, checks.InputError):
        raise
    except Exception as error:  # of a user's function, which has worked with numbers
        raise Untraceable(
            f"called with columns that have no numbers, it raised {error!r}"
        ) from error
    zero = _spread(0.0, builder)
    as_column = lambda x: x if type(x) is Column else _spread(x, builder)
    rates = [as_column(inside.get(n, zero)) for n in circuit.species]
    flux = [as_column(outside.get(n, zero)) for n in circuit.given]
    roots = [*rates, *flux]
    columns = {
        builder.name(n): Column.of(builder.name(n), builder, *k) for n, k in kinds.items() if k
    }
    simple = lowered([r.expression for r in roots], columns, builder)
    # a rate is of the variables' type
    wide = [x if x.dtype == torch.float64 else apply("cast64", x) for x in simple]
    final, given = wide[: len(rates)], wide[len(rates) :]
    if given:
        final += _exchange(given, circuit, builder, kinds)
        if circuit.in_reservoir is not None:
            variables += [f"own.{way}_{n}" for way in ("to", "from") for n in circuit.given]
            kinds |= {n: (torch.float64, 1) for n in variables}
    literals, made = _without_literals([x.expression for x in final], builder)
    kinds |= dict.fromkeys(literals)
    read = {e.name for e in walk(made) if e.op == NAME} | set(variables)
    equations = Equations(
        made, tuple(variables), {n: k for n, k in kinds.items() if n in read}, builder
    )
    functions(equations)  # raises where an operation has no compiled form
    each = [n for n in equations.leaves if (kinds[n] or (None, 0))[1] == 1]
    once = [n for n in equations.leaves if n not in each]
    return CompiledCircuit(equations, literals, equations.slopes(), tuple(each), tuple(once))


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


def _spread(value: Any, builder: Builder) -> Column:
    """A rate that is a number, as a column."""
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise Untraceable("it returns a tensor that is made of no column")
    made = builder.make("full64", builder.number(value))
    return Column.of(made, builder, torch.float64)


def _exchange(
    flux: Sequence[Column], circuit: CircuitCells, builder: Builder, kinds: dict[str, Kind | None]
) -> list[Column]:
    """Rates of the pools' concentrations, and of what a reservoir is given and gives, as
    `CircuitCells.rates` has them."""
    assert circuit.pool is not None
    kinds["own.pool"] = kind = (circuit.pool.dtype, 1)
    pool = Column.of(builder.name("own.pool"), builder, *kind)
    into = [apply("div", x, pool) for x in flux]
    if circuit.in_reservoir is None:
        return into
    kinds["own.away"] = kind = (torch.bool, 1)
    away = Column.of(builder.name("own.away"), builder, *kind)
    up = [apply("where", away, apply("maximum", x, 0.0), 0.0) for x in flux]
    down = [apply("where", away, apply("maximum", apply("neg", x), 0.0), 0.0) for x in flux]
    return [*(apply("where", away, 0.0, x) for x in into), *up, *down]


def source(circuit: CompiledCircuit) -> str:
    """The text of the module."""
    place = {n: f"columns[{k}, n]" for k, n in enumerate(circuit.columns)}
    place |= {n: f"numbers[{k}]" for k, n in enumerate(circuit.numbers)}
    leaves = [place[n] for n in circuit.equations.leaves] or ["0.0"]
    names = ", ".join(circuit.equations.variables)
    # constants by value: the text then says all that it depends on, and finds its compiled form
    constants = "\n".join(f"{n} = {x!r}" for n, x in CONSTANTS.items())
    head = HEAD.format(what=f"A circuit of {names}", constants=constants)
    size = len(circuit.equations.variables)
    return head + functions(circuit.equations) + method(size, f"({', '.join(leaves)},)")


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
    if not file.exists() or file.read_text() != text:
        draft = file.with_suffix(f".{os.getpid()}")
        draft.write_text(text)
        draft.replace(file)
    spec = importlib.util.spec_from_file_location(f"torchfilm.kernels.{name}", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module

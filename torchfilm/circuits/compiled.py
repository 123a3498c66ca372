"""Circuits by compiled functions: traced once, then run cell by cell without torch."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.emission import Equations, functions, tangent_functions
from torchfilm.circuits.expressions import NAME, NUMBER, Builder, Expression, walk
from torchfilm.circuits.graph import Leaves, evaluated, traced_rates
from torchfilm.circuits.names import Names
from torchfilm.circuits.rosenbrock import MAX_STEPS, RosenbrockReport
from torchfilm.circuits.stiff_text import CONSTANTS, HEAD, method
from torchfilm.circuits.tangent_text import tangent_method
from torchfilm.circuits.tracing import FULL, Column, Kind, Untraceable, apply, lowered
from torchfilm.tools import checks
from torchfilm.tools.tangents import both, has_tangent, with_tangent
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

    # by the columns and numbers that carry tangents
    _tangent_modules: dict[Any, ModuleType] = field(default_factory=dict, repr=False)

    @cached_property
    def module(self) -> ModuleType:
        return _module(source(self))

    def _compile(self, module: ModuleType, work: Callable[[int, int], object]) -> None:
        """By one thread, without cells; and say so where it takes time."""
        from torchfilm.kernels.compiling import announce, keep

        names = ", ".join(n.partition(".")[2] for n in self.equations.variables)
        said = announce(module.__name__, f"a circuit ({names}), some seconds")
        work(0, 0)
        _compiled.add(module.__name__)
        if said:
            keep(module.__name__)

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
        """As `rosenbrock.rodas3`, of the cells `circuit.rows`, with tangents in forward mode; None
        where a backward pass is wanted, and over no time."""
        if dt == 0:
            return None
        values = self.values(circuit, circuit.rows)
        every = (start, *values.values())
        if torch.is_grad_enabled() and any(x.requires_grad for x in every):
            return None
        moving = {n for n, x in values.items() if x.is_floating_point() and has_tangent(x)}
        if moving or has_tangent(start):
            return self._with_tangents(values, moving, start, (dt, rtol, atol))
        count = start.shape[0]
        # a copy, also of float64: the state must not change
        at = torch.empty(start.shape, dtype=torch.float64).copy_(start)
        report = torch.zeros(3, count, dtype=torch.int64)
        run, arrays = self.module.run, (
            at.numpy(), _packed(values, self.columns, count), _packed(values, self.numbers)
        )  # fmt: skip
        rest, counts = _limits(dt, rtol, atol, start.dtype), report.numpy()
        self._share(self.module, count, lambda a, b: run(a, b, *arrays, *rest, *counts))
        return at.to(start.dtype), RosenbrockReport(*report)

    def _with_tangents(
        self,
        values: Mapping[str, Tensor],
        moving: set[str],
        start: Tensor,
        settings: tuple[float, float, float],
    ) -> tuple[Tensor, RosenbrockReport]:
        """The same where the values `moving`, or the start, carry tangents."""
        columns, numbers = ([n for n in x if n in moving] for x in (self.columns, self.numbers))
        module = self._tangent_module(tuple(columns), tuple(numbers))
        count, (first, tangent) = start.shape[0], both(start)
        at = torch.empty(start.shape, dtype=torch.float64).copy_(first)
        turned = torch.zeros(start.shape, dtype=torch.float64)
        if tangent is not None:
            turned.copy_(tangent)
        still = {n: both(x)[0] for n, x in values.items()}
        turns = {n: both(values[n])[1] for n in moving}
        report = torch.zeros(3, count, dtype=torch.int64)
        arrays = (
            at.numpy(), turned.numpy(),
            _packed(still, self.columns, count), _packed(turns, columns, count),
            _packed(still, self.numbers), _packed(turns, numbers),
        )  # fmt: skip
        rest, counts = _limits(*settings, start.dtype), report.numpy()
        run = module.run_moved
        self._share(module, count, lambda a, b: run(a, b, *arrays, *rest, *counts))
        dtype = start.dtype
        return with_tangent(at.to(dtype), turned.to(dtype)), RosenbrockReport(*report)

    def _share(self, module: ModuleType, count: int, work: Callable[[int, int], object]) -> None:
        """The work by threads, a share of the cells each; compiled before, where it is not yet."""
        if module.__name__ not in _compiled:
            self._compile(module, work)
        shares_of(count, WORTH_A_THREAD, work)

    def _tangent_module(self, columns: tuple[str, ...], numbers: tuple[str, ...]) -> ModuleType:
        key = (columns, numbers)
        if key not in self._tangent_modules:
            self._tangent_modules[key] = _module(tangent_source(self, *key))
        return self._tangent_modules[key]


def _packed(values: Mapping[str, Tensor | None], names: Sequence[str], *size: int) -> np.ndarray:
    """The values of these names, (names, *size), of which there is one at least."""
    wide = [values[n].detach().to(torch.float64) for n in names]  # type: ignore[union-attr]
    return torch.stack(wide).numpy() if wide else np.zeros((1, *size))


def _limits(dt: float, rtol: float, atol: float, dtype: torch.dtype) -> tuple[float, ...]:
    limits = torch.finfo(dtype)
    return dt, max(rtol, 4 * limits.eps), atol, limits.eps, limits.max, MAX_STEPS


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
    leaves = _leaves(circuit.equations.leaves, circuit.columns, circuit.numbers)
    return _common(circuit) + method(len(circuit.equations.variables), leaves)


def tangent_source(
    circuit: CompiledCircuit, columns: tuple[str, ...], numbers: tuple[str, ...]
) -> str:
    """The text of the module that carries tangents, where these columns and numbers have them."""
    equations, size = circuit.equations, len(circuit.equations.variables)
    leaves = _leaves(equations.leaves, circuit.columns, circuit.numbers)
    moving = [n for n in equations.leaves if n in columns or n in numbers]
    turns = _leaves(moving, columns, numbers, "turning", "turned")
    return "".join((
        _common(circuit), tangent_functions(equations, moving), method(size, leaves),
        tangent_method(size, leaves, turns),
    ))  # fmt: skip


def _common(circuit: CompiledCircuit) -> str:
    names = ", ".join(circuit.equations.variables)
    # constants by value: the text then says all that it depends on, and finds its compiled form
    constants = "\n".join(f"{n} = {x!r}" for n, x in CONSTANTS.items())
    head = HEAD.format(what=f"A circuit of {names}", constants=constants)
    return head + functions(circuit.equations)


def _leaves(
    names: Sequence[str],
    columns: Sequence[str],
    numbers: Sequence[str],
    each: str = "columns",
    once: str = "numbers",
) -> str:
    """The text of a cell's values of these names, as a tuple."""
    place = {n: f"{each}[{k}, n]" for k, n in enumerate(columns)}
    place |= {n: f"{once}[{k}]" for k, n in enumerate(numbers)}
    return f"({', '.join([place[n] for n in names] or ['0.0'])},)"


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

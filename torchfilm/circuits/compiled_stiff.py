"""Circuits by the stiff method as compiled functions: the numbers of `circuits.rosenbrock`, cell by
cell without torch, and their derivatives, of both kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits import compiled_gradients
from torchfilm.circuits.compiled import Compiled, packed, pools, rates_of, values_text
from torchfilm.circuits.emission import functions, tangent_functions
from torchfilm.circuits.expressions import Expression
from torchfilm.circuits.graph import evaluated
from torchfilm.circuits.rosenbrock import MAX_STEPS, RosenbrockReport
from torchfilm.circuits.stiff_text import CONSTANTS, method, step
from torchfilm.circuits.tangent_text import tangent_method
from torchfilm.tools.tangents import both, has_tangent, only_forward, tracked, with_tangent

if TYPE_CHECKING:
    from torchfilm.circuits.run import CircuitCells


@dataclass(frozen=True, eq=False)
class CompiledStiff(Compiled):
    """The stiff method."""

    slopes: Mapping[tuple[int, int], Expression]
    # by what has a number for each cell, and by the columns and numbers that carry tangents
    _moved: dict[Any, CompiledTangents] = field(default_factory=dict, repr=False)

    @property
    def text(self) -> str:
        text, prepared = functions(self.equations)
        return (
            self.head(CONSTANTS)
            + text
            + method(len(self.equations.variables), self.free, prepared, self.leaves())
        )

    def slopes_by_torch(self, circuit: CircuitCells, u: Tensor, rows: Tensor) -> Tensor:
        """∂fᵢ/∂uₖ (V, V, M) at u (V, M) of the cells `rows` (M,) among all."""
        values = self.values(circuit, rows, pools(circuit, rows))
        values |= dict(zip(self.equations.variables, u, strict=True))
        found = evaluated(list(self.slopes.values()), lambda leaf: values[leaf.name], u.device)
        zero = torch.zeros_like(u[0])
        at = dict(zip(self.slopes, found, strict=True))
        count = u.shape[0]
        entry = lambda i, k: zero + at[i, k] if (i, k) in at else zero
        return torch.stack([torch.stack([entry(i, k) for k in range(count)]) for i in range(count)])

    def integrate(
        self, circuit: CircuitCells, start: Tensor, dt: float, rtol: float, atol: float
    ) -> tuple[Tensor, RosenbrockReport] | None:  # fmt: skip
        """As `rosenbrock.rodas3`, of the cells `circuit.rows`, with derivatives; None over no time,
        where both kinds are wanted at once, for gradients by too many numbers, and where
        derivatives of the rates are not those of their operations."""
        if dt == 0:
            return None
        values = self.values(circuit, circuit.rows, pools(circuit, circuit.rows))
        if not tracked(start, *values.values()):
            return self._rodas3(values, start, dt, rtol, atol)
        if self.equations.builder.own_derivative:
            return None
        if only_forward(start, *values.values()):
            moving = {n for n, x in values.items() if has_tangent(x)}
            some = lambda names: tuple(n for n in names if n in moving)
            made = self._tangents(self.columns, some(self.columns), some(self.numbers))
            return made.rodas3(values, start, dt, rtol, atol)
        wanted = compiled_gradients.moving(self.columns, values)
        directions = len(self.equations.variables) + len(wanted)
        if has_tangent(start, *values.values()) or directions > compiled_gradients.MOST_DIRECTIONS:
            return None
        columns = tuple(dict.fromkeys((*self.columns, *wanted)))
        made = self._tangents(columns, wanted, ())
        return compiled_gradients.rodas3(made, values, start, (dt, rtol, atol))

    def _tangents(
        self, columns: Sequence[str], moving: Sequence[str], moving_numbers: Sequence[str]
    ) -> CompiledTangents:
        """The method with tangents of these, where these names have a number for each cell."""
        key = tuple(columns), tuple(moving), tuple(moving_numbers)
        if key not in self._moved:
            numbers = tuple(n for n in self.numbers if n not in columns)
            self._moved[key] = CompiledTangents(
                self.equations, self.literals, key[0], numbers, *key[1:], label=self.label
            )
        return self._moved[key]

    def _rodas3(
        self, values: Mapping[str, Tensor], start: Tensor, dt: float, rtol: float, atol: float
    ) -> tuple[Tensor, RosenbrockReport]:
        count, run = start.shape[0], self.module.run
        at = torch.empty(start.shape, dtype=torch.float64).copy_(start)
        report = torch.zeros(3, count, dtype=torch.int64)
        rest = *limits(dt, rtol, atol, start.dtype), *report.numpy()
        given = at.numpy(), *self.packed(values, count), *rest
        self.run(count, lambda first, last: run(first, last, *given))
        return at.to(start.dtype), RosenbrockReport(*report)


@dataclass(frozen=True, eq=False)
class CompiledTangents(Compiled):
    """The stiff method with tangents, where some columns and numbers carry them."""

    moving: tuple[str, ...]
    moving_numbers: tuple[str, ...]

    how = " with derivatives"

    @cached_property
    def text(self) -> str:
        equations, (text, prepared) = self.equations, functions(self.equations)
        names = [n for n in equations.leaves if n in (*self.moving, *self.moving_numbers)]
        turns = values_text(names, self.moving, self.moving_numbers, ("turning", "turned"))
        size, leaves = len(equations.variables), self.leaves()
        fixed = {"c": prepared, "leaf": len(equations.leaves), "turn": len(names)}
        return "".join((
            self.head(CONSTANTS), text, tangent_functions(equations, names),
            step(size, self.free), tangent_method(size, self.free, fixed, leaves, turns),
        ))  # fmt: skip

    def rodas3(
        self, values: Mapping[str, Tensor], start: Tensor, dt: float, rtol: float, atol: float
    ) -> tuple[Tensor, RosenbrockReport]:
        count, dtype, (first, tangent) = start.shape[0], start.dtype, both(start)
        at = torch.empty(start.shape, dtype=torch.float64).copy_(first)
        moved = torch.zeros(start.shape, dtype=torch.float64)
        if tangent is not None:
            moved.copy_(tangent)
        still, turns = {}, {}
        for name, value in values.items():
            still[name], turn = both(value)
            if turn is not None:
                turns[name] = turn
        columns, numbers = self.packed(still, count)
        report = torch.zeros(3, count, dtype=torch.int64)
        of_cells = at, moved, columns, packed(turns, self.moving, count)
        of_all = numbers, packed(turns, self.moving_numbers)
        self.run_steps(of_cells, of_all, (dt, rtol, atol), dtype, report)
        return with_tangent(at.to(dtype), moved.to(dtype)), RosenbrockReport(*report)

    def run_steps(
        self, of_cells: tuple[Tensor, Tensor, np.ndarray, np.ndarray],
        of_all: tuple[np.ndarray, np.ndarray], settings: tuple[float, float, float],
        dtype: torch.dtype, report: Tensor,
    ) -> None:  # fmt: skip
        """The steps of M cells, in place. of_cells: variables and their tangents (M, V), columns
        (K, M) and theirs (Q, M). of_all: numbers (L,) and their tangents. settings: dt, rtol, atol.
        report: (3, M)."""
        at, moved, columns, turning = of_cells
        numbers, turned = of_all
        arrays = at.numpy(), moved.numpy(), columns, turning, numbers, turned
        rest = *limits(*settings, dtype), *report.numpy()
        run = self.module.run_moved
        self.run(len(at), lambda first, last: run(first, last, *arrays, *rest))


@lru_cache(64)
def limits(dt: float, rtol: float, atol: float, dtype: torch.dtype) -> tuple[float, ...]:
    """What `run` is told of the step's length and tolerances."""
    limits = torch.finfo(dtype)
    return dt, max(rtol, 4 * limits.eps), atol, limits.eps, limits.max, MAX_STEPS


def compiled_stiff(circuit: CircuitCells) -> CompiledStiff:
    """The circuit in these cells, of which one is enough. Raises Untraceable."""
    found = rates_of(circuit, torch.float64)
    functions(found[0])  # raises where a derivative has no compiled form
    return CompiledStiff(*found, slopes=found[0].slopes(), label=circuit.label)

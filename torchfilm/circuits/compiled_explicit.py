"""Circuits by the methods with equal steps as compiled functions: the numbers of
`circuits.integrators`, cell by cell without torch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.circuits.compiled import Compiled, pools, rates_of
from torchfilm.circuits.emission import Functions
from torchfilm.circuits.explicit_text import method
from torchfilm.circuits.integrators import lengths
from torchfilm.tools.tangents import tracked

if TYPE_CHECKING:
    from torchfilm.circuits.run import CircuitCells


@dataclass(frozen=True, eq=False)
class CompiledExplicit(Compiled):
    """A method with equal steps, in numbers of a type."""

    method: str
    dtype: torch.dtype

    @cached_property
    def text(self) -> str:
        size, dtype = len(self.equations.variables), str(self.dtype).removeprefix("torch.")
        made = Functions(self.equations).values(self.dtype)
        return self.head({}) + made + method(self.method, size, dtype, self.leaves())

    def integrate(
        self, circuit: CircuitCells, start: Tensor, dt: float, steps: int
    ) -> Tensor | None:
        """As `integrators`, of the cells `circuit.rows`; None where derivatives are wanted, or
        over no time."""
        if dt == 0:
            return None
        values = self.values(circuit, circuit.rows, pools(circuit, circuit.rows))
        if tracked(start, *values.values()):
            return None
        # a copy: the state must not change
        at = torch.empty(start.shape, dtype=self.dtype).copy_(start)
        count, run = start.shape[0], self.module.run
        given = (at.numpy(), *self.packed(values, count), lengths(dt, steps, self.method).numpy())
        self.run(count, lambda first, last: run(first, last, *given))
        return at


def compiled_explicit(circuit: CircuitCells, name: str, dtype: torch.dtype) -> CompiledExplicit:
    """The circuit in these cells, of which one is enough. Raises Untraceable."""
    return CompiledExplicit(
        *rates_of(circuit, dtype), method=name, dtype=dtype, label=circuit.label
    )

"""Circuits molecule by molecule by compiled functions: the draws and the molecules of
`circuits.stochastic`, some cells side by side, without torch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled import Compiled, Trace
from torchfilm.circuits.draws import KeyedDraws
from torchfilm.circuits.emission import Functions
from torchfilm.circuits.molecules_text import CONSTANTS, IMPORTS, method
from torchfilm.circuits.network import Network
from torchfilm.circuits.stochastic import (
    MAX_LEAP_HALVINGS,
    MOST_EVENTS,
    MOST_LEAPS,
    TOO_MANY_EVENTS,
    StochasticReport,
)
from torchfilm.tools.random import MASK

if TYPE_CHECKING:
    from torchfilm.circuits.run import CircuitCells


@dataclass(frozen=True, eq=False)
class CompiledMolecules(Compiled):
    """A list of reactions; the equations give the propensities, at molecule numbers."""

    network: Network

    how = " molecule by molecule"

    @cached_property
    def text(self) -> str:
        made = Functions(self.equations)
        steps = method(self.network, made, self.leaves())
        return self.head(CONSTANTS) + IMPORTS + made.values() + steps

    def advance(
        self,
        circuit: CircuitCells,
        counts: Tensor,
        own: dict[str, Tensor],
        dt: float,
        draw: KeyedDraws,
        leaps: bool,
    ) -> tuple[Tensor, StochasticReport]:
        """As `stochastic.tau_leap`, or without leaps `stochastic.direct`: molecule numbers (M, S)
        of the cells `circuit.rows`. own: (M,) or (), `pool` and `molecules_per_unit`."""
        count = counts.shape[0]
        at = counts.detach().to(torch.float64).contiguous().clone()
        values = self.values(circuit, circuit.rows, own)
        steps, status, wrong = torch.zeros(3, count, dtype=torch.int64)
        status += TOO_MANY_EVENTS
        wrong -= 1
        run, most = self.module.run, MOST_LEAPS if leaps else MOST_EVENTS
        arrays = [at, *self.packed(values, count), draw.uid, draw.stream]
        given = [x.contiguous().numpy() if isinstance(x, Tensor) else x for x in arrays]
        rest = (keys_of(draw), self._codes(draw), float(dt), most, leaps)
        report = [x.numpy() for x in (steps, status, wrong)]
        work = lambda first, last: run(first, last, *given, *rest, *report)
        self.run(count, work)
        return at.to(counts.dtype), StochasticReport(steps, status, wrong)

    def _codes(self, draw: KeyedDraws) -> np.ndarray:
        """Of a single event, of critical reactions, and of each pair of reactions in a leap that
        was halved so many times."""
        pairs = (len(self.network.reactions) + 1) // 2
        codes = [*draw.codes("single", 1), *draw.codes("rare", 1)]
        for trial in range(MAX_LEAP_HALVINGS):
            codes += draw.codes(f"leap {trial}", pairs)
        return np.array(codes, np.uint64)


def keys_of(draw: KeyedDraws) -> np.ndarray:
    """The step, and the lower and upper half of the seed, as words of 32 bits."""
    words = (draw.step, draw.seed, draw.seed >> 32)
    return np.array([x & MASK for x in words], np.uint64)


def compiled_molecules(circuit: CircuitCells, molecules_per_unit: Tensor) -> CompiledMolecules:
    """The reactions in these cells, of which one is enough. molecules_per_unit: () or, in float64,
    (M,). Raises Untraceable."""
    network = circuit.part
    assert isinstance(network, Network)
    trace = Trace(circuit, [f"u.{n}" for n in network.names], torch.float64)
    kind = (molecules_per_unit.dtype, molecules_per_unit.dim())
    each = trace.column("own.molecules_per_unit", kind)
    pool = [trace.column("own.pool", (torch.float64, 1))] * len(network.signals)
    counts = [trace.column(n) for n in trace.variables]
    _, _, p, cell = trace.names
    found = trace.called(
        lambda: network.propensity_columns(counts, p, cell, molecules_per_unit=each, pools=pool)
    )
    rates = trace.simple([trace.spread(x) for x in found], torch.float64)
    return CompiledMolecules(*trace.equations(rates), network=network, label=circuit.label)

"""The steps of a bound circuit that kernels take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled_step import Changes, KernelStep, Surroundings, known
from torchfilm.circuits.compiled_stiff import CompiledStiff
from torchfilm.circuits.dilution import Start
from torchfilm.effects.circuit_cells import Kind, cell_column
from torchfilm.effects.circuit_report import Failures
from torchfilm.medium_exchange import MediumExchange
from torchfilm.state import State
from torchfilm.tools import checks

if TYPE_CHECKING:
    from torchfilm.effects.bound_circuit import BoundCircuit

# By cell type, the step that kernels take, and what it reads in a state.
Taken = Mapping[Kind, tuple[KernelStep, Mapping[str, Tensor]]]


class CircuitKernels:
    """The steps of a circuit by kernels, each made when there are first cells of its type."""

    def __init__(self, circuit: BoundCircuit):
        self.circuit = circuit
        # by cell type and whether there is a reservoir; None where torch takes it
        self._steps: dict[tuple[Kind, bool], KernelStep | None] = {}

    def taken(
        self, middle: State, rows: Mapping[Kind, Tensor], medium: MediumExchange | None,
        start: Start,
    ) -> Taken:  # fmt: skip
        """The steps of these cells, by type, that kernels take. middle: the state half way."""
        found = {}
        for kind, of_type in rows.items():
            step = self._step(kind, middle, of_type, medium)
            if step is None:
                continue
            if step.colonies and (highest := int(middle.colony_id.max())) >= step.colonies:
                raise checks.input_error(
                    "state.colony_id",
                    highest,
                    f"below {step.colonies}",
                    f"{self.circuit.effect.value_owner()} has values for so many colonies.",
                )
            read = {n: known(self._read(n, kind, middle, medium)) for n in step.changing}
            signals = () if medium is None else (medium.found[n] for n in step.exchanged)
            if step.may_run(start, *read.values(), *signals):
                found[kind] = step, read
        return found

    def run(
        self, taken: Taken, middle: State, rows: Mapping[Kind, Tensor],
        medium: MediumExchange | None, start: Start, report: Failures,
    ) -> dict[str, Tensor]:  # fmt: skip
        """The species of all cells, (N,), after these steps; in cells of others after growth alone.
        The medium is told what they give to it, and the report of failures."""
        effect = self.circuit.effect
        whole = sum(rows[k].numel() for k in taken) == middle.cells
        names = tuple(dict.fromkeys(n for step, _ in taken.values() for n in step.exchanged))
        pool, found = (None, {}) if medium is None else (medium.pool, medium.found)
        around = Surroundings(found, pool, middle.own_colony_id)
        into = Changes.of(start, names, _has_reservoir(medium), whole)
        for kind, (step, read) in taken.items():
            settings = report.dt, effect.rtol, effect.atol
            code = step(rows[kind], start, read, around, *settings, into)
            if np.count_nonzero(code):
                cells = self.circuit.cells(middle, rows[kind], kind, medium=medium)
                report.note(start, cells, torch.from_numpy(code))
        report.steps = torch.from_numpy(into.steps)
        given, back = torch.from_numpy(into.given), torch.from_numpy(into.back)
        for k, name in enumerate(names):
            assert medium is not None
            medium.give(name, given[k], back[k] if len(back) else None)
        return dict(zip(start.fields, torch.from_numpy(into.species).unbind(), strict=True))

    def _step(
        self, kind: Kind, middle: State, rows: Tensor, medium: MediumExchange | None
    ) -> KernelStep | None:
        key = kind, _has_reservoir(medium)
        if key not in self._steps:
            circuit, step = self.circuit, None
            cells = circuit.cells(middle, rows, kind, medium=medium)
            if isinstance(cells.compiled, CompiledStiff) and not cells.by_torch:
                values, own = circuit.values, None if isinstance(kind, str) else kind
                found = {f"p.{n}": values[n].constant(own) for n in circuit.effect.parameters}
                constants = {n: x for n, x in found.items() if x is not None}
                step = KernelStep(cells.compiled, cells.exchanged, constants)
            self._steps[key] = step
        return self._steps[key]

    def _read(self, name: str, kind: Kind, middle: State, medium: MediumExchange | None) -> Tensor:
        """What a name of a compiled circuit stands for: a column (N,), or one number ()."""
        home, _, name = name.partition(".")
        if home == "cell":
            return cell_column(middle, name)
        if home == "p":
            own = None if isinstance(kind, str) else kind
            return self.circuit.values[name].of_cells(middle, own)
        assert medium is not None
        if home == "s":
            return medium.found[name]
        found = medium.pool if name == "pool" else medium.in_reservoir
        assert found is not None
        return found


def _has_reservoir(medium: MediumExchange | None) -> bool:
    return medium is not None and medium.in_reservoir is not None

"""The steps of a bound circuit that kernels take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled_step import Changes, KernelStep, Surroundings, known
from torchfilm.circuits.compiled_stiff import CompiledStiff
from torchfilm.effects.circuit_cells import Kind, cell_column
from torchfilm.effects.circuit_report import Failures
from torchfilm.medium_exchange import Around, MediumExchange, Ramped, form_of
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.threads import Course

if TYPE_CHECKING:
    from torchfilm.effects.bound_circuit import BoundCircuit

# By cell type, the step that kernels take, and what it reads in a state.
Taken = Mapping[Kind, tuple[KernelStep, Mapping[str, Tensor]]]


class PreparedStep:
    """Steps of a circuit by kernels, ready to be run, also again and again.

    released: what cells gave to the signals `names` in the last run, to reservoirs or where
    transport is solved together with them, (E, N).
    """

    def __init__(
        self, circuit: BoundCircuit, taken: Taken, middle: State, rows: Mapping[Kind, Tensor],
        medium: Around | None, around: Surroundings, report: Failures,
    ):  # fmt: skip
        self.circuit, self.middle, self.rows = circuit, middle, rows
        self.medium, self.start, self.report = medium, around.start, report
        # of these kernels only know the addresses
        self._read = taken, around
        effect, start = circuit.effect, around.start
        whole = sum(rows[k].numel() for k in taken) == middle.cells
        self.names = tuple(dict.fromkeys(n for step, _ in taken.values() for n in step.exchanged))
        into = self._into = Changes.of(start, self.names, form_of(medium) != "pool", whole)
        self.released, self._codes = into.back, {}
        self._loops = [] if medium is None else medium.take_loops()
        for kind, (step, read) in taken.items():
            settings = report.dt, effect.rtol, effect.atol
            loop, self._codes[kind] = step.loop(rows[kind], read, around, *settings, into)
            self._loops.append(loop)
        self._given = dict(zip(self.names, into.given, strict=True))
        self._at_once = medium is not None and medium.in_loops and len(taken) == len(rows)
        if self._at_once and isinstance(medium, MediumExchange):  # nobody else gives anything
            self._loops += medium.write_in_loops(self._given)

    def run(self, course: Course) -> None:
        """Take the steps."""
        course(self._loops, self.middle.groups.ends)

    def finished(self) -> dict[str, Tensor]:
        """The species of all cells after the last run, (N,); the medium and the report are told."""
        into, medium = self._into, self.medium
        for kind, code in self._codes.items():
            if np.count_nonzero(code):
                cells = self.circuit.cells(self.middle, self.rows[kind], kind, medium=medium)
                self.report.note(self.start, cells, torch.from_numpy(code))
        self.report.steps = torch.from_numpy(into.steps)
        for k, name in enumerate(() if self._at_once else self.names):
            assert medium is not None
            back = torch.from_numpy(into.back[k]) if len(into.back) else None
            medium.give(name, torch.from_numpy(self._given[name]), back)
        return dict(zip(self.start.fields, torch.from_numpy(into.species).unbind(), strict=True))


class CircuitKernels:
    """The steps of a circuit by kernels, each made when there are first cells of its type."""

    def __init__(self, circuit: BoundCircuit):
        self.circuit = circuit
        # by cell type and form of exchange; None where torch takes it
        self._steps: dict[tuple[Kind, str], KernelStep | None] = {}
        self._course, self.again = Course(), Course()

    def taken(
        self, middle: State, rows: Mapping[Kind, Tensor], medium: Around | None,
        around: Surroundings,
    ) -> Taken:  # fmt: skip
        """The steps of these cells, by type, that kernels take. middle: the state half way."""
        found, half = {}, around.start.half
        given = (*around.start.fields.values(), half.before, *around.signals.values())
        columns: dict[str, Tensor] = {}  # that do not depend on the type
        for kind, of_type in rows.items():
            step = self._step(kind, middle, of_type, medium)
            if step is None:
                continue
            if step.colonies and around.highest >= step.colonies:
                raise checks.input_error(
                    "state.colony_id",
                    around.highest,
                    f"below {step.colonies}",
                    f"{self.circuit.effect.value_owner()} has values for so many colonies.",
                )
            read = {}
            for n in step.changing:
                if n not in columns or n.startswith("p."):
                    columns[n] = known(self._read(n, kind, middle, medium))
                read[n] = columns[n]
            if step.may_run(*given, *read.values()):
                found[kind] = step, read
        return found

    def run(
        self, taken: Taken, middle: State, rows: Mapping[Kind, Tensor],
        medium: Around | None, around: Surroundings, report: Failures,
    ) -> dict[str, Tensor]:  # fmt: skip
        """The species of all cells, (N,), after these steps; in cells of others after growth alone.
        The medium is told what they give to it, and the report of failures."""
        made = PreparedStep(self.circuit, taken, middle, rows, medium, around, report)
        made.run(self._course)
        return made.finished()

    def _step(
        self, kind: Kind, middle: State, rows: Tensor, medium: Around | None
    ) -> KernelStep | None:
        key = kind, form_of(medium)
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

    def _read(self, name: str, kind: Kind, middle: State, medium: Around | None) -> Tensor:
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
        if isinstance(medium, Ramped):
            return medium.ramp[name.removeprefix("ramp_")][1]
        found = medium.pool if name == "pool" else medium.in_reservoir
        assert found is not None
        return found

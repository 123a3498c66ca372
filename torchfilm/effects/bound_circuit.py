"""A circuit bound to a batch: traced once, then stepped."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.circuits import run
from torchfilm.circuits.columns import Lookup
from torchfilm.circuits.compiled import Compiled
from torchfilm.circuits.compiled_explicit import compiled_explicit
from torchfilm.circuits.compiled_molecules import compiled_molecules
from torchfilm.circuits.compiled_step import Surroundings
from torchfilm.circuits.compiled_stiff import compiled_stiff
from torchfilm.circuits.dilution import Start, half_way, part_way
from torchfilm.circuits.draws import KeyedDraws
from torchfilm.circuits.molecules import whole_concentration
from torchfilm.circuits.names import label_of
from torchfilm.circuits.network import build_network
from torchfilm.circuits.tracing import Untraceable
from torchfilm.circuits.trial import try_circuit
from torchfilm.effect import Binding, BoundEffect
from torchfilm.effects.circuit_cells import Kind, cell_column, cell_names, cells_of_type
from torchfilm.effects.circuit_checks import check_levels, check_read, warn_of_gradients
from torchfilm.effects.circuit_daughters import single_genes
from torchfilm.effects.circuit_kernels import CircuitKernels, PreparedStep, Taken
from torchfilm.effects.circuit_report import Failures
from torchfilm.effects.circuit_words import methods_of, together_lines
from torchfilm.medium_exchange import Around, Exchanged, MediumExchange, Ramped, form_of
from torchfilm.resolver import Values, snapshot
from torchfilm.signals.schedule import Schedule, warn_of_means
from torchfilm.state import OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.backends import why_torch
from torchfilm.tools.tangents import outside_checkpoints, scaled

if TYPE_CHECKING:
    from torchfilm.effects.circuit import Circuit

# What of the cell's geometry a name stands for.
GEOMETRY = {
    "volume": ("length", "radius"),
    "area": ("length", "radius"),
    "x": ("position",),
    "y": ("position",),
    "z": ("position",),
    "colony": ("colony",),
}


class BoundCircuit(BoundEffect):
    """A circuit with its networks built, and with the names that its rates read and the signals
    that they change known."""

    effect: Circuit

    def __init__(self, effect: Circuit, binding: Binding):
        super().__init__(effect, binding)
        kinds = [k for k in effect.rates if isinstance(k, int)]
        if kinds:  # cells of other types need no constants
            self.values = Values({n: self.values[n].needed_by(kinds) for n in self.values})
        self.rates = snapshot(effect.rates, "Circuit.rates", binding.batch)
        self.networks: dict[Kind, run.Network] = {}
        self.genes: list[tuple[str, ...]] = []  # of which a division leaves some cells without
        self.exchanged: dict[Kind, tuple[str, ...]] = {}
        # by cell type and form of exchange: the compiled circuit, or why there is none
        self.compiled: dict[tuple[Kind, str], Compiled | str] = {}
        self.kernels = CircuitKernels(self)
        self.by_torch = why_torch("Circuit", effect.backend, binding.batch.device)
        self.traced_reads: tuple[str, ...] = ()
        self.signals: tuple[str, ...] = ()  # that rates read or change
        self.fields = tuple(effect.variables.values())

    # --- binding -------------------------------------------------------------------------

    def reads(self) -> tuple[str, ...]:
        reservoir = self.binding.reservoirs(self.exchanges())
        return tuple(dict.fromkeys((*super().reads(), *self.traced_reads, *reservoir)))

    def writes(self) -> tuple[str, ...]:
        written = [OUTSIDE + n for n in self.exchanges()]
        return (*super().writes(), *written, *self.binding.reservoirs(self.exchanges()))

    def typed_values(self) -> dict[str, tuple[int, ...]]:
        """First values serve the start only, and constants by type the rates of that type."""
        own = [self.values[n] for n in self.effect.parameters]
        every = all(isinstance(k, str) for k in self.rates)
        each = [v for v in own if v.known_types and (every or v.draw is not None)]
        return {v.name: v.known_types for v in each}

    def exchanges(self) -> tuple[str, ...]:
        """The signals that cells exchange."""
        return tuple(dict.fromkeys(n for names in self.exchanged.values() for n in names))

    def ready(self, state: State) -> State:
        return self._whole_molecules(state) if self.effect.is_stochastic and state.cells else state

    def trace(self, state: State) -> State:
        """Build the networks, and try each rate function on a few cells."""
        if state.cells == 0:
            return state
        if state.step == 0:
            state = self.ready(state)
        given, state = state, state.replace(dt=self.binding.dt)
        circuit, signals = self.effect, tuple(state.signals)
        self.networks = {
            k: build_network(part, tuple(circuit.variables), signals)
            for k, part in self.rates.items()
            if not callable(part)
        }
        for made in self.networks.values():
            made.check_parameters("Circuit", circuit.parameters)
        if circuit.is_stochastic and state.step == 0:
            self.genes = single_genes(self, state)
        named = [n for made in self.networks.values() for n in made.parameters]
        seen: dict[str, set[str]] = {"s": set(), "cell": set(), "p": set(named)}
        contact = state.contact()
        found = {} if contact is None else contact.found
        exchanged = {}
        for kind in self.rates:
            rows = cells_of_type(state, kind)
            # at least two, so that a function that works for a single cell only is found out
            rows = (
                rows if rows.numel() else torch.zeros(1, dtype=torch.int64, device=state.device)
            ).repeat(2)[:64]
            tried = self._named(state, rows, kind, (), found, seen)
            each = [state.fields[n].index_select(0, rows) for n in self.fields]
            exchanged[kind] = try_circuit(
                tried,
                torch.stack(each, 1),
                self._unlike(state, rows, kind, found),
                circuit.atol if circuit.method == "rosenbrock" else None,
            )
        check_read(circuit, seen, state, exchanged)
        warn_of_gradients(circuit, self.networks.values(), self.values.requires_grad)
        self.exchanged = exchanged
        of_networks = [n for made in self.networks.values() for n in made.signals]
        self.signals = tuple(
            n for n in signals if n in {*seen["s"], *self.exchanges(), *of_networks}
        )
        geometry = {
            g for n in seen["cell"] for g in GEOMETRY.get(n, (n,) if n in state.fields else ())
        }
        if self.signals:
            geometry.add("position")
        outside = {OUTSIDE + n for n in self.signals}
        self.traced_reads = tuple(sorted({*geometry, *outside}))
        self.compiled, self.kernels = {}, CircuitKernels(self)
        medium = MediumExchange.of(state, self.signals)
        if medium is not None:
            medium.find()
        for kind in self.rates:
            self.cells(state, cells_of_type(state, kind), kind, medium=medium)
        return given

    def _unlike(
        self, state: State, rows: Tensor, kind: Kind, found: Mapping[str, Tensor]
    ) -> run.CircuitCells:
        """These cells (M,) as if each were at a place of its own, of its own length and among
        signals of its own."""
        rows, number = rows.sort().values, torch.arange(len(rows), device=rows.device)
        cells, more = state.take(rows), 1.0 + 0.1 * number.to(state.dtype)
        cells = cells.replace(
            position=cells.position + number.unsqueeze(1), length=cells.length * more
        )
        around = {n: x.index_select(0, rows) * more.to(x.dtype) for n, x in found.items()}
        return self._named(cells, number, kind, (), around)

    def _compiled(
        self, kind: Kind, form: str, state: State, cells: run.CircuitCells
    ) -> run.CircuitCells:
        """The cells with their circuit's equations, where there are: torch's derivatives, too."""
        key, stiff = (kind, form), self.effect.method == "rosenbrock"
        if cells.rows.numel() == 0 or (self.by_torch and not stiff):
            return cells
        if key not in self.compiled:
            try:
                with outside_checkpoints():
                    self.compiled[key] = self._equations(state, cells)
            except Untraceable as why:
                self.compiled[key] = said = f"{cells.label}: {why}"
                if self.effect.backend == "compiled":
                    wanted = f"Circuit.backend = 'compiled', but {said}. Leave backend out."
                    raise checks.InputError(wanted) from why
        found = self.compiled[key]
        if isinstance(found, str):
            return cells
        return dataclasses.replace(cells, compiled=found, by_torch=bool(self.by_torch))

    def _equations(self, state: State, cells: run.CircuitCells) -> Compiled:
        """Raises Untraceable."""
        if self.effect.is_stochastic:
            per_unit = cells.per_unit(self.values.molecules_per_unit.of_cells(state))
            return compiled_molecules(cells, per_unit)
        if self.effect.method == "rosenbrock":
            return compiled_stiff(cells)
        return compiled_explicit(cells, self.effect.method, state.dtype)

    def _whole_molecules(self, state: State) -> State:
        """First concentrations that are whole numbers of molecules: rounded up or down at random,
        so that the mean stays."""
        rows = torch.arange(state.cells, device=state.device)
        size = state.volume * self.values.molecules_per_unit.of_cells(state)
        draw = lambda name: state.uniform(rows, f"first {name}")
        found = {
            n: whole_concentration(state.fields[n], size, partial(draw, n))
            for n in self.effect.own_fields
        }
        return state.with_fields(**found)

    @property
    def by_kernels(self) -> bool:
        return not self._why_torch()

    def _why_torch(self) -> list[str]:
        """Why torch computes it, or parts of it."""
        parts = [x for x in self.compiled.values() if isinstance(x, str)]
        return [self.by_torch] if self.by_torch else parts

    def numerics(self, dt: float, state: State) -> list[str]:
        plan, transport = self.plan, self.plan.transport  # where both are solved together
        exchanged = () if transport else self.exchanges()
        known = [c for c in self.compiled.values() if not isinstance(c, str)]
        own = next((x for c in known if (x := c.equations.builder.own_derivative)), "")
        lines = methods_of(self.effect, dt, plan.turns, self._why_torch(), exchanged, own)
        each = self.effect.parameters.items()
        lines += [f"{n} {x.told}" for n, x in each if isinstance(x, Schedule)]
        if transport:
            lines += together_lines(self.exchanges(), plan, dt, state)
        return lines

    def check_step(self, dt: float, divides: bool) -> None:
        super().check_step(dt, divides)
        together, circuit = self.plan.transport, self.effect
        dt /= together.medium.steps if together else self.plan.turns
        warn_of_means(circuit.value_owner(), circuit.parameters, dt)

    def check_given(self, state: State, free: Container[str]) -> None:
        check_levels(self.effect, state.fields, free)

    @property
    def why_turns(self) -> str:
        method = self.effect.method
        jumps = f"Circuit.method = {method!r} makes amounts that jump: no equation can be solved."
        return jumps if self.effect.is_stochastic else ""

    # --- stepping ------------------------------------------------------------------------

    def step(self, state: State, dt: float) -> State:
        """Dilution, rates in the cells as they are half way, dilution: of second order in dt, and
        keeps amounts."""
        return self.turn(state, dt, 0, 1)

    def turn(self, state: State, dt: float, done: int, number: int) -> State:
        """The state after dt hours, one of a `number` of turns with transport in a step of the
        scene, of which so many are `done`. Growth dilutes evenly over them."""
        if state.cells == 0:
            return state
        medium = MediumExchange.of(state, self.signals)
        report = Failures(state, self.effect.method, dt)
        changed = self.changed(state, dt, done, number, medium, report)
        exchanged = None if medium is None else medium.exchanged()
        state = state.with_fields(**changed) if medium is None else medium.settle(**changed)
        return self.reported(state, report, exchanged, done)

    def reported(
        self, state: State, report: Failures, exchanged: Exchanged | None, done: int,
        noted: Mapping[str, Any] | None = None,
    ) -> State:  # fmt: skip
        """The state with the report of a turn added to those that are `done`. noted: more of it."""
        made = dataclasses.replace(
            report.report(exchanged), shared=self.plan.shared, **(noted or {})
        )
        made = made.after(state.reports[self.title]) if done else made
        return state.replace(reports={**state.reports, self.title: made})

    def changed(
        self, state: State, dt: float, done: int, number: int, medium: Around | None,
        report: Failures,
    ) -> dict[str, Tensor]:  # fmt: skip
        """The fields that `turn` changes, (N,) by name; the medium is told what cells give, and the
        report what failed."""
        middle, rows, around, taken = self._prepared(state, dt, done, number, medium)
        start = around.start
        if taken:
            changed = self.kernels.run(taken, middle, rows, medium, around, report)
        else:
            changed = start.kept()
        if left := [k for k in rows if k not in taken]:
            if medium is not None:
                medium.find()
            same = self._constants(middle)
            cells = [self.cells(middle, rows[k], k, medium=medium, same=same) for k in left]
            changed = self._by_torch(state, start, cells, medium, report, changed, done)
        changed[self.effect.volume_field] = start.half.end
        return changed

    def _prepared(
        self, state: State, dt: float, done: int, number: int, medium: Around | None
    ) -> tuple[State, dict[Kind, Tensor], Surroundings, Taken]:
        """For `changed`: the state half way, the cells by type, what they begin with, and the steps
        that kernels take."""
        begin = state.time + done * dt
        now = state.replace(time=begin + 0.5 * dt, dt=dt * number, span=(begin, begin + dt))
        middle, start = self.begun(now, 1.0 / (number - done))
        rows = {k: x for k in self.rates if (x := cells_of_type(state, k)).numel()}
        signals, pool = ({}, None) if medium is None else (medium.first, medium.pool)
        around = Surroundings(start, signals, pool, state.colony_id, state.colony)
        taken = self.kernels.taken(middle, rows, medium, around) if dt else {}
        return middle, rows, around, taken

    def prepared(
        self, state: State, dt: float, done: int, number: int, medium: Ramped, report: Failures
    ) -> PreparedStep | None:
        """`changed` made ready to be run again and again, as what the medium holds changes; None
        where kernels cannot take all of it."""
        middle, rows, around, taken = self._prepared(state, dt, done, number, medium)
        if not taken or len(taken) < len(rows):
            return None
        return PreparedStep(self, taken, middle, rows, medium, around, report)

    def begun(self, state: State, share: float = 1.0) -> tuple[State, Start]:
        """The cells as they are half way through this share of their growth, and what a step begins
        with."""
        circuit = self.effect
        volume, length = state.fields[circuit.volume_field], state.length
        if share < 1.0:
            length = part_way(length, state.radius, volume, share)
        half = half_way(length, state.radius, volume)
        each, dtype = ((n, state.fields[n]) for n in self.fields), state.dtype
        fields = {n: x if x.dtype == dtype else x.to(dtype) for n, x in each}
        middle = state.with_length(half.length, half.volume, half.area)
        return middle, Start(fields, circuit.diluted_fields, half)

    def _by_torch(
        self,
        state: State,
        start: Start,
        cells: Sequence[run.CircuitCells],
        medium: Around | None,
        report: Failures,
        changed: dict[str, Tensor],
        done: int,
    ) -> dict[str, Tensor]:
        """The species of all cells after these circuits, of what they are after the others."""
        circuit, keys = self.effect, None
        # each turn draws numbers of its own
        purpose = f"{circuit.name} turn {done}".strip() if done else circuit.name
        settings = run.IntegrationSettings(
            circuit.method,
            circuit.steps,
            circuit.rtol,
            circuit.atol,
            self.values.molecules_per_unit.of_cells(state),
        )
        if circuit.is_stochastic:
            keys = KeyedDraws(state.seed, state.own_stream, state.uid, state.step)
        for c in cells:
            rows, whole = c.rows, c.rows.numel() == state.cells
            concentrations = start.concentrations(rows)
            draw = None if keys is None else keys.of(rows, purpose)
            made = run.step(c, concentrations, report.dt, settings, draw)
            report.note(start, c, made.code, made.steps)
            after = start.half.after if whole else start.half.after.index_select(0, rows)
            for name, value in zip(self.fields, made.concentrations.unbind(1), strict=True):
                value = scaled(value, after) if name in start.diluted else value
                changed[name] = value if whole else changed[name].index_copy(0, rows, value)
            for name in c.exchanged:
                assert medium is not None
                medium.give(name, made.pools.get(name), made.reservoir.get(name), rows)
        return changed

    def cells(
        self,
        state: State,
        rows: Tensor,
        kind: Kind,
        *,
        medium: Around | None = None,
        same: Lookup | None = None,
    ) -> run.CircuitCells:
        """The circuit in the cells of one type as they are in this state, half way. same:
        constants, where the circuits of several types share what does not depend on the type."""
        found = {} if medium is None else medium.found
        cells = self._named(state, rows, kind, self.exchanged[kind], found, same=same)
        if isinstance(medium, Ramped):
            cells = dataclasses.replace(cells, ramp=medium.ramp)
        elif medium is not None:
            pool, away = medium.pool, medium.in_reservoir
            cells = dataclasses.replace(cells, pool=pool, in_reservoir=away)
        return self._compiled(kind, form_of(medium), state, cells)

    def _named(
        self,
        state: State,
        rows: Tensor,
        kind: Kind,
        exchanged: tuple[str, ...],
        found: Mapping[str, Tensor],
        seen: dict[str, set[str]] | None = None,
        same: Lookup | None = None,
    ) -> run.CircuitCells:
        """As `cells`, without a pool. seen: it collects the names that are read."""
        part = self.networks.get(kind, self.rates[kind])
        label = label_of(part)
        label += "" if isinstance(kind, str) else f" (cell type {kind})"
        if isinstance(part, run.Network):
            exchanged = part.signals
        own = None if isinstance(kind, str) else kind
        same = same or self._constants(state)
        return run.CircuitCells(
            part,
            tuple(self.effect.variables),
            exchanged,
            rows,
            Lookup(partial(cell_names, state, self.fields), partial(cell_column, state)),
            same if own is None else self._constants(state, own, same),
            found,
            label=label,
            seen=seen or {},
        )

    def _constants(
        self, state: State, kind: int | None = None, same: Lookup | None = None
    ) -> Lookup:
        """The constants of all cells, or as if all were of this type."""

        def find(name: str) -> Tensor:
            value = self.values[name]
            if same is None or value.types is not None or value.draw is not None:
                return value.of_cells(state, kind)
            return same[name]

        return Lookup(partial(tuple, self.effect.parameters), find)

"""Gene circuits: species inside the cells that react, are diluted by growth, and pass to and from
the medium (the paper's equation 5)."""

from __future__ import annotations

import copy
import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits import integrators, run
from torchfilm.circuits.columns import Lazy
from torchfilm.circuits.draws import keyed_draws
from torchfilm.circuits.names import unknown
from torchfilm.circuits.network import build_network
from torchfilm.circuits.partition import binomial
from torchfilm.circuits.reactions import Reaction
from torchfilm.effect import CIRCUIT, Distribution, Effect, draw, parameter, per_cell
from torchfilm.signals.exchange import write
from torchfilm.state import CELL, CELL_TYPE, OUTSIDE, RESERVED, Field, State
from torchfilm.tools import checks

Part = run.RateFunction | Sequence[Reaction | Sequence[Reaction]]

STIFF, LEAP, DIRECT = "rosenbrock", "tau_leap", "direct"
EXPLICIT = ("euler", *integrators.METHODS)
METHODS = (STIFF, *EXPLICIT, LEAP, DIRECT)
GEOMETRY = {
    "volume": ("length", "radius"),
    "area": ("length", "radius"),
    "x": ("position",),
    "y": ("position",),
    "z": ("position",),
}
OPTIONS = ("initial", "daughters", "method", "steps", "rtol", "atol", "molecules_per_unit")
EVERY = "every cell"  # where a circuit runs that is not given by type


@dataclass(frozen=True)
class CircuitReport:
    """`status` (B,): 0, or 1 where a cell's circuit could not be stepped, and `words`, by place in
    the batch, what happened there. steps, (N,) int64: how many steps each cell's circuit took."""

    status: Tensor
    steps: Tensor
    words: Mapping[int, str]
    hint = (
        "A smaller dt, or rates that stay finite and do not push a concentration below 0, may help"
    )

    def reason(self, place: int) -> str:
        return self.words[place]


class Noted:
    """What a circuit has found out about itself when it was tried: names that it reads, and by cell
    type the signals it gives and its network.

    A plain class: whatever looks for the parameters of an effect shall not find any here.
    """

    def __init__(self) -> None:
        self.reads: tuple[str, ...] = ()
        self.given: dict[int | str, tuple[str, ...]] = {}
        self.networks: dict[int | str, Any] = {}


@dataclass(frozen=True, init=False, eq=False)
class Circuit(Effect):
    """Species in every cell and how they change: `Circuit(lux, species=("luxi", "ahl"), k1=1.0,
    …)`.

    rates: a function (u, s, p, cell) that returns a dict of rates of change, conc/h, of species
    (those left out do not react), and, if cells and medium exchange, a second dict of amounts per
    hour, conc·µm³/h, that each cell gives to signals (negative: takes). Its arguments hold columns
    over cells by name: u concentrations, s signals where the cell is, p parameters, cell volume,
    area, length, radius, x, y, z, growth_rate, cell_type and every other field. Or a list of
    reactions and parts. Or a dict of either by cell type, {0: …, 1: …}: other types have no
    reactions. species: names. initial: concentrations at the start by name, 0 without: a number,
    one per colony, or a distribution over cells. daughters: "concentration", they have their
    parent's (the paper's way; the two new caps make both together smaller than it was), "amount",
    its molecules are shared by volume and none is lost. method: "rosenbrock" (stiff, adaptive for
    each cell), "euler", "midpoint", "heun2", "heun3", "rk4" (`steps` equal steps), or for reactions
    "tau_leap" or "direct": molecule by molecule, `molecules_per_unit` of them in a unit of concentration × µm³
    (0.6022 for nM). rtol, atol: of the adaptive method. Growth dilutes: amounts stay,
    concentrations are multiplied by V_old/V_new. Further names are parameters: numbers, or one per
    colony.
    """

    rates: Mapping[int | str, Part]
    species: tuple[str, ...]
    initial: Mapping[str, float | Tensor | Distribution] = field(default_factory=dict)
    daughters: str = "concentration"
    method: str = STIFF
    steps: int = 1
    rtol: float = 1e-4
    atol: float = 1e-9
    molecules_per_unit: float | Tensor = 1.0
    parameters: Mapping[str, float | Tensor] = field(default_factory=dict)
    noted: Noted = field(default_factory=Noted, repr=False)

    stage = CIRCUIT
    title = "circuit"

    def __init__(
        self,
        rates: Part | Mapping[int, Part],
        *,
        species: Sequence[str],
        initial: Mapping[str, float | Tensor | Distribution] | None = None,
        daughters: str = "concentration",
        method: str = STIFF,
        steps: int = 1,
        rtol: float = 1e-4,
        atol: float = 1e-9,
        molecules_per_unit: float | Tensor = 1.0,
        **parameters: float | Tensor,
    ):
        by_type: dict[int | str, Part] = (
            {k: part for k, part in rates.items()} if isinstance(rates, Mapping) else {EVERY: rates}
        )
        names = _names(species)
        taken = [n for n in names if n in RESERVED or n in GEOMETRY]
        if taken:
            raise checks.input_error(
                "Circuit.species",
                taken[0],
                "a name that cells do not have already",
                "Call the species something else.",
            )
        for kind, part in by_type.items():
            if isinstance(rates, Mapping) and (isinstance(kind, bool) or not isinstance(kind, int)):
                raise checks.input_error(
                    "Circuit.rates", kind, "by cell types that are whole numbers"
                )
            if not callable(part) and not (isinstance(part, (list, tuple)) and part):
                raise checks.input_error(
                    "Circuit.rates",
                    part,
                    "a function (u, s, p, cell), a list of reactions, or a dict of either by cell"
                    " type",
                )
        if initial is not None and not isinstance(initial, Mapping):
            raise checks.input_error(
                "Circuit.initial", initial, f"a dict by species, such as {{{names[0]!r}: 1.0}}"
            )
        for name in initial or {}:
            if name not in names:
                raise checks.InputError(
                    unknown(f"Circuit.initial names {name!r}, which is no species", name, names)
                )
        for name, odd in parameters.items():
            if isinstance(odd, str) or callable(odd):
                near = difflib.get_close_matches(
                    name, [f.name for f in dataclasses.fields(self)], 1
                )
                hint = (
                    f"Did you mean {near[0]}?"
                    if near
                    else "Further names are parameters of the rates."
                )
                raise checks.input_error(
                    f"Circuit.{name}", odd, "a number, or one number per colony", hint
                )
        checks.choice("Circuit.daughters", daughters, ("concentration", "amount"))
        checks.choice("Circuit.method", method, METHODS)
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise checks.input_error("Circuit.steps", steps, "a whole number from 1")
        functions = [part for part in by_type.values() if callable(part)]
        if method in (LEAP, DIRECT) and functions:
            raise checks.input_error(
                "Circuit.method",
                method,
                f"for reactions; {getattr(functions[0], '__name__', 'a function')} gives rates",
                "Write the circuit as a list of reactions.",
            )
        given = {
            "rates": by_type,
            "species": names,
            "initial": {
                n: parameter(f"Circuit.initial[{n!r}]", v, least=0.0)
                for n, v in (initial or {}).items()
            },
            "daughters": daughters,
            "method": method,
            "steps": steps,
            "rtol": checks.number("Circuit.rtol", rtol, above=0.0, most=0.1),
            "atol": checks.number("Circuit.atol", atol, above=0.0),
            "molecules_per_unit": checks.value(
                "Circuit.molecules_per_unit", molecules_per_unit, above=0.0
            ),
            "parameters": {n: checks.value(f"Circuit.{n}", v) for n, v in parameters.items()},
            "noted": Noted(),
        }
        for name, value in given.items():
            object.__setattr__(self, name, value)

    def solved_to(self, rtol: float) -> Circuit:
        """The same circuit to another relative tolerance."""
        return self._with(rtol=checks.number("Circuit.rtol", rtol, above=0.0, most=0.1))

    def smooth(self) -> Circuit:
        """The same circuit by the stiff solver: of reactions that run molecule by molecule, the
        mean that many molecules come to."""
        return self._with(method=STIFF, daughters="amount")

    def _with(self, **changes: object) -> Circuit:
        changed = copy.copy(self)
        for name, value in changes.items():
            object.__setattr__(changed, name, value)
        object.__setattr__(changed, "noted", Noted())
        return changed

    @property
    def is_stochastic(self) -> bool:
        return self.method in (LEAP, DIRECT)

    def declares(self, dim: int) -> tuple[Field, ...]:
        rule = "reset" if self.is_stochastic or self.daughters == "amount" else "copy"
        fields = [
            Field(
                n,
                "concentration in the cell",
                "conc",
                initial=partial(self._first, name=n),
                at_division=rule,
            )
            for n in self.species
        ]
        fields.append(
            Field(
                "circuit_volume",
                "volume that the concentrations refer to",
                "µm³",
                initial=_volume_of,
                at_division="reset",
            )
        )
        return (*fields, CELL_TYPE) if EVERY not in self.rates else tuple(fields)

    def _first(self, state: State, rows: Tensor, name: str) -> Tensor:
        """Concentrations (M,) of new cells: at the start as `initial` says, of daughters as
        `daughters` says."""
        if not state.births:
            return draw(f"Circuit.{name}", self.initial.get(name, 0.0), state, rows)
        births = state.births[-1]
        amount = births.parents.fields[name] * births.parents.circuit_volume
        volumes = [state.volume.index_select(0, r) for r in (births.first, births.second)]
        share = volumes[0] / (volumes[0] + volumes[1])
        if not self.is_stochastic:
            return torch.cat([amount * share / volumes[0], amount * (1 - share) / volumes[1]])
        molecules_per_unit = per_cell(self.molecules_per_unit, births.parents)
        count = torch.round(amount * molecules_per_unit)
        taken = binomial(
            count,
            share,
            births.parents.uniform(
                torch.arange(count.numel(), device=count.device), f"partition {name}"
            ),
        )
        return torch.cat(
            [
                taken / (volumes[0] * molecules_per_unit),
                (count - taken) / (volumes[1] * molecules_per_unit),
            ]
        )

    def prepare(self, state: State) -> State:
        """Molecules made whole, each rate function tried on a few cells."""
        if state.cells == 0:
            return state
        if self.is_stochastic:
            state = self._whole(state)
        self._note(state)
        return state

    def _note(self, state: State) -> None:
        """Put the networks together, try each rate function on a few cells, and note what is read
        and given."""
        signals = tuple(state.signals)
        self.noted.networks = {
            kind: build_network(part, self.species, signals)
            for kind, part in self.rates.items()
            if not callable(part)
        }
        for made in self.noted.networks.values():
            for name in made.parameters:
                if name not in self.parameters:
                    raise checks.InputError(
                        unknown(
                            f"a reaction needs the parameter {name!r}, which Circuit was not given",
                            name,
                            list(self.parameters),
                        )
                    )
        seen: dict[str, set[str]] = {
            "s": set(),
            "cell": set(),
            "p": {n for made in self.noted.networks.values() for n in made.parameters},
        }
        given = {}
        contact = state.contact()
        outside = {} if contact is None else contact.found
        for kind in self.rates:
            rows = _cells_of(state, kind)
            # at least two, so that a function that works for a single cell only is found out
            rows = (
                rows if rows.numel() else torch.zeros(1, dtype=torch.int64, device=state.device)
            ).repeat(2)[:64]
            tried = self._circuit(state, rows, kind, (), outside, seen=seen)
            given[kind] = run.trial(
                tried, self._concentrations(state, rows), derivatives=self.method == STIFF
            )
        for name in self.parameters:
            near = difflib.get_close_matches(name, OPTIONS, 1, 0.75)
            if near and name not in seen["p"]:
                raise checks.InputError(
                    f"Circuit.{name} is taken for a parameter, but no rate reads it. Did you mean"
                    f" the option {near[0]}?"
                )
        self.noted.given = given
        geometry = {
            g for n in seen["cell"] for g in GEOMETRY.get(n, (n,) if n in state.fields else ())
        }
        if seen["s"] or any(given.values()):
            geometry.add("position")
        self.noted.reads = tuple(
            sorted(
                {
                    *geometry,
                    *(OUTSIDE + n for n in seen["s"]),
                    *(OUTSIDE + n for g in given.values() for n in g),
                }
            )
        )

    def _whole(self, state: State) -> State:
        """First concentrations that are whole numbers of molecules: rounded up or down at random,
        so that the mean stays."""
        rows = torch.arange(state.cells, device=state.device)
        size = state.volume * per_cell(self.molecules_per_unit, state)
        found = {
            n: torch.floor(state.fields[n] * size + state.uniform(rows, f"first {n}")) / size
            for n in self.species
        }
        return state.with_fields(**found)

    def reads(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.species, "length", "radius", *self.noted.reads)))

    def writes(self) -> tuple[str, ...]:
        return (
            *self.species,
            *dict.fromkeys(OUTSIDE + n for g in self.noted.given.values() for n in g),
        )

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        if not self.noted.given:  # a state that was seeded by another scene of the same fields
            self._note(state)
        # dilution, rates in the cell as it is half way, dilution: of second order in dt, and keeps
        # amounts
        middle, end = _half_way(state), state.volume
        state = state.with_fields(
            circuit_volume=end,
            **{n: state.fields[n] * (state.circuit_volume / middle.volume) for n in self.species},
        )
        medium = _Medium(state) if state.layout is not None else None
        outside = {} if medium is None else medium.found
        settings = run.Settings(
            self.method, self.steps, self.rtol, self.atol, per_cell(self.molecules_per_unit, state)
        )
        keys = (
            keyed_draws(state.seed, state.own_stream, state.uid, state.step)
            if self.is_stochastic
            else None
        )
        report = _Notes(state)
        changed = {n: state.fields[n] for n in self.species}
        for kind in self.rates:
            rows = _cells_of(state, kind)
            if rows.numel() == 0:
                continue
            circuit = self._circuit(middle, rows, kind, self.noted.given[kind], outside, medium)
            concentrations = self._concentrations(state, rows)
            draws = (
                None
                if keys is None
                else lambda mine, event, what, count, rows=rows: keys(
                    rows.index_select(0, mine), event, what, count
                )
            )
            found = run.step(circuit, concentrations, dt, settings, draws)
            report.note(circuit, found, concentrations, self.method, dt)
            for name, value in zip(self.species, found.concentrations.unbind(1), strict=True):
                changed[name] = (
                    value
                    if rows.numel() == state.cells
                    else changed[name].index_copy(0, rows, value)
                )
            if medium is not None:
                medium.note(rows, found)
        if medium is not None:
            state = medium.settle()
        thinner = middle.volume / end
        state = state.with_fields(**{n: value * thinner for n, value in changed.items()})
        return state.replace(reports={**state.reports, "circuit": report.report()})

    def _concentrations(self, state: State, rows: Tensor) -> Tensor:
        """Of the cells `rows` (M,), (M, S)."""
        return torch.stack([state.fields[n].index_select(0, rows) for n in self.species], 1)

    def _circuit(
        self,
        state: State,
        rows: Tensor,
        kind: int | str,
        given: tuple[str, ...],
        outside: Mapping[str, Tensor],
        medium: _Medium | None = None,
        seen: dict[str, set[str]] | None = None,
    ) -> run.Circuit:
        """The circuit of one type of cell as it stands in this state."""
        part = self.noted.networks.get(kind, self.rates[kind])
        label = getattr(part, "__name__", "the list of reactions") + (
            "" if kind == EVERY else f" (cell type {kind})"
        )
        pool, in_reservoir = (None, None) if medium is None else (medium.pool, medium.in_reservoir)
        if isinstance(part, run.Network):
            given = part.signals
        p = {n: per_cell(v, state) for n, v in self.parameters.items()}
        return run.Circuit(
            part,
            self.species,
            given,
            rows,
            _cell_columns(state, self.species),
            p,
            outside,
            pool,
            in_reservoir,
            label,
            seen or {},
        )


def _half_way(state: State) -> State:
    """The cells as long as they were half way, in time, between the volume that their
    concentrations refer to and their own."""
    volume = (state.circuit_volume * state.volume).sqrt()
    longer = volume / (math.pi * state.radius * state.radius) - state.radius * (4.0 / 3.0)
    return state.replace(
        length=torch.where(
            state.circuit_volume == state.volume, state.length, longer.clamp(min=0.0)
        )
    )


def _names(species: Sequence[str]) -> tuple[str, ...]:
    """The names of the species, checked."""
    fit = lambda names: (
        names
        and len(set(names)) == len(names)
        and all(isinstance(n, str) and n.isidentifier() for n in names)
    )
    names = (species,) if isinstance(species, str) else tuple(species)
    if not fit(names):
        apart = tuple(species.replace(",", " ").split()) if isinstance(species, str) else ()
        raise checks.input_error(
            "Circuit.species",
            species,
            "different names, at least one",
            f"Pass a tuple of names: species={apart}." if fit(apart) else "",
        )
    return names


def _cell_columns(state: State, species: Sequence[str]) -> dict[str, Any]:
    """What a rate function may ask of its cell, by name."""
    columns: dict[str, Any] = {
        n: v
        for n, v in state.fields.items()
        if state.declared[n].scope == CELL and n not in species
    }
    columns |= {
        "length": state.length,
        "radius": state.radius,
        "volume": Lazy(lambda: state.volume),
        "area": Lazy(lambda: state.area),
    }
    columns |= {
        letter: Lazy(partial(_place, state, k))
        for k, letter in zip(range(state.dim), "xyz", strict=False)
    }
    return columns | {
        "colony": Lazy(lambda: state.own_colony_id),
        "time": state.length.new_tensor(state.time),
        "uid": state.uid,
    }


def _place(state: State, k: int) -> Tensor:
    return state.position[:, k].to(state.dtype)


class _Medium:
    """What the cells of a state find outside, and what they have given to it by the end of the
    step."""

    def __init__(self, state: State):
        contact = state.contact()
        assert contact is not None
        self.state, self.stencil, self.found, self.pool, self.in_reservoir = (
            state,
            contact.stencil,
            contact.found,
            contact.pool,
            contact.in_reservoir,
        )
        self.given: dict[str, Tensor] = {}
        self.gone: dict[str, Tensor] = {}

    def note(self, rows: Tensor, found: run.Outcome) -> None:
        """What the cells `rows` (M,) have given, to their pools and to a reservoir."""
        for here, new in ((self.given, found.pools), (self.gone, found.reservoir)):
            for name, amount in new.items():
                start = here.get(name)
                here[name] = (torch.zeros_like(self.pool) if start is None else start).index_add(
                    0, rows, amount
                )

    def settle(self) -> State:
        """The state in which the medium has what was given to it."""
        state = self.state
        changed = {
            OUTSIDE + n: write(state.fields[OUTSIDE + n], amount, self.stencil)
            for n, amount in self.given.items()
        }
        changed |= {
            f"{n}_reservoir": (
                state.fields[f"{n}_reservoir"] + state.groups.sum(amount.unsqueeze(1)).squeeze(1)
            )
            for n, amount in self.gone.items()
        }
        return state.with_fields(**changed)


class _Notes:
    """What went wrong where, gathered over the circuits of all types."""

    def __init__(self, state: State):
        self.state = state
        self.status = torch.zeros(state.colonies, dtype=torch.int64, device=state.device)
        self.steps = torch.zeros(state.cells, dtype=torch.int64, device=state.device)
        self.words: dict[int, str] = {}

    def note(
        self,
        circuit: run.Circuit,
        found: run.Outcome,
        concentrations: Tensor,
        method: str,
        dt: float,
    ) -> None:
        state = self.state
        self.steps = self.steps.index_copy(0, circuit.rows, found.steps)
        if not bool(found.failed.any()):
            return
        at = torch.nonzero(found.failed).squeeze(1)
        owner = state.colony.index_select(0, circuit.rows.index_select(0, at)).tolist()
        for place in sorted(set(owner)):
            mine = [k for k, o in zip(at.tolist(), owner, strict=True) if o == place]
            row = int(circuit.rows[mine[0]])
            said = run.words(circuit, found, concentrations, mine[0], method, dt)
            kind = (
                f" (type {int(state.fields['cell_type'][row])})"
                if "cell_type" in state.fields
                else ""
            )
            self.words[place] = f"circuit of cell {int(state.uid[row])}{kind}: {said}" + (
                f"; and {len(mine) - 1} more cell(s)" if len(mine) > 1 else ""
            )
            self.status[place] = 1

    def report(self) -> CircuitReport:
        return CircuitReport(self.status, self.steps, self.words)


def _volume_of(state: State, rows: Tensor) -> Tensor:
    return state.volume.index_select(0, rows)


def _cells_of(state: State, kind: int | str) -> Tensor:
    """The cells in which a circuit runs, (M,)."""
    if isinstance(kind, str):
        return torch.arange(state.cells, device=state.device)
    return torch.nonzero(torch.eq(state.fields["cell_type"], kind)).squeeze(1)

"""Gene circuits: species inside the cells that react, are diluted by growth, and pass to and from
the medium (the paper's equation 5)."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from torchfilm.circuits import run
from torchfilm.circuits.graph import CircuitGraph, graph_of
from torchfilm.circuits.names import label_of
from torchfilm.circuits.reactions import Reaction
from torchfilm.circuits.tracing import Untraceable
from torchfilm.effect import CIRCUIT, Binding, BoundEffect, Effect
from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.effects.circuit_checks import (
    DIRECT,
    LEAP,
    STIFF,
    check_constants,
    check_initial,
    check_method,
    check_rates,
    check_replicated,
    check_species,
    diluted_names,
    equations_of,
    left_out,
    mass_action_constants,
    molecules_in,
    names_of,
    no_cells_of,
    shared_fields,
)
from torchfilm.effects.circuit_daughters import EACH_CELL, First, volume_of
from torchfilm.parameters import shorten
from torchfilm.state import CELL_TYPE, Field, State
from torchfilm.tools import checks, displays
from torchfilm.tools.backends import check_backend
from torchfilm.tools.parts import keywords
from torchfilm.tools.units import CONCENTRATION, checked_unit
from torchfilm.values import COLONY, CONSTANT, Rule, ScheduledValue, Value, checked

Part = run.RateFunction | Sequence[Reaction | Sequence[Reaction]]

EVERY = "every cell"  # where a circuit runs that is not given by type
POSITIVE = dataclasses.replace(CONSTANT, least=0.0)


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Circuit(Effect):
    """Species in every cell and how they change: `Circuit(lux, species=("luxi", "ahl"), k1=1.0,
    …)`.

    rates: a function (u, s, p, cell) that returns a dict of rates of change, conc/h, of species
    (those left out do not react), and, if cells and medium exchange, a second dict of amounts per
    hour, conc·µm³/h, that each cell gives to signals (negative: takes). Its arguments hold columns
    over cells by name: u concentrations, s signals where the cell is, p parameters, cell volume,
    area, length, radius, x, y, z, growth_rate, cell_type and every other field. Or a list of
    reactions and parts. Or a dict of either by cell type, {0: …, 1: …}: other types have no
    reactions. species: names. initial: concentrations at the start by name, 0 without. daughters:
    "concentration", they have their parent's (the paper's way; the two new caps make both together
    smaller than it was), "amount", its molecules are shared by volume and none is lost; where
    molecules are counted, they are always shared, by chance. replicated: names of species of which
    each daughter has as many molecules as the parent, as of genes, which are replicated before a
    division. method: "rosenbrock" (stiff, adaptive for each cell), "euler", "midpoint", "heun2",
    "heun3", "rk4" (`steps` equal steps), or for reactions "tau_leap" or "direct": molecule by
    molecule, `molecules_per_unit` of them in a unit of concentration × µm³, by default those of
    `concentration_unit`, and 1 without. rtol, atol: of the adaptive method. concentration_unit: the
    name of the unit of all species, such as "nM", for pictures and tables. name: of one circuit
    among several in a scene; its species are then the fields NAME_SPECIES. shared: species of
    another circuit that this one reads and changes too, as field names, or {name here: field}.
    backend: "compiled" functions of its equations (on the CPU) or "torch"; by default compiled
    where the rates can be written as equations: see `graph`. dilution: True, growth dilutes:
    amounts stay, concentrations are multiplied by V_old/V_new; False, concentrations stay; or
    names, the species that growth dilutes. Circuits act one after the other. Further keywords are
    constants of the rates: each a number, one per colony, one per cell type, or a distribution
    drawn for each cell at birth (extrinsic noise). Where rates are given by cell type, cells of
    other types need no constants.
    """

    rates: Mapping[int | str, Part]
    species: tuple[str, ...]
    initial: Mapping[str, Value] = field(default_factory=dict)
    daughters: str = "concentration"
    replicated: tuple[str, ...] = ()
    method: str = STIFF
    steps: int = 1
    rtol: float = 1e-4
    atol: float = 1e-9
    molecules_per_unit: Value = 1.0
    name: str = ""
    shared: Mapping[str, str] = field(default_factory=dict)
    backend: str | None = None
    dilution: bool | tuple[str, ...] = True
    # repr=False: a name alone, which does not count for a scene's digest
    concentration_unit: str = field(default=CONCENTRATION, repr=False)
    parameters: Mapping[str, Value] = field(default_factory=dict)

    stage = CIRCUIT

    def __init__(
        self,
        rates: Part | Mapping[int, Part],
        *,
        species: Sequence[str],
        initial: Mapping[str, Value] | None = None,
        daughters: str = "concentration",
        replicated: Sequence[str] = (),
        method: str = STIFF,
        steps: int = 1,
        rtol: float = 1e-4,
        atol: float = 1e-9,
        molecules_per_unit: Value | None = None,
        name: str = "",
        shared: Sequence[str] | Mapping[str, str] = (),
        backend: str | None = None,
        dilution: bool | Sequence[str] = True,
        concentration_unit: str = CONCENTRATION,
        **parameters: ScheduledValue,
    ):
        by_type: dict[int | str, Part] = (
            dict(rates.items()) if isinstance(rates, Mapping) else {EVERY: rates}
        )
        options = [f.name for f in dataclasses.fields(self)]
        parameters = keywords("Circuit", parameters, "parameters", options)
        names = names_of(species)
        others = shared_fields(shared)
        check_species(names, others)
        check_rates(by_type, [*by_type] != [EVERY])
        check_initial(initial, names)
        check_constants(parameters, options)
        check_method(method, steps, by_type)
        check_backend("Circuit", backend)
        checks.choice("Circuit.daughters", daughters, ("concentration", "amount"))
        if name and not (isinstance(name, str) and name.isidentifier()):
            raise checks.input_error("Circuit.name", name, 'an identifier, such as "toggle"')
        first, mass_action = Rule(least=0.0), mass_action_constants([*by_type.values()])
        given = {
            "rates": {k if isinstance(k, str) else int(k): part for k, part in by_type.items()},
            "species": names,
            "name": name,
            "shared": others,
            "backend": backend,
            "dilution": (diluted := diluted_names(dilution, names, method)),
            "daughters": daughters,
            "replicated": check_replicated(replicated, names, diluted),
            "method": method,
            "steps": int(steps),
            "initial": {
                n: checked(f"Circuit.initial[{n!r}]", v, first) for n, v in (initial or {}).items()
            },
            "rtol": checks.number("Circuit.rtol", rtol, above=0.0, most=0.1),
            "atol": checks.number("Circuit.atol", atol, above=0.0),
            "concentration_unit": (
                unit := checked_unit("Circuit.concentration_unit", concentration_unit)
            ),
            "molecules_per_unit": molecules_in(unit, molecules_per_unit, method),
            "parameters": {
                n: checked(f"Circuit.{n}", v, POSITIVE if n in mass_action else CONSTANT)
                for n, v in parameters.items()
            },
        }
        for key, value in given.items():
            object.__setattr__(self, key, value)

    @classmethod
    @checks.known_keywords
    def from_sbml(
        cls,
        path: str | Path,
        *,
        signals: Sequence[str] | Mapping[str, str] = (),
        properties: Mapping[str, str] | None = None,
        without: Sequence[str] = (),
        time_unit: str | None = None,
        initial: Mapping[str, Value] | None = None,
        dilution: bool | Sequence[str] = True,
        **options: Any,
    ) -> Circuit:
        """The circuit of an SBML model (Levels 1 to 3): its species and all else that has a rate
        are species of the circuit, its constants are parameters.

        signals: ids of species that are signals outside, or {id: name of the signal}. properties:
        ids of the model that are properties of the cell, {"cytosol": "volume"}. without: reactions
        to leave out. time_unit: "s", "min", "h" or "day", in place of what the model declares;
        rates become per hour. initial: first values in place of the model's. dilution: as for a
        circuit; True is all species, and not parameters or compartments. Further keywords are
        values for constants by id, of the forms that a circuit takes, and its options. Raises
        InputError, with the line or the id, for what cannot be read or simulated.
        """
        from torchfilm.effects import circuit_sbml

        choices = circuit_sbml.model_choices(
            signals, properties, without, time_unit, initial, options, OPTION_NAMES
        )
        model = circuit_sbml.read_file(path)
        return cls(**circuit_sbml.keywords(*model, choices, dilution, options))

    @classmethod
    @checks.known_keywords
    def from_antimony(
        cls,
        text: str | Path,
        *,
        signals: Sequence[str] | Mapping[str, str] = (),
        properties: Mapping[str, str] | None = None,
        without: Sequence[str] = (),
        time_unit: str | None = None,
        initial: Mapping[str, Value] | None = None,
        dilution: bool | Sequence[str] = True,
        **options: Any,
    ) -> Circuit:
        """The circuit of a model in Antimony: its text, or the `Path` of a file. Keywords and
        errors as of `from_sbml`."""
        from torchfilm.effects import circuit_sbml

        choices = circuit_sbml.model_choices(
            signals, properties, without, time_unit, initial, options, OPTION_NAMES
        )
        model = circuit_sbml.read_antimony(text)
        return cls(**circuit_sbml.keywords(*model, choices, dilution, options))

    def to_sbml(
        self,
        path: str | Path,
        *,
        cell_type: int | None = None,
        initial: Mapping[str, float] | None = None,
        dilution: float | None = None,
        cell: Mapping[str, float] | None = None,
        **values: float,
    ) -> None:
        """Write the equations as an SBML model (Level 3 Version 2), in hours. `from_sbml` reads
        the same circuit again: the same equations and numbers. A list of reactions becomes rates.

        cell_type: whose rates and constants, where they differ. initial, and further keywords:
        numbers by name in place of first values and constants that are not one number. dilution:
        1/h; the rates then contain −dilution · x, for programs whose cells do not grow. cell: what
        the rates read of a cell, by name, beside its shape. Raises InputError where a number is
        missing, and where rates cannot be written as equations."""
        from torchfilm.effects import circuit_sbml

        circuit_sbml.write_file(path, self, cell_type, initial or {}, dilution, cell or {}, values)

    @property
    def title(self) -> str:  # type: ignore[override]
        return f"circuit {self.name}" if self.name else "circuit"

    instead_of_two = "Give all but one a name, such as Circuit(…, name='second')."

    @property
    def may_repeat(self) -> bool:  # type: ignore[override]
        return bool(self.name)

    def value_owner(self) -> str:
        return f"Circuit {self.name!r}" if self.name else "Circuit"

    @property
    def is_stochastic(self) -> bool:
        return self.method in (LEAP, DIRECT)

    @cached_property
    def variables(self) -> dict[str, str]:
        """The species of the rates by name, own ones first, and the field of each."""
        return {n: f"{self.name}_{n}" if self.name else n for n in self.species} | dict(self.shared)

    @cached_property
    def own_fields(self) -> tuple[str, ...]:
        """The fields of its own species."""
        return tuple(self.variables[n] for n in self.species)

    @cached_property
    def diluted_fields(self) -> tuple[str, ...]:
        """The fields of those that growth dilutes."""
        chosen = self.species if self.dilution is True else self.dilution or ()
        return tuple(self.variables[n] for n in chosen)

    @property
    def volume_field(self) -> str:
        """The field that holds the volume to which its concentrations refer."""
        return f"{self.name}_circuit_volume" if self.name else "circuit_volume"

    @property
    def resets(self) -> bool:
        """Whether daughters' concentrations are computed again from their parent's amounts."""
        return self.is_stochastic or self.daughters == "amount"

    @property
    def graph(self) -> CircuitGraph:
        """Its equations, to print, to differentiate and to look into. Of rates by cell type:
        `graphs`. Raises InputError where the rates cannot be written as equations."""
        if EVERY not in self.rates:
            kinds = ", ".join(map(str, self.rates))
            raise checks.InputError(
                f"{self.value_owner()} has rates by cell type ({kinds}): ask graphs[type]."
            )
        return self.graphs[EVERY]

    @cached_property
    def graphs(self) -> Mapping[int | str, CircuitGraph]:
        """Its equations by cell type."""
        found = {}
        for kind, part in self.rates.items():
            label, names = label_of(part), (tuple(self.variables), tuple(self.parameters))
            try:
                found[kind] = graph_of(part, *names, label, left_out(self))
            except Untraceable as why:
                raise checks.InputError(
                    f"{self.value_owner()}: {label} cannot be written as equations: {why}. It still"
                    " runs, by torch, if torch can compute it for all cells at once."
                ) from why
        return found

    def __repr__(self) -> str:
        constants = "".join(f", {name}={shorten(x)}" for name, x in self.parameters.items())
        parts = ", ".join(dict.fromkeys(label_of(part) for part in self.rates.values()))
        return f"Circuit({parts}, species={list(self.species)}{constants})"

    def _repr_html_(self) -> str:
        rows = [(f"first {n}", shorten(x)) for n, x in self.initial.items()]
        rows += [(n, shorten(x)) for n, x in self.parameters.items()]
        parts = [displays.lines(a) + displays.text(b) for a, b in self.equations().items()]
        return displays.card(self.title, displays.pairs(rows), *parts)

    def equations(self) -> dict[str, str]:
        """Those of `graphs`, by title."""
        return equations_of(self)

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        first = Rule(least=0.0, drawn_by_effect=True)
        found = {EACH_CELL.format(n): (self.initial.get(n, 0.0), first) for n in self.species}
        found["molecules_per_unit"] = (self.molecules_per_unit, Rule(above=0.0, scope=COLONY))
        return found | {n: (v, CONSTANT) for n, v in self.parameters.items()}

    def declares(self, dim: int) -> tuple[Field, ...]:
        of_genes = tuple(self.variables[n] for n in self.replicated)
        again = self.diluted_fields if self.resets else of_genes
        fields = [
            Field(
                self.variables[n],
                "concentration in the cell",
                self.concentration_unit,
                initial=First(self, n),
                at_division="reset" if self.variables[n] in again else "copy",
            )
            for n in self.species
        ]
        name, meaning = self.volume_field, "volume that the concentrations refer to"
        fields.append(
            Field(name, meaning, "µm³", initial=volume_of, at_division="reset", internal=True)
        )
        return (*fields, CELL_TYPE) if EVERY not in self.rates else tuple(fields)

    def clash_hint(self, name: str) -> str:
        return (
            ' Give one circuit a name, Circuit(…, name="second"), or share the species, Circuit(…,'
            f" shared=({name!r},))."
        )

    def at_least_zero(self) -> tuple[str, ...]:
        return self.own_fields

    def reads(self) -> tuple[str, ...]:
        typed = () if EVERY in self.rates else ("cell_type",)
        return (*self.variables.values(), self.volume_field, "length", "radius", *typed)

    def needs(self) -> tuple[str, ...]:
        return tuple(self.shared.values())

    def writes(self) -> tuple[str, ...]:
        return (*self.variables.values(), self.volume_field)

    def idle_without(self, state: State) -> Mapping[str, str]:
        kinds = [k for k in self.rates if isinstance(k, int)]
        there = state.fields["cell_type"].unique().tolist() if kinds and state.cells else kinds
        if not (lacking := [k for k in kinds if k not in there]):
            return {}
        return {"cell_type": no_cells_of(self.value_owner(), lacking, there)}

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (BoundCircuit(self, binding),)

    # --- what explaining and tuning need -------------------------------------------------

    def accuracy_knobs(self) -> Mapping[str, float]:
        return {"rtol": self.rtol} if self.method == STIFF else {}

    def accuracy_parameters(self) -> Mapping[str, str]:
        return {"rtol": f"{self.rtol:g}"} if self.method == STIFF else {}

    def with_settings(self, settings: Any) -> Circuit:
        if self.method != STIFF or settings.rtol is None:
            return self
        return self._with(rtol=checks.number("Circuit.rtol", settings.rtol, above=0.0, most=0.1))

    def without_noise(self) -> Circuit:
        """The same circuit by the stiff solver: of reactions that run molecule by molecule, the
        mean of many molecules."""
        return self._with(method=STIFF, daughters="amount") if self.is_stochastic else self

    def _with(self, **changes: object) -> Circuit:
        changed = copy.copy(self)
        for name, value in changes.items():
            object.__setattr__(changed, name, value)
        return changed


OPTION_NAMES = tuple(
    n for n in inspect.signature(Circuit.__init__).parameters
    if n not in ("self", "rates", "species", "initial", "dilution", "parameters")
)  # fmt: skip

"""With which concentrations of a circuit new cells begin: the first ones, and daughters; and which
species daughters may be without."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.circuits.graph import null_space
from torchfilm.circuits.molecules import whole
from torchfilm.circuits.partition import binomial
from torchfilm.effects.circuit_cells import cells_of_type
from torchfilm.resolver import Values
from torchfilm.state import State

if TYPE_CHECKING:
    from torchfilm.effects.bound_circuit import BoundCircuit
    from torchfilm.effects.circuit import Circuit

EACH_CELL = "initial[{!r}]"  # by which name the first value of a species is resolved


@dataclass(frozen=True, eq=False)
class First:
    """Concentrations (M,) of new cells: at the start as `initial` says, of daughters as `daughters`
    and `replicated` say."""

    circuit: Circuit
    species: str

    def __call__(self, state: State, rows: Tensor, values: Values) -> Tensor:
        circuit, name = self.circuit, self.species
        if not state.births:
            first = values[EACH_CELL.format(name)]
            return first.of_rows(state, rows, f"Circuit.{circuit.variables[name]}")
        births, own = state.births[-1], circuit.variables[name]
        before = births.parents
        everyone = torch.arange(births.first.numel(), device=state.device)
        draw = lambda what: before.uniform(everyone, f"{what} {own}")
        amount = before.fields[own] * before.fields[circuit.volume_field]
        volumes = [state.volume.index_select(0, r) for r in (births.first, births.second)]
        per_unit: float | Tensor = 1.0
        if circuit.is_stochastic:
            per_unit = values.molecules_per_unit.of_cells(before)
            amount = whole(amount * per_unit, lambda: draw("whole"))
        if name in circuit.replicated:
            return torch.cat([amount / (v * per_unit) for v in volumes])
        share = volumes[0] / (volumes[0] + volumes[1])
        if not circuit.is_stochastic:
            return torch.cat([amount * share / volumes[0], amount * (1 - share) / volumes[1]])
        taken = binomial(amount, share, draw("partition"))
        return torch.cat(
            [taken / (volumes[0] * per_unit), (amount - taken) / (volumes[1] * per_unit)]
        )


def single_genes(bound: BoundCircuit, state: State) -> list[tuple[str, ...]]:
    """Species whose sum no reaction changes, of which cells that have any have one molecule or two
    to begin with, and daughters as chance has it: as of the states of a gene."""
    circuit, found = bound.effect, []
    size = state.volume * bound.values.molecules_per_unit.of_cells(state)
    for kind, network in bound.networks.items():
        rows = cells_of_type(state, kind)
        for weights in null_space(network.stoichiometry.cpu().numpy()):
            names = tuple(n for n, w in zip(network.names, weights, strict=True) if w)
            alike = all(w in (0, 1) for w in weights) and all(n in circuit.species for n in names)
            if not alike or set(names) <= set(circuit.replicated):
                continue
            held = sum(state.fields[circuit.variables[n]] * size for n in names)[rows].round()
            some = held[held > 0]
            if some.numel() and float(some.mean()) < 2.5:
                found.append(names)
    return list(dict.fromkeys(found))


def volume_of(state: State, rows: Tensor, values: Values) -> Tensor:
    """The volume to which concentrations refer."""
    return state.volume.index_select(0, rows)

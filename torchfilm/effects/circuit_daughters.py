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
from torchfilm.resolver import Values
from torchfilm.state import State
from torchfilm.tools.warn_once import warn

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
        amount = before.fields[own] * before.fields[circuit.volume_field]
        volumes = [state.volume.index_select(0, r) for r in (births.first, births.second)]
        per_unit: float | Tensor = 1.0
        if circuit.is_stochastic:
            per_unit = values.molecules_per_unit.of_cells(before)
            everyone = torch.arange(amount.numel(), device=amount.device)
            draw = lambda what: before.uniform(everyone, f"{what} {own}")
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
    """Species whose sum no reaction changes, of which cells have one molecule or two to begin
    with, and daughters as chance has it: as of the states of a gene."""
    circuit, found = bound.effect, []
    size = state.volume * bound.values.molecules_per_unit.of_cells(state)
    held = {n: float((state.fields[f] * size).mean()) for n, f in circuit.variables.items()}
    for network in bound.networks.values():
        for weights in null_space(network.stoichiometry.cpu().numpy()):
            names = tuple(n for n, w in zip(network.names, weights, strict=True) if w)
            alike = all(w in (0, 1) for w in weights) and all(n in circuit.species for n in names)
            count = sum(held.get(n, 0.0) for n in names)
            if alike and 0.5 < count < 2.5 and not set(names) <= set(circuit.replicated):
                found.append(names)
    return list(dict.fromkeys(found))


def warn_of_lost_genes(owner: str, names: tuple[str, ...]) -> None:
    """Warn of species that a division shares among daughters though there is next to nothing."""
    warn(
        f"{owner}: no reaction changes the number of {' + '.join(names)}, cells begin with one or"
        " two, and division shares them: soon most cells have none. If it is a gene, which cells"
        f" replicate before they divide, add replicated={names} to the circuit."
    )


def volume_of(state: State, rows: Tensor, values: Values) -> Tensor:
    """The volume to which concentrations refer."""
    return state.volume.index_select(0, rows)

"""The cells that a circuit is in, and what its rates may read of them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.state import CELL, State

# The type of the cells that have a circuit; a word where it is in all cells.
Kind = int | str

OF_CELLS = ("length", "radius", "volume", "area", "uid")
OF_STEPS = ("time", "dt")


def cell_names(state: State, species: tuple[str, ...]) -> list[str]:
    """What a rate function may read of its cell."""
    fields = [n for n in state.fields if state.declared[n].scope == CELL and n not in species]
    return [*fields, *OF_CELLS, *"xyz"[: state.dim], "colony", *OF_STEPS]


def cell_column(state: State, name: str) -> Tensor:
    if name in OF_CELLS:
        return getattr(state, name)
    if name in ("x", "y", "z"):
        return state.position[:, "xyz".index(name)].to(state.dtype)
    if name == "colony":
        return state.own_colony_id
    if name in OF_STEPS:
        return state.length.new_full((), getattr(state, name))
    return state.fields[name]


def cells_of_type(state: State, kind: Kind) -> Tensor:
    """The cells in which a circuit runs, (M,)."""
    if isinstance(kind, str):
        return torch.arange(state.cells, device=state.device)
    types = state.fields["cell_type"]
    if state.device.type == "cpu":  # torch takes six times as long for a hundred cells
        return torch.from_numpy((types.numpy() == kind).nonzero()[0])
    return torch.nonzero(torch.eq(types, kind)).squeeze(1)

"""Sheets of cells from a state, and what scripts have set as a new state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.cellmodeller.cell import READ_ONLY, UNSET, Cell, Sheet, written
from torchfilm.cellmodeller.rates import SIGNAL, SPECIES
from torchfilm.cellmodeller.variables import COLOR, FIELDS, GREY, Variable
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.state import CELL_TYPE, Field, State
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

TOUCHING = 0.05  # µm between surfaces of neighbours
SHARES = (
    "the script sets cell.asymm, which CellModeller's CLBacterium does not use: cells divide in the"
    " middle, here as well."
)


@dataclass(frozen=True)
class CellLayout:
    """What cells of a script have. variables by name; species, signals: how many; neighbours:
    whether contacts are listed (CLBacterium(compNeighbours=True))."""

    variables: Mapping[str, Variable]
    species: int
    signals: int
    neighbours: bool

    def known(self) -> set[str]:
        """The names that a script may set in a cell."""
        return {*self.variables, *FIELDS, *READ_ONLY, *(("species",) if self.species else ())}

    def species_fields(self) -> list[str]:
        return [SPECIES.format(k) for k in range(self.species)]


def sheet_of(state: State, layout: CellLayout, rows: Tensor | None = None) -> Sheet:
    """The sheet of all cells, or of the cells `rows` (M,)."""
    reader = _Reader(state, layout, rows)
    levels = {"species": reader.species} if layout.species else {}
    if layout.signals:
        levels["signals"] = reader.signals
    return Sheet(reader, levels)


class _Reader:
    """Reads columns of a state by the names of CellModeller."""

    def __init__(self, state: State, layout: CellLayout, rows: Tensor | None):
        self.state, self.layout, self.rows = state, layout, rows
        self.count = state.cells if rows is None else rows.numel()

    def __call__(self, name: str) -> Sequence[Any] | None:
        known = self.layout.variables.get(name)
        if known is not None:
            return self._variable(known)
        own = getattr(self, "_" + name, None) if name in (*READ_ONLY, *FIELDS) else None
        return None if own is None else own()

    def take(self, values: Tensor) -> Tensor:
        return values if self.rows is None else values.index_select(0, self.rows)

    def _variable(self, known: Variable) -> Sequence[Any]:
        if known.field in self.state.fields:
            return known.shown(self.take(self.state.fields[known.field]))
        grey = known.name == COLOR
        return [[GREY] * 3 if grey else UNSET for _ in range(self.count)]

    def _field(self, name: str, default: Any) -> list[Any]:
        if name not in self.state.fields:
            return [default] * self.count
        return self.take(self.state.fields[name]).tolist()

    def _growthRate(self) -> list[float]:
        return self._field("growth_rate", 1.0)

    def _cellType(self) -> list[int]:
        return self._field("cell_type", 0)

    def _divideFlag(self) -> list[bool]:
        return self._field("divide_flag", False)

    def _cellAdh(self) -> list[int]:
        return [0] * self.count

    def _id(self) -> list[int]:
        return (self.take(self.state.uid) + 1).tolist()

    def _idx(self) -> list[int]:
        first = torch.cumsum(self.state.counts, 0) - self.state.counts
        place = torch.arange(self.state.cells, device=self.state.device)
        return self.take(place - first.index_select(0, self.state.colony)).tolist()

    def _time(self) -> list[float]:
        return [self.state.time] * self.count

    def _length(self) -> list[float]:
        return self.take(self.state.length).tolist()

    _volume = _length  # as in CellModeller

    def _radius(self) -> list[float]:
        return self.take(self.state.radius).tolist()

    def _vectors(self, values: Tensor) -> np.ndarray:
        """Vectors (M, d) in three dimensions."""
        made = np.zeros((self.count, 3))
        made[:, : values.shape[1]] = self.take(values).detach().cpu().numpy()
        return made

    def _pos(self) -> list[Any]:
        return [tuple(x) for x in self._vectors(self.state.position).tolist()]

    def _dir(self) -> list[Any]:
        return [tuple(x) for x in self._vectors(self.state.axis).tolist()]

    def _ends(self) -> list[Any]:
        centre = self._vectors(self.state.position)
        half = self._vectors(self.state.axis) * (np.array(self._length())[:, None] / 2)
        made = np.stack([centre - half, centre + half], 1)
        made.flags.writeable = False
        return [tuple(x) for x in made]

    def _neighbours(self) -> list[list[int]]:
        s = self.state
        if not self.layout.neighbours:
            warn(
                "the script reads cell.neighbours, which is empty in CellModeller and here without"
                " CLBacterium(compNeighbours=True)."
            )
            return [[] for _ in range(self.count)]
        i, j, gap = gaps_nearby(
            s.position, s.axis, s.length, s.radius, s.colony, s.colonies, TOUCHING, s.space
        )
        keep = gap <= TOUCHING
        found: list[list[int]] = [[] for _ in range(s.cells)]
        uid = (s.uid + 1).tolist()
        for a, b in zip(i[keep].tolist(), j[keep].tolist(), strict=True):
            found[a].append(uid[b])
            found[b].append(uid[a])
        found = [sorted(x) for x in found]
        return found if self.rows is None else [found[k] for k in self.rows.tolist()]

    def _cts(self) -> list[int]:
        return [len(x) for x in self._neighbours()]

    def species(self) -> np.ndarray:
        fields = self.state.fields
        zero = torch.zeros(self.state.cells, device=self.state.device)
        each = [self.take(fields.get(n, zero)).detach() for n in self.layout.species_fields()]
        return torch.stack(each, 1).cpu().numpy().astype(np.float64)

    def signals(self) -> np.ndarray:
        each = [self.take(x) for x in found_signals(self.state, self.layout)]
        return torch.stack(each, 1).detach().cpu().numpy().astype(np.float64)


def found_signals(state: State, layout: CellLayout) -> list[Tensor]:
    """The concentration of each signal at each cell, (N,); 0 before the medium is laid."""
    contact = state.contact()
    if contact is None:
        return [torch.zeros_like(state.length)] * layout.signals
    return [contact.found[SIGNAL.format(k)] for k in range(layout.signals)]


def first_fields(layout: CellLayout) -> list[Field]:
    """The fields in which a script's cells begin; the scene's effects declare them again."""
    return [
        CELL_TYPE,
        Field("growth_rate", "relative growth rate", initial=1.0),
        Field("divide_flag", "divides at the next opportunity", dtype=torch.bool),
        *(v.declared() for v in layout.variables.values()),
        *(Field(n, "species of the script") for n in layout.species_fields()),
    ]


def with_written(
    state: State,
    layout: CellLayout,
    sheet: Sheet,
    cells: Sequence[Cell],
    rows: Tensor | None = None,
) -> tuple[State, Tensor | None]:
    """The state with what a script has set in cells, and which cells it has marked as dead (N,), or
    None. rows: of the sheet's cells in the state."""
    found = written(cells)
    changed = sheet.changed_species()
    values: dict[str, Tensor] = {}
    own = torch.arange(state.cells) if rows is None else rows.cpu()

    def put(field: str, at: Sequence[int], new: np.ndarray) -> None:
        column = values.get(field, state.fields[field]).clone()
        to = own[torch.as_tensor(at, dtype=torch.int64)].to(column.device)
        column[to] = torch.as_tensor(new).to(column.dtype).to(column.device)
        values[field] = column

    if changed is not None:
        for k, name in enumerate(layout.species_fields()):
            put(name, range(len(changed)), changed[:, k])
    dead = None
    for name, (at, given) in found.items():
        if name == "deathFlag":
            dead = torch.zeros(state.cells, dtype=torch.bool)
            dead[own[torch.as_tensor(at)]] = torch.as_tensor([bool(x) for x in given])
        elif name == "species" and layout.species:
            each = np.stack([np.broadcast_to(np.asarray(x, float), layout.species) for x in given])
            for k, field in enumerate(layout.species_fields()):
                put(field, at, each[:, k])
        elif name in FIELDS:
            put(FIELDS[name], at, _plain(name, given))
        elif name in layout.variables:
            known = layout.variables[name]
            put(known.field, at, known.column(given))
        elif name in READ_ONLY:
            _warn_ignored(name)
        elif name == "asymm":
            warn(SHARES)
        else:
            raise InputError(
                f"cell.{name} is set for the first time after the start: set it in init(cell) as"
                " well, so that all cells have it."
            )
    return state.with_fields(**values), None if dead is None else dead.to(state.device)


def _plain(name: str, given: Sequence[Any]) -> np.ndarray:
    """One number per cell."""
    made = np.asarray(given)
    if made.ndim != 1 or made.dtype.kind not in "biuf":
        raise InputError(f"cell.{name} = {given[0]!r} is not supported: it must be one number.")
    if name == "cellType" and ((made != np.round(made)) | (made < 0)).any():
        raise InputError(f"cell.cellType = {given[0]!r}: it must be a whole number from 0.")
    if name == "growthRate":
        check_growth(torch.as_tensor(made))
    return made


def check_growth(rates: Tensor) -> None:
    """Raise InputError for a growth rate that no cell can have."""
    bad = ~(rates >= 0)
    if bool(bad.any()):
        raise InputError(f"cell.growthRate = {float(rates[bad][0]):g}: it must be at least 0, 1/h.")


def _warn_ignored(name: str) -> None:
    warn(f"the script sets cell.{name}, which changes nothing, here as in CellModeller.")

"""A rehearsal of a script's functions: which variables its cells have."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch

from torchfilm.cellmodeller import draws
from torchfilm.cellmodeller.cell import READ_ONLY, Cell, written
from torchfilm.cellmodeller.globals_watch import GlobalsWatch
from torchfilm.cellmodeller.loading import Script, importing
from torchfilm.cellmodeller.sheets import CellLayout, first_fields, sheet_of, with_written
from torchfilm.cellmodeller.variables import COLOR, FIELDS, GREY, HISTORY, Variable, variable
from torchfilm.initial_cells import Cells
from torchfilm.state import State
from torchfilm.tools.checks import InputError


def rehearse(script: Script, bare: CellLayout, founders: Cells) -> tuple[CellLayout, State]:
    """The layout with the script's variables, which `init`, `update` and `divide` set on copies of
    the first cells, and these cells after `init`. Global variables are as before afterwards."""
    state = founders.state(1, 0, torch.device("cpu"), torch.float32)
    named: dict[str, Variable] = {}
    if any(script.mentions(n) for n in HISTORY):  # these need each other
        named = {n: variable(n, [0 if n == "cellAge" else 0.0]) for n in HISTORY}
    state = _with_first(state, named)
    known = CellLayout(named, bare.species, bare.signals, bare.neighbours)
    sheet = sheet_of(state, known)
    cells = {k + 1: Cell(sheet, k) for k in range(state.cells)}
    everyone = list(cells.values())
    for cell in everyone:
        cell.__dict__[COLOR] = [GREY] * 3
    watch = GlobalsWatch(script.module)
    with draws.kept(), importing(script):
        seen = [_rehearsed(script, "init", [[c] for c in everyone], everyone)]
        first = [copy.deepcopy(cell.__dict__) for cell in everyone]
        script.sim._at(0, cells)
        seen.append(_rehearsed(script, "update", [[cells]], everyone))
        script.sim._at(0)
        if script.function("divide") is not None:
            family = [_copied(everyone[0]) for _ in range(3)]
            seen.append(_rehearsed(script, "divide", [family], family))
    watch.restore()
    found: dict[str, list[Any]] = {}
    for values in seen:
        for name, (_, given) in values.items():
            found.setdefault(name, []).extend(given)
    if not script.mentions(COLOR):
        del found[COLOR]
    variables = {**named, **_variables(script, found, named, bare)}
    layout = CellLayout(variables, bare.species, bare.signals, bare.neighbours)
    return layout, _first_state(state, layout, first)


def _copied(cell: Cell) -> Cell:
    made = Cell(cell._sheet, cell._row)
    made.__dict__.update(copy.deepcopy(cell.__dict__))
    return made


def _first_state(state: State, layout: CellLayout, first: Sequence[dict[str, Any]]) -> State:
    """The first cells with what `init` has set."""
    for field in first_fields(layout):
        if field.name not in state.fields:
            state = state.declare(field)
    sheet = sheet_of(state, layout)
    cells = [Cell(sheet, k) for k in range(state.cells)]
    for cell, values in zip(cells, first, strict=True):
        there = {n: v for n, v in values.items() if n != "length" and n in layout.known()}
        cell.__dict__.update(there)
    return with_written(state, layout, sheet, cells)[0]


def _with_first(state: State, named: dict[str, Variable]) -> State:
    for known in named.values():
        state = state.declare(known.declared())
    zero = torch.zeros(state.cells, dtype=torch.float64)
    length = state.length.double()
    values = {n: length if n in ("oldLen", "startVol") else zero for n in named}
    return state.with_fields(**values)


def _rehearsed(script: Script, name: str, calls: Sequence[list[Any]], cells: list[Cell]) -> Any:
    function = script.function(name)
    if function is None:
        raise InputError(f"{script.path.name} has no function {name}.")
    with script.errors(f"{name}(…)"), script.limited():
        for given in calls:
            draws.seed("rehearsal", name)
            function(*given)
    return written(cells)


def _variables(
    script: Script, found: dict[str, list[Any]], named: dict[str, Variable], bare: CellLayout
) -> dict[str, Variable]:
    """The variables among all that the script has set."""
    others = {*READ_ONLY, *FIELDS, *named, "deathFlag"}
    if bare.species:
        others.add("species")
    if not bare.signals:
        others.discard("signals")
    made = {}
    for name in found.keys() - others:
        try:
            made[name] = variable(name, found[name])
        except InputError as error:
            raise InputError(f"{script.place_of(name)}: {error}") from error
    return {name: made[name] for name in sorted(made)}

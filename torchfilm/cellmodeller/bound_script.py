"""A script's functions bound to a batch: called in each step, colony by colony."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.cellmodeller import draws
from torchfilm.cellmodeller.cell import Cell
from torchfilm.cellmodeller.columns import Uneven
from torchfilm.cellmodeller.globals_watch import GlobalsWatch
from torchfilm.cellmodeller.loading import INNER_IMPORT, importing
from torchfilm.cellmodeller.sheets import SHARES, first_fields, sheet_of, with_written
from torchfilm.cellmodeller.variables import HISTORY
from torchfilm.effect import Binding, BoundEffect
from torchfilm.state import Births, Field, State
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.cellmodeller.script_rules import ScriptRules


class _Bound(BoundEffect):
    """What both parts share."""

    effect: ScriptRules

    def __init__(self, effect: ScriptRules, binding: Binding):
        super().__init__(effect, binding)
        self.script, self.layout = effect.script, effect.layout
        self.history = [n for n in HISTORY if n in self.layout.variables]
        self.script.watch = GlobalsWatch(self.script.module)

    def reads(self) -> tuple[str, ...]:
        return (
            "cells", "position", "axis", "length", "radius", "growth_rate", "cell_type",
            *self._own_fields(), *self._signals(),
        )  # fmt: skip

    def writes(self) -> tuple[str, ...]:
        dies = ("cells",) if self.script.mentions("deathFlag") else ()
        return ("growth_rate", "divide_flag", "cell_type", *self._own_fields(), *dies)

    def _own_fields(self) -> list[str]:
        return [
            *(v.field for v in self.layout.variables.values()), *self.layout.species_fields()
        ]  # fmt: skip

    def _signals(self) -> list[str]:
        return [f"out.signal{k}" for k in range(self.layout.signals)]

    def _imports(self) -> AbstractContextManager[None]:
        """Within, imports in the script's functions find what they found at the start."""
        return importing(self.script) if INNER_IMPORT.search(self.script.text) else nullcontext()

    @contextmanager
    def running(self, doing: str, state: State, starting: bool = False) -> Iterator[None]:
        """Errors of the script with their line, and its global variables watched."""
        self.script.sim._at(state.step)
        try:
            with draws.kept(), self._imports(), self.script.errors(doing):
                yield
        except InputError as error:
            if starting:
                raise
            raise SimulationError(str(error)) from error
        assert self.script.watch is not None
        changed = self.script.watch.changed()
        if not changed:
            return
        names = ", ".join(changed)
        self.script.watch = GlobalsWatch(self.script.module)
        if state.colonies > 1:
            raise SimulationError(
                f"{self.script.path.name}: {doing} changes the global variable {names}, which all"
                " colonies share, so that they would depend on each other. Run one colony, or keep"
                " the value in the cells."
            )
        warn(
            f"{self.script.path.name}: {doing} changes the global variable {names}. Results do not"
            " hold it: a resumed run begins with its first value. Keep it in the cells."
        )


class BoundScript(_Bound):
    """`init` of the first cells, and `update` at the start of each step."""

    def lay(self, state: State) -> State:
        """The first cells as `init(cell)` makes them."""
        sheet = sheet_of(state, self.layout)
        cells = [Cell(sheet, row) for row in range(state.cells)]
        init = self.script.function("init")
        assert init is not None
        with self.running("init(cell)", state, starting=True):
            for cell, stream, uid in zip(
                cells, state.own_stream.tolist(), state.uid.tolist(), strict=True
            ):
                draws.seed(state.seed, stream, "init", uid)
                init(cell)
        given = {*state.fields}
        for wanted in first_fields(self.layout):
            if wanted.name not in given:
                state = state.declare(wanted)
        for cell in cells:  # first cells from a table keep their own values
            for name in [n for n in cell.__dict__ if self._field_of(n) in given - {"cell_type"}]:
                del cell.__dict__[name]
        state = _with_lengths(state, cells)
        state, _ = with_written(state, self.layout, sheet, cells)
        return self._with_history(state, given)

    def _field_of(self, name: str) -> str:
        known = self.layout.variables.get(name)
        return known.field if known is not None else name

    def _with_history(self, state: State, given: set[str]) -> State:
        """First values of what CellModeller keeps of each cell's past. An age of −1 says that no
        step has passed since the start."""
        length = state.length.double()
        first = {
            "cellAge": torch.full_like(length, -1.0), "strainRate": torch.zeros_like(length),
            "effGrowth": torch.zeros_like(length), "oldLen": length, "startVol": length,
        }  # fmt: skip
        return state.with_fields(**{n: first[n] for n in self.history if n not in given})

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        state = self._after_step(state)
        if self.effect.rule is None:
            return self._cell_by_cell(state)
        with self.running("update(cells)", state):
            try:
                return self.effect.rule.act(state)
            except Uneven as error:
                raise InputError(
                    f"update(cells) cannot act on whole columns any more ({error}). Run it cell by"
                    " cell: --set loop=cells."
                ) from error

    def _after_step(self, state: State) -> State:
        """What CellModeller notes of a cell after each step, from the length before it."""
        if not self.history:
            return state
        f, length = state.fields, state.length.double()
        old, moved = f["oldLen"], f["cellAge"] >= 0
        grown = torch.where(moved, length - old, 0.0)
        age = f["cellAge"].clamp(min=0.0)
        mean = (f["effGrowth"] * age + grown) / (age + 1.0)
        return state.with_fields(
            strainRate=torch.where(moved, grown / old, 0.0),
            effGrowth=torch.where(moved, mean, f["effGrowth"]),
            cellAge=f["cellAge"] + 1.0,
            oldLen=length,
        )

    def _cell_by_cell(self, state: State) -> State:
        update = self.script.function("update")
        assert update is not None
        sheet = sheet_of(state, self.layout)
        uid, counts = state.uid.tolist(), state.counts.tolist()
        cells, start = [], 0
        with self.running("update(cells)", state):
            for count, stream in zip(counts, state.stream.tolist(), strict=True):
                mine = {uid[k] + 1: Cell(sheet, k) for k in range(start, start + count)}
                cells += list(mine.values())
                start += count
                if mine:
                    draws.seed(state.seed, stream, state.step, "update")
                    self.script.sim._at(state.step, dict(mine))
                    _call_on(update, mine)
            state, dead = with_written(state, self.layout, sheet, cells)
        return state if dead is None else state.remove(dead, "removed")


def _call_on(update: Callable[..., Any], cells: dict[int, Cell]) -> None:
    before = list(cells)
    update(cells)
    if list(cells) != before:
        raise InputError(
            "update(cells) adds or deletes entries of `cells`: set cell.deathFlag = True to remove"
            " a cell."
        )


def _with_lengths(state: State, cells: list[Cell]) -> State:
    """The state with lengths that init has set, which CellModeller takes over."""
    set_ = {cell._row: cell.__dict__.pop("length") for cell in cells if "length" in cell.__dict__}
    if not set_:
        return state
    length = state.length.clone()
    for row, value in set_.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= 0:
            raise InputError(f"init sets cell.length = {value!r}: it must be a number from 0, µm.")
        length[row] = float(value)
    return state.replace(length=length)


class ScriptDivision(_Bound):
    """`divide(parent, d1, d2)` after each division."""

    def __init__(self, effect: ScriptRules, binding: Binding):
        super().__init__(effect, binding)
        self.stage, self.title = binding.division_stage + 1, "script at division"

    def declares(self) -> list[Field]:
        return []

    def step(self, state: State, dt: float) -> State:
        for births in state.births:
            self._warn_of_shares(births.parents)
            state = self._daughters(state, torch.cat([births.first, births.second]))
            if self.script.function("divide") is not None:
                state = self._divide(state, births)
        return state

    def _warn_of_shares(self, parents: State) -> None:
        share = self.layout.variables.get("asymm")
        if share is not None and share.shape == (2,):
            one, other = parents.fields[share.field].unbind(1)
            if bool((one - other).abs().gt(0).any()):
                warn(SHARES)

    def _daughters(self, state: State, rows: Tensor) -> State:
        """What CellModeller resets in daughters."""
        length = state.length.index_select(0, rows).double()
        zero = torch.zeros_like(length)
        new = {"cellAge": zero, "strainRate": zero, "oldLen": length, "startVol": length}
        return state.with_fields(
            **{n: state.fields[n].index_copy(0, rows, new[n]) for n in self.history if n in new}
        )

    def _divide(self, state: State, births: Births) -> State:
        divide = self.script.function("divide")
        assert divide is not None
        parents = sheet_of(births.parents, self.layout)
        sheets = [sheet_of(state, self.layout, r) for r in (births.first, births.second)]
        mothers = births.parents
        cells: list[list[Cell]] = [[], []]
        with self.running("divide(parent, d1, d2)", state):
            for k, (stream, uid) in enumerate(
                zip(mothers.own_stream.tolist(), mothers.uid.tolist(), strict=True)
            ):
                pair = [Cell(sheet, k) for sheet in sheets]
                draws.seed(state.seed, stream, state.step, "divide", uid)
                divide(Cell(parents, k), *pair)
                cells[0].append(pair[0])
                cells[1].append(pair[1])
            for sheet, mine, rows in zip(sheets, cells, (births.first, births.second), strict=True):
                state, _ = with_written(state, self.layout, sheet, mine, rows)
        return state

    def numerics(self, dt: float, state: State) -> list[str]:
        return ["divide(parent, d1, d2), one division after the other"]

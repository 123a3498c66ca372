"""Colonies of a state as wholes, some of them taken out or put in the place of others; and what
their cells draw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.tools import checks, displays, random, row_checks
from torchfilm.tools.ragged import offsets, order_within
from torchfilm.tools.threads import one_torch_thread

if TYPE_CHECKING:
    from torchfilm.state import State

CELL, COLONY, GRID = "cell", "colony", "grid"
PER_COLONY = ("colony_id", "stream", "next_uid")


@dataclass(frozen=True)
class Ended:
    """Cells that left in one step: why, of `FATES`; and colony ids, uids and lengths (M,), and
    their types, None in a scene without types."""

    fate: str
    colony_id: Tensor
    uid: Tensor
    length: Tensor
    cell_type: Tensor | None


@dataclass(frozen=True)
class Arrived:
    """Cells that came from outside, not by division: colony ids, uids and lengths (M,); the step
    and the time, h, at which they came."""

    colony_id: Tensor
    uid: Tensor
    length: Tensor
    step: int
    time: float

    def moved(self, move: Callable[[Any], Any]) -> Arrived:
        columns = {n: move(getattr(self, n)) for n in ("colony_id", "uid", "length")}
        return replace(self, **columns)


def note_of(state: State, rows: Tensor, fate: str) -> Ended:
    """That the cells `rows` (M,) of a state leave."""
    colony = state.colony_id.index_select(0, state.colony.index_select(0, rows))
    uid, length = (x.index_select(0, rows) for x in (state.uid, state.length))
    kind = state.fields.get("cell_type")
    return Ended(fate, colony, uid, length, None if kind is None else kind.index_select(0, rows))


def drawn(state: State, law: Callable[..., Tensor], rows: Tensor, purpose: str) -> Tensor:
    """See `State.uniform`. law: of `torchfilm.tools.random`."""
    row_checks.check_rows("rows", rows, state.cells)
    if not isinstance(purpose, str):
        raise checks.input_error("purpose", purpose, "a text")
    try:
        stream = state.stream.index_select(0, state.colony.index_select(0, rows))
        uid = state.uid.index_select(0, rows)
    except IndexError as error:
        raise row_checks.out_of_range("rows", rows, state.cells) from error
    return law(state.seed, stream, uid, state.step, purpose, state.dtype)


def sampled(state: State, count: int, purpose: str) -> Tensor:
    """See `State.sample_cells`."""
    count = checks.integer("sample_cells(count)", count, least=0)
    every = torch.arange(state.cells, device=state.device)
    # two draws, since one has values that repeat among many cells
    coarse, fine = (drawn(state, random.uniform, every, f"{purpose} {k}") for k in (0, 1))
    order = order_within(state.colony, random.fine_uniform(coarse, fine))
    rank = every - offsets(state.counts)[state.colony[order]]
    return torch.zeros_like(every, dtype=torch.bool).index_copy(0, order, rank < count)


def selected(state: State, places: Tensor) -> State:
    """The colonies at these places (b,) int64, in this order; one may come more than once."""
    counts = state.counts.index_select(0, places)
    owner = torch.repeat_interleave(torch.arange(places.numel(), device=state.device), counts)
    begin = offsets(counts)[:-1].index_select(0, owner)
    within = torch.arange(owner.numel(), device=state.device) - begin
    taken = state.take(state.groups.begin.index_select(0, places).index_select(0, owner) + within)
    layout, nodes = (None, None) if state.layout is None else state.layout.take(places)
    kept = {CELL: None, COLONY: places, GRID: nodes}
    fields = {
        n: v if (index := kept[state.declared[n].scope]) is None else v.index_select(0, index)
        for n, v in taken.fields.items()
    }
    return taken.replace(
        colony=owner,
        fields=fields,
        layout=layout,
        births=(),
        ended=(),
        arrived=(),
        reports={},
        **{name: getattr(state, name).index_select(0, places) for name in PER_COLONY},
    )


@one_torch_thread()  # the tensors are short
def put(state: State, given: Any, other: State, taken: Any) -> State:
    """See `State.put`."""
    places = row_checks.checked_places("colonies", given, state.colonies, state.device, least=0)
    check_alike(state, other)
    rows = checked_taken(taken, places, other.colonies)
    if places.numel() == 0:
        return state
    order = torch.arange(state.colonies, device=state.device)
    order = order.index_copy(0, places, state.colonies + rows)
    made = selected(_side_by_side(state, other), order)
    layout = made.layout
    if layout is not None and state.layout is not None and layout.grid.alike(state.layout.grid):
        layout = state.layout  # which has found out much about its grid
    return made.replace(colony_id=state.colony_id, stream=state.stream, layout=layout)


def _side_by_side(state: State, other: State) -> State:
    """The colonies of both. Those of the second lie at places after those of the first."""
    joined = lambda name: torch.cat([getattr(state, name), getattr(other, name)])
    owner = torch.cat([state.colony, state.colonies + other.colony])
    columns = [n for n in state.cell_columns() if n not in state.fields and n != "colony"]
    layout = state.layout
    if layout is not None and other.layout is not None:
        layout = layout.joined(other.layout)
    return state.replace(
        colony=owner,
        fields={n: torch.cat([x, other.fields[n]]) for n, x in state.fields.items()},
        layout=layout,
        **{name: joined(name) for name in (*columns, *PER_COLONY)},
    )


def check_alike(state: State, other: State) -> None:
    """Raises InputError for a state whose colonies cannot stand beside those of a first one."""
    if not isinstance(other, type(state)):
        raise checks.input_error("other", other, "a State, such as model.start()")
    for what in ("dim", "dtype", "device", "space"):
        mine, theirs = getattr(state, what), getattr(other, what)
        if mine != theirs:
            raise checks.input_error(f"other.{what}", theirs, f"{mine}, as this state has")
    names = sorted(state.fields.keys() ^ other.fields.keys())
    hint = "Take a state of the same scene, such as model.start()."
    if names:
        has, lacks = ("this", "the other") if names[0] in state.fields else ("the other", "this")
        found = f"of another scene: {has} state has the field {names[0]!r}, {lacks} has not"
        raise checks.InputError(f"other is {found}. {hint}")
    for name, value in state.fields.items():
        theirs, scope = other.fields[name], state.declared[name].scope
        if value.dtype != theirs.dtype or value.shape[1:] != theirs.shape[1:]:
            raise checks.input_error(
                f"other.fields[{name!r}]", f"{tuple(theirs.shape)}, {theirs.dtype}",
                f"of rows {tuple(value.shape[1:])} and {value.dtype}, as in this state", hint,
            )  # fmt: skip
        if other.declared[name].scope != scope:
            raise checks.input_error(f"scope of {name!r}", other.declared[name].scope, scope, hint)
    if state.layout is not None and other.layout is not None:
        mine, theirs = (
            (x.grid.spacing, x.periodic, x.height) for x in (state.layout, other.layout)
        )
        if mine != theirs:
            what = "other's spacing, periodic axes and height"
            raise checks.input_error(what, theirs, f"{mine}, as this state's medium has", hint)


def checked_taken(given: Any, places: Tensor, count: int) -> Tensor:
    """Which colonies of another state, of `count`, go to these places; by default the first ones
    in order. Raises InputError where there are not as many."""
    if given is None:
        wanted = displays.counted(places.numel(), "colony", "colonies")
        rule = f"{wanted}, one for each place"
        if count != places.numel():
            has = displays.counted(count, "colony", "colonies")
            raise checks.input_error(
                "other", f"of {has}", rule, "Say which by taken=…, such as taken=[0, 0]."
            )
        return torch.arange(count, device=places.device)
    taken = row_checks.checked_places("taken", given, count, places.device, distinct=False, least=0)
    if taken.numel() != places.numel():
        rule = f"{displays.counted(places.numel(), 'place')}, one for each of `colonies`"
        raise checks.input_error("taken", taken.tolist(), rule)
    return taken

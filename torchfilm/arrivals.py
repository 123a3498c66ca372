"""Cells that come to colonies from outside during a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.initial_cells import GIVEN, Cells
from torchfilm.state import CELL, PER_CELL, State
from torchfilm.state_colonies import Arrived
from torchfilm.tools import checks, row_checks
from torchfilm.tools.threads import one_torch_thread

if TYPE_CHECKING:
    from torchfilm.model import Model


@one_torch_thread()
def with_arrivals(
    model: Model, state: State, cells: Cells, colonies: row_checks.Rows | None
) -> State:
    """See `Model.add`."""
    model.check(state)
    if state.span is not None:
        raise checks.InputError("add puts cells into a state between two steps, not within one.")
    _check_cells(cells, state, typed=model.begin.cells.cell_type is not None)
    places = _places(cells, state, colonies)
    if not places:
        return state
    come = _as_state(cells, places, state)
    made = _beside(state.replace(declared={**state.declared, **model.first_fields}), come)
    rows = torch.nonzero(made.uid >= state.next_uid.index_select(0, made.colony)).squeeze(1)
    made = _ready(model, _with_first_values(model, made, rows, come), rows)
    alone = made.take(rows)
    for effect in model.effects:
        effect.check_arrivals(made, rows)
    ids, length = alone.own_colony_id, alone.length.detach()
    note = Arrived(ids, alone.uid, length, step=state.step, time=state.time)
    return made.replace(arrived=(*state.arrived, note))


def _check_cells(cells: Cells, state: State, typed: bool) -> None:
    """Raise InputError for cells that cannot stand beside those of a state. typed: whether the
    founders have types."""
    if not isinstance(cells, Cells):
        raise checks.input_error("add(cells)", cells, "a tf.Cells, such as tf.inoculum(…)")
    if cells.dim != state.dim:
        raise checks.input_error("add(cells)", f"{cells.dim}-D", f"{state.dim}-D, as the state is")
    has = cells.cell_type is not None
    if (has and "cell_type" not in state.fields) or (typed and not has):
        given, rule = ("with", "without") if has else ("without", "with")
        raise checks.input_error(
            "add(cells)", f"{given} cell_type", f"{rule} cell_type, as the founders are"
        )
    own = [n for n, f in state.declared.items() if f.scope == CELL and not f.internal]
    for name in cells.extra:
        if name not in own:
            rule = f"a variable of the state's cells: {', '.join(own) or 'none'}"
            raise checks.input_error("add(cells).extra", name, rule, checks.suggestion(name, own))


def _places(cells: Cells, state: State, colonies: row_checks.Rows | None) -> dict[int, list[int]]:
    """Which of the cells come to each colony, by its place."""
    if cells.colony is None:
        whole = list(range(cells.count))
        each = list(range(state.colonies))
        if colonies is not None:
            each = row_checks.checked_places(
                "colonies", colonies, state.colonies, state.device, least=0
            ).tolist()
        return {k: whole for k in each if whole}
    if colonies is not None:
        rule = "left out, as the cells have colony numbers"
        raise checks.input_error("add(colonies)", colonies, rule)
    if cells.count and cells.colonies > state.colonies:
        rule = f"below {state.colonies}, the number of colonies of the state"
        raise checks.input_error("add(cells).colony", cells.colonies - 1, rule)
    found: dict[int, list[int]] = {}
    for row, place in enumerate(cells.colony.tolist()):
        found.setdefault(place, []).append(row)
    return dict(sorted(found.items()))


def _as_state(cells: Cells, places: dict[int, list[int]], state: State) -> State:
    """The cells that come, in the order of their colonies, with the numbers that they will have."""
    rows = [row for mine in places.values() for row in mine]
    number = [k for mine in places.values() for k in range(len(mine))]
    place = torch.tensor(
        [k for k, mine in places.items() for _ in mine], dtype=torch.int64, device=state.device
    )
    given = Cells(
        cells.position[rows], cells.axis[rows], cells.length[rows], cells.radius[rows],
        None if cells.cell_type is None else cells.cell_type[rows],
        extra={n: x[rows] for n, x in cells.extra.items()},
    ).state(1, state.seed, state.device, state.dtype)  # fmt: skip
    first = state.next_uid.index_select(0, place)
    return given.replace(colony=place, uid=first + torch.tensor(number, device=state.device))


def _beside(state: State, come: State) -> State:
    """The cells of both, those of a colony side by side, the new ones last. Of their fields, only
    those have values that the new cells bring."""
    order = torch.argsort(torch.cat([state.colony, come.colony]), stable=True)

    def both(old: Tensor, new: Tensor) -> Tensor:
        return torch.cat([old, new.to(old.dtype)]).index_select(0, order)

    def empty(old: Tensor) -> Tensor:
        return old.new_zeros(come.cells, *old.shape[1:])

    counts = torch.bincount(come.colony, minlength=state.colonies)
    fields = {
        n: both(x, come.fields[n] if n in come.fields else empty(x))
        if state.declared[n].scope == CELL
        else x
        for n, x in state.fields.items()
    }
    return state.replace(
        **{n: both(getattr(state, n), getattr(come, n)) for n in PER_CELL},
        fields=fields, next_uid=state.next_uid + counts, births=(),
    )  # fmt: skip


def _with_first_values(model: Model, state: State, rows: Tensor, come: State) -> State:
    """The state whose cells `rows` (M,) have first values of all that they do not bring, in the
    order in which first cells have them."""
    names = [n for n, f in state.declared.items() if f.scope == CELL and n not in come.fields]
    for name in names:
        if name not in model.first_fields and state.declared[name].meaning == GIVEN:
            raise checks.input_error(
                "add(cells).extra", [*come.fields], f"with {name!r}, which the founders brought",
                f"No effect gives it a first value: extra={{{name!r}: …}}.",
            )  # fmt: skip
        first = state.declared[name].start(state, rows)
        state = state.with_fields(**{name: state.fields[name].index_copy(0, rows, first)})
    return state


def _ready(model: Model, state: State, rows: Tensor) -> State:
    """The state made ready for the effects as a first one, but for the cells that were there."""
    ready = state
    for effect in model.effects:
        ready = effect.ready(ready)
    own = {n: x for n, x in state.fields.items() if state.declared[n].scope == CELL}
    return ready.with_fields(
        **{n: x.index_copy(0, rows, ready.fields[n].index_select(0, rows)) for n, x in own.items()}
    )

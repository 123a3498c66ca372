"""What cells of a type keep in fields of their own, and what becomes of it when a rule or a user's
effect gives them another type."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.state import State

if TYPE_CHECKING:
    from torchfilm.effect import BoundEffect


def kept_by_type(effects: Sequence[BoundEffect]) -> tuple[str, ...]:
    """The fields in which cells keep a value that depends on their type, such as a threshold or
    what was drawn for them at birth."""
    found = []
    for bound in effects:
        own = bound.effect.keeps()
        for name, value in vars(bound.values).items():
            if value is None:
                continue
            by_type = value.types is not None or (value.draw is not None and value.draw.types)
            field = value.field or own.get(name)
            if by_type and field is not None:
                found.append(field)
    return tuple(dict.fromkeys(found))


def with_values_of_new_types(before: State, after: State, names: Iterable[str]) -> State:
    """`after`, with cells that were of another type in `before` given the values of their new type
    in these fields, drawn anew where they are drawn; but for what has changed itself."""
    if not before.cells:
        return after
    rows, known = _rows_in(before, after)
    then = lambda name: before.fields[name].index_select(0, rows)
    new_type = known & (then("cell_type") != after.fields["cell_type"])
    changed = {}
    for name in names:
        if name in after.fields:
            value = after.fields[name]
            cells = torch.nonzero(new_type & (value == then(name))).squeeze(1)
            if cells.numel():
                # as of first cells: what the parents have is of another type
                first = after.declared[name].start(after.replace(births=()), cells)
                changed[name] = value.index_copy(0, cells, first)
    return after.with_fields(**changed)


def _rows_in(before: State, after: State) -> tuple[Tensor, Tensor]:
    """The row in `before` of each cell of `after`, (N,), and whether it was there."""
    every = torch.arange(after.cells, device=after.device)
    if before.uid is after.uid and before.colony is after.colony:
        return every, torch.ones_like(every, dtype=torch.bool)
    count = int(max(before.next_uid.max(), after.next_uid.max()))
    of = lambda state: state.colony * count + state.uid
    there, order = torch.sort(of(before))
    place = torch.searchsorted(there, of(after)).clamp(max=before.cells - 1)
    return order[place], there[place] == of(after)

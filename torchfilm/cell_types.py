"""What cells of a type keep in fields of their own, and what becomes of it when a rule or a user's
effect gives them another type."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import torch

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
    """`after`, with cells that were of another type in `before`, row by row, given the values of
    their new type in these fields, drawn anew where they are drawn; but for what has changed
    itself, and where cells have gone or come."""
    if not torch.equal(before.uid, after.uid) or not torch.equal(before.colony, after.colony):
        return after
    new_type = before.fields["cell_type"] != after.fields["cell_type"]
    changed = {}
    for name in names:
        if name in after.fields:
            value = after.fields[name]
            rows = torch.nonzero(new_type & (value == before.fields[name])).squeeze(1)
            if rows.numel():
                # as of first cells: what the parents have is of another type
                first = after.declared[name].start(after.replace(births=()), rows)
                changed[name] = value.index_copy(0, rows, first)
    return after.with_fields(**changed)

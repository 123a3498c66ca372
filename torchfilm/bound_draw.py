"""How the values of a batch's cells are drawn, and what daughters inherit of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchfilm.state import State
from torchfilm.tools import checks


@dataclass(frozen=True, eq=False)
class BoundDraw:
    """How the values of cells are drawn: by one distribution, or by one value for each cell type.
    others: the type whose value cells of types without one get; None: there may be no such cells.
    """

    name: str
    parts: tuple[
        tuple[int | None, Any], ...
    ]  # (cell type or None, Resolved or (Distribution, its resolved parameters))
    others: int | None = None

    def __call__(
        self, state: State, rows: Tensor, purpose: str, parents: Tensor | None = None
    ) -> Tensor:
        """(M,) for the cells `rows` (M,). parents: what the parents have, (M,), where daughters
        take after them."""
        if self.parts[0][0] is None:
            return self._part(self.parts[0][1], state, rows, purpose, parents)
        kind = state.fields["cell_type"].index_select(0, rows)
        if self.others is not None:
            kind = torch.where(torch.isin(kind, kind.new_tensor(self.types)), kind, self.others)
        known = torch.zeros_like(kind, dtype=torch.bool)
        out = torch.zeros(rows.numel(), dtype=state.dtype, device=state.device)
        for number, part in self.parts:
            mine = torch.eq(kind, int(number or 0))
            known = known | mine
            out = torch.where(mine, self._part(part, state, rows, purpose, parents), out)
        if not bool(known.all()):
            raise missing_type(self.name, int(kind[~known][0]), self.types)
        return out

    @cached_property
    def takes_after(self) -> bool:
        """Whether daughters inherit a share of what their parents have."""
        drawn = [part for _, part in self.parts if isinstance(part, tuple)]
        return any(not isinstance(of.inherited, bool) for of, _ in drawn)

    @property
    def types(self) -> tuple[int, ...]:
        """The cell types that it has values for; none if it is the same for all."""
        return tuple(n for n, _ in self.parts if n is not None)

    def check_kind(self, kind: int) -> None:
        """Raise InputError if rates in cells of this type read it, and it has no value for them."""
        if self.types and kind not in self.types:
            raise checks.InputError(
                f"{self.name} has values for the cell types {', '.join(map(str, self.types))}, but"
                f" the rates of type {kind} read it. Add {kind}: … to it."
            )

    @property
    def requires_grad(self) -> bool:
        each = (part if not isinstance(part, tuple) else part[1] for _, part in self.parts)
        return any(x.requires_grad for x in each)

    @staticmethod
    def _part(
        part: Any, state: State, rows: Tensor, purpose: str, parents: Tensor | None
    ) -> Tensor:
        if not isinstance(part, tuple):
            return part.of_rows(state, rows)
        distribution, values = part
        if parents is None or isinstance(distribution.inherited, bool):
            return distribution.draw(state, rows, purpose, values)
        return distribution.draw_after(parents, state, rows, purpose, values)


def of_parents(state: State, rows: Tensor, name: str) -> Tensor | None:
    """What the parents of the cells `rows` (M,) had in a field, or their length, where these are
    the daughters of the last divisions, first daughters first; None where they are others, or
    where there is no such field."""
    if not state.births:
        return None
    births = state.births[-1]
    daughters = torch.cat([births.first, births.second])
    if rows.shape != daughters.shape or not torch.equal(rows, daughters):
        return None
    before = births.before.length if name == "length" else births.before.fields.get(name)
    return None if before is None else before.index_select(0, births.rows).repeat(2)


def missing_type(name: str, kind: int, known: Sequence[Any]) -> checks.InputError:
    listed = ", ".join(map(str, known))
    return checks.InputError(
        f"{name} has values for the cell types {listed}, but a cell has type {kind}. Add {kind}: …"
        " to it."
    )

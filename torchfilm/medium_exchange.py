"""Exchange between cells and medium: what cells find outside, and what they give to it in a step.
One service that circuits and nutrition share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfilm.signals.exchange import write
from torchfilm.state import OUTSIDE, State


class MediumExchange:
    """The medium about the cells of a state, and what they exchange with it in this step.

    found: concentration of each signal at each cell, (N,) by name. pool: (N,) µm³, the part of the
    medium from which each cell may draw all that there is. in_reservoir: (N,) bool, cells outside
    the box, whose pool is a reservoir that nothing changes, or None.
    """

    def __init__(self, state: State, signals: Sequence[str]):
        contact = state.contact(signals)
        assert contact is not None
        self.state, self.stencil, self.found = state, contact.stencil, contact.found
        self.pool, self.in_reservoir = contact.pool, contact.in_reservoir
        self._in_voxels = contact.in_voxels
        self._given: dict[str, Tensor] = {}
        self._to_reservoir: dict[str, Tensor] = {}

    @staticmethod
    def of(state: State, signals: Sequence[str]) -> MediumExchange | None:
        """The medium of a state, for these of its signals; None where no signal or no medium is."""
        return MediumExchange(state, signals) if signals and state.layout is not None else None

    def give(
        self, name: str, amount: Tensor, to_reservoir: Tensor | None, rows: Tensor | None = None
    ) -> None:
        """Note what cells give to a signal (negative: take), conc·µm³: to their pools `amount`
        (M,), and to the reservoir. Gifts add up.

        rows: (M,) the cells; None: all of them."""
        for noted, new in ((self._given, amount), (self._to_reservoir, to_reservoir)):
            if new is None:
                continue
            if rows is None:
                noted[name] = noted[name] + new if name in noted else new
            else:
                start = noted.get(name)
                start = torch.zeros_like(self.pool) if start is None else start
                noted[name] = start.index_add(0, rows, new)

    def settle(self) -> State:
        """The state in which the medium has what was given to it."""
        state = self.state
        changed = {
            OUTSIDE + n: write(state.fields[OUTSIDE + n], x, self.stencil, self._in_voxels[n])
            for n, x in self._given.items()
        }
        for name, amount in self._to_reservoir.items():
            total = state.groups.sum(amount.unsqueeze(1)).squeeze(1)
            changed[f"{name}_reservoir"] = state.fields[f"{name}_reservoir"] + total
        return state.with_fields(**changed)

"""What a step of a circuit reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.circuits import run
from torchfilm.circuits.dilution import Start
from torchfilm.state import State


@dataclass(frozen=True)
class CircuitReport:
    """`status` (B,): 0, or 1 where a cell's circuit could not be stepped, and `words`, by place in
    the batch, what happened there. steps, (N,) int64: how many steps each cell's circuit took."""

    status: Tensor
    steps: Tensor
    words: Mapping[int, str]
    hint = (
        "Look at the signs of the rates (none may be below 0 where its species is 0), at their"
        " units (per hour), and at whether they stay finite; a smaller dt may help"
    )

    def reason(self, place: int) -> str:
        return self.words[place]


class Failures:
    """What went wrong where, gathered over the cells of all types."""

    def __init__(self, state: State, method: str, dt: float):
        self.state, self.method, self.dt = state, method, dt
        self.status = torch.zeros(state.colonies, dtype=torch.int64, device=state.device)
        self.steps: Tensor | None = None
        self.words: dict[int, tuple[int, str]] = {}  # the first cell of a colony, and its words

    def note(
        self, start: Start, cells: run.CircuitCells, code: Tensor, steps: Tensor | None = None
    ) -> None:
        """code: (M,), what `run.step` says of each cell, which began with `start`. steps: (M,)."""
        state = self.state
        if steps is not None:
            self.steps = self._steps().index_copy(0, cells.rows, steps)
        if not bool(code.any()):
            return
        at = torch.nonzero(code).squeeze(1)
        owner = state.colony.index_select(0, cells.rows.index_select(0, at)).tolist()
        begin = start.concentrations(cells.rows)
        for place in sorted(set(owner)):
            mine = [k for k, o in zip(at.tolist(), owner, strict=True) if o == place]
            row = int(cells.rows[mine[0]])
            said = run.words(cells, int(code[mine[0]]), begin, mine[0], self.method, self.dt)
            kind = (
                f" (type {int(state.fields['cell_type'][row])})"
                if "cell_type" in state.fields
                else ""
            )
            more = f"; and {len(mine) - 1} more cell(s)" if len(mine) > 1 else ""
            text = f"circuit of cell {int(state.uid[row])}{kind}: {said}{more}"
            self.words[place] = min((row, text), self.words.get(place, (row, text)))
            self.status[place] = 1

    def _steps(self) -> Tensor:
        """Those that are known; 0 in other cells."""
        if self.steps is None:
            return torch.zeros_like(self.state.colony)
        return self.steps

    def report(self) -> CircuitReport:
        words = {place: text for place, (_, text) in self.words.items()}
        return CircuitReport(self.status, self._steps(), words)

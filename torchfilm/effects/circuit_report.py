"""What a step of a circuit reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchfilm.circuits import failures, run
from torchfilm.circuits.dilution import Start
from torchfilm.medium_exchange import Exchanged
from torchfilm.reports import Concern
from torchfilm.state import State
from torchfilm.tools.threads import one_torch_thread

# Of the pools' swing: from which it is a concern, in colonies of how many cells; and what is fine.
SWING, CROWD, FINE = 0.5, 100, 0.1
# It is looked at in every eighth step, and lasts if five looks in a row find it.
LOOK, LASTING = 8, 5


@dataclass(frozen=True)
class CircuitReport:
    """`status` (B,): 0, or 1 where a cell's circuit could not be stepped, and `words`, by place in
    the batch, what happened there. steps, (N,) int64: how many steps each cell's circuit took.
    exchanged: what cells gave to the medium; None without one. Where exchange and transport are
    solved together, (B,) each: the iterations; what cells took of signals beyond what there was,
    conc·µm³, as it may be within the circuits' tolerance; and how many parts of the step were taken
    in turns, since their equation could not be solved. shared: signals that Monod takes, too."""

    status: Tensor
    steps: Tensor
    words: Mapping[int, str]
    exchanged: Exchanged | None = None
    iterations: Tensor | int = 0
    overdrawn: Tensor | float = 0.0
    unsolved: Tensor | int = 0
    shared: frozenset[str] = frozenset()
    hint = (
        "Look at the signs of the rates (none may be below 0 where its species is 0), at their"
        " units (per hour), and at whether they stay finite and do not jump; a smaller dt may help"
    )

    def reason(self, place: int) -> str:
        return self.words[place]

    def after(self, earlier: CircuitReport) -> CircuitReport:
        """With what failed, and the steps that were taken, earlier in the same step."""
        return replace(
            self,
            status=torch.maximum(earlier.status, self.status),
            steps=earlier.steps + self.steps,
            words={**self.words, **earlier.words},
            # a part may have taken turns after others that were solved
            exchanged=(
                self.exchanged.after(earlier.exchanged)
                if self.exchanged and earlier.exchanged
                else None
            ),
            iterations=earlier.iterations + self.iterations,
            overdrawn=earlier.overdrawn + self.overdrawn,
            unsolved=earlier.unsolved + self.unsolved,
        )

    def or_else(self, other: CircuitReport, where: Tensor, colony: Tensor) -> CircuitReport:
        """This report, or in the colonies `where` (B,) another one. colony: of each cell, (N,)."""
        places = set(torch.nonzero(where).squeeze(1).tolist())
        return replace(
            self,
            status=torch.where(where, other.status, self.status),
            steps=torch.where(where.index_select(0, colony), other.steps, self.steps),
            words={k: w for k, w in self.words.items() if k not in places}
            | {k: w for k, w in other.words.items() if k in places},
            iterations=torch.where(where, other.iterations, self.iterations),
            overdrawn=torch.where(where, other.overdrawn, self.overdrawn),
            unsolved=torch.where(where, other.unsolved, self.unsolved),
        )

    @property
    def swing(self) -> Tensor:
        """`Exchanged.swing`, (B,); 0 without a medium."""
        none = torch.zeros(len(self.status), dtype=torch.float64, device=self.status.device)
        return none if self.exchanged is None else self.exchanged.swing

    def concerns(self) -> list[Concern]:
        """Colonies whose exchange and transport could not be solved together; and those in which
        they lag behind each other for long. Small ones are left out of these: around a few cells a
        signal is weak, and its swing says little."""
        if isinstance(self.unsolved, Tensor) and bool((self.unsolved > 0).any()):
            return [Concern("unsolved", self.unsolved > 0, 1, _of_unsolved)]
        exchanged = self.exchanged
        if exchanged is None or exchanged.step % LOOK:
            return []
        if self.shared:
            both = {n: x for n, x in exchanged.given.items() if n in self.shared}
            given = {n: x.clamp(max=0.0) for n, x in both.items()}  # what they take
            with one_torch_thread():
                swing = replace(exchanged, given=given).swing
            if bool((swing > SWING).any()):
                said = partial(_of_shared, ", ".join(given))
                return [Concern("shared", swing > SWING, 1, said)]
        crowd = exchanged.groups.counts >= CROWD
        if not exchanged.given or not bool(crowd.any()):
            return []
        with one_torch_thread():  # a sum over few numbers
            swing = self.swing
        where = (swing > SWING) & crowd
        return [Concern("swing", where, LASTING, partial(_of_swing, swing))]


def _of_unsolved(ids: Tensor, where: Tensor) -> str:
    return (
        f"colony {', '.join(map(str, ids[where].tolist()[:5]))}: exchange and transport of signals"
        " could not be solved together, not even in a sixteenth of a step, so that they took turns"
        " there: what cells take may be far from right. Give a smaller dt, or a rate of exchange"
        " that changes less steeply with the signal."
    )


def _of_shared(names: str, ids: Tensor, where: Tensor) -> str:
    return (
        f"colony {', '.join(map(str, ids[where].tolist()[:5]))}: a circuit exchanges {names}, which"
        " Monod takes, too, and most of what it finds in a turn. Monod is served first, so that the"
        " circuit gets too little, and more turns hardly help. Let one of them take it all: Monod"
        " (a smaller growth_yield), or the circuit (with a rule that sets growth_rate by what it"
        " has taken)."
    )


def _of_swing(swing: Tensor, ids: Tensor, where: Tensor) -> str:
    worst = float(swing[where].max())
    return (
        f"colony {', '.join(map(str, ids[where].tolist()[:5]))}: exchange moves the"
        f" medium at the cells by {worst:.0%} in the mean, which transport and the other cells see"
        " only afterwards; concentrations there may be off by as much. With"
        f" {worst / FINE:.0f} times as many Medium(steps=…), or a dt smaller by as much, it is a"
        " tenth. Circuits that do not count molecules need no turns: Medium(exchange='together')."
    )


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
            said = failures.words(cells, int(code[mine[0]]), begin, mine[0], self.method, self.dt)
            kind = (
                f" (type {int(state.fields['cell_type'][row])})"
                if "cell_type" in state.fields
                else ""
            )
            more = f"; and {len(mine) - 1} more cell(s)" if len(mine) > 1 else ""
            text = f"circuit of cell {int(state.uid[row])}{kind}: {said}{more}"
            self.words[place] = min((row, text), self.words.get(place, (row, text)))
            self.status[place] = 1

    def note_colonies(self, failed: Tensor, said: str) -> None:
        """failed: (B,) bool, colonies of which that is said."""
        for place in torch.nonzero(failed).squeeze(1).tolist():
            self.words.setdefault(place, (0, said))
            self.status[place] = 1

    def _steps(self) -> Tensor:
        """Those that are known; 0 in other cells."""
        if self.steps is None:
            return torch.zeros_like(self.state.colony)
        return self.steps

    def report(self, exchanged: Exchanged | None) -> CircuitReport:
        words = {place: text for place, (_, text) in self.words.items()}
        return CircuitReport(self.status, self._steps(), words, exchanged)

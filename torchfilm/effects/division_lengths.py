"""Lengths at division: which cells are too short to divide, and how long daughters are at birth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchfilm.bound_draw import of_parents
from torchfilm.resolver import Resolved, Values
from torchfilm.state import State
from torchfilm.values import ByType, is_drawn, largest, smallest

# Of what a division conserves, the two caps of a cell hold as much as this many radii of its
# length.
CAPS = {"length": 2.0, "volume": 4 / 3}
TOO_SHORT = 1


@dataclass(frozen=True)
class DivisionReport:
    """Which colonies could not divide, per colony (B,).

    status: 0 or TOO_SHORT. uid, length: the first cell that was due and too short, µm. needs: the
    length that it needs, µm. The report exists only if there is such a cell; no cell divided in its
    colony.
    """

    status: Tensor
    uid: Tensor
    length: Tensor
    needs: Tensor

    hint: ClassVar[str] = "Divide later, or start from longer cells"

    def reason(self, place: int) -> str:
        """Describes the failure of the colony at this place of the batch."""
        return (
            f"cell {int(self.uid[place])} is due to divide at length {float(self.length[place]):g}"
            f" µm, but needs at least {float(self.needs[place]):g} µm for the caps of its daughters"
        )


def least_length(share: Any, caps: float) -> Any:
    """The least length, radii, of a cell that can divide into `share` and the rest of what is
    conserved: no daughter has a length below 0. caps: see CAPS."""
    if not isinstance(share, Tensor):
        return caps * (1.0 / min(share, 1.0 - share) - 1.0)
    share = share.detach()
    return caps * (1.0 / torch.minimum(share, 1.0 - share) - 1.0)


def smaller_shares(fraction: Any, resolved: Resolved, state: State) -> Tensor:
    """The least that either daughter of each cell can get, (N,) float64; 0.5 where it is drawn
    from what differs between colonies. resolved: the fraction on the state's device."""
    if not is_drawn(fraction):
        share = resolved.of_cells(state).detach().double()
        return torch.minimum(share, 1.0 - share).expand(state.cells)
    least = torch.full_like(state.length, 0.5, dtype=torch.float64)
    of_types = fraction.values if isinstance(fraction, ByType) else {None: fraction}
    for kind, value in of_types.items():
        parts = vars(value).values() if is_drawn(value) else [value]
        if all(torch.as_tensor(x).numel() == 1 for x in parts):
            small = min(smallest(value), 1.0 - largest(value))
            mine = True if kind is None else state.fields["cell_type"] == kind
            least = torch.where(torch.as_tensor(mine, device=least.device), small, least)
    return least


def without_short(state: State, rows: Tensor, need: Any) -> tuple[State, Tensor | None]:
    """The state that reports those of the cells `rows` (M,) that are too short to divide, and which
    are of other colonies, (M,) bool; None where no cell is too short. need: radii, one number or
    (M,)."""
    needed = need * state.radius.index_select(0, rows)
    too_short = state.length.index_select(0, rows) < needed
    if not bool(too_short.any()):
        return state, None
    lengths = torch.zeros_like(state.length).index_copy(0, rows, needed)
    number = torch.arange(state.cells, 0, -1, device=state.device)
    marks = torch.zeros_like(number).index_copy(0, rows, torch.where(too_short, number[rows], 0))
    first = state.cells - state.groups.max(marks)
    status = torch.where(first < state.cells, TOO_SHORT, 0)
    row = first.clamp(max=state.cells - 1)
    pick = lambda x: x.detach().index_select(0, row)
    report = DivisionReport(status, pick(state.uid), pick(state.length), pick(lengths))
    sound = (status != TOO_SHORT).index_select(0, state.colony.index_select(0, rows))
    return state.replace(reports={**state.reports, "division": report}), sound


def length_at_birth(state: State, rows: Tensor, values: Values) -> Tensor:
    """The length from which cells count what they add. A step ends after a parent has reached its
    threshold: what its daughters have grown since then counts as added."""
    length = state.length.index_select(0, rows)
    parent, begin, threshold, grown = (
        of_parents(state, rows, n)
        for n in ("length", "birth_length", "division_threshold", "elongation")
    )
    if parent is None or begin is None or threshold is None:
        return length
    late = (parent - begin - threshold).clamp(min=0.0)  # 0 of cells that a rule has flagged
    late = late if grown is None else torch.minimum(late, grown.clamp(min=0.0))
    # with c, the length that makes caps, a daughter of the share f is f·(parent + c) − c long
    caps = parent - length.view(2, -1).sum(0).repeat(2)
    return length - (length + caps) / (parent + caps) * late

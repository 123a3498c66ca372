"""How cells have grown and moved since an earlier state."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.measure.of_a_state import of_a_state
from torchfilm.state import State
from torchfilm.tools import checks


@of_a_state
def growth_rates(state: State, earlier: State) -> Tensor:
    """How fast each cell has grown since an earlier state of the same run, (N,) 1/h: the change of
    ln(volume) over time. NaN for cells born since, which are those that grow: take states a few
    steps apart, or the mean is too low. Pressure makes it less than the field `growth_rate`."""
    known, before = _known_before("growth_rates", state, earlier)
    now, before = state.volume.double()[known], earlier.volume.double()[before]
    rates = torch.full_like(state.volume.detach().double(), torch.nan)
    return rates.index_copy(0, known, (now / before).log() / (state.time - earlier.time))


@of_a_state
def displacement(state: State, earlier: State) -> Tensor:
    """How far each cell's centre has moved since an earlier state of the same run, (N, d) float64
    µm; NaN for cells that were born since. In a periodic space it is the way to the nearest image:
    take states between which no cell goes half of the way between the faces, and add up several."""
    known, before = _known_before("displacement", state, earlier)
    moved = torch.full_like(state.position.detach(), torch.nan)
    way = (state.position[known] - earlier.position[before]).T
    way = way if state.space is None else way + state.space.shift(way)
    return moved.index_copy(0, known, way.T)


def _known_before(measure: str, state: State, earlier: State) -> tuple[Tensor, Tensor]:
    """The cells (M,) that an earlier state of the run has, too, and their places there, (M,).
    Raises InputError for a state that is not earlier."""
    if not isinstance(earlier, State) or not earlier.time < state.time:
        shown = f"a state at {earlier.time:g} h" if isinstance(earlier, State) else earlier
        rule = f"a state of the same run before {state.time:g} h"
        raise checks.input_error(f"{measure}(earlier)", shown, rule)
    key = lambda s: torch.stack([s.own_colony_id, s.uid], 1)
    names, which = torch.unique(torch.cat([key(earlier), key(state)]), dim=0, return_inverse=True)
    place = torch.full((len(names),), -1, device=state.device)
    place[which[: earlier.cells]] = torch.arange(earlier.cells, device=state.device)
    before = place[which[earlier.cells :]]
    known = torch.nonzero(before >= 0).squeeze(1)
    return known, before[known]

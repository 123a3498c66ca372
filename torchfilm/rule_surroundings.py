"""What rules can ask of the surroundings of each cell: its colony, its neighbours, its film."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchfilm.colony_edge import below_edge_of
from torchfilm.film_shape import below_top_of
from torchfilm.physics.nearby import pairs_within
from torchfilm.rule_values import real_column
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread


class SurroundingsView:
    """The methods of `CellsView` that look beyond the cell."""

    _state: State
    _read: set[str]
    _pairs: dict[float, tuple[Tensor, Tensor]]  # by the distance within which they are

    def colony_max(self, value: Tensor) -> Tensor:
        """The greatest value in each cell's own colony, (N,) -> (N,)."""
        value = real_column("colony_max", value, self._state)
        return self._state.groups.max(value).index_select(0, self._state.colony)

    def colony_min(self, value: Tensor) -> Tensor:
        """The smallest value in each cell's own colony, (N,) -> (N,)."""
        return -self.colony_max(-real_column("colony_min", value, self._state))

    def colony_sum(self, value: Tensor) -> Tensor:
        """The sum over each cell's own colony, (N,) -> (N,); of a condition, how many fulfil it."""
        value = real_column("colony_sum", value, self._state)
        total = self._state.groups.sum(value)
        return total.index_select(0, self._state.colony)

    def colony_mean(self, value: Tensor) -> Tensor:
        """The mean over each cell's own colony, (N,) -> (N,); of a condition, which share fulfils
        it."""
        value = real_column("colony_mean", value, self._state)
        mean = self._state.groups.sum(value) / self._state.counts.clamp(min=1)
        return mean.index_select(0, self._state.colony)

    @one_torch_thread()  # or its others wait in a loop while the next step is computed
    def contacts(self, within: float = 0.05) -> tuple[Tensor, Tensor]:
        """Pairs of cells of one colony whose surfaces are at most `within` µm apart: two (P,)
        tensors i, j of places among the cells.

        Each pair occurs once, in either order: what goes from cell to cell both ways needs both
        (i, j) and (j, i), as in `contact_sum`. What each pair draws for itself is
        `contact_random(i, j)`. The search runs only when a rule calls this, once for each `within`.
        """
        distance = checks.number("contacts(within)", within, least=0.0)
        self._read.update(("position", "axis", "length", "radius"))
        if distance not in self._pairs:
            s = self._state
            shape = s.position, s.axis, s.length, s.radius
            self._pairs[distance] = pairs_within(*shape, s.groups, distance, s.space)
        i, j = self._pairs[distance]
        return i.clone(), j.clone()  # which a rule may change

    @one_torch_thread()
    def contact_sum(self, value: Tensor, within: float = 0.05) -> Tensor:
        """The sum of a value over the cells that each cell touches, (N,) -> (N,); of a condition,
        how many of them fulfil it: `cells.contact_sum(cells.cell_type == 1)`. within: as of
        `contacts`. Gradients pass through the value."""
        value = real_column("contact_sum", value, self._state)
        i, j = self.contacts(within)
        given = torch.cat([value.index_select(0, j), value.index_select(0, i)])
        return Groups(torch.cat([i, j]), self._state.cells).sum(given)

    @one_torch_thread()
    def contact_count(self, within: float = 0.05) -> Tensor:
        """The number of cells that each cell touches, (N,) int64."""
        i, j = self.contacts(within)
        return torch.bincount(torch.cat([i, j]), minlength=self._state.cells)

    @one_torch_thread()
    def below_top(
        self,
        spacing: float = 1.0,
        *,
        floor: float = 0.0,
        across: Mapping[str, tuple[float, float]] | None = None,
    ) -> Tensor:
        """How far each cell lies below the top of the film above it, (N,) µm: along y in the plane,
        along z in space. The parameters are those of `measure.below_top`."""
        checks.number("below_top(spacing)", spacing, above=0.0)
        checks.number("below_top(floor)", floor)
        self._read.update(("cells", "position", "axis", "length", "radius"))
        with torch.no_grad():
            found = below_top_of(self._state, spacing, floor, across)
        return found.to(self._state.dtype)

    @one_torch_thread()
    def below_edge(self) -> Tensor:
        """How far each cell lies below the edge of its colony, seen from above, (N,) µm; negative
        beyond it. See `measure.below_edge`."""
        self._read.update(("cells", "position", "axis", "length", "radius"))
        return below_edge_of(self._state).to(self._state.dtype)

"""Erosion: a biofilm loses cells at its surface, the faster the higher it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import REMOVAL, Effect
from torchfilm.film_shape import CellsOverColumns, Floor, columns_of
from torchfilm.reports import CellsLost
from torchfilm.resolver import Values
from torchfilm.signals.schedule import warn_of_means
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.deterministic_math import power
from torchfilm.tools.ragged import order_within
from torchfilm.tools.random import fine_uniform
from torchfilm.tools.read_only import read_only
from torchfilm.values import COLONY, ScheduledValue, physical

MOST = 1e200  # chance of a cell to leave, per h


@dataclass(frozen=True, eq=False)
class Erosion(Effect):
    """A biofilm on a floor loses cells at its surface: the surface recedes at rate · h^order µm/h
    where it is h above the floor (Wanner & Gujer, Biotechnol. Bioeng. 28, 314, 1986; order 2 as in
    Stewart, Biotechnol. Bioeng. 41, 111, 1993).

    rate: µm^(1 − order)/h; a number, one per colony, or a Schedule. order: 0 or more. With order 2
    a flat film that grows at μ throughout comes to rest at the height μ/rate.

    Cells leave whole, by chance. In each column of the floor the cell that is highest bears the
    loss: per hour it leaves with the chance that lets a colony lose rate · h^order of its height
    there, on average, with as much volume as it has per height. What is below is then exposed, in
    the same step, too, so that the mean loss does not depend on dt.

    spacing: width of a column, µm. floor: its y in the plane, or z in space, µm. across: from where
    to where it reaches, µm, such as {"x": (0, 60)}; left out along an axis that is periodic. Cells
    that are above none of its columns stay.

    The lineage keeps the end of these cells, with the fate "eroded"; `state.reports["erosion"]` has
    their number and volume.
    """

    rate: ScheduledValue = physical(
        unit="µm^(1 − order)/h", least=0.0, scope=COLONY, scheduled=True
    )
    order: float = 2.0
    spacing: float = 0.5
    floor: float = 0.0
    across: Mapping[str, tuple[float, float]] | None = None

    stage = REMOVAL
    title = "erosion"
    by_kernels = True
    may_repeat = False

    def __post_init__(self) -> None:
        checked = {
            "order": checks.number("Erosion.order", self.order, least=0.0),
            "spacing": checks.number("Erosion.spacing", self.spacing, above=0.0),
            "floor": checks.number("Erosion.floor", self.floor),
        }
        for name, number in checked.items():
            object.__setattr__(self, name, number)
        if isinstance(self.across, Mapping):
            object.__setattr__(self, "across", read_only(self.across))

    def reads(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "radius")

    def writes(self) -> tuple[str, ...]:
        return ("cells",)

    def check(self, state: State, values: Values) -> None:
        self._ground(state)

    def check_step(self, dt: float, divides: bool) -> None:
        warn_of_means("Erosion", {"rate": self.rate}, dt)

    def numerics(self, dt: float, state: State) -> list[str]:
        counts = " × ".join(map(str, self._ground(state).counts))
        return [
            f"at the end of the step, by {counts} columns; each cell on top by a draw, those below"
            " it from the moment on at which they are exposed"
        ]

    def _ground(self, state: State) -> Floor:
        return Floor.of("Erosion", state, self.spacing, self.floor, self.across, of_medium=False)

    def step(self, state: State, dt: float, values: Values) -> State:
        gone = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        rate = values.rate.of_colonies(state)
        if state.cells and bool((rate > 0).any()):
            # on the CPU, where sums over columns have an order
            here = state if state.device.type == "cpu" else state.to("cpu")
            gone = self._eroded(here, rate.double().cpu(), dt).to(state.device)
        report = CellsLost.of(state, gone)
        state = state.replace(reports={**state.reports, self.title: report})
        return state.remove(gone, "eroded")

    @torch.no_grad()
    def _eroded(self, state: State, rate: Tensor, dt: float) -> Tensor:
        """Which cells leave within dt hours, (N,) bool.

        A cell on top of the column c from the time t_c on leaves once Σ_c h_c · (t − t_c), with the
        chance h_c per hour, is a draw of the exponential distribution: at t = (draw + Σ h_c t_c)/Σ
        h_c. Then the next cell of its columns is on top. So each column loses for dt hours,
        whichever cells bear it.
        """
        columns = columns_of(state, self._ground(state))
        rows = torch.arange(state.cells, device=state.device)
        draw = -torch.log(fine_uniform(*(state.uniform(rows, f"erosion {k}") for k in range(2))))
        volume, stacks = state.volume.double(), _Stacks(columns)
        colony = torch.arange(columns.size, device=state.device) // (columns.size // state.colonies)
        total = lambda x, where: torch.bincount(where, x, minlength=state.colonies)
        held = total(torch.where(columns.inside, volume, 0.0), state.colony)
        # µm³ per µm of a column
        filled = (held / total(stacks.height(), colony)).index_select(0, colony)
        falls = rate.expand(state.colonies).index_select(0, colony) * filled
        since, gone = torch.zeros_like(filled), torch.zeros_like(columns.inside)
        hazard, late = torch.zeros_like(volume), torch.zeros_like(volume)
        exposed = torch.nonzero(stacks.there).squeeze(1)
        while len(exposed):
            top = stacks.cell()
            cell = top.index_select(0, exposed)
            height = power(stacks.height().index_select(0, exposed), self.order)
            chance = falls.index_select(0, exposed) * height / volume[cell]
            chance = chance.clamp(max=MOST)  # whatever the rate, a number
            hazard = hazard + torch.bincount(cell, chance, minlength=state.cells)
            late = late + torch.bincount(cell, chance * since[exposed], minlength=state.cells)
            end = (draw + late) / hazard
            gone = gone | (end <= dt)
            bare = torch.nonzero(stacks.there & gone[top]).squeeze(1)
            # also where it is before the column bared the cell: its draw has this span as negative
            since[bare] = end[top[bare]]
            exposed = stacks.below(bare, gone)
        return gone


class _Stacks:
    """The cells of each column, from the highest down, and which of them is on top."""

    def __init__(self, columns: CellsOverColumns):
        order = order_within(columns.place, columns.top, descending=True)
        # and one more, for columns in which there is none
        self._cells = torch.cat([columns.cell[order], columns.cell.new_zeros(1)])
        self._tops = torch.cat([columns.top[order], columns.top.new_zeros(1)])
        self._end = torch.cumsum(torch.bincount(columns.place, minlength=columns.size), 0)
        self._at = torch.cat([self._end.new_zeros(1), self._end[:-1]])

    @property
    def there(self) -> Tensor:
        """The columns in which there is a cell, (C,) bool."""
        return self._at < self._end

    def cell(self) -> Tensor:
        """On top of each column, (C,); any where there is none."""
        return self._cells.index_select(0, self._at)

    def height(self) -> Tensor:
        """Of each column, (C,) float64 µm."""
        return torch.where(self.there, self._tops.index_select(0, self._at), 0.0)

    def below(self, bare: Tensor, gone: Tensor) -> Tensor:
        """In the columns `bare` the next cell that is not gone comes to the top. Returns those in
        which there is one."""
        falls = bare
        while len(falls):
            self._at[falls] += 1
            at = self._at[falls]
            falls = falls[(at < self._end[falls]) & gone[self._cells[at]]]
        return bare[self._at[bare] < self._end[bare]]

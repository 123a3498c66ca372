"""Space that is periodic along some axes: what leaves at one face comes in at the opposite one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.surfaces import FlatSurface, Surface
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.reads import rows_where

AXES = "xyz"
# By how much the reach of cells is enlarged, so that rounding loses no pair that touches exactly.
ENLARGED = 1e-5


@dataclass(frozen=True)
class PeriodicSpace:
    """Where cells are in d dimensions: low (d,) the lower face of each axis, µm, and period (d,)
    the distance to the upper one, µm; 0 along an axis that is not periodic.

    A contact is that of the nearest images of its cells. No other images meet as long as no cell,
    with what it reaches, is longer than half a period: see `too_long`.
    """

    low: tuple[float, ...]
    period: tuple[float, ...]

    @staticmethod
    def of(name: str, given: Any, dim: int) -> PeriodicSpace | None:
        """From {"x": (low, high), …}; None of no axis. Raises InputError, which names `name`."""
        rule = 'a dict of axes and their faces in µm, such as {"x": (0, 40)}'
        if not isinstance(given, Mapping):
            raise checks.input_error(name, given, rule)
        axes, low, period = AXES[:dim], [0.0] * dim, [0.0] * dim
        for axis, faces in given.items():
            if axis not in tuple(axes):
                raise checks.input_error(f"{name}, axis", axis, " or ".join(map(repr, axes)))
            if not isinstance(faces, (tuple, list)) or len(faces) != 2:
                raise checks.input_error(f"{name}[{axis!r}]", faces, "(low, high) in µm")
            k = axes.index(axis)
            low[k] = checks.number(f"{name}[{axis!r}], low", faces[0])
            high = checks.number(f"{name}[{axis!r}], high", faces[1], above=low[k])
            period[k] = high - low[k]
        return PeriodicSpace(tuple(low), tuple(period)) if given else None

    @property
    def faces(self) -> dict[str, tuple[float, float]]:
        """The faces of each periodic axis, µm, as they are given."""
        each = zip(AXES, self.low, self.period, strict=False)
        return {axis: (low, low + period) for axis, low, period in each if period}

    @property
    def told(self) -> str:
        """In words."""
        return ", ".join(
            f"{a} from {low:g} to {high:g} µm" for a, (low, high) in self.faces.items()
        )

    @property
    def shortest(self) -> float:
        """The shortest period, µm."""
        return min(period for period in self.period if period)

    def too_long(self, length: Tensor, radius: Tensor, reach: float | Tensor) -> Tensor:
        """Which cells, whose caps count, could meet two images of a cell that is nearer than
        `reach`, µm, (N,) bool."""
        return length + 2 * radius + reach > 0.5 * self.shortest

    def inside(self, position: Tensor) -> Tensor:
        """The image of each position between the faces, (N, d) float64; the bits of one that lies
        there stay as they are."""
        columns = list(position.unbind(1))
        for k, (low, period) in enumerate(zip(self.low, self.period, strict=True)):
            if period:
                x = columns[k]
                away = torch.floor((x.detach() - low) / period)
                moved = x - period * away
                moved = torch.where(moved.detach() < low + period, moved, low + 0.0 * moved)
                columns[k] = torch.where(away == 0, x, moved)
        return torch.stack(columns, 1)

    def outside(self, position: Tensor) -> Tensor:
        """Which positions lie beyond a face, (N,) bool."""
        found = torch.zeros_like(position[:, 0], dtype=torch.bool)
        for k, (low, period) in enumerate(zip(self.low, self.period, strict=True)):
            if period:
                found = found | ((position[:, k] < low) | (position[:, k] > low + period))
        return found

    @torch.no_grad()
    def shift(self, between: Tensor) -> Tensor:
        """What leads from the second point of each pair to its image that is nearest to the first,
        (d, P) µm. between: (d, P), from the first to the second."""
        moves = torch.zeros_like(between)
        for k, period in enumerate(self.period):
            if period:
                moves[k] = -period * torch.round(between[k] / period)
        return moves

    def images(self, position: Tensor, side: Tensor, groups: Groups) -> _Images:
        """The cells in a period about the first of their colony, and those images above it that a
        cell in it may meet. side: (N, d) how far each cell reaches along each axis, µm."""
        periods = torch.tensor(self.period, dtype=position.dtype, device=position.device)
        first = groups.begin[:-1].clamp(max=position.shape[0] - 1).index_select(0, groups.owner)
        away = position - position.index_select(0, first)
        turns = torch.round(away / torch.where(periods > 0, periods, 1.0))
        base, away = (x - periods * turns for x in (position, away))
        most = torch.stack([groups.max(x) for x in side.unbind(1)], 1).index_select(0, groups.owner)
        # slightly larger, so that rounding loses no pair that touches exactly
        meets = away + 0.5 * periods <= (side + most) * (1 + ENLARGED)
        every = [(False, True) if period else (False,) for period in self.period]
        ways = torch.tensor(list(itertools.product(*every)), device=position.device)
        # the first way is none at all: every cell
        wanted = (meets.unsqueeze(0) | ~ways.unsqueeze(1)).all(2)
        (place,) = rows_where(wanted.reshape(-1))
        count = position.shape[0]
        cell, way = place % count, ways.index_select(0, place // count)
        # of a colony side by side, first its cells, then images
        order = torch.argsort(groups.owner.index_select(0, cell), stable=True)
        cell, way = cell.index_select(0, order), way.index_select(0, order)
        return _Images(base.index_select(0, cell) + periods * way, cell, way)


def check_walls_in(space: PeriodicSpace, surfaces: Sequence[Surface]) -> None:
    """Raise InputError for a wall that is not the same at opposite faces."""
    for surface in surfaces:
        wall = type(surface.wall).__name__
        across = list(space.faces)
        if isinstance(surface, FlatSurface):
            across = [
                a
                for a in across
                if bool((torch.as_tensor(surface.normal[AXES.index(a)]) != 0).any())
            ]
        if across:
            raise checks.InputError(
                f"Mechanics.periodic: the {wall} ends space along {' and '.join(across)}, which is"
                f" periodic ({space.told}). Leave out the wall, or that axis; walls that fit are"
                " planes parallel to it."
            )


def check_reach(space: PeriodicSpace, length: Tensor, radius: Tensor, reach: float) -> None:
    """Raise InputError where cells, (N,), are so long, or look so far, µm, that a pair would have
    two images."""
    if bool(space.too_long(length, radius, reach).any()):
        longest = float((length + 2 * radius).max())
        raise checks.InputError(
            f"Mechanics.periodic: neighbours up to {reach:g} µm away of cells up to {longest:.3g}"
            f" µm long are wanted, and half of the way between the faces is"
            f" {0.5 * space.shortest:g} µm: cells would meet two images of others. Place the faces"
            " farther apart, or take shorter cells or distances."
        )


def check_inside(space: PeriodicSpace, position: Tensor, ids: Tensor, uid: Tensor) -> None:
    """Raise InputError for a cell that starts beyond a face. ids: (N,) of the cells' colonies."""
    beyond = torch.nonzero(space.outside(position)).squeeze(1)
    if beyond.numel():
        k = int(beyond[0])
        at = [round(x, 3) for x in position[k].tolist()]
        raise checks.InputError(
            f"Mechanics.periodic: cell {int(uid[k])} of colony {int(ids[k])} starts at {at}, beyond"
            f" the faces ({space.told}; cells beyond them: {beyond.numel()}). Move the cell, or the"
            " faces."
        )


@dataclass(frozen=True)
class _Images:
    """Cells and images of cells: positions (M, d), which cell each is, (M,), and along which axes
    it is moved by a period, (M, d) bool."""

    position: Tensor
    cell: Tensor
    way: Tensor

    def pairs_of_cells(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """The pairs of cells whose images are these pairs, each once: of the pairs that differ by
        the same moves, that in which no two are moved along the same axis."""
        both = self.way.index_select(0, first) & self.way.index_select(0, second)
        i, j = self.cell.index_select(0, first), self.cell.index_select(0, second)
        (once,) = rows_where(~both.any(1) & (i != j))
        return i.index_select(0, once), j.index_select(0, once)


@torch.no_grad()
def near_pairs(
    position: Tensor, axis: Tensor, length: Tensor, radius: Tensor, colony: Tensor, colonies: int,
    margin: float | Tensor = 0.0, space: PeriodicSpace | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The pairs of `Neighbourhood`, also those across the faces of a periodic space."""
    if space is None or not colony.numel():
        return Neighbourhood(position, axis, length, radius, colony, colonies, margin).pairs()
    reach = (radius + 0.5 * margin).unsqueeze(1)
    side = 0.5 * length.unsqueeze(1) * axis.abs() + reach
    found = space.images(position, side, Groups(colony, colonies))
    pick = lambda x: x.index_select(0, found.cell)
    near = Neighbourhood(
        found.position, pick(axis), pick(length), pick(radius), pick(colony), colonies,
        pick(margin) if isinstance(margin, Tensor) else margin,
    )  # fmt: skip
    return found.pairs_of_cells(*near.pairs())

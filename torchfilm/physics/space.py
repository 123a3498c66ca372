"""Space that is periodic along some axes: what leaves at one face comes in at the opposite one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchfilm.kernels.scheme import ENLARGED
from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.surfaces import FlatSurface, Surface
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.reads import rows_where

Faces = Mapping[str, tuple[float, float]]  # (low, high) µm by axis


def checked_spans(name: str, given: Any, axes: str) -> dict[str, tuple[float, float]]:
    """From {"x": (low, high), …}, µm. Raises InputError, which names `name`."""
    if not isinstance(given, Mapping):
        rule = 'a dict of axes and their ends in µm, such as {"x": (0, 40)}'
        raise checks.input_error(name, given, rule)
    found = {}
    for axis, ends in given.items():
        if axis not in tuple(axes):
            raise checks.input_error(f"{name}, axis", axis, " or ".join(map(repr, axes)))
        if isinstance(ends, (str, Mapping)) or not hasattr(ends, "__len__") or len(ends) != 2:
            rule = "(low, high) in µm, the same for all colonies"
            raise checks.input_error(f"{name}[{axis!r}]", ends, rule)
        low = checks.number(f"{name}[{axis!r}], low", ends[0])
        found[axis] = low, checks.number(f"{name}[{axis!r}], high", ends[1], above=low)
    return found


@dataclass(frozen=True)
class PeriodicSpace:
    """Where cells are in d dimensions: low and high (d,) the faces of each axis, µm; alike along an
    axis that is not periodic.

    A contact is that of the nearest images of its cells. No other images meet as long as no cell,
    with what it reaches, is longer than half a period: see `too_long`.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    @staticmethod
    def of(name: str, given: Any, dim: int) -> PeriodicSpace | None:
        """From {"x": (low, high), …}; None of no axis. Raises InputError, which names `name`."""
        if given is None:
            return None
        faces, axes = checked_spans(name, given, "xyz"[:dim]), "xyz"[:dim]
        low, high = ([faces.get(a, (0.0, 0.0))[end] for a in axes] for end in (0, 1))
        return PeriodicSpace(tuple(low), tuple(high)) if faces else None

    @cached_property
    def period(self) -> tuple[float, ...]:
        """The distance of the faces of each axis, µm; 0 along one that is not periodic."""
        return tuple(high - low for low, high in zip(self.low, self.high, strict=True))

    @cached_property
    def faces(self) -> dict[str, tuple[float, float]]:
        """The faces of each periodic axis, µm, as they are given."""
        each = zip("xyz", self.low, self.high, strict=False)
        return {axis: (low, high) for axis, low, high in each if high > low}

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
        """Which cells, with their caps, could meet two images of another one as long, if those meet
        that are nearer than `reach`, µm, (N,) bool."""
        return length + 2 * radius + reach > 0.5 * self.shortest

    def inside(self, position: Tensor) -> Tensor:
        """The image of each position between the faces, (N, d) float64; the bits of one that lies
        there stay as they are."""
        columns = list(position.unbind(1))
        for k, (low, high, period) in enumerate(zip(self.low, self.high, self.period, strict=True)):
            if period:
                x = columns[k]
                moved = x - period * torch.floor((x.detach() - low) / period)
                at = moved.detach()  # may be rounded over a face
                at_low = low + (moved - at)
                moved = torch.where((at < low) | (at >= high), at_low, moved)
                columns[k] = torch.where((x >= low) & (x < high), x, moved)
        return torch.stack(columns, 1)

    def outside(self, position: Tensor) -> Tensor:
        """Which positions lie beyond a face, (N,) bool."""
        found = torch.zeros_like(position[:, 0], dtype=torch.bool)
        for k, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if high > low:
                found = found | ((position[:, k] < low) | (position[:, k] > high))
        return found

    @torch.no_grad()
    def shift(self, between: Tensor) -> Tensor:
        """What leads from the second point of each pair to its image that is nearest to the first,
        (d, P) µm. between: (d, P), from the first to the second; or its first axes alone."""
        return torch.stack([self.shift_along(k, x) for k, x in enumerate(between)])

    @torch.no_grad()
    def shift_along(self, k: int, between: Tensor) -> Tensor:
        """As `shift`, along one axis, of any shape."""
        period = self.period[k]
        if not period:
            return torch.zeros_like(between)
        return -period * torch.floor(between / period + 0.5)

    @torch.no_grad()
    def images(self, position: Tensor, side: Tensor, groups: Groups) -> Images:
        """The cells in a period about the first of their colony, and those images above it that a
        cell in it may meet. side: (N, d) how far each cell reaches along each axis, µm."""
        periods = torch.tensor(self.period, dtype=position.dtype, device=position.device)
        first = groups.begin[:-1].clamp(max=position.shape[0] - 1).index_select(0, groups.owner)
        away = position - position.index_select(0, first)
        move = self.shift(away.T).T
        base, away = position + move, away + move
        most = torch.stack([groups.max(x) for x in side.unbind(1)], 1).index_select(0, groups.owner)
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
        return Images(base.index_select(0, cell) + periods * way, cell, way, base, self)


@dataclass(frozen=True)
class Images:
    """Cells and images of cells: positions (M, d), which cell each is, (M,), and along which axes
    it is moved by a period, (M, d) bool, from the cells' `base` (N, d)."""

    position: Tensor
    cell: Tensor
    way: Tensor
    base: Tensor
    space: PeriodicSpace

    def cells_of(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """The cells of pairs of images, (P,) each."""
        return self.cell.index_select(0, first), self.cell.index_select(0, second)

    def distinct(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Of the pairs of images (P,), each once: of those that differ by the same moves, that in
        which no two are moved along the same axis; and no cell with itself."""
        both = self.way.index_select(0, first) & self.way.index_select(0, second)
        i, j = self.cells_of(first, second)
        (once,) = rows_where(~both.any(1) & (i != j))
        return first.index_select(0, once), second.index_select(0, once)

    def nearest_pairs(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """The pairs of cells, each once, of which these pairs are the nearest images."""
        first, second = self.distinct(first, second)
        i, j = self.cells_of(first, second)
        # the way from the lower to the higher cell decides, in whichever order they were found
        low, high = torch.minimum(i, j), torch.maximum(i, j)
        between = self.base.index_select(0, high) - self.base.index_select(0, low)
        moved = self.way.index_select(0, second).long() - self.way.index_select(0, first).long()
        moved = torch.where((i < j).unsqueeze(1), moved, -moved)
        periods = torch.tensor(self.space.period, dtype=between.dtype, device=between.device)
        (keep,) = rows_where((moved * periods == self.space.shift(between.T).T).all(1))
        return i.index_select(0, keep), j.index_select(0, keep)


@torch.no_grad()
def near_images(
    space: PeriodicSpace, position: Tensor, axis: Tensor, length: Tensor, radius: Tensor,
    colony: Tensor, colonies: int, margin: float | Tensor,
) -> tuple[Images, Tensor, Tensor]:  # fmt: skip
    """The images of cells, and the pairs of `Neighbourhood` among them."""
    side = 0.5 * length.unsqueeze(1) * axis.abs() + (radius + 0.5 * margin).unsqueeze(1)
    found = space.images(position, side, Groups(colony, colonies))
    pick = lambda x: x.index_select(0, found.cell)
    near = Neighbourhood(
        found.position, pick(axis), pick(length), pick(radius), pick(colony), colonies,
        pick(margin) if isinstance(margin, Tensor) else margin,
    )  # fmt: skip
    return found, *near.pairs()


@torch.no_grad()
def near_pairs(
    position: Tensor, axis: Tensor, length: Tensor, radius: Tensor, colony: Tensor, colonies: int,
    margin: float | Tensor = 0.0, space: PeriodicSpace | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The pairs of `Neighbourhood`; in a periodic space those whose nearest images are near."""
    cells = position, axis, length, radius, colony, colonies, margin
    if space is None or not colony.numel():
        return Neighbourhood(*cells).pairs()
    images, first, second = near_images(space, *cells)
    return images.nearest_pairs(first, second)


def check_walls_in(space: PeriodicSpace, surfaces: Sequence[Surface]) -> None:
    """Raise InputError for a wall that is not the same at opposite faces."""
    for surface in surfaces:
        wall, across = type(surface.wall).__name__, list(space.faces)
        if isinstance(surface, FlatSurface):
            normal = [torch.as_tensor(x).detach() for x in surface.normal]
            across = [a for a in across if bool((normal["xyz".index(a)].abs() > 1e-12).any())]
        if across:
            raise checks.InputError(
                f"Mechanics.periodic: the {wall} ends space along {' and '.join(across)}, which is"
                f" periodic ({space.told}). Leave out the wall, or that axis; walls that fit are"
                " planes parallel to it."
            )


def check_first_cells(
    space: PeriodicSpace, position: Tensor, length: Tensor, radius: Tensor, reach: Tensor,
    ids: Tensor, uid: Tensor,
) -> None:  # fmt: skip
    """Raise InputError for a cell that starts beyond a face, or is too long. position (N, d);
    length, radius, and reach of contacts, (N,) µm; ids, uid: (N,) of the cells' colonies, and of
    the cells."""
    name = lambda k: f"cell {int(uid[k])} of colony {int(ids[k])}"
    beyond = torch.nonzero(space.outside(position)).squeeze(1)
    if beyond.numel():
        k = int(beyond[0])
        at = [round(x, 3) for x in position[k].tolist()]
        raise checks.InputError(
            f"Mechanics.periodic: {name(k)} starts at {at}, beyond the faces ({space.told}; cells"
            f" beyond them: {beyond.numel()}). Move the cell, or the faces."
        )
    long = torch.nonzero(space.too_long(length, radius, reach)).squeeze(1)
    if long.numel():
        k = int(long[0])
        raise checks.InputError(
            f"Mechanics.periodic: {name(k)} is {float(length[k] + 2 * radius[k]):.3g} µm long with"
            f" its caps, and its contacts reach {float(reach[k]):.3g} µm, in all more than half of"
            f" the way between the faces ({space.told}): it could meet two images of another cell."
            " Place the faces farther apart."
        )

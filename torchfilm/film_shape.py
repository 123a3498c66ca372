"""The shape of a biofilm on a floor: its height above each place of the floor, and what is on
top."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.physics.space import checked_spans
from torchfilm.state import State
from torchfilm.tools import checks


@dataclass(frozen=True)
class Film:
    """The film of each colony. height: (B, C) float64 µm, of the highest cell above the middle of
    each of C columns of the floor, 0 where there is none; in space (B, CX, CY). thickness: (B,)
    their mean. roughness: (B,) the mean of |height − thickness| over the thickness, 0 for a flat
    film (Heydorn et al., Microbiology 146, 2395, 2000); NaN without cells on the floor. coverage:
    (B,) the share of the columns in which there is a cell."""

    height: Tensor
    thickness: Tensor
    roughness: Tensor
    coverage: Tensor


@dataclass(frozen=True)
class Floor:
    """A floor in columns: along each of its axes the ends, how many columns, and whether the last
    is beside the first. at: its y in the plane, or z in space, µm."""

    spans: tuple[tuple[float, float], ...]
    counts: tuple[int, ...]
    periodic: tuple[bool, ...]
    at: float

    @staticmethod
    def of(
        name: str, state: State, spacing: float, at: float,
        across: Mapping[str, tuple[float, float]] | None, of_medium: bool = True,
    ) -> Floor:  # fmt: skip
        """The floor of a state's colonies. across: see `measure.film`. of_medium: whether it may be
        as wide as the box of the medium. Raises InputError, which names `name`."""
        ground, upward = "xyz"[: state.dim - 1], "xyz"[state.dim - 1]
        faces = {} if state.space is None else state.space.faces
        if upward in faces:
            raise checks.InputError(
                f"{name} goes by height along {upward}, and space is periodic there: there is no"
                " floor."
            )
        found = {**(_of_medium(state, ground) if of_medium else {}), **faces}
        given = checked_spans(f"{name}(across)", {} if across is None else across, ground)
        for axis, span in given.items():
            if faces.get(axis, span) != span:
                rule = f"left out along {axis}, where space is periodic"
                raise checks.input_error(f"{name}(across)", across, rule)
            found[axis] = span
        if missing := [a for a in ground if a not in found]:
            medium = ", and there is no medium that is as wide in all colonies" if of_medium else ""
            raise checks.InputError(
                f"{name} does not know how far the floor reaches along {' and '.join(missing)}:"
                f" space is not periodic there{medium}. Give it, such as"
                f" across={{{missing[0]!r}: (0, 40)}}."
            )
        spans = tuple(found[a] for a in ground)
        counts = [max(1, math.ceil((high - low) / spacing - 1e-9)) for low, high in spans]
        return Floor(spans, tuple(counts), tuple(a in faces for a in ground), at)

    @property
    def steps(self) -> list[float]:
        """How wide a column is along each axis, µm."""
        ends = zip(self.spans, self.counts, strict=True)
        return [(high - low) / count for (low, high), count in ends]


@dataclass(frozen=True, eq=False)
class CellsOverColumns:
    """Where cells meet the middles of columns. place: (M,), the column, of all colonies one after
    the other. cell: (M,). top: (M,) float64, how high the cell reaches there, µm above the floor.
    inside: (N,) bool, whether a cell's centre is above the floor, in a column of it. size: how many
    columns there are."""

    place: Tensor
    cell: Tensor
    top: Tensor
    inside: Tensor
    size: int

    def height(self) -> Tensor:
        """Of the highest cell above the middle of each column, (size,) float64; 0 where there is
        none."""
        return self.top.new_zeros(self.size).scatter_reduce(0, self.place, self.top, "amax")


def film_of(
    state: State, spacing: float, floor: float, across: Mapping[str, tuple[float, float]] | None
) -> Film:
    """See `measure.film`."""
    where = Floor.of("film", state, spacing, floor, across)
    height = columns_of(state, where).height().reshape(state.colonies, *where.counts)
    flat = height.flatten(1)
    thickness = flat.mean(1)
    roughness = (flat - thickness.unsqueeze(1)).abs().mean(1) / thickness
    return Film(height, thickness, roughness, (flat > 0).double().mean(1))


def below_top_of(
    state: State, spacing: float, floor: float, across: Mapping[str, tuple[float, float]] | None
) -> Tensor:
    """See `measure.below_top`."""
    where = Floor.of("below_top", state, spacing, floor, across)
    height = columns_of(state, where).height()
    place, there = state.colony, torch.ones_like(state.colony, dtype=torch.bool)
    for k, ((low, high), step) in enumerate(zip(where.spans, where.steps, strict=True)):
        x = state.position[:, k]
        column, count = torch.floor((x - low) / step).long(), where.counts[k]
        if where.periodic[k]:
            column = column % count
        else:
            there &= (x >= low) & (x <= high)
        place = place * count + column.clamp(0, count - 1)
    above = state.position[:, -1] - floor
    # a cell may lie beside the middle of its column and reach above all that is there
    own = above + 0.5 * state.length * state.axis[:, -1].abs() + state.radius
    top = torch.maximum(height.index_select(0, place), own)
    return torch.where(there, top - above, math.nan)


def columns_of(state: State, floor: Floor) -> CellsOverColumns:
    """Where the cells of a state meet the columns of a floor, above it."""
    half, radius, axis = 0.5 * state.length.double(), state.radius.double(), state.axis.double()
    inside = state.position[:, -1] >= floor.at
    firsts, numbers = [], []  # of the columns whose middle is within what a cell takes up
    for k, ((low, high), step) in enumerate(zip(floor.spans, floor.steps, strict=True)):
        x, wide = state.position[:, k], half * axis[:, k].abs() + radius
        firsts.append(torch.ceil((x - wide - low) / step - 0.5).long())
        last = torch.floor((x + wide - low) / step - 0.5).long()
        numbers.append((last - firsts[k] + 1).clamp(min=0))
        if not floor.periodic[k]:
            inside &= (x >= low) & (x < high)
    each = functools.reduce(torch.mul, numbers)
    cell = torch.repeat_interleave(torch.arange(state.cells, device=state.device), each)
    pick = lambda x: x.index_select(0, cell)
    rank = torch.arange(len(cell), device=state.device) - pick(torch.cumsum(each, 0) - each)
    place, there, away = pick(state.colony), torch.ones_like(cell, dtype=torch.bool), []
    for k, ((low, _), step) in enumerate(zip(floor.spans, floor.steps, strict=True)):
        number, count = pick(numbers[k]), floor.counts[k]
        column, rank = pick(firsts[k]) + rank % number, rank // number
        away.append(low + (column + 0.5) * step - pick(state.position[:, k]))
        if not floor.periodic[k]:
            there &= (column >= 0) & (column < count)
        place = place * count + column % count
    top = pick(state.position[:, -1]) + _top(away, pick(axis), pick(half), pick(radius)) - floor.at
    meets = torch.nonzero(there & (top > 0)).squeeze(1)  # a NaN is not above 0
    size = state.colonies * math.prod(floor.counts)
    return CellsOverColumns(place[meets], cell[meets], top[meets], inside, size)


def _top(away: Sequence[Tensor], axis: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """How high above its centre a cell reaches on an upright line, (M,) µm; NaN where it does not
    meet it. away: from the centre to the line along each axis of the ground, (M,).

    It is the highest of the points t·a_z + √(r² − |d − t·a_xy|²) for t along the centreline, with
    the line at d. With p along the cell's ground track, of length s for each unit of t, and R² = r²
    − |d|² + p² for what is across it, that is where p − s·t = −a_z·R, or at an end.
    """
    upward = axis[:, -1]
    track = (1.0 - upward * upward).clamp(min=0.0).sqrt()
    lies = track > 1e-9  # else it stands upright, and its track is a point
    one = torch.where(lies, track, 1.0)
    p = functools.reduce(torch.add, (d * axis[:, k] for k, d in enumerate(away))) / one
    p = torch.where(lies, p, 0.0)
    square = radius * radius - functools.reduce(torch.add, (d * d for d in away)) + p * p
    across = square.clamp(min=0.0).sqrt()
    t = torch.where(lies, (p + upward * across) / one, torch.copysign(half, upward))
    t = torch.minimum(torch.maximum(t, -half), half)
    u = p - track * t
    return t * upward + (square - u * u).sqrt()


def _of_medium(state: State, ground: str) -> dict[str, tuple[float, float]]:
    """The ends of the box of the medium, along the axes on which it is as wide in all colonies."""
    if state.layout is None:
        return {}
    grid = state.layout.grid
    step = torch.tensor(grid.spacing, dtype=torch.float64, device=state.device)
    low, high = grid.origin, grid.origin + grid.shape * step
    alike = lambda k: bool((low[:, k] == low[0, k]).all() & (high[:, k] == high[0, k]).all())
    return {a: (float(low[0, k]), float(high[0, k])) for k, a in enumerate(ground) if alike(k)}

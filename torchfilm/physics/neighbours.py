"""Broad phase: pairs of cells near enough to touch, found on the tensors' own device.

Every cell has a reach: half its length plus its radius plus half the given margin. Cells are sorted
into rows (in the plane) or columns of rows (in space), and by position along the row. Each row is
about as high as the cells' reach. The partners of a cell in one row are then one contiguous range,
found by bisection.

Cells of very different reach form classes, each with its own grid. So one filament among a thousand
rods does not slow down the rods. There is no capacity to overflow: the list is as long as needed.
All sizes are computed for each colony by itself, so the pairs of a colony, and their order, do not
depend on other colonies in the batch.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfilm.tools.ragged import Groups, expand_ranges, offsets
from torchfilm.tools.reads import numbers, rows_where

# Slices of a row per reach of a cell. Finer slices leave fewer cells out of reach to test; coarser
# slices make the table of their starts shorter.
SLICES = 8
# A table may have this many entries per cell. Cells at a lower density are found by bisection.
TABLE_SHARE = 64
MAX_ROWS = 2**17
# A cell whose reach exceeds this multiple of the smallest in its colony is in the next class.
CLASS_RATIO = 4.0


class Neighbourhood:
    """The cells of many colonies at fixed positions, for repeated searches of near pairs.

    position, axis: (N, d), µm and unit. length, radius: (N,) µm. colony: (N,) int64. margin: µm,
    one number, or one per cell (N,), of which a pair uses the mean.

    A pair (i, j), i ≠ j, is in one colony, and its bounding spheres and bounding boxes are within
    `margin` of each other. No pair whose surfaces are within `margin` is missing. Pairs are two
    (P,) int64 tensors.
    """

    @torch.no_grad()
    def __init__(
        self,
        position: Tensor,
        axis: Tensor,
        length: Tensor,
        radius: Tensor,
        colony: Tensor,
        colonies: int,
        margin: float | Tensor = 0.0,
    ):
        self.place, self.reach = position.T.contiguous(), 0.5 * length + radius + 0.5 * margin
        # slightly larger, so that rounding loses no pair that touches exactly
        self.box = (0.5 * length * axis.abs().T + radius + 0.5 * margin) * (1 + 1e-5)
        # one per class, with the cells of larger classes
        self.grids: list[tuple[_CellGrid, Tensor]] = []
        if colony.numel() < 2:
            return
        groups = Groups(colony, colonies)
        smallest = -groups.max(-self.reach)
        level = torch.floor(
            torch.log(self.reach / smallest.index_select(0, colony)) / math.log(CLASS_RATIO) + 1e-3
        ).long()
        everyone = torch.arange(colony.numel(), device=colony.device)
        # most often all are of one class: its grid is made before that is known, for one read less
        grid, last = _CellGrid.build(position, self.reach, groups, everyone, level.max())
        if last == 0:
            self.grids.append((grid, everyone[:0]))
            return
        for k in range(last + 1):
            members, larger = rows_where(level == k, level > k)
            if members.numel():
                grid, _ = _CellGrid.build(position, self.reach, groups, members, level.max())
                self.grids.append((grid, larger))

    @torch.no_grad()
    def pairs(self) -> tuple[Tensor, Tensor]:
        """Every pair, once."""
        found = []
        for grid, larger in self.grids:
            found.append(grid.pairs_within(self.place, self.reach))
            if larger.numel():
                found.append(
                    _keep_spheres_that_meet(self.place, self.reach, *grid.pairs_with(larger))
                )
        return self._keep_boxes_that_meet(found)

    @torch.no_grad()
    def pairs_of(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Every pair with at least one of `cells` (M,), once; that cell is the first of the
        pair.
        """
        selected = torch.zeros(
            self.reach.numel(), dtype=torch.bool, device=self.reach.device
        ).index_fill(0, cells, True)
        found = []
        for grid, _ in self.grids if cells.numel() else ():
            i, j = _keep_spheres_that_meet(self.place, self.reach, *grid.pairs_with(cells))
            # a pair of two selected cells was found twice, and each selected cell has found itself
            (once,) = rows_where((i < j) | ~selected.index_select(0, j))
            found.append((i.index_select(0, once), j.index_select(0, once)))
        return self._keep_boxes_that_meet(found)

    def _keep_boxes_that_meet(self, found: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        """The pairs whose bounding boxes meet, each box grown by half the margin."""
        none = self.reach.new_empty(0, dtype=torch.int64)
        i, j = (
            torch.cat([none, *side]) for side in (zip(*found, strict=True) if found else ((), ()))
        )
        meet = torch.ones_like(i, dtype=torch.bool)
        for x, size in zip(self.place, self.box, strict=True):
            apart = (x.index_select(0, j) - x.index_select(0, i)).abs()
            meet &= ~(apart > size.index_select(0, i) + size.index_select(0, j))
        (keep,) = rows_where(meet)
        return i.index_select(0, keep), j.index_select(0, keep)


@dataclass(frozen=True)
class _CellGrid:
    """The rows of one class of cells, in units of the rows' height."""

    at: Tensor  # (d, N) position of each cell: along the row, then across rows
    shape: Tensor  # (d, B) int64: slices along a row, then numbers of rows
    base: Tensor  # (B,) int64: first key of each colony
    # (N,) the greatest distance of a partner: a cell's own reach plus the members' greatest reach
    window: Tensor
    colony: Tensor
    members: Tensor  # sorted by key
    keys: Tensor
    slices: int  # per row height
    most_rows: list[int]  # of any colony, along each axis across rows
    table: Tensor | None = None  # number of members before each key

    @staticmethod
    def build(
        position: Tensor, reach: Tensor, groups: Groups, members: Tensor, also: Tensor
    ) -> tuple[_CellGrid, int]:
        """The grid of one class, for its cells `members`, and the number `also`, read with it."""
        colony, of_members = groups.owner, groups
        if members.numel() < colony.numel():
            of_members = Groups(colony.index_select(0, members), groups.size)
        greatest = of_members.max(reach.index_select(0, members), empty=1.0)
        # narrow rows leave fewer cells out of reach to test, but in space there are many more rows
        wide = 1 if position.shape[1] == 2 else 2
        extent = torch.stack([groups.max(x) + groups.max(-x) for x in position.unbind(1)]).amax(0)
        # a lower bound on the row height: keys must fit 64 bits even for cells metres apart
        height = torch.maximum(wide * greatest, extent / MAX_ROWS).index_select(0, colony)
        slices = wide * SLICES
        at, shape = [], []
        for k in range(position.shape[1]):
            x = position[:, k]
            low = -groups.max(-x)
            at.append((x - low.index_select(0, colony)) / height)
            shape.append(groups.max(torch.floor(at[k] * (slices if k == 0 else 1)).long()) + 1)
        entries = shape[0]
        for k in range(1, len(shape)):
            entries = entries * shape[k]
        read, size, *most_rows = numbers(also, entries.sum(), *(rows.amax() for rows in shape[1:]))
        window = (reach + greatest.index_select(0, colony)) / height * (1 + 1e-5)
        grid = _CellGrid(
            torch.stack(at),
            torch.stack(shape),
            offsets(entries)[:-1],
            window,
            colony,
            members,
            members,
            slices,
            most_rows,
        )
        mine = grid.at.index_select(1, members)
        key = grid._key(
            colony.index_select(0, members),
            torch.floor(mine[1:]).long(),
            torch.floor(mine[0] * slices).long(),
        )
        keys, order = torch.sort(key, stable=True)
        table = None
        if size <= TABLE_SHARE * colony.numel():
            table = offsets(keys.new_zeros(size).scatter_add_(0, keys, torch.ones_like(keys)))
        members = members.index_select(0, order)
        return replace(grid, members=members, keys=keys, table=table), read

    def _key(self, colony: Tensor, rows: Tensor, along: Tensor) -> Tensor:
        """The key of a slice: cells are sorted by colony, then row, then slice."""
        row = rows[-1]
        for k in range(rows.shape[0] - 1, 0, -1):
            row = row * self.shape[k].index_select(0, colony) + rows[k - 1]
        return (
            self.base.index_select(0, colony) + row * self.shape[0].index_select(0, colony) + along
        )

    def _range_in_row(self, cells: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """The possible partners of `cells` (Q,) in the rows with indices `rows` (d − 1, Q).

        Returns the start and the length of their range in the sorted list.
        """
        colony, at = self.colony.index_select(0, cells), self.at.index_select(1, cells)
        window = self.window.index_select(0, cells)
        # only a part of a distant row is within the window
        away = torch.maximum(rows - at[1:], at[1:] - rows - 1).clamp(min=0)
        left = window * window - (away * away).sum(0)
        width = left.clamp(min=0).sqrt()
        last = self.shape.index_select(1, colony) - 1
        inside = ((rows >= 0) & (rows <= last[1:])).all(0) & (left >= 0)
        low = torch.floor((at[0] - width) * self.slices).long().clamp(min=0)
        high = torch.minimum(torch.floor((at[0] + width) * self.slices).long(), last[0])
        # a row outside has no key; any existing key will do, since nothing is taken from it
        rows = torch.minimum(rows.clamp(min=0), last[1:])
        start = self._members_before(self._key(colony, rows, torch.minimum(low, last[0])))
        stop = self._members_before(self._key(colony, rows, high.clamp(min=0)) + 1)
        return start, torch.where(inside, (stop - start).clamp(min=0), 0)

    def _members_before(self, key: Tensor) -> Tensor:
        """The number of members before each key."""
        return (
            torch.searchsorted(self.keys, key)
            if self.table is None
            else self.table.index_select(0, key)
        )

    def pairs_within(self, place: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        """Every pair of members whose bounding spheres meet, once.

        The search covers the rest of a member's own row and the rows after it. place: (d, N).
        reach: (N,).
        """
        # in sorted order, so that neighbours in space are neighbours in memory
        members = self.members
        own = torch.floor(self.at[1:].index_select(1, members)).long()
        # pairs out of reach are dropped row by row, from copies in sorted order: the data that is
        # read is contiguous and fits a cache
        place, reach = place.index_select(1, members), reach.index_select(0, members)
        reaches = 2 if own.shape[0] == 1 else 1
        starts, counts = [], []
        steps = [
            step
            for step in itertools.product(range(-reaches, reaches + 1), repeat=own.shape[0])
            # a film one row thick has no rows above or below
            if step[::-1] >= (0,) * len(step)
            and all(abs(k) < rows for k, rows in zip(step, self.most_rows, strict=True))
        ]
        shifts = torch.tensor(steps, device=own.device).unsqueeze(2)  # one copy to the device
        for step, offset in zip(steps, shifts, strict=True):
            start, count = self._range_in_row(members, own + offset)
            if not any(step):
                stop = start + count
                start = torch.arange(1, members.numel() + 1, device=members.device)
                count = (stop - start).clamp(min=0)
            starts.append(start)
            counts.append(count)
        totals = numbers(*(count.sum() for count in counts))
        runs = [expand_ranges(*each) for each in zip(starts, counts, totals, strict=True)]
        (keep,) = rows_where(torch.cat([_spheres_meet(place, reach, *run) for run in runs]))
        first, second = (torch.cat(side).index_select(0, keep) for side in zip(*runs, strict=True))
        return members.index_select(0, first), members.index_select(0, second)

    def pairs_with(self, queried: Tensor) -> tuple[Tensor, Tensor]:
        """Every pair of one of the cells `queried` (M,), of this class or another, and a member.

        A queried cell of this class also finds itself.
        """
        # the margin of the windows for rounding must not add another row
        rows_each_way = torch.ceil(self.window.index_select(0, queried) * (1 - 2e-5)).long()
        found: list[Tensor] = []
        query = torch.arange(queried.numel(), device=queried.device)
        for own_row in torch.floor(self.at[1:].index_select(1, queried)).long():
            each = rows_each_way.index_select(0, query)
            owner, row = expand_ranges(own_row.index_select(0, query) - each, 2 * each + 1)
            found = [earlier.index_select(0, owner) for earlier in found] + [row]
            query = query.index_select(0, owner)
        cells = queried.index_select(0, query)
        start, count = self._range_in_row(cells, torch.stack(found))
        owner, run = expand_ranges(start, count)
        return cells.index_select(0, owner), self.members.index_select(0, run)


def _keep_spheres_that_meet(
    place: Tensor, reach: Tensor, i: Tensor, j: Tensor
) -> tuple[Tensor, Tensor]:
    """The pairs (i, j) whose bounding spheres meet. place: (d, N). reach: (N,)."""
    (keep,) = rows_where(_spheres_meet(place, reach, i, j))
    return i.index_select(0, keep), j.index_select(0, keep)


def _spheres_meet(place: Tensor, reach: Tensor, i: Tensor, j: Tensor) -> Tensor:
    """Whether the bounding spheres of each pair meet, (P,) bool."""
    between = [x.index_select(0, j) - x.index_select(0, i) for x in place]
    squared = between[0] * between[0]
    for x in between[1:]:
        squared = squared + x * x
    sum_reach = reach.index_select(0, i) + reach.index_select(0, j)
    # slightly more than the reach: rounding must not lose a pair that touches exactly
    return squared <= sum_reach * sum_reach * (1 + 1e-5)

"""The contact rows of a batch as one linear operator J; JᵀJ is never formed."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from torchfilm.tools.ragged import Groups, WeightedRows, csr
from torchfilm.tools.reads import rows_where


class ContactJacobian:
    """J: R rows over N cells with D degrees of freedom.

    The first K rows are of two cells, the last W rows are of a cell and a wall. `first`, `second`
    (K,) and `at_wall` (W,) int64 are the cells. `row_first`, `row_second` (K, D) and `row_wall` (W,
    D) are the entries of J, already scaled by row weights and by drag as the solve requires.
    """

    def __init__(
        self,
        first: Tensor,
        second: Tensor,
        row_first: Tensor,
        row_second: Tensor,
        at_wall: Tensor,
        row_wall: Tensor,
        cells: int,
    ):
        self.first, self.second, self.at_wall = first, second, at_wall
        self.row_first, self.row_second, self.row_wall = row_first, row_second, row_wall
        self.cells, self.pairs, self.walls = cells, first.numel(), at_wall.numel()
        self.half_rows = Groups(torch.cat([first, second, at_wall]), cells)
        self.row_owner = torch.cat([first, at_wall])
        self._matrix: Tensor | None = None

    @property
    def rows(self) -> int:
        """R, the number of rows."""
        return self.pairs + self.walls

    def part(self, rows: Tensor, pairs: int, number: Tensor, cells: int) -> ContactJacobian:
        """The given rows (M,), of which the first `pairs` are of two cells, as an operator over
        `cells` cells.

        number: (N,) the new index of each cell that these rows touch.
        """
        pair, wall = rows[:pairs], rows[pairs:] - self.pairs
        of_pairs = [
            x.index_select(0, pair)
            for x in (self.first, self.second, self.row_first, self.row_second)
        ]
        at_wall, row_wall = self.at_wall.index_select(0, wall), self.row_wall.index_select(0, wall)
        return ContactJacobian(
            number.index_select(0, of_pairs[0]),
            number.index_select(0, of_pairs[1]),
            of_pairs[2],
            of_pairs[3],
            number.index_select(0, at_wall),
            row_wall,
            cells,
        )

    def among(self, moving: Tensor, cells: int) -> tuple[ContactJacobian, Tensor]:
        """The rows of the moving cells, (N,) bool, which are `cells`, with these renumbered.

        A cell at rest acts on them like a wall. Also returns the index of each new row here, (R',).
        """
        number = torch.cumsum(moving, 0) - 1
        one, other = moving.index_select(0, self.first), moving.index_select(0, self.second)
        both, only_one, only_other, wall = rows_where(
            one & other, one & ~other, other & ~one, moving.index_select(0, self.at_wall)
        )
        of = lambda cell, rows: number.index_select(0, cell.index_select(0, rows))
        at_wall = torch.cat(
            [of(self.first, only_one), of(self.second, only_other), of(self.at_wall, wall)]
        )
        parts = ((self.row_first, only_one), (self.row_second, only_other), (self.row_wall, wall))
        rows = ContactJacobian(
            of(self.first, both),
            of(self.second, both),
            self.row_first.index_select(0, both),
            self.row_second.index_select(0, both),
            at_wall,
            torch.cat([row.index_select(0, which) for row, which in parts]),
            cells,
        )
        return rows, torch.cat([both, only_one, only_other, self.pairs + wall])

    def apply(self, x: Tensor) -> Tensor:
        """J x: (N, D) -> (R,)."""
        if self._needs_grad(x) or not self.rows:
            pair = (self.row_first * x.index_select(0, self.first)).sum(1) + (
                self.row_second * x.index_select(0, self.second)
            ).sum(1)
            return torch.cat([pair, (self.row_wall * x.index_select(0, self.at_wall)).sum(1)])
        if x.device.type != "cpu":  # in few operations: there each costs more than its arithmetic
            each = (self._entries * x.index_select(0, self.half_rows.owner)).sum(1)
            pairs, others, walls = each.split([self.pairs, self.pairs, self.walls])
            return torch.cat([pairs + others, walls]) if self.walls else pairs + others
        if self._matrix is None:
            self._matrix = self._assemble(x.shape[1])
        return torch.mm(self._matrix, x.reshape(-1, 1)).squeeze(1)

    def apply_transpose(self, e: Tensor) -> Tensor:
        """Jᵀ e: (R,) -> (N, D)."""
        if self._needs_grad(e):
            pair, wall = e.unsqueeze(1)[: self.pairs], e.unsqueeze(1)[self.pairs :]
            return self.half_rows.sum(
                torch.cat([self.row_first * pair, self.row_second * pair, self.row_wall * wall])
            )
        halves, row = self._halves
        return halves.sum(e.index_select(0, row))

    @cached_property
    def _entries(self) -> Tensor:
        """The row entries of all halves, (2 K + W, D)."""
        return torch.cat([self.row_first, self.row_second, self.row_wall]).detach()

    @cached_property
    def _halves(self) -> tuple[WeightedRows, Tensor]:
        """The row entries of each cell, sorted by cell, and the row of each entry."""
        halves = WeightedRows(self._entries, self.half_rows)
        pair = torch.arange(self.pairs, device=self.first.device)
        wall = torch.arange(self.pairs, self.rows, device=self.first.device)
        return halves, halves.sorted(torch.cat([pair, pair, wall]))

    def sizes_of(self, x: Tensor) -> Tensor:
        """|J| |x|: (N, D) -> (R,)."""
        pick = lambda row, cell: (row.abs() * x.abs().index_select(0, cell)).sum(1)
        return torch.cat(
            [
                pick(self.row_first, self.first) + pick(self.row_second, self.second),
                pick(self.row_wall, self.at_wall),
            ]
        )

    def transpose_of_sizes(self, e: Tensor) -> Tensor:
        """|J|ᵀ |e|: (R,) -> (N, D)."""
        pair, wall = e.abs().unsqueeze(1)[: self.pairs], e.abs().unsqueeze(1)[self.pairs :]
        parts = torch.cat(
            [self.row_first.abs() * pair, self.row_second.abs() * pair, self.row_wall.abs() * wall]
        )
        return self.half_rows.plain_sum(parts)

    def blocks(self, active: Tensor | None = None) -> Tensor:
        """The diagonal blocks of Jᵀ diag(active) J, or of JᵀJ: (R,) -> (N, D, D)."""
        halves, row = self._halves
        weight = halves.value.T.contiguous()
        if active is not None:
            weight = weight * active.index_select(0, row)
        return torch.stack([halves.sum(of_column) for of_column in weight], 1)

    def _needs_grad(self, x: Tensor) -> bool:
        """Whether a product with x must be differentiable."""
        return torch.is_grad_enabled() and (
            x.requires_grad or self.row_first.requires_grad or self.row_wall.requires_grad
        )

    def _assemble(self, width: int) -> Tensor:
        """J as one sparse matrix."""
        # 32-bit from the start: these indices and values are as much memory traffic as a whole
        # product
        dof = torch.arange(width, dtype=torch.int32, device=self.first.device)
        columns = torch.empty(
            2 * self.pairs + self.walls, width, dtype=torch.int32, device=dof.device
        )
        values = self.row_first.new_empty(columns.shape)
        of_pairs, of_walls = 2 * self.pairs, columns[2 * self.pairs :]
        for side, (cell, row) in enumerate(
            ((self.first, self.row_first), (self.second, self.row_second))
        ):
            torch.add((cell * width).int().unsqueeze(1), dof, out=columns[side:of_pairs:2])
            values[side:of_pairs:2] = row.detach()
        torch.add((self.at_wall * width).int().unsqueeze(1), dof, out=of_walls)
        values[of_pairs:] = self.row_wall.detach()
        start = torch.cat(
            [
                torch.arange(self.pairs, device=dof.device) * 2,
                of_pairs + torch.arange(self.walls + 1, device=dof.device),
            ]
        )
        return csr(
            start * width, columns.reshape(-1), values.reshape(-1), (self.rows, self.cells * width)
        )

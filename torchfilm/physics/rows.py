"""The contact rows of a batch as one linear operator, J, never multiplied out into JᵀJ."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.tools.ragged import Groups, csr


class ContactRows:
    """R rows over N cells with D degrees of freedom: K rows of two cells, then W rows of a cell and a wall.

    `first`, `second` (K,), `at_wall` (W,) int64: the cells; `row_first`, `row_second` (K, D), `row_wall` (W, D): J's entries,
    already scaled by row weights and by drag as the solve wants them.
    """

    def __init__(self, first: Tensor, second: Tensor, row_first: Tensor, row_second: Tensor, at_wall: Tensor, row_wall: Tensor, cells: int):
        self.first, self.second, self.at_wall = first, second, at_wall
        self.row_first, self.row_second, self.row_wall = row_first, row_second, row_wall
        self.cells, self.pairs, self.walls = cells, first.numel(), at_wall.numel()
        self.half_rows = Groups(torch.cat([first, second, at_wall]), cells)
        self.row_owner = torch.cat([first, at_wall])
        self._matrix: Tensor | None = None
        self._work: Tensor | None = None

    @property
    def rows(self) -> int:
        return self.pairs + self.walls

    def part(self, rows: Tensor, number: Tensor, cells: int) -> ContactRows:
        """Some of the rows (M,), in their order, over `cells` cells; number: (N,) the new number of each cell that they touch."""
        pair, wall = rows[rows < self.pairs], rows[rows >= self.pairs] - self.pairs
        of_pairs = [x.index_select(0, pair) for x in (self.first, self.second, self.row_first, self.row_second)]
        at_wall, row_wall = self.at_wall.index_select(0, wall), self.row_wall.index_select(0, wall)
        return ContactRows(
            number.index_select(0, of_pairs[0]), number.index_select(0, of_pairs[1]), of_pairs[2], of_pairs[3],
            number.index_select(0, at_wall), row_wall, cells,
        )  # fmt: skip

    def among(self, moving: Tensor) -> tuple[ContactRows, Tensor]:
        """The rows of the cells that move, (N,) bool, numbered anew: to them a cell that stays is like a wall. And where each row stands here, (R',)."""
        number = torch.cumsum(moving, 0) - 1
        one, other = moving.index_select(0, self.first), moving.index_select(0, self.second)
        both, only_one, only_other, wall = (
            torch.nonzero(which).squeeze(1) for which in (one & other, one & ~other, other & ~one, moving.index_select(0, self.at_wall))
        )
        of = lambda cell, rows: number.index_select(0, cell.index_select(0, rows))  # noqa: E731
        at_wall = torch.cat([of(self.first, only_one), of(self.second, only_other), of(self.at_wall, wall)])
        parts = ((self.row_first, only_one), (self.row_second, only_other), (self.row_wall, wall))
        rows = ContactRows(
            of(self.first, both), of(self.second, both), self.row_first.index_select(0, both), self.row_second.index_select(0, both),
            at_wall, torch.cat([row.index_select(0, which) for row, which in parts]), int(moving.sum()),
        )  # fmt: skip
        return rows, torch.cat([both, only_one, only_other, self.pairs + wall])

    def apply(self, x: Tensor) -> Tensor:
        """J x: (N, D) -> (R,)."""
        if x.device.type != "cpu" or self._needs_grad(x) or not self.rows:
            pair = (self.row_first * x.index_select(0, self.first)).sum(1) + (self.row_second * x.index_select(0, self.second)).sum(1)
            return torch.cat([pair, (self.row_wall * x.index_select(0, self.at_wall)).sum(1)])
        if self._matrix is None:
            self._matrix = self._assemble(x.shape[1])
        return torch.mm(self._matrix, x.reshape(-1, 1)).squeeze(1)

    def apply_transpose(self, e: Tensor) -> Tensor:
        """Jᵀ e: (R,) -> (N, D)."""
        e = e.unsqueeze(1)
        pair, wall = e[: self.pairs], e[self.pairs :]
        if self._needs_grad(e):
            return self.half_rows.sum(torch.cat([self.row_first * pair, self.row_second * pair, self.row_wall * wall]))
        width = self.row_first.shape[1]
        if self._work is None:
            self._work = e.new_empty(2 * self.pairs + self.walls, width)
        # one buffer for the life of the rows: fresh memory for every product would cost more than the product
        torch.mul(self.row_first, pair, out=self._work[: self.pairs])
        torch.mul(self.row_second, pair, out=self._work[self.pairs : 2 * self.pairs])
        torch.mul(self.row_wall, wall, out=self._work[2 * self.pairs :])
        return self.half_rows.sum_into(self._work, e.new_empty(self.cells, width))

    def sizes_of(self, x: Tensor) -> Tensor:
        """|J| |x|: (N, D) -> (R,)."""
        pick = lambda row, cell: (row.abs() * x.abs().index_select(0, cell)).sum(1)  # noqa: E731
        return torch.cat([pick(self.row_first, self.first) + pick(self.row_second, self.second), pick(self.row_wall, self.at_wall)])

    def transpose_of_sizes(self, e: Tensor) -> Tensor:
        """|J|ᵀ |e|: (R,) -> (N, D)."""
        pair, wall = e.abs().unsqueeze(1)[: self.pairs], e.abs().unsqueeze(1)[self.pairs :]
        parts = torch.cat([self.row_first.abs() * pair, self.row_second.abs() * pair, self.row_wall.abs() * wall])
        return self.half_rows.sum_into(parts, parts.new_empty(self.cells, parts.shape[1]))

    def blocks(self, active: Tensor | None = None) -> Tensor:
        """The diagonal blocks of Jᵀ diag(active) J, or of JᵀJ: (R,) -> (N, D, D)."""
        width = self.row_first.shape[1]
        rows = torch.cat([self.row_first, self.row_second, self.row_wall])
        scaled = rows
        if active is not None:
            pair, wall = active[: self.pairs], active[self.pairs :]
            scaled = rows * torch.cat([pair, pair, wall]).unsqueeze(1)
        # the upper half of each square, row by row of it: slices are cheap, picking columns is not, and the whole half would not fit a cache
        parts = (rows[:, k : k + 1] * scaled[:, k:] for k in range(width))
        summed = torch.cat([self.half_rows.sum_into(part, rows.new_empty(self.cells, part.shape[1])) for part in parts], 1)
        i, j = torch.triu_indices(width, width, device=rows.device)
        whole = torch.empty(width, width, dtype=torch.int64, device=rows.device)
        whole[i, j] = whole[j, i] = torch.arange(i.numel(), device=rows.device)
        return summed.index_select(1, whole.reshape(-1)).reshape(-1, width, width)

    def _needs_grad(self, x: Tensor) -> bool:
        return torch.is_grad_enabled() and (x.requires_grad or self.row_first.requires_grad or self.row_wall.requires_grad)

    def _assemble(self, width: int) -> Tensor:
        dof = torch.arange(width, device=self.first.device)
        column = lambda cell: cell.unsqueeze(1) * width + dof  # noqa: E731
        columns = torch.cat([torch.cat([column(self.first), column(self.second)], 1).reshape(-1), column(self.at_wall).reshape(-1)])
        values = torch.cat([torch.cat([self.row_first, self.row_second], 1).reshape(-1), self.row_wall.reshape(-1)])
        pair_end = 2 * width * self.pairs
        start = torch.cat(
            [
                torch.arange(self.pairs, device=dof.device) * (2 * width),
                pair_end + torch.arange(self.walls + 1, device=dof.device) * width,
            ]
        )
        return csr(start, columns, values.detach(), (self.rows, self.cells * width))

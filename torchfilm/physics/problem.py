"""The linearised contact problem of a batch of colonies, and the report of its solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.kernels.scheme import BAD_DRAG as BAD_DRAG
from torchfilm.kernels.scheme import BAD_LENGTH as BAD_LENGTH
from torchfilm.kernels.scheme import COLLAPSED as COLLAPSED
from torchfilm.kernels.scheme import CONVERGED as CONVERGED
from torchfilm.kernels.scheme import ITERATION_LIMIT as ITERATION_LIMIT
from torchfilm.kernels.scheme import NOT_FINITE as NOT_FINITE
from torchfilm.kernels.scheme import TOO_FAST as TOO_FAST
from torchfilm.kernels.scheme import TOO_LONG as TOO_LONG
from torchfilm.kernels.scheme import TOO_STICKY as TOO_STICKY
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.tools.ragged import Groups

STATUS = {
    CONVERGED: "converged",
    ITERATION_LIMIT: "reached its iteration limit",
    NOT_FINITE: "is not finite",
    TOO_FAST: "would have to follow too much growth in one step",
    BAD_DRAG: "has a drag that is not above 0 and finite",
    COLLAPSED: "leaves too many cells deep in others, step after step",
    BAD_LENGTH: "has a cell whose length is below 0",
    TOO_STICKY: "has cells that stick together too strongly",
    TOO_LONG: "has a cell that is too long for its periodic space",
}


@dataclass(frozen=True)
class SolveReport:
    """What a solve did in each colony; every field is (B,).

    status: see STATUS. iterations: of CG. residual: recomputed from x, the worst preconditioned
    residual, divided by the worst residual at x = 0. Where opposing forces cancel, the divisor is
    the least residual that rounding resolves.
    """

    status: Tensor
    iterations: Tensor
    residual: Tensor


@dataclass(frozen=True)
class ContactProblem:
    """One linearised contact problem: R rows over N cells with D degrees of freedom, in B colonies.

    rows: D J M^(−½), scaled by row weights and drag. gap: (R,) D g. applied_force: (R,) force that
    each row already exerted in this step: D min(0, g) for soft rows in later passes, else 0. alpha:
    (N, D). lower: (N,) least scaled Δl. scale: (N, D) M^(−½). rigid: (N,) bool, cells that do not
    grow. The length of a rigid cell is not a degree of freedom, so bilateral contacts cannot
    stretch it.
    """

    rows: ContactJacobian
    gap: Tensor
    applied_force: Tensor
    alpha: Tensor
    lower: Tensor
    scale: Tensor
    rigid: Tensor
    colonies: Groups

    def gap_after(self, y: Tensor) -> Tensor:
        """The scaled gap of each row after the move y (N, D): D(g − Jx), (R,)."""
        return self.gap - self.rows.apply(y)

    def gradient(self, y: Tensor, violation: Tensor) -> Tensor:
        """The gradient of the minimised function, (N, D).

        violation: (R,) the gap after the move for rows that act, 0 for the others.
        """
        return self.alpha * y - self.rows.apply_transpose(violation - self.applied_force)

    def system(self, active: Tensor | None = None) -> Callable[[Tensor], Tensor]:
        """The map v -> (JᵀAJ + α) v. A marks the rows that act, (R,); None: all do.

        The preconditioner discards its output for degrees of freedom that are not free.
        """

        def apply(v: Tensor) -> Tensor:
            change = self.rows.apply(v)
            change = change if active is None else active * change
            return self.rows.apply_transpose(change).addcmul_(self.alpha, v)

        return apply

    @property
    def tracked(self) -> bool:
        """Whether a gradient is required of anything in it."""
        rows = self.rows
        parts = (self.gap, rows.row_first, rows.row_wall, self.alpha, self.lower, self.scale)
        return any(part.requires_grad for part in parts)

    def detached(self) -> ContactProblem:
        """The same problem without gradients."""
        r = self.rows
        if not torch.is_grad_enabled() and not r.row_first.requires_grad:
            return self
        rows = ContactJacobian(
            r.first,
            r.second,
            r.row_first.detach(),
            r.row_second.detach(),
            r.at_wall,
            r.row_wall.detach(),
            r.cells,
        )
        return ContactProblem(
            rows,
            self.gap.detach(),
            self.applied_force.detach(),
            self.alpha.detach(),
            self.lower.detach(),
            self.scale.detach(),
            self.rigid,
            self.colonies,
        )

    def among(self, moving: Tensor, cells: Tensor) -> ContactProblem:
        """The problem of the moving cells, (N,) bool and their places, while the others stay at
        rest.

        Colonies keep their numbers.
        """
        rows, index = self.rows.among(moving, cells.numel())
        of_rows, of_cells = (lambda x, at=at: x.index_select(0, at) for at in (index, cells))
        return ContactProblem(
            rows,
            of_rows(self.gap),
            of_rows(self.applied_force),
            of_cells(self.alpha),
            of_cells(self.lower),
            of_cells(self.scale),
            of_cells(self.rigid),
            Groups(of_cells(self.colonies.owner), self.colonies.size, ordered=True),
        )

    def part(self, which: Selection) -> ContactProblem:
        """The problem of some of its colonies."""
        cells, rows = which.cells, which.rows
        number = torch.empty(self.rows.cells, dtype=torch.int64, device=cells.device)
        number[cells] = torch.arange(cells.numel(), device=cells.device)
        place = torch.empty(self.colonies.size, dtype=torch.int64, device=cells.device)
        place[which.colonies] = torch.arange(which.colonies.numel(), device=cells.device)
        owner = place.index_select(0, self.colonies.owner.index_select(0, cells))
        return ContactProblem(
            self.rows.part(rows, which.pairs, number, cells.numel()),
            self.gap.index_select(0, rows),
            self.applied_force.index_select(0, rows),
            self.alpha.index_select(0, cells),
            self.lower.index_select(0, cells),
            self.scale.index_select(0, cells),
            self.rigid.index_select(0, cells),
            Groups(owner, which.colonies.numel(), ordered=True),
        )

    @cached_property
    def of_rows(self) -> Groups:
        """The rows of each colony."""
        return Groups(self.colonies.owner.index_select(0, self.rows.row_owner), self.colonies.size)


@dataclass(frozen=True)
class Selection:
    """Some colonies of a problem: their indices, their cells and their rows, of which the first
    `pairs` are of two cells."""

    colonies: Tensor
    cells: Tensor
    rows: Tensor
    pairs: int

    def by_field(self) -> tuple[Tensor, ...]:
        """The index into each field of an Iterate, in the order of its fields."""
        return (
            self.cells,
            self.rows,
            self.cells,
            self.cells,
            self.colonies,
            self.colonies,
            self.colonies,
        )

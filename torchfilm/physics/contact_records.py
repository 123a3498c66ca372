"""What the parts of a contact step hand to each other: settings, properties of cells, where cells
are, and what the solves did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import COARSE_PASSES
from torchfilm.physics.problem import SolveReport
from torchfilm.physics.surfaces import Surface
from torchfilm.tools.ragged import Groups


@dataclass(frozen=True)
class ContactSettings:
    """How contacts are solved, every default filled in: a default that is given explicitly is the
    default.

    dim: 2 or 3. soft: cells have a physical stiffness. passes: at most this many a step;
    coarse_passes: for colonies that take sub-steps. overlap: µm, that later passes solve to; None:
    DEEP radii, CLOSE for colonies that take sub-steps. tolerance: of the solve; None: by the
    penalty. max_iterations: of CG a solve.
    """

    dim: int
    soft: bool
    passes: int
    coarse_passes: int
    overlap: float | None
    tolerance: float | None
    max_iterations: int

    @staticmethod
    def resolve(
        dim: int,
        *,
        soft: bool,
        passes: int | None,
        overlap: float | None,
        tolerance: float | None,
        max_iterations: int,
    ) -> ContactSettings:
        """From what a user gave, None for a default: one pass in the plane, two in space."""
        usual = dim - 1 if passes is None else passes
        return ContactSettings(
            dim, soft, usual, max(usual, COARSE_PASSES), overlap, tolerance, max_iterations
        )

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a cell: 4 in strict 2-D, 7 in 3-D."""
        return 4 if self.dim == 2 else 7

    @property
    def sees_near(self) -> tuple[bool, bool]:
        """Whether the first pass, and a later one, see what nearly touches. Rows that hold would
        glue what growth takes apart; soft cells have no later pass that could push what nearly
        touches together."""
        return False, not self.soft


@dataclass(frozen=True)
class CellProperties:
    """What the contact step needs of N cells in B colonies and does not change, for one step.

    radius (N,) µm; viscosity, length_drag, alpha (N,) or 0-dim; dt (N,) h, of each cell's sub-step;
    overlap (N,) µm, how deep a contact may be left; colony_ids (N,); reference (N, d), a point near
    each cell's colony. walls: for each surface its kind ("hard", "stiffness", "weight") and its
    stiffness · α · Δt or weight by cell.
    """

    settings: ContactSettings
    radius: Tensor
    viscosity: Tensor
    length_drag: Tensor
    alpha: Tensor
    overlap: Tensor
    colony_ids: Tensor
    reference: Tensor
    start: Tensor
    groups: Groups
    surfaces: Sequence[Surface]
    walls: Sequence[tuple[str, Tensor | None]]

    @property
    def colony(self) -> Tensor:
        return self.groups.owner


@dataclass(frozen=True)
class Moved:
    """Where cells are, and what one solve hands to the next: position (N, d) float64 µm, axis (N,
    d), length (N,) µm; clipped (N,) bool, whether the last move was cut short; reach (N,) µm, how
    far the surface came at most; first_move (N, D), of the first solve, from which the next step
    starts."""

    position: Tensor
    axis: Tensor
    length: Tensor
    clipped: Tensor
    reach: Tensor
    first_move: Tensor


@dataclass(frozen=True)
class ContactReport:
    """What the contact solves of a step did, per colony (B,). `status` of the worst solve,
    `iterations` of CG in all, and the worst true `residual`; `passes` taken; `clipped`: cells whose
    last move was cut short; `deeply_overlapping`: cells that were deeper in another than a radius
    when the step, or its last sub-step, began (0 of soft cells, which may be); `alpha` (float64): α
    of the first pass, of the last sub-step; 0 of bilateral contacts and where α is given.
    """

    status: Tensor
    iterations: Tensor
    residual: Tensor
    passes: Tensor
    clipped: Tensor
    deeply_overlapping: Tensor
    alpha: Tensor

    def with_solve(self, new: SolveReport, clipped: Tensor, active: Tensor) -> ContactReport:
        """The report after one more pass in the colonies that are active, (B,) bool."""
        return ContactReport(
            torch.where(active, torch.maximum(self.status, new.status), self.status),
            self.iterations + torch.where(active, new.iterations, 0),
            torch.where(active, torch.maximum(self.residual, new.residual), self.residual),
            self.passes + active,
            torch.where(active, clipped, self.clipped),
            self.deeply_overlapping,
            self.alpha,
        )

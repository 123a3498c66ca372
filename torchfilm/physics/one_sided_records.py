"""What one-sided contact steps are given and return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchfilm.physics.surfaces import Surface
from torchfilm.tools.ragged import Groups


@dataclass(frozen=True)
class OneSidedSettings:
    """How one-sided contacts are solved, every default filled in.

    dim: 2 or 3. soft: cells have a physical stiffness: one pass. passes: at most this many a step.
    overlap: µm, deeper cells are solved again; None: TOO_DEEP radii. contact_overlap: mean overlap
    that contacts leave, radii. tolerance: relative error of the contact forces. max_iterations: of
    CG a solve.
    """

    dim: int
    soft: bool
    passes: int
    overlap: float | None
    contact_overlap: float
    tolerance: float
    max_iterations: int

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a cell: 4 in strict 2-D, 7 in 3-D."""
        return 4 if self.dim == 2 else 7


@dataclass(frozen=True)
class StepInput:
    """What one-sided contact steps need of N cells in B colonies, and do not change.

    position (N, d) float64 µm, axis (N, d), length (N,) µm before growth, growth (N,) µm, radius
    (N,) µm; viscosity, length_drag (N,); steps (B,) sub-steps, 0 for a colony that cannot be
    stepped; start (N, D) the last move; hardness (B,) float64 the α of the colony's last step, 0 at
    the start; alpha (N,) where it is given, else None; walls: for each surface its kind ("hard",
    "stiffness", "weight") and its weight, or its stiffness · Δt of the sub-step, (N,).
    """

    settings: OneSidedSettings
    groups: Groups
    position: Tensor
    axis: Tensor
    length: Tensor
    growth: Tensor
    radius: Tensor
    viscosity: Tensor
    length_drag: Tensor
    steps: Tensor
    start: Tensor
    hardness: Tensor
    alpha: Tensor | None
    colony_ids: Tensor
    surfaces: Sequence[Surface]
    walls: Sequence[tuple[str, Tensor | None]]

    @property
    def ids(self) -> Tensor:
        """The id of each colony, (B,); 0 for one without cells."""
        return self.groups.max(self.colony_ids)


@dataclass(frozen=True)
class StepResult:
    """Where cells are after the steps, the move to start from next, α of each colony, and what the
    solves did: see `contact_records.ContactReport`."""

    position: Tensor
    axis: Tensor
    length: Tensor
    move: Tensor
    hardness: Tensor
    status: Tensor
    iterations: Tensor
    error: Tensor
    passes: Tensor
    clipped: Tensor
    deeply_overlapping: Tensor

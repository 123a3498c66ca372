"""The settings of one-sided contacts."""

from __future__ import annotations

from dataclasses import dataclass

from torchfilm.kernels.scheme import DEEPER, DEEPEST, TOO_DEEP
from torchfilm.physics.space import PeriodicSpace


@dataclass(frozen=True)
class OneSidedSettings:
    """How one-sided contacts are solved, every default filled in.

    dim: 2 or 3. soft: cells have a physical stiffness: one pass. passes: at most this many a step.
    overlap: µm, deeper cells are solved again; None: `too_deep` radii. contact_overlap: mean
    overlap that contacts leave, radii. tolerance: relative error of the contact forces.
    max_iterations: of CG a solve. space: where cells are, if it is periodic. compiled: kernels
    solve what torch assembles, on the CPU.
    """

    dim: int
    soft: bool
    passes: int
    overlap: float | None
    contact_overlap: float
    tolerance: float
    max_iterations: int
    space: PeriodicSpace | None = None
    compiled: bool = False

    @property
    def too_deep(self) -> float:
        """How deep cells may lie where `overlap` does not say, radii."""
        return max(TOO_DEEP, min(DEEPER * self.contact_overlap, DEEPEST))

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a cell: 4 in strict 2-D, 7 in 3-D."""
        return 4 if self.dim == 2 else 7

"""What steps of mechanics, and their contact steps, are given and return, of either kind of
contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from torchfilm.physics.adhesion import Bonds
from torchfilm.physics.contact_records import ContactReport, ContactSettings
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.surfaces import Surface
from torchfilm.tools.ragged import Groups

Settings = TypeVar("Settings", OneSidedSettings, ContactSettings)


@dataclass(frozen=True)
class MechanicsInput(Generic[Settings]):
    """What a step of mechanics is given of N cells in B colonies, and does not change.

    dt: h. longest: µm, by which a cell may grow in one sub-step. position (N, d) float64 µm, axis
    (N, d), length (N,) µm with its elongation (N,) of this step, radius (N,) µm; move (N, D), the
    last one; collapsed (N,) int64, steps in a row in which contacts have not held the cell's
    colony; contact_alpha (N,), α with which the step begins, and compression (N,) µm: None of
    bilateral contacts. viscosity, length_drag, and alpha or stiffness where one of them is given:
    0-dim or (N,); drag (N,), a factor of viscosity, or None. colony_id (B,). walls: for each
    surface its kind ("hard", "stiffness", "weight") and that value, 0-dim or (N,). bonds: of cells
    that stick together, or None. drift: (N, d + turns), how far they have moved and turned by
    themselves in this step, or None.
    """

    settings: Settings
    dt: float
    longest: float
    groups: Groups
    position: Tensor
    axis: Tensor
    length: Tensor
    elongation: Tensor
    radius: Tensor
    move: Tensor
    collapsed: Tensor
    contact_alpha: Tensor | None
    compression: Tensor | None
    viscosity: Tensor
    length_drag: Tensor
    drag: Tensor | None
    alpha: Tensor | None
    stiffness: Tensor | None
    colony_id: Tensor
    surfaces: Sequence[Surface]
    walls: Sequence[tuple[str, Tensor | None]]
    bonds: Bonds | None = None
    drift: Tensor | None = None


@dataclass(frozen=True)
class MechanicsResult:
    """What a step of mechanics makes of cells, as in `MechanicsInput`, and what its solves did in
    each colony, with the number of sub-steps (B,)."""

    position: Tensor
    axis: Tensor
    length: Tensor
    move: Tensor
    elongation: Tensor
    collapsed: Tensor
    contact_alpha: Tensor | None
    compression: Tensor | None
    report: ContactReport
    substeps: Tensor


@dataclass(frozen=True)
class StepInput(Generic[Settings]):
    """What contact steps need of N cells in B colonies, and do not change.

    position (N, d) float64 µm, axis (N, d), length (N,) µm before growth, growth (N,) µm, radius
    (N,) µm; viscosity, length_drag (N,); steps (B,) sub-steps, 0 for a colony that cannot be
    stepped; start (N, D) the last move; hardness (B,) float64 the α with which the colony's step
    begins, 0 at the start and for bilateral contacts; alpha (N,) where it is given, else None, and
    of bilateral contacts always; walls: for each surface its kind ("hard", "stiffness", "weight")
    and its weight, or its stiffness · Δt of the sub-step, (N,); shortest (N,) µm, of one-sided
    contacts: no cell becomes shorter by pressure. bonds: with stiffness · Δt of the sub-step, or
    None. drift: see `MechanicsInput`.
    """

    settings: Settings
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
    shortest: Tensor
    bonds: Bonds | None
    drift: Tensor | None

    @property
    def ids(self) -> Tensor:
        """The id of each colony, (B,); 0 for one without cells."""
        return self.groups.max(self.colony_ids)


@dataclass(frozen=True)
class StepResult:
    """Where cells are after the steps, the move to start from next, α of each colony for the next
    step (hardness), and what the solves did: see `contact_records.ContactReport`; `error` is its
    residual."""

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
    alpha: Tensor

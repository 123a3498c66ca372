"""What contact mechanics reports of a step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from torch import Tensor

from torchfilm.kernels.scheme import BURIED, LONG, MOST_SUBSTEPS
from torchfilm.physics.contact_records import ContactReport
from torchfilm.physics.problem import (
    BAD_DRAG,
    BAD_LENGTH,
    COLLAPSED,
    STATUS,
    TOO_FAST,
    TOO_LONG,
    TOO_STICKY,
)

if TYPE_CHECKING:
    from torchfilm.state import State

# What may help, by status; SOLVE for the others.
SOLVE = (
    "A smaller dt, a larger alpha or more max_iterations may help; and where cells stick together,"
    " a smaller strength, or lower levels of what multiplies it in both cells"
)
HINTS = {
    TOO_STICKY: (
        "Take a smaller strength, or lower levels of what multiplies it in both cells, or a smaller"
        " dt"
    ),
    TOO_LONG: "Place the faces of Mechanics.periodic farther apart, or let cells divide earlier",
    BAD_LENGTH: "Check what sets the lengths: a state that was changed, or an effect of your own",
    BAD_DRAG: "Check the effect or rule that sets the field drag",
    COLLAPSED: (
        "Take a smaller dt or length_drag; leave alpha out, or take a smaller one where contacts"
        " give way too much; or start from cells that do not overlap"
    ),
}


@dataclass(frozen=True)
class MechanicsReport(ContactReport):
    """As `ContactReport`, with the `substeps` taken in each colony, (B,), and the step, `dt` h.
    left: the cells as mechanics left them, on which the forces of the step acted: later in it some
    divide, burst or leave."""

    substeps: Tensor
    dt: float
    left: State = field(repr=False)

    @property
    def hint(self) -> str:
        """What may help against all that went wrong."""
        found = sorted(set(self.status[self.status != 0].tolist()))
        return ". ".join(dict.fromkeys(HINTS.get(status, SOLVE) for status in found))

    def reason(self, place: int) -> str:
        """What went wrong in the colony at `place`."""
        status = int(self.status[place])
        if status == TOO_FAST:
            return (
                f"a cell would take more than {MOST_SUBSTEPS} sub-steps to grow as it should in one"
                " step (rates are per hour, and dt is in hours)"
            )
        if status == BAD_DRAG:
            return (
                "a cell's drag is not above 0 and finite (viscosity, times the field drag if a"
                " scene has it, and length_drag)"
            )
        if status == COLLAPSED:
            return (
                f"{int(self.deeply_overlapping[place])} cells lie deeper in others than a radius;"
                f" for {LONG} steps it has been over {100 * BURIED:g} % of the cells"
            )
        if status == BAD_LENGTH:
            return "the length of a cell is below 0"
        if status == TOO_LONG:
            return (
                "a cell, with its caps and what its contacts and bonds reach, is longer than half"
                " of the way between the faces of its periodic space, so that it could meet two"
                " images of another cell"
            )
        if status == TOO_STICKY:
            return (
                "cells stick together more strongly than solves for the contacts allow: strength"
                " times levels, as Adhesion.strength says of it"
            )
        return (
            f"the mechanics solve {STATUS[status]} after {int(self.iterations[place])} iterations,"
            f" residual {float(self.residual[place]):.2g}"
        )

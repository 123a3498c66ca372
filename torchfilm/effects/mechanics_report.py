"""What contact mechanics reports of a step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from torch import Tensor

from torchfilm.effect import Concern
from torchfilm.physics.contact_records import ContactReport
from torchfilm.physics.problem import STATUS, TOO_FAST

MOST_SUBSTEPS = 1000
# A colony whose contacts do not hold has more than this share of its cells (of MANY, if it has
# fewer) deep in others for LONG steps. Cells that start in a heap part within a few steps.
BURIED, MANY, LONG = 0.1, 50, 20


@dataclass(frozen=True)
class MechanicsReport(ContactReport):
    """As `ContactReport`, with the `substeps` taken in each colony, (B,)."""

    substeps: Tensor
    counts: Tensor
    hint = "A smaller dt, a larger alpha or more max_iterations may help"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at `place`."""
        status = int(self.status[place])
        if status == TOO_FAST:
            return (
                f"a cell would take more than {MOST_SUBSTEPS} sub-steps to grow as it should in one"
                " step (rates are per hour, and dt is in hours)"
            )
        return (
            f"the mechanics solve {STATUS[status]} after {int(self.iterations[place])} iterations,"
            f" residual {float(self.residual[place]):.2g}"
        )

    def concerns(self) -> tuple[Concern, ...]:
        """Colonies whose contacts do not hold cells apart, although each solve converges: they have
        failed."""
        deep = self.deeply_overlapping > BURIED * self.counts.clamp(min=MANY)
        return (Concern("overlap", deep, LONG, partial(_collapsed, self), fails=True),)


def _collapsed(report: MechanicsReport, ids: Tensor, fallen: Tensor) -> str:
    each = zip(ids[fallen].tolist()[:5], report.deeply_overlapping[fallen].tolist(), strict=False)
    names = ", ".join(f"{colony} ({cells} cells)" for colony, cells in each)
    return (
        f"cells have been lying deeper in one another than a radius for {LONG} steps in colony"
        f" {names}. Take a smaller dt; leave alpha out, or take a smaller one where contacts give"
        " way too much; or start from cells that do not overlap."
    )

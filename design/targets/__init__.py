"""Targets: patterns of a colony. The loss of each is 0 where the colony has the pattern."""

from design.targets.base import Target
from design.targets.composition import Composition
from design.targets.conditions import Conditions
from design.targets.goals import Burden, Constrained, Duration, Goals, Spread, Weighted
from design.targets.gradient import Gradient
from design.targets.image import Image
from design.targets.lasting import Lasting
from design.targets.measured import Measured
from design.targets.observed import Observed
from design.targets.observed_course import ObservedCourse
from design.targets.observed_cycles import ObservedCycles
from design.targets.oscillation import Oscillation
from design.targets.patterns import DomainSize, OnFraction
from design.targets.profiles import Bands, ProfileTarget, Ring
from design.targets.stripe import Stripe

__all__ = [
    "Bands",
    "Burden",
    "Composition",
    "Conditions",
    "Constrained",
    "DomainSize",
    "Duration",
    "Goals",
    "Gradient",
    "Image",
    "Lasting",
    "Measured",
    "Observed",
    "ObservedCourse",
    "ObservedCycles",
    "OnFraction",
    "Oscillation",
    "ProfileTarget",
    "Ring",
    "Spread",
    "Stripe",
    "Target",
    "Weighted",
]

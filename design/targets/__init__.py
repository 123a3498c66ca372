"""Patterns that a colony may be wanted to make, each with a loss that is 0 where it does."""

from design.targets.base import Target
from design.targets.oscillation import Oscillation
from design.targets.patterns import DomainSize, OnFraction
from design.targets.profiles import Bands, Gradient, Image, ProfileTarget, Ring
from design.targets.stripe import Stripe

__all__ = [
    "Bands",
    "DomainSize",
    "Gradient",
    "Image",
    "OnFraction",
    "Oscillation",
    "ProfileTarget",
    "Ring",
    "Stripe",
    "Target",
]

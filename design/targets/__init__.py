"""Patterns that a colony may be wanted to make, each with a loss that is 0 where it does."""

from design.targets.base import Target
from design.targets.masks import Bands, Gradient, Image, Mask, Ring
from design.targets.oscillation import Oscillation
from design.targets.patterns import DomainSize, OnFraction
from design.targets.stripe import Stripe

__all__ = [
    "Bands",
    "DomainSize",
    "Gradient",
    "Image",
    "Mask",
    "OnFraction",
    "Oscillation",
    "Ring",
    "Stripe",
    "Target",
]

"""Capsules by the area and the second moments of a region, and back. Exact for a stadium."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from torch import Tensor

HALVINGS = 90  # of the bracket of length/radius; to the last digits of a float64


Numbers = TypeVar("Numbers", np.ndarray, Tensor)


def moments_of_capsule(length: Numbers, radius: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """The area of capsules in the plane, and their second central moments per area, along the axis
    and across it; (N,) each.

    length: (N,) of the centreline. radius: (N,). With t = length/radius the area is radius² (2t +
    π), and the moments are radius² (t³/6 + πt²/4 + 4t/3 + π/4) / (2t + π) along and radius² (2t/3 +
    π/4) / (2t + π) across.
    """
    t, square = length / radius, radius**2
    return (square * _area(t), square * _along(t) / _area(t), square * _across(t) / _area(t))


def capsule_of_area(area: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The length of the centreline and the radius of capsules, by their area and their second
    central moment per area along the axis; (N,) each, above 0. A curved cell keeps its width.
    """
    t = _root(lambda t: _along(t) / _area(t) ** 2, along / area)
    radius = np.sqrt(area / _area(t))
    return t * radius, radius


def capsule_of_moments(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same by the second central moments per area along the axis and across it; (N,) each, with
    along ≥ across > 0."""
    t = _root(lambda t: _along(t) / _across(t), along / across)
    radius = np.sqrt(across * _area(t) / _across(t))
    return t * radius, radius


# for radius 1: the area, and the integrals of the squared distances from the centre
def _area(t: Numbers) -> Numbers:
    return 2 * t + math.pi


def _along(t: Numbers) -> Numbers:
    return t**3 / 6 + math.pi * t**2 / 4 + 4 * t / 3 + math.pi / 4


def _across(t: Numbers) -> Numbers:
    return 2 * t / 3 + math.pi / 4


def _root(function: Callable[[np.ndarray], np.ndarray], value: np.ndarray) -> np.ndarray:
    """Where a function that increases from t = 0 on has a value; 0 where that is less than its
    value there. Both functions are at least t/24."""
    low, high = np.zeros_like(value), 25.0 * value + 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        above = function(middle) > value
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return low

"""The capsule that has the same second moments as a region, and back. Exact for a stadium."""

from __future__ import annotations

import math

import numpy as np

# Newton steps; each at least halves the distance from above, and near the root doubles the digits
STEPS = 80


def moments_of_capsule(length: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The second central moments per area, along the axis and across it, of capsules in the plane.

    length: (N,) of the centreline. radius: (N,). With t = length/radius, they are
    radius² (t³/6 + πt²/4 + 4t/3 + π/4) / (2t + π) and radius² (2t/3 + π/4) / (2t + π).
    """
    t, area = length / radius, 2.0 * length / radius + math.pi
    along = t**3 / 6 + math.pi * t**2 / 4 + 4 * t / 3 + math.pi / 4
    return radius**2 * along / area, radius**2 * (2 * t / 3 + math.pi / 4) / area


def capsule_of_moments(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The length of the centreline and the radius of capsules, by their second central moments per
    area: along the axis and across it, each (N,), with along ≥ across > 0.

    The ratio of the moments gives a cubic equation for t = length/radius, which has one root that
    is not negative. Newton's method approaches it from above without overshooting, since the cubic
    is convex there.
    """
    ratio = np.maximum(along / across, 1.0)
    t = 3.0 * (1.0 + np.sqrt(ratio))  # above the root
    for _ in range(STEPS):
        value = t**3 / 6 + math.pi * t**2 / 4 + (4 - 2 * ratio) * t / 3 + math.pi / 4 * (1 - ratio)
        slope = t**2 / 2 + math.pi * t / 2 + (4 - 2 * ratio) / 3
        t = np.maximum(t - value / slope, 0.0)
    radius = np.sqrt(across * (2 * t + math.pi) / (2 * t / 3 + math.pi / 4))
    return t * radius, radius

"""Functions of numbers, and of vectors of them, as torch defines them, also where there is no
number."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.vectors import near_inverse_cube_root, where


@kernel(inline=True)
def _finite(x):
    """x, or 0 where it is infinite or no number: the slope of a root at 0."""
    return where(abs(x) < np.inf, x, 0.0)


@kernel(inline=True)
def _least(a, b):
    """The smaller; no number where one of them is none."""
    return where((a < b) | (a != a), a, b)


@kernel(inline=True)
def _most(a, b):
    """The greater; no number where one of them is none."""
    return where((a > b) | (a != a), a, b)


@kernel(inline=True)
def _sign(x):
    return where(x > 0, 1.0, 0.0) - where(x < 0, 1.0, 0.0)


@kernel(inline=True)
def inverse_cube_root(x):
    """x^(−1/3) of a normal number above 0, with an error of a few units in the last place."""
    y = near_inverse_cube_root(x)
    for _ in range(4):  # Newton's method: each step squares the error, at first below 0.1
        y = y * (4.0 / 3.0 - (1.0 / 3.0) * x * (y * y * y))
    return y


@kernel(inline=True)
def natural_log(x):
    """Of a normal number above 0, with an error below one unit in the last place. Without branches
    and calls, so that a loop of it becomes vectors of the processor (fdlibm's e_log.c, S. Moshier
    and Sun)."""
    # x = 2ᵏ (1 + f), with √½ < 1 + f < √2
    bits = np.float64(x).view(np.uint64)
    upper = (bits >> np.uint64(32)) + np.uint64(0x3FF00000 - 0x3FE6A09E)
    k = np.float64(np.int64(upper >> np.uint64(20)) - 0x3FF)
    upper = (upper & np.uint64(0xFFFFF)) + np.uint64(0x3FE6A09E)
    f = np.uint64(upper << np.uint64(32) | bits & np.uint64(0xFFFFFFFF)).view(np.float64) - 1.0
    half, s = 0.5 * f * f, f / (2.0 + f)
    z = s * s
    w = z * z
    odd = w * (0.2857142874366239149 + w * (0.1818357216161805012 + w * 0.1479819860511658591))
    even = w * (0.3999999999940941908 + w * (0.2222219843214978396 + w * 0.1531383769920937332))
    series = z * (0.6666666666666735130 + odd) + even
    low, high = k * 1.90821492927058770002e-10, k * 6.93147180369123816490e-01
    return s * (half + series) + low - half + f + high

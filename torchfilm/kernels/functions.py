"""Functions of numbers as torch defines them, also where there is no number."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel


@kernel
def _finite(x):
    """x, or 0 where it is infinite or no number: the slope of a root at 0."""
    return x if abs(x) < np.inf else 0.0


@kernel
def _least(a, b):
    """The smaller; no number where one of them is none."""
    return a if a < b or a != a else b


@kernel
def _most(a, b):
    """The greater; no number where one of them is none."""
    return a if a > b or a != a else b


@kernel
def _sign(x):
    return (x > 0) * 1.0 - (x < 0) * 1.0


@kernel
def _remainder(a, b):
    """a − b ⌊a/b⌋, of the sign of b."""
    return np.remainder(a, b)


@kernel
def _sqrt(x):
    return math.sqrt(x) if x >= 0 else np.nan


@kernel
def _log(x):
    return math.log(x) if x > 0 else (-np.inf if x == 0 else np.nan)


@kernel
def _log2(x):
    return np.log2(x)


@kernel
def _log10(x):
    return np.log10(x)


@kernel
def _log1p(x):
    return math.log1p(x) if x > -1 else (-np.inf if x == -1 else np.nan)


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

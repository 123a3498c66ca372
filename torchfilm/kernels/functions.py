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

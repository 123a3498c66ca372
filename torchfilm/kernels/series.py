"""Coefficients of power series, the highest power first. What they leave out is below half a unit
in the last place of float64."""

from __future__ import annotations

import math

# log m = 2 s (1 + s²/3 + s⁴/5 + …), s = (m − 1)/(m + 1), in s², for m from √½ to √2
LOG = tuple(1.0 / (2 * k + 1) for k in range(11, -1, -1))
# sin x / x and cos x, in x², for x up to π/4
SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(8, -1, -1))
COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(8, -1, -1))
# √½, log 2 and 2π
SMALL, LOG_TWO, TURN = math.sqrt(0.5), math.log(2.0), 2 * math.pi

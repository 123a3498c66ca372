"""How far a cell may grow in one step."""

from __future__ import annotations

import math

from torchfilm.tools.checks import InputError


def check_doubling(name: str, rate: float, dt: float) -> None:
    """Raise InputError for a growth rate (1/h) by which a cell more than doubles in dt hours."""
    if rate * dt > math.log(2.0):
        longest = math.log(2.0) / rate
        raise InputError(
            f"dt = {dt:g} h is too long for {name} = {rate:g}/h: a cell would be due to"
            f" divide more than once in a step. Take dt below {longest:.2g} h;"
            f" {longest / 28:.1g} h is usual. (Rates are per hour.)"
        )

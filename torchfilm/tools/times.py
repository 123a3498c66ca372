"""Times that are what a person would write."""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache


def later(time: float, step: int, dt: float) -> float:
    """The time after one more step, `step` + 1 in all. Where times are fractions, so are their
    sums: the fifth step of 1/12 h ends at 5/12, and `cells.time >= 5 / 12` holds then."""
    parts = _fraction(dt)
    if abs(step * dt - time) < 1e-9 * max(1.0, time):
        # a quotient of integers is rounded once
        return (step + 1) * dt if parts is None else (step + 1) * parts[0] / parts[1]
    mine = _fraction(time)
    if parts is None or mine is None:
        return time + dt
    return (mine[0] * parts[1] + parts[0] * mine[1]) / (mine[1] * parts[1])


@lru_cache(256)
def _fraction(x: float) -> tuple[int, int] | None:
    """The fraction of small numbers that a number is the nearest one to, if it is of any."""
    top, bottom = Fraction(x).limit_denominator(1_000_000).as_integer_ratio()
    return (top, bottom) if top / bottom == x else None

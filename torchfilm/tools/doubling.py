"""How far a cell may grow in one step."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

NAMED = 10  # colonies that a message names
# Growth in a step, as a rate times dt, from which volumes are off by 5 % (a length at division) to
# 12 % (an added length) after eight divisions: a cell divides at the end of the step in which it is
# due, and is too long by then.
LONG = 0.2


def check_doubling(name: str, rate: Tensor, dt: float) -> None:
    """Raise InputError for growth rates, one or (B,) by colony id, 1/h, by which a cell more than
    doubles in dt hours; warn of those above a fifth per step."""
    fast = torch.nonzero(rate.reshape(-1) * dt > math.log(2.0)).squeeze(1)
    fastest = float(rate.max())
    if not fast.numel():
        if fastest * dt > LONG * (1 + 1e-9):
            warn(
                f"dt = {dt:g} h is long for {name} = {fastest:g}/h: a cell grows by"
                f" {math.expm1(fastest * dt):.0%} in a step, divides late, and numbers of cells or"
                f" volumes are off by 5 % or more. Take dt below {LONG / fastest:.2g} h;"
                f" {math.log(2.0) / fastest / 28:.1g} h is usual."
            )
        return
    longest = math.log(2.0) / fastest
    raise InputError(
        f"dt = {dt:g} h is too long for {name} = {fastest:g}/h{_where(rate, fast.tolist())}: a cell"
        f" would be due to divide more than once in a step. Take dt below {longest:.2g} h;"
        f" {longest / 28:.1g} h is usual. (Rates are per hour.)"
    )


def _where(rate: Tensor, fast: list[int]) -> str:
    """In which colonies, in words; nothing where all have one rate."""
    if rate.numel() == 1:
        return ""
    first = f" in colony {int(rate.argmax())}"
    if len(fast) == 1:
        return first
    more = ", …" if len(fast) > NAMED else ""
    listed = ", ".join(map(str, fast[:NAMED])) + more
    return f"{first} (too fast in {len(fast)} of {rate.numel()} colonies: {listed})"

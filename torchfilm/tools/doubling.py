"""How far a cell may grow in one step."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfilm.tools.checks import InputError

NAMED = 10  # colonies that a message names
# A step is long above this share of the time 1/rate: numbers of cells are then a tenth too small,
# even where cells divide at different moments.
LONG = 0.1


def check_doubling(name: str, rate: Tensor, dt: float) -> None:
    """Raise InputError for growth rates, one or (B,) by colony id, 1/h, by which a cell more than
    doubles in dt hours."""
    fast = torch.nonzero(rate.reshape(-1) * dt > math.log(2.0)).squeeze(1)
    if not fast.numel():
        return
    fastest = float(rate.max())
    longest = math.log(2.0) / fastest
    raise InputError(
        f"dt = {dt:g} h is too long for {name} = {fastest:g}/h{_where(rate, fast.tolist())}: a cell"
        f" would be due to divide more than once in a step. Take dt below {longest:.2g} h;"
        f" {longest / 28:.1g} h is usual. (Rates are per hour.)"
    )


def late_lines(rate: float, dt: float) -> list[str]:
    """How much too small a number of cells is that grow at a rate, 1/h, and divide in the step of
    dt hours after they are due, in lines."""
    if rate <= 0:
        return []
    # N cells grow to N·exp(rate·dt) in the step by which each division is late
    lines = [
        f"a number of cells is that of one step before: about {-100 * math.expm1(-rate * dt):.2g} %"
        f" too small at {rate:.3g}/h, and more where cells divide together"
    ]
    if rate * dt > LONG * (1.0 + 1e-6):  # a tenth may be rounded
        lines.append(
            f"LONG STEP: take dt of {LONG / rate:.2g} h or less"
            f" ({math.log(2.0) / rate / 28:.1g} h is usual), or let `torchfilm tune` find one"
        )
    return lines


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

"""Whole numbers of molecules."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Units in the last place by which a number of molecules may be off a whole one: it is a
# concentration times a volume, both rounded.
ROUNDED = 8


def nearest(amount: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The nearest whole numbers, and which amounts are none, not even but for the rounding of
    `dtype`."""
    near = torch.round(amount)
    eps = torch.finfo(dtype).eps
    return near, (amount - near).abs() > ROUNDED * eps * amount.abs().clamp(min=1.0)


def whole_concentration(value: Tensor, size: Tensor, uniform: Callable[[], Tensor]) -> Tensor:
    """A concentration that is a whole number of molecules, `size` of which are in its unit: the
    same where it is one but for rounding, else `whole`."""
    amount = value * size
    _, off = nearest(amount, value.dtype)
    return torch.where(off, whole(amount, uniform) / size, value)


def whole(
    amount: Tensor, uniform: Callable[[], Tensor], dtype: torch.dtype | None = None
) -> Tensor:
    """Whole numbers of molecules: the nearest where an amount is one but for the rounding of
    `dtype`, by default its own; else rounded up or down at random, so that the mean stays.
    uniform: draws, of the shape of the amounts."""
    near, off = nearest(amount, dtype or amount.dtype)
    if off.device.type == "cpu" and not bool(off.any()):
        return near
    return torch.where(off, torch.floor(amount + uniform().to(amount.dtype)), near)

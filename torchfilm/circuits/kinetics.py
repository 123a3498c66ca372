"""Rate laws that are valid for all concentrations.

Below zero they equal their value at zero, at large concentrations they do not overflow, and at zero
their derivatives are finite. x, half and power are tensors that broadcast, or numbers; half > 0,
power ≥ 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.circuits.tracing import named
from torchfilm.tools.deterministic_math import power as steady_power


@named
def activation(x: float | Tensor, half: float | Tensor, power: float | Tensor = 1.0) -> Tensor:
    """xⁿ/(Kⁿ + xⁿ), with K = half and n = power."""
    return _activation(x, half, power)


@named
def repression(x: float | Tensor, half: float | Tensor, power: float | Tensor = 1.0) -> Tensor:
    """Kⁿ/(Kⁿ + xⁿ) = 1 − activation, but accurate also where it is small."""
    big, p = _ratio(x, half, power)
    return torch.where(big, p, torch.ones_like(p)) / (1.0 + p)


@named
def michaelis_menten(x: float | Tensor, half: float | Tensor) -> Tensor:
    """x/(K + x), with K = half."""
    return _activation(x, half, 1.0)  # no law by name: what a law is made of has simple operations


def _activation(x: float | Tensor, half: float | Tensor, power: float | Tensor) -> Tensor:
    big, p = _ratio(x, half, power)
    return torch.where(big, torch.ones_like(p), p) / (1.0 + p)


def _ratio(x: float | Tensor, half: float | Tensor, power: float | Tensor) -> tuple[Tensor, Tensor]:
    """Whether x > K, and (x/K)ⁿ, or (K/x)ⁿ where x > K.

    The ratio is from 0 to 1; it neither overflows nor divides by 0.
    """
    r = x / half
    r = (r if isinstance(r, Tensor) else torch.as_tensor(r, dtype=torch.float64)).clamp(min=0.0)
    big = r.detach() > 1.0
    inner = torch.where(big, torch.where(big, r, 1.0).reciprocal(), r)
    return big, steady_power(inner, power)

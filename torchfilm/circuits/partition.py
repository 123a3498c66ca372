"""Partition of molecules between two daughters."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def binomial(count: Tensor, share: Tensor, uniform: Tensor) -> Tensor:
    """The molecules of `count` (M,) in the first daughter, each with probability `share` (M,).

    It is the least k with P(X ≤ k) ≥ uniform (M,).
    """
    from scipy.stats import (
        binom,
    )  # imported where it is used: it takes longer to load than torchfilm itself

    found = binom.ppf(
        uniform.double().cpu().numpy(), count.double().cpu().numpy(), share.double().cpu().numpy()
    )
    return torch.from_numpy(found).to(count).clamp(min=0.0)

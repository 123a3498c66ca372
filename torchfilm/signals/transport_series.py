"""Transport over a step of any operator, exact in time: exp(Δt T) as a series without subtractions.

With λ at least the greatest loss rate of a voxel, P = I + T/λ has no negative entry, and

    exp(Δt T) = Σ_k e^(−λΔt) (λΔt)^k/k! · P^k

is a mean of its powers: what a random number of exchanges makes of the field. (Jensen's method, or
uniformization, for Markov chains.) All axes exchange at once. So a steady state does not depend on
Δt, as it does where one axis is solved after the other. Nothing becomes negative, and the weights
add up to 1. The number of terms grows as λΔt; beyond MOST a colony takes a step of backward Euler,
all axes in one solve, which has the same steady states.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.mixing import Mixing, mixing_of, rate_above
from torchfilm.signals.series_sums import sums
from torchfilm.signals.transport_iterative import Unsplit, prepare_backward_euler
from torchfilm.signals.transport_operator import Operator

# λΔt up to which a colony takes the series: some 1,200 terms.
MOST = 1000.0
# More exchanges of a voxel in a step leave nothing but rounding of backward Euler's solve.
FARTHEST = 1e12
# Weights below this part of the precision of the values are left out.
CUT = 1 / 64


@dataclass(frozen=True, eq=False)
class Series:
    """u ↦ Σ_k weights_k P^k u + gained, in float64.

    exchanges: λΔt, (B or 1,). weights: (terms, B or 1). gained: None or (B or 1, nx, ny, nz).
    far: (B or 1,) bool, colonies with λΔt over MOST, which take a step of `solved` instead; None
    without such colonies.
    """

    mixing: Mixing
    exchanges: Tensor
    weights: Tensor
    gained: Tensor | None
    far: Tensor | None
    solved: Unsplit | None
    compiled: bool = False

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later."""
        (out,) = sums(self.mixing, None, [self.weights], u.double(), compiled=self.compiled)
        out = (out if self.gained is None else out + self.gained).to(u.dtype)
        if self.far is None or self.solved is None:
            return out
        return torch.where(self.far.reshape(-1, 1, 1, 1), self.solved.step(u), out)

    @cached_property
    def terms(self) -> np.ndarray:
        """Terms up to the last that is not 0 of each colony, (B or 1,) int64. Where λΔt is large,
        the first ones are 0, too."""
        number = torch.arange(1, self.weights.shape[0] + 1, device=self.weights.device)
        return torch.where(self.weights > 0, number.unsqueeze(1), 0).amax(0).cpu().numpy()


def prepare_series(operator: Operator, dt: float, *, compiled: bool = False) -> Series:
    """The series of a step of `dt` hours. compiled: whether kernels may compute gradients."""
    fastest = operator.loss.detach().flatten(1).amax(1)
    rate = rate_above(fastest)
    mean = (rate * dt).cpu().numpy()
    far = mean > MOST
    weights, tails = poisson(np.where(far, 0.0, mean), torch.finfo(operator.dtype).eps * CUT)
    mixing = mixing_of(operator, rate.reshape(-1, 1, 1, 1))
    on_device = lambda x: torch.as_tensor(x, device=operator.device)
    gained = None
    if operator.gain is not None:
        each = on_device(tails) / rate
        whole = operator.gain.expand(max(rate.numel(), operator.gain.shape[0]), *operator.shape)
        (gained,) = sums(mixing, None, [each], whole, compiled=compiled)
    any_far = bool(far.any())
    return Series(
        mixing,
        on_device(mean),
        on_device(weights),
        gained,
        on_device(far) if any_far else None,
        prepare_backward_euler(operator, dt, compiled=compiled) if any_far else None,
        compiled,
    )


def poisson(mean: np.ndarray, cut: float) -> tuple[np.ndarray, np.ndarray]:
    """The probabilities of 0, 1, … events of a Poisson distribution, and those of more events than
    that, (terms, B) each.

    Probabilities below `cut` beyond the mean are 0; the sums are exactly 1 and the mean, whatever
    the other colonies.
    """
    count = int(mean.max() + 10 * np.sqrt(mean.max()) + 30)
    number = np.arange(count)[:, None]
    logs = np.concatenate([np.zeros((1, 1)), np.cumsum(np.log(number[1:]), 0)])
    found = np.exp(number * np.log(np.where(mean > 0, mean, 1.0)) - mean - logs)
    found = np.where(mean > 0, found, number == 0)
    found[(found < cut) & (number > mean)] = 0.0
    found = found / np.cumsum(found, 0)[-1]
    # summed from the rarest: small numbers first
    above = np.cumsum(found[::-1], 0)[::-1]
    more = np.concatenate([above[1:], np.zeros((1, mean.size))])
    total = np.cumsum(more[::-1], 0)[-1]
    more = more * np.where(total > 0, mean / np.where(total > 0, total, 1.0), 1.0)
    more[0] = np.where(total > 0, more[0], mean)  # hardly anything happens
    used = int((found > 0).any(1).nonzero()[0].max()) + 1
    return found[:used], more[:used]

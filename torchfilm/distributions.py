"""Distributions of a physical value over cells: uniform, normal, lognormal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.deterministic_math import power
from torchfilm.values import COLONY, Distribution, Rule, largest, numbers, smallest

TAIL = 4.0  # standard deviations, beyond which draws are folded back


@dataclass(frozen=True, eq=False)
class Uniform(Distribution):
    """Uniform between low and high; each one number or one per colony. inherited: True, daughters
    have their parent's value."""

    low: checks.Value
    high: checks.Value

    parameters = ("low", "high")

    def __post_init__(self) -> None:
        self._check(low=Rule(scope=COLONY), high=Rule(scope=COLONY))
        if bool((numbers(self.low) > numbers(self.high)).any()):
            raise checks.input_error(
                "Uniform", (self.low, self.high), "low ≤ high", "Swap the two."
            )

    def draw(self, state: State, rows: Tensor, purpose: str, values: Any) -> Tensor:
        low, high = values.low.of_rows(state, rows), values.high.of_rows(state, rows)
        return low + (high - low) * state.uniform(rows, purpose)

    def least(self) -> float:
        return smallest(self.low)

    def greatest(self) -> float:
        return largest(self.high)


@dataclass(frozen=True, eq=False)
class Normal(Distribution):
    """Gaussian of mean and sd; each one number or one per colony. Its tails beyond 4 sd (one draw
    in 16,000) are folded back inside. inherited: True, daughters have their parent's value; or the
    correlation of parent and daughter, from 0 to 1."""

    mean: checks.Value
    sd: checks.Value

    parameters = ("mean", "sd")
    reach = "A Normal reaches from mean − 4 sd to mean + 4 sd: give a smaller sd, or a LogNormal."

    def __post_init__(self) -> None:
        self._check(mean=Rule(scope=COLONY), sd=Rule(scope=COLONY, least=0.0))

    def draw(self, state: State, rows: Tensor, purpose: str, values: Any) -> Tensor:
        z = _standard_normal(state, rows, purpose)
        return values.mean.of_rows(state, rows) + values.sd.of_rows(state, rows) * z

    def draw_after(
        self, parents: Tensor, state: State, rows: Tensor, purpose: str, values: Any
    ) -> Tensor:
        mean, sd = values.mean.of_rows(state, rows), values.sd.of_rows(state, rows)
        share = values.inherited.of_rows(state, rows)
        own = ((parents - mean) / torch.where(sd > 0, sd, 1.0)).clamp(-TAIL, TAIL)
        z = share * own + _rest(share) * _standard_normal(state, rows, purpose)
        return mean + sd * _folded(z)

    def least(self) -> float:
        return float((numbers(self.mean) - 4 * numbers(self.sd)).min())

    def greatest(self) -> float:
        return float((numbers(self.mean) + 4 * numbers(self.sd)).max())


@dataclass(frozen=True, eq=False)
class LogNormal(Distribution):
    """The exponential of a Gaussian: its median, and sigma, the standard deviation of its
    logarithm; each one number or one per colony. Tails beyond 4 sigma are folded back inside.
    inherited: as of `Normal`."""

    median: checks.Value
    sigma: checks.Value

    parameters = ("median", "sigma")

    def __post_init__(self) -> None:
        self._check(median=Rule(scope=COLONY, above=0.0), sigma=Rule(scope=COLONY, least=0.0))

    def draw(self, state: State, rows: Tensor, purpose: str, values: Any) -> Tensor:
        z = _standard_normal(state, rows, purpose)
        # (0 + 1 · z, as of a Normal of mean 0 and sd 1)
        return values.median.of_rows(state, rows) * torch.exp(values.sigma.of_rows(state, rows) * z)

    def draw_after(
        self, parents: Tensor, state: State, rows: Tensor, purpose: str, values: Any
    ) -> Tensor:
        median, sigma = values.median.of_rows(state, rows), values.sigma.of_rows(state, rows)
        share = values.inherited.of_rows(state, rows)
        most = torch.exp(TAIL * sigma)
        own = (parents / median).clamp(1.0 / most, most)
        drawn = torch.exp(_rest(share) * sigma * _standard_normal(state, rows, purpose))
        found = power(own, share) * drawn
        # the tails of the logarithm are folded back
        found = torch.where(found > most, most * most / found, found)
        return median * torch.where(found * most < 1, 1.0 / (most * most * found), found)

    def least(self) -> float:
        return float((numbers(self.median) * torch.exp(-4 * numbers(self.sigma))).min())

    def greatest(self) -> float:
        return float((numbers(self.median) * torch.exp(4 * numbers(self.sigma))).max())


def _standard_normal(state: State, rows: Tensor, purpose: str) -> Tensor:
    """Standard normal draws (M,), the tails beyond 4 folded back inside."""
    return _folded(state.normal(rows, purpose)[:, 0])


def _folded(z: Tensor) -> Tensor:
    """With the tails beyond 4 folded back inside."""
    return torch.where(z.abs() > TAIL, z.sign() * (2 * TAIL - z.abs()).clamp(min=0), z)


def _rest(share: Tensor) -> Tensor:
    """The standard deviation of what is drawn beside the share that is inherited, so that all cells
    together vary by 1."""
    return (1.0 - share * share).sqrt()

"""Oscillations in time with a target period, of all cells together or of their mean."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import (
    FAILED,
    Target,
    ratio,
    require,
    species_name,
    total,
    valid_levels,
    weights,
)
from design.targets.patterns import TARGET
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SAMPLES = 6  # the least number, for a fit of three numbers
STEADY = 1e-12  # variance, in mean squares of the level, that rounding can cause
SLACK = 1e-6  # periods: tolerance, because times are sums of steps
FINER = 10  # tried frequencies for each one that the window can resolve
TRIED = 5.0  # periods are tried from the target divided by this to the target times this
FOUND = "#757575"  # the colour of the mean that was found


@dataclass(frozen=True)
class Oscillation(Target):
    """An oscillation with one period, h, of the mean over the colony and, with synchrony, of all
    cells alike.

    After every step the target notes the mean and the mean square over the cells. It uses the
    samples of the last `cycles` periods (at least one is needed). F is the share of their variance
    that has the target period: the sum of squares that a least-squares fit of the mean by a
    constant, cos 2πt/period and sin 2πt/period explains, over that of all samples. With synchrony
    the variance is that over time and cells, else that of the mean over time. Loss: 1 − F. floor:
    the amplitude from which an oscillation counts; floor²/2 is added to the variance, so that F of
    an oscillation of that amplitude is 1/2. The loss is 1 for a colony that is steady to rounding,
    or that has fewer than six samples or less than one period of them.

    Cells out of phase have a variance of their own while their mean is steady: with synchrony, F of
    a population whose phases have spread is small.
    """

    differentiable = True
    failed = FAILED
    species: str
    period: float
    _: KW_ONLY
    synchrony: bool = True
    cycles: float = 3.0
    floor: float = 0.0

    def __post_init__(self) -> None:
        species_name("Oscillation.species", self.species)
        checks.number("Oscillation.period", self.period, above=0.0)
        checks.choice("Oscillation.synchrony", self.synchrony, (True, False))
        checks.number("Oscillation.cycles", self.cycles, least=1.0)
        checks.number("Oscillation.floor", self.floor, least=0.0)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    def check(self, state: tf.State) -> None:
        require(state, (self.species,))

    def note(self, state: tf.State) -> Tensor:
        """Time, mean and mean square, weighted by the cells' volume, (B, 3) float64; NaN for a
        colony that cannot be scored."""
        y, sound = valid_levels(state, (self.species,))
        w = weights(state).unsqueeze(1)
        sums = total(state, torch.cat([w, w * y, w * y * y], 1))
        means = ratio(sums[:, 1:], sums[:, :1], 0.0)
        kept = torch.cat([torch.full_like(means[:, :1], state.time), means], 1)
        return torch.where(sound.unsqueeze(1), kept, math.nan)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        _, sound = valid_levels(state, (self.species,))
        window = self._window(history)
        explained = _explained(
            window, torch.tensor([1.0 / self.period], dtype=torch.float64, device=state.device)
        )[:, 0]
        whole = window.mean_square + (window.spread if self.synchrony else 0.0)
        swings = window.long & (whole > STEADY * window.level)
        share = torch.where(
            swings, explained / torch.where(swings, whole + 0.5 * self.floor**2, 1.0), 0.0
        )
        return torch.where(sound, (1.0 - share).clamp(min=0.0), self.failed)

    def _window(self, history: Tensor | None) -> _Samples:
        if history is None or history.dim() != 3 or history.shape[2] != 3 or not len(history):
            shape = None if history is None else tuple(history.shape)
            raise checks.input_error(
                "history",
                shape,
                "(T, B, 3), the notes of every step",
                "Keep target.note(state) after every step and stack them.",
            )
        present = torch.isfinite(history).all(2)
        time, mean, square = torch.where(present.unsqueeze(2), history, 0.0).unbind(2)
        last = torch.where(present, time, -math.inf).amax(0)
        used = present & (time >= last - (self.cycles + SLACK) * self.period)
        # drop samples that no colony uses: they are zeros
        kept = used.any(1) | (torch.arange(len(used), device=used.device) == 0)
        used, time, mean, square = (v[kept] for v in (used, time, mean, square))
        length = last - torch.where(used, time, math.inf).amin(0)
        count = used.sum(0)
        long = (count >= SAMPLES) & (length >= (1.0 - SLACK) * self.period)
        n = count.clamp(min=1)
        used = used.double()
        average = _sum(used * mean) / n
        swing = used * (mean - average)
        spread = _sum(used * (square - mean * mean).clamp(min=0.0)) / n
        return _Samples(
            time - torch.where(count > 0, last, 0.0),
            used,
            swing,
            n,
            length,
            long,
            _sum(swing * swing) / n,
            spread,
            _sum(used * square) / n,
        )

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Of the same samples, (B,) each. period_h: where the power of the mean has its peak,
        among periods from a fifth of the target to five times it and at most twice as long as the
        window; NaN for a drift. amplitude: √2 standard deviations of the mean. synchrony: the
        variance of the mean over that of all cells at all times."""
        window = self._window(history)
        count = math.ceil(FINER * self.cycles * (TRIED - 1.0 / TRIED))
        tried = (
            torch.linspace(1.0 / TRIED, TRIED, count + 1, dtype=torch.float64, device=state.device)
            / self.period
        )
        power = torch.cat([_explained(window, some) for some in tried.split(16)], 1)
        # at most half the sampling frequency, at least half an oscillation in the window: a drift
        # has its greatest power at that end, and no peak
        fastest = 0.5 * (window.n - 1).clamp(min=1) / window.length
        possible = (tried * window.length.unsqueeze(1) >= 0.5) & (tried < fastest.unsqueeze(1))
        power = torch.where(possible, power, -1.0)
        top = power.argmax(1).clamp(1, count - 1)
        before, here, after = (
            power.gather(1, (top + k).unsqueeze(1)).squeeze(1) for k in (-1, 0, 1)
        )
        bend = before - 2 * here + after
        peak = (before >= 0) & (after >= 0) & (here >= before) & (here >= after) & (bend < 0)
        # the top of the parabola through the three points
        shift = 0.5 * (before - after) / torch.where(peak, bend, 1.0)
        frequency = tried[0] + (top + shift) * (tried[1] - tried[0])
        whole = window.mean_square + window.spread
        swings = window.long & (whole > STEADY * window.level)
        return {
            "period_h": torch.where(
                swings & (window.mean_square > STEADY * window.level) & peak,
                1.0 / frequency,
                math.nan,
            ),
            "amplitude": torch.where(window.long, (2 * window.mean_square).sqrt(), math.nan),
            "synchrony": torch.where(swings, ratio(window.mean_square, whole, math.nan), math.nan),
        }

    def why_undefined(self, measure: str) -> str:
        short = (
            f"the run has fewer than {SAMPLES} steps or is shorter than one period of"
            f" {self.period:g} h (run for longer, or by shorter steps)"
        )
        steady = "all cells have one level that does not change"
        why = {
            "period_h": f"the mean is steady or drifts without a peak in its power, or {short}",
            "amplitude": short,
            "synchrony": f"{steady}, or {short}",
        }
        return why.get(measure, "")

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw the mean over time in a corner, and a wave of the target period with the same
        amplitude, in phase at the maximum; nothing without history."""
        if history is None:
            return
        kept = history[:, place, :2].detach().double().cpu().numpy()
        time, mean = kept[np.isfinite(kept).all(1)].T
        inset = ax.inset_axes((0.02, 0.02, 0.4, 0.2))
        inset.set(xticks=[], yticks=[])
        if not len(time):
            return
        wave = np.cos(2 * math.pi * (time - time[mean.argmax()]) / self.period)
        inset.plot(
            time,
            0.5 * (mean.max() + mean.min()) + 0.5 * np.ptp(mean) * wave,
            color=TARGET,
            linewidth=0.8,
            linestyle="--",
        )
        inset.plot(time, mean, color=FOUND, linewidth=1.0)

    def describe(self) -> str:
        return f"{self.species} swings with a period of {self.period:g} h" + (
            ", all cells together" if self.synchrony else ""
        )


@dataclass(frozen=True)
class _Samples:
    """The samples in use.

    (T, B) each: time from the last sample; used, 1 or 0; swing, the mean less its average. (B,)
    each: n samples over `length` h; long, whether that is enough; mean_square, of the swing;
    spread, the mean square of the cells about their mean; level, the mean square of their levels.
    """

    time: Tensor
    used: Tensor
    swing: Tensor
    n: Tensor
    length: Tensor
    long: Tensor
    mean_square: Tensor
    spread: Tensor
    level: Tensor


def _explained(window: _Samples, frequency: Tensor) -> Tensor:
    """The mean square of the swing that a wave of each frequency (F,) 1/h explains, by least
    squares with a constant, (B, F)."""
    used, n = window.used.unsqueeze(2), window.n.unsqueeze(1)
    phase = 2 * math.pi * window.time.unsqueeze(2) * frequency
    cos, sin = used * torch.cos(phase), used * torch.sin(phase)
    cos, sin = (wave - used * (_sum(wave) / n) for wave in (cos, sin))
    y = window.swing.unsqueeze(2)
    cc, ss, cs, cy, sy = (_sum(v) / n for v in (cos * cos, sin * sin, cos * sin, cos * y, sin * y))
    # samples at the nodes of a wave do not determine its amplitude
    det = cc * ss - cs * cs
    determined = det > 1e-6
    return torch.where(
        determined,
        (ss * cy * cy - 2 * cs * cy * sy + cc * sy * sy) / torch.where(determined, det, 1.0),
        0.0,
    )


def _sum(value: Tensor) -> Tensor:
    """The sum over time, (T, …) -> (…), sample by sample, so that it does not depend on the number
    of colonies in the batch. (The order of a cumsum on CUDA may.)"""
    return sum(value.unbind(0), torch.zeros_like(value[0]))

"""What `tune` measures: observables in a window of growth, which it runs repeatedly from one state.

The error of each observable:

- cells: relative difference of the number of cells.
- volume: difference of the volume added in the second half of the window, relative to that volume.
  If growth without pressure or loss of cells would add more, the difference is relative to that. In
  the first half the cells settle, because other settings grew the start. A cell's volume is here
  that of the cylinder around it, π r² times the length from end to end: no division changes it.
- radius: relative difference.
- overlap: mean overlap of touching cells over their diameter, of which the right value is 0. For
  soft cells, the difference of this mean.
- a species: relative difference of its mean and of its standard deviation over cells.
- signal NAME: relative difference of its amount, or of the mean concentration at its own molecules,
  whichever is larger.

Colonies are chaotic, so two runs of the same scene differ at random. The jackknife over colonies
(each is left out in turn) estimates this random part of an error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from scipy.special import stdtrit
from torch import Tensor

from torchfilm import measure
from torchfilm.effect import GROWTH
from torchfilm.loop import Standstill, advance
from torchfilm.model import Model
from torchfilm.scene import Scene
from torchfilm.simulation import simulate
from torchfilm.state import State
from torchfilm.tools.ragged import Groups
from torchfilm.tools.timing import Timings
from torchfilm.tuning.settings import Settings

# Length of the window, in steps of the scene. With half as many, the settling of the start causes
# most of the error in volume, even in the second half (measured).
WINDOW = 24
# If a scene never reaches the given number of cells, its growth ends when a colony has grown by
# less than a hundredth in STILL steps, or after MOST_STEPS.
STILL, MOST_STEPS = 10 * WINDOW, 2000
SIGNAL = "signal "
SURE = 0.95  # level of upper bounds: 19 of 20 errors are below

Seen = dict[str, list[Tensor]]
"""By observable, its sums over each colony, (B, m) float64, in the middle of the window and at its
end; NaN if a colony failed."""


@dataclass(frozen=True)
class Error:
    """A relative error, and its standard error over `colonies` colonies (jackknife: Efron and Stein
    1981)."""

    value: float
    noise: float
    colonies: int = field(default=2, compare=False)

    @property
    def ci95(self) -> float:
        """Distance from the value to the upper bound (one-sided 95 %, Student's t)."""
        return float(stdtrit(self.colonies - 1, SURE)) * self.noise if self.noise else 0.0

    @property
    def upper_bound(self) -> float:
        """The upper end of the one-sided 95 % confidence interval."""
        return self.value + self.ci95

    def __str__(self) -> str:
        return (
            "failed"
            if math.isinf(self.value)
            else f"{100 * self.value:.2g} ± {100 * self.noise:.1g} %"
        )


def percent(error: float) -> str:
    """A relative error as text, without its uncertainty."""
    return "failed" if math.isinf(error) else f"{100 * error:.2g} %"


@dataclass(frozen=True)
class WindowRun:
    """One run of the window.

    found: the observables in the middle and at the end. seconds: computing time (on the CPU: of the
    thread that ran it). spent: seconds by effect. several: whether a step was split into substeps.
    """

    found: Seen
    seconds: float
    spent: dict[str, float]
    several: bool


@dataclass(frozen=True)
class AccuracyProbe:
    """The state from which all windows start, and how their observables are compared."""

    given: Scene
    scene: Scene  # without noise: molecules by their mean
    model: Model  # of that scene, with its own settings
    start: State
    dt: float
    of: tuple[str, ...] | None

    @property
    def needed(self) -> tuple[str, ...]:
        """The observables that must be resolved: those that the user named, or the volume, which
        every knob affects."""
        return self.of or ("volume",)

    def steps(self, settings: Settings) -> int:
        """The number of steps in the window."""
        return round(WINDOW * self.dt / (settings.dt or self.dt))

    def observed(self, settings: Settings) -> WindowRun:
        """Runs the window with these settings."""
        steps = self.steps(settings)
        made = settings.apply(self.scene).bind(state=self.start, per_colony=True)
        dt, seen, timings = self.dt * WINDOW / steps, [], Timings()
        broken = several = False
        # on the CPU, the time of this thread only: other work on the machine does not count
        clock = time.thread_time if self.start.device.type == "cpu" else time.perf_counter
        begun = clock()
        last = self.start.step + steps
        stop = lambda s: s.step >= last
        for state in advance(partial(made.step, dt=dt, timings=timings), self.start, stop=stop):
            broken = broken or any(bool((r.status != 0).any()) for r in state.reports.values())
            several = several or any(
                bool((r.substeps > 1).any())
                for r in state.reports.values()
                if hasattr(r, "substeps")
            )
            if 2 * (state.step - self.start.step) % steps == 0:
                seen.append(state)
        seconds = clock() - begun
        found: Seen = {}
        for state in seen:
            parts = sums(state)
            for name, value in (
                parts
                | {
                    "cells": state.counts.double().cpu().unsqueeze(1),
                    "volume": torch.cat([parts["volume"], self._wanted(state)], 1),
                }
            ).items():
                if self.of is None or name in self.of:
                    found.setdefault(name, []).append(value * math.nan if broken else value)
        return WindowRun(found, seconds, timings.seconds, several)

    def _wanted(self, state: State) -> Tensor:
        """Growth of the volume per hour without pressure, (B, 1) µm³/h."""
        grown = state
        for effect in self.model.effects:
            if effect.stage == GROWTH:
                grown = effect.step(grown, self.dt)
        return _over(state, math.pi * state.radius**2 * (grown.length - state.length) / self.dt)

    def errors(self, found: Seen, against: Seen, apart: bool = False) -> dict[str, Error]:
        """For each observable of `against`, the greater of the errors in the middle and at the end;
        infinite where `found` lacks it.

        apart: neither run is the reference. The overlap is then also a difference of the two runs,
        not an error by itself.
        """
        out = {}
        for name, rights in against.items():
            values = found.get(name, [])
            if len(values) != len(rights):
                out[name] = Error(math.inf, 0.0)
                continue
            each = self._error(name, _left_out(name, values), _left_out(name, rights), apart)
            error, without = float(each[0]), each[1:]
            noise = math.sqrt((len(without) - 1) * float(without.var(correction=0)))
            # if only one colony has cells, the standard error is unknown, so infinite
            out[name] = (
                Error(math.inf, 0.0)
                if math.isnan(error)
                else Error(error, math.inf if math.isnan(noise) else noise, len(without))
            )
        return out

    def _error(self, name: str, value: Tensor, right: Tensor, apart: bool) -> Tensor:
        """The greater of an observable's errors in the middle and at the end, (J,), from values
        (J, 2, k)."""
        if name == "volume":
            # columns: the volume, and its growth per hour without pressure
            added, growth = right[:, -1, 0] - right[:, 0, 0], right[:, :, 1].mean(1)
            return (value[:, -1, 0] - value[:, 0, 0] - added).abs() / torch.maximum(
                added.abs(), growth * self.dt * WINDOW / 2
            ).clamp(min=1e-30)
        if name == "overlap" and not apart and not any(e.soft_contacts for e in self.scene.effects):
            each = value
        elif name == "overlap":
            each = (value - right).abs()
        elif name.startswith(SIGNAL):
            each = ((value - right) / right).abs()
        else:
            each = ((value - right).norm(dim=2) / right.norm(dim=2).clamp(min=1e-30)).unsqueeze(2)
        return each.flatten(1).amax(1)


@torch.no_grad()
def begin(
    scene: Scene,
    cells: int,
    colonies: int,
    of: Sequence[str] | None = None,
    seed: int = 0,
    device: str | torch.device = "cpu",
) -> AccuracyProbe:
    """Grows a noise-free copy of the scene to `cells` cells per colony, where the windows start."""
    made = scene.replace(*(e.without_noise() for e in scene.effects))
    fixed = scene.fixed_colonies
    model = made.bind(fixed if fixed > 1 else colonies, seed=seed, device=device, per_colony=True)
    founded = state = model.start()
    standstill = Standstill(cells, STILL)
    for state in simulate(model, founded, cells=cells, until=MOST_STEPS * scene.dt):
        # stop if any colony stays small: the others would grow without end
        if bool(standstill(state).any()):
            break
    return AccuracyProbe(scene, made, model, state, scene.dt, None if of is None else tuple(of))


def observables(state: State) -> dict[str, Tensor]:
    """The observables of a batch by name, (k,) float64 each. Species and signals that are 0
    everywhere are omitted."""
    return {name: _made(name, parts.sum(0)) for name, parts in sums(state).items()}


def sums(state: State) -> dict[str, Tensor]:
    """By observable, its sums over each colony, (B, m) float64."""
    over = partial(_over, state)
    one, radius = torch.ones_like(state.length), state.radius.double()
    out = {
        "cells": over(one),
        "volume": over(math.pi * radius**2 * (state.length.double() + 2.0 * radius)),
    }
    # without mechanics, cells may overlap freely
    if "displacement" in state.fields:
        found = measure.overlaps(state)
        out["overlap"] = torch.cat(
            [
                torch.stack([found.mean.double() * found.count, found.count.double()], 1).cpu(),
                over(2.0 * radius, one),
            ],
            1,
        )
    if int(state.counts.min()) >= 2:
        of_each = measure.colony_radius(state).double().cpu()
        out["radius"] = torch.stack([of_each, torch.ones_like(of_each)], 1)
    for name in species(state):
        value = state.fields[name].double()
        if bool((value != 0).any()):
            out[name] = over(value, value * value, one)
    for name, grid in state.signals.items():
        value = grid.double()
        if bool((value != 0).any()):
            assert state.layout is not None
            voxels = Groups(state.layout.grid.owner, state.colonies)
            out[SIGNAL + name] = torch.stack(
                [voxels.sum(value), voxels.sum(value * value)], 1
            ).cpu()
    return out


def _over(state: State, *values: Tensor) -> Tensor:
    """Sums of k values per cell, (N,) each, over each colony: (B, k) float64."""
    return torch.stack([state.groups.sum(v.double()) for v in values], 1).cpu()


def _made(name: str, total: Tensor) -> Tensor:
    """An observable (…, k) from its sums (…, m)."""
    if name in ("cells", "volume"):
        return total
    if name == "overlap":
        depth, pairs, diameters, cells = total.unbind(-1)
        return (depth / pairs.clamp(min=1) * cells / diameters).unsqueeze(-1)
    if name == "radius":
        return total[..., :1] / total[..., 1:]
    if name.startswith(SIGNAL):
        # the amount, and the mean concentration at the molecules of the signal
        amount, square = total.unbind(-1)
        return torch.stack([amount, square / amount], -1)
    first, second, cells = total.unbind(-1)
    mean = first / cells
    return torch.stack([mean, (second / cells - mean * mean).clamp(min=0).sqrt()], -1)


def _left_out(name: str, parts: Sequence[Tensor]) -> Tensor:
    """An observable of all colonies, then without each colony in turn, in the middle and at the
    end: (1 + B, 2, k)."""
    each = torch.stack(list(parts), 1)  # (B, 2, m)
    total = each.sum(0, keepdim=True)
    return _made(name, torch.cat([total, total - each]))


def species(state: State) -> list[str]:
    """Names of the fields that are concentrations in cells."""
    return [name for name, f in state.declared.items() if f.is_species]

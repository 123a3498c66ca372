"""What `tune` looks at: a window of some colonies' growth, run again and again from one state, and
what one would read off it.

- cells: relative difference of their number; a cell that is due to divide at the next step counts
  as two.
- volume: relative difference of what the window's second half added, or, where that is more, of
  what growth would add without pressure or loss of cells. In the first half cells settle, since the
  start was grown by other settings. It is the volume of the cylinders round the cells, π r² times
  the length from end to end, which no division changes.
- radius: relative difference.
- overlap: mean overlap of touching cells over their diameter (0 is right); of soft cells its
  difference.
- a species: relative difference of its mean and of its standard deviation over cells.
- signal NAME: relative difference of its amount, and of the mean concentration that its own
  molecules find; the larger.

Colonies are chaotic: two runs of one law differ by chance. How much of an error that may be is told
by the colonies themselves, each left out in turn.
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
from torchfilm.effect import DIVISION, GROWTH
from torchfilm.loop import Standstill, advance
from torchfilm.model import Model
from torchfilm.scene import Scene
from torchfilm.simulation import simulate
from torchfilm.state import State
from torchfilm.tools.ragged import Groups
from torchfilm.tools.timing import Timings
from torchfilm.tuning.settings import Settings

# The window, in steps of the scene. Of half as many, most of the second half's error in volume is
# still the start's settling (measured).
WINDOW = 24
# A scene that never has as many cells as asked for is taken as it is where so many steps have not
# made a colony larger by a hundredth, or after MOST_STEPS.
STILL, MOST_STEPS = 10 * WINDOW, 2000
SIGNAL = "signal "
SURE = 0.95  # of 20 errors 19 are at most what is told

Seen = dict[str, list[Tensor]]
"""By observable, what it is made of in the middle and at the end, summed over each colony: (B, m)
float64; NaN if a colony failed."""


@dataclass(frozen=True)
class Error:
    """A relative error, and how much of it may be chance: its standard error among `colonies`
    (jackknife: Efron and Stein 1981)."""

    value: float
    noise: float
    colonies: int = field(default=2, compare=False)

    @property
    def ci95(self) -> float:
        """How much more it may be, to 95 % (Student's t)."""
        return float(stdtrit(self.colonies - 1, SURE)) * self.noise if self.noise else 0.0

    @property
    def upper_bound(self) -> float:
        """What it is at most, to 95 %."""
        return self.value + self.ci95

    def __str__(self) -> str:
        return (
            "failed"
            if math.isinf(self.value)
            else f"{100 * self.value:.2g} ± {100 * self.noise:.1g} %"
        )


@dataclass(frozen=True)
class WindowRun:
    """What was found in a window's middle and at its end, the seconds it took, in all (on the CPU
    of the thread that ran it) and by effect, and whether a step was taken in `several`."""

    found: Seen
    seconds: float
    spent: dict[str, float]
    several: bool


@dataclass(frozen=True)
class AccuracyProbe:
    """Where all windows begin, and what they are compared with."""

    given: Scene
    scene: Scene  # as it is probed: molecules by their mean
    model: Model  # of that, as its own settings have it
    start: State
    dt: float
    of: tuple[str, ...] | None

    @property
    def needed(self) -> tuple[str, ...]:
        """What must be told: what was named, or the volume, in which every knob tells."""
        return self.of or ("volume",)

    def steps(self, settings: Settings) -> int:
        """Into how many steps the window is divided."""
        return round(WINDOW * self.dt / (settings.dt or self.dt))

    def observed(self, settings: Settings) -> WindowRun:
        """What is read off the window by these settings."""
        steps = self.steps(settings)
        made = settings.apply(self.scene).bind(state=self.start, per_colony=True)
        dt, state, seen, timings, broken, several = (
            self.dt * WINDOW / steps,
            self.start,
            [],
            Timings(),
            False,
            False,
        )
        # what other work on the machine takes does not count, where the work is this thread's own
        clock = time.thread_time if state.device.type == "cpu" else time.perf_counter
        begun = clock()
        last = self.start.step + steps
        stop = lambda s: s.step >= last
        for after in advance(partial(made.step, dt=dt, timings=timings), state, stop=stop):
            state = after
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
                    "cells": self._due(state),
                    "volume": torch.cat([parts["volume"], self._wanted(state)], 1),
                }
            ).items():
                if self.of is None or name in self.of:
                    found.setdefault(name, []).append(value * math.nan if broken else value)
        return WindowRun(found, seconds, timings.seconds, several)

    def _due(self, state: State) -> Tensor:
        """The number of cells after the divisions with which the next step would begin, (B, 1):
        until then it is late, by a step that is known."""
        for effect in self.model.effects:
            if effect.stage <= DIVISION:
                state = effect.step(state, self.dt)
        return state.counts.double().cpu().unsqueeze(1)

    def _wanted(self, state: State) -> Tensor:
        """By how much the volume would grow in an hour if nothing held it back, (B, 1) µm³."""
        grown = state
        for effect in self.model.effects:
            if effect.stage == GROWTH:
                grown = effect.step(grown, self.dt)
        return _over(state, math.pi * state.radius**2 * (grown.length - state.length) / self.dt)

    def errors(self, found: Seen, against: Seen, apart: bool = False) -> dict[str, Error]:
        """By observable of `against`, the greater of the errors in the middle and at the end;
        infinite where it is not found.

        apart: of two runs of which neither is right, so that overlaps, too, are compared and not
        told.
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
            # of colonies of which all but one have lost their cells nothing can be told
            out[name] = (
                Error(math.inf, 0.0)
                if math.isnan(error)
                else Error(error, math.inf if math.isnan(noise) else noise, len(without))
            )
        return out

    def _error(self, name: str, value: Tensor, right: Tensor, apart: bool) -> Tensor:
        """Of an observable (J, 2, k) the greater of the errors in the middle and at the end,
        (J,)."""
        if name == "volume":
            # the volume, and by how much it would grow in an hour
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
    """The scene as it is probed, grown to where the windows begin."""
    made = scene.replace(*(e.without_noise() for e in scene.effects))
    fixed = scene.fixed_colonies
    model = made.bind(fixed if fixed > 1 else colonies, seed=seed, device=device, per_colony=True)
    founded = state = model.start()
    standstill = Standstill(cells, STILL)
    for state in simulate(model, founded, cells=cells, until=MOST_STEPS * scene.dt):
        # one colony that stays small is enough: the others would grow without end
        if bool(standstill(state).any()):
            break
    return AccuracyProbe(scene, made, model, state, scene.dt, None if of is None else tuple(of))


def observables(state: State) -> dict[str, Tensor]:
    """What is read off a state of a batch: numbers by name, (k,) float64 each. Species and signals
    that are 0 everywhere are left out."""
    return {name: _made(name, parts.sum(0)) for name, parts in sums(state).items()}


def sums(state: State) -> dict[str, Tensor]:
    """By observable, what it is made of, summed over each colony: (B, m) float64."""
    over = partial(_over, state)
    one, radius = torch.ones_like(state.length), state.radius.double()
    out = {
        "cells": over(one),
        "volume": over(math.pi * radius**2 * (state.length.double() + 2.0 * radius)),
    }
    # cells that do not push each other have no overlap to speak of
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
    """Sums over each colony of k values of its cells (N,), (B, k) float64."""
    return torch.stack([state.groups.sum(v.double()) for v in values], 1).cpu()


def _made(name: str, total: Tensor) -> Tensor:
    """An observable (…, k) of its sums (…, m)."""
    if name in ("cells", "volume"):
        return total
    if name == "overlap":
        depth, pairs, diameters, cells = total.unbind(-1)
        return (depth / pairs.clamp(min=1) * cells / diameters).unsqueeze(-1)
    if name == "radius":
        return total[..., :1] / total[..., 1:]
    if name.startswith(SIGNAL):
        # the amount, and the mean concentration that a molecule of it finds itself in
        amount, square = total.unbind(-1)
        return torch.stack([amount, square / amount], -1)
    first, second, cells = total.unbind(-1)
    mean = first / cells
    return torch.stack([mean, (second / cells - mean * mean).clamp(min=0).sqrt()], -1)


def _left_out(name: str, parts: Sequence[Tensor]) -> Tensor:
    """An observable of all colonies, and with each of them left out, in the middle and at the end:
    (1 + B, 2, k)."""
    each = torch.stack(list(parts), 1)  # (B, 2, m)
    total = each.sum(0, keepdim=True)
    return _made(name, torch.cat([total, total - each]))


def species(state: State) -> list[str]:
    """Names of fields that are concentrations in cells."""
    return [name for name, f in state.declared.items() if f.scope == "cell" and f.unit == "conc"]

"""The cheapest settings that hold an error: `tune(scene, error=0.01)`.

A few colonies of the scene are grown by its own settings; from that same state a window of some steps is run again and again: once by far tighter settings,
the reference, and then by settings that are tried from coarse to fine. What a user would read off at the end is compared. Each observable's error must be
within what was asked; of the settings that are, the one that took the least time is chosen, confirmed in other colonies that are larger by half, and
measured once more with each of its knobs tightened, which tells the knobs' parts in the error.

| observable | error                                                                                                                   |
|------------|-------------------------------------------------------------------------------------------------------------------------|
| cells      | difference of their number, relative; those that are due to divide at the next step count as two                          |
| volume     | difference of what the window's second half added, relative (or to a tenth of the whole, if that is more): what a longer  |
|            | run comes to. In the first half cells settle: how deep they overlap goes by the settings, and the start is by others      |
| radius     | difference, relative                                                                                                    |
| overlap    | mean overlap of touching cells over their diameter, 0 being right; of soft cells its difference                         |
| a species  | difference of its mean and standard deviation over cells, relative                                                      |
| signal …   | difference of its amount, and of its mean seen by its own molecules, relative; the greater                              |
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm import measure
from torchfilm.accuracy import Settings
from torchfilm.effect import DIVISION
from torchfilm.effects.circuit import STIFF, Circuit
from torchfilm.effects.mechanics import Mechanics
from torchfilm.scene import Scene
from torchfilm.simulate import simulate
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.timing import Timings

# The window, in steps of the scene, and into how many steps it is divided instead: all even, so that its middle is a step too.
WINDOW = 16
STEPS = (4, 6, 8, 10, 12, 16, 20, 26, 32, 40, 50, 64, 80, 100)
FINEST = 160  # the reference
# Knobs from loose to tight: (penalty, passes beyond the least, tolerance) of contacts, and rtol of circuits.
# A larger penalty saves no time, and its overlap grows with the colony beyond what a probe of a small one shows. In the order of what they cost.
CONTACTS = (
    (0.1, 0, 0.2), (0.1, 0, 0.1), (0.03, 0, 0.2), (0.1, 0, 0.05), (0.03, 0, 0.1), (0.1, 0, 0.02), (0.03, 0, 0.05), (0.03, 0, 0.02),
    (0.01, 0, 0.05), (0.1, 0, 0.01), (0.03, 0, 0.01), (0.01, 0, 0.02), (0.01, 0, 0.01), (0.03, 1, 0.005),
)  # fmt: skip
CIRCUITS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
TIGHT_CONTACTS, TIGHT_CIRCUITS = (0.03, 3, 1e-3), 1e-8
# A scene that never has as many cells as asked for is taken as it is after this many steps.
MOST_STEPS = 2000
SIGNAL = "signal "
# Other seeds, and colonies somewhat larger, have somewhat other errors than the probe's. So of the error that is asked for AIM is aimed at, and what is chosen
# must hold CONFIRM of it in a second probe of other colonies, LARGER times as large; where it does not, a part STRICTER as large is aimed at.
AIM, CONFIRM, LARGER, STRICTER = 0.75, 0.8, 1.5, 0.8
# A long step lets a colony grow too much and a loose solve too little. So a step is not given up where it alone is over what is aimed at, but where it is OFF
# times over. Circuits may take a SMALL part of it.
OFF, SMALL = 1.4, 0.3


@dataclass(frozen=True)
class Try:
    """One setting that was run: its errors by observable, and what its window took, s, in all (on the CPU of the thread that ran it) and by effect."""

    settings: Settings
    errors: dict[str, float]
    seconds: float
    spent: dict[str, float]

    @property
    def worst(self) -> float:
        """The greatest error."""
        return max(self.errors.values())


@dataclass(frozen=True)
class Tuned:
    """Settings that hold an error, and how that is known.

    scene: with the settings. error: what was asked. chosen: the try that was taken; own: the scene's own settings, for comparison. parts: by knob, how much of
    each observable's error comes from it. unsure: by observable, how far two references differ; left_out: observables that cannot be told so finely, with
    why. tries: all that were run, in order. window: hours, cells: at its start.
    """

    scene: Scene
    settings: Settings
    error: float
    chosen: Try
    own: Try
    confirmed: dict[str, float]
    parts: dict[str, dict[str, float]]
    unsure: dict[str, float]
    left_out: dict[str, str]
    tries: list[Try]
    window: float
    cells: int

    def __str__(self) -> str:
        return "\n".join(_told(self))


@dataclass(frozen=True)
class Probe:
    """Where all windows begin, and what they are compared with."""

    given: Scene
    scene: Scene  # as it is probed: molecules by their mean
    start: State
    dt: float
    of: tuple[str, ...] | None

    def steps(self, settings: Settings) -> int:
        """Into how many steps the window is divided."""
        return round(WINDOW * self.dt / (settings.dt or self.dt))

    def window(self, settings: Settings) -> tuple[list[State], bool, float, dict[str, float]]:
        """The states in the middle and at the end of the window, whether a colony failed, the seconds it took, and those of each effect."""
        made, steps = settings.apply(self.scene), self.steps(settings)
        dt, state, seen, timings, broken = self.dt * WINDOW / steps, self.start, [], Timings(), False
        # what other work on the machine takes does not count, where the work is this thread's own
        clock = time.thread_time if state.device.type == "cpu" else time.perf_counter
        begun = clock()
        for k in range(steps):
            state = made.step(state, dt, timings)
            broken = broken or any(bool((r.status != 0).any()) for r in state.reports.values())
            if 2 * (k + 1) % steps == 0:
                seen.append(state)
        return seen, broken, clock() - begun, timings.seconds

    def observed(self, settings: Settings) -> tuple[dict[str, list[Tensor]], float, dict[str, float]]:
        """What is read off in the middle and at the end, by observable; NaN if a colony failed."""
        states, broken, seconds, spent = self.window(settings)
        found: dict[str, list[Tensor]] = {}
        for state in states:
            for name, value in (observables(state) | self.due(state)).items():
                if self.of is None or name in self.of:
                    found.setdefault(name, []).append(value * math.nan if broken else value)
        return found, seconds, spent

    def due(self, state: State) -> dict[str, Tensor]:
        """The number of cells and their volume after the divisions with which the next step would begin: until then both are late, by a step that is known.
        (A division costs the volume of two caps' worth of length.)"""
        for effect in self.scene.effects:
            if effect.stage <= DIVISION:
                state = effect.step(state, self.dt)
        seen = observables(state)
        return {name: seen[name] for name in ("cells", "volume")}

    def errors(self, found: dict[str, list[Tensor]], against: dict[str, list[Tensor]], apart: bool = False) -> dict[str, float]:
        """By observable of `against`, the greater of the errors in the middle and at the end; infinite where it is not found.

        apart: of two runs of which neither is right, so that overlaps, too, are compared and not told."""
        soft = any(isinstance(e, Mechanics) and e.stiffness is not None for e in self.scene.listed)
        out = {}
        for name, rights in against.items():
            values, worst = found.get(name, []), 0.0
            for value, right in zip(values, rights, strict=False):
                if name == "overlap" and not soft:
                    error = float((value - right).abs().max() if apart else value.max())
                elif name.startswith(SIGNAL):
                    error = float(((value - right) / right).abs().max())
                elif name == "volume":
                    added = rights[1] - rights[0]
                    error = float((values[-1] - values[0] - added).abs() / torch.maximum(added.abs(), 0.1 * rights[1]))
                else:
                    error = float((value - right).norm() / right.norm().clamp(min=1e-30))
                worst = max(worst, math.inf if math.isnan(error) else error)
            out[name] = worst if len(values) == len(rights) else math.inf
        return out


def observables(state: State) -> dict[str, Tensor]:
    """What is read off a state of a batch: numbers by name, (k,) float64 each. Species and signals that are 0 everywhere are left out."""
    cells = max(1, state.cells)
    one = lambda *x: torch.stack([torch.as_tensor(v, dtype=torch.float64).cpu() for v in x])  # noqa: E731
    out = {"cells": one(cells), "volume": one(state.volume.double().sum())}
    if "displacement" in state.fields:  # cells that do not push each other have no overlap to speak of
        found, diameter = measure.overlaps(state), 2 * float(state.radius.double().mean())
        out["overlap"] = one((found.mean.double() * found.count).sum() / found.count.sum().clamp(min=1) / diameter)
    if int(state.counts.min()) >= 2:
        out["radius"] = one(measure.colony_radius(state).double().mean())
    for name in _species(state):
        value = state.fields[name].double()
        if bool((value != 0).any()):
            out[name] = one(value.mean(), value.std(correction=0))
    for name, grid in state.signals.items():
        value = grid.double()
        if bool((value != 0).any()):
            # the amount, and the mean concentration that a molecule of it finds itself in
            out[SIGNAL + name] = one(value.sum(), value.sum() * (value * value).sum() / value.sum() ** 2)
    return out


def _species(state: State) -> list[str]:
    """Names of fields that are concentrations in cells."""
    return [name for name, f in state.declared.items() if f.scope == "cell" and f.unit == "conc"]


def tune(
    scene: Scene, error: float = 0.01, *, cells: int = 100, colonies: int = 24, of: Sequence[str] | None = None, seed: int = 0,
    device: str | torch.device = "cpu",
) -> Tuned:  # fmt: skip
    """The cheapest settings with which a scene's observables are within `error` (relative, 0.01 for 1 %) of what far tighter settings give; about a minute.

    cells: in each of `colonies` colonies (or as many as the scene's parameters are for) where the probe begins; a scene that stays smaller is taken as it
    is after 2,000 steps. of: names of the observables that matter, by default all: "cells", "volume", "radius", "overlap", species, "signal NAME". Circuits
    that run molecule by molecule are probed by their smooth mean, since noise is no error. Raises InputError where nothing holds the error, or
    where the probe cannot tell it; SimulationError where the scene fails on the way to where the probe begins.
    """
    checks.number("error", error, above=0.0, most=0.5)
    for name, given in (("cells", cells), ("colonies", colonies)):
        if isinstance(given, bool) or not isinstance(given, int) or given < 1:
            raise checks.refuse(name, given, "a whole number from 1")
    probe = begin(scene, cells, colonies, of, seed, device)
    if of is not None:
        known = list(dict.fromkeys([*observables(probe.start), *_species(probe.start), *(SIGNAL + n for n in probe.start.signals)]))
        for name in of:
            if name not in known:
                raise checks.refuse("of", name, "among " + ", ".join(known))
    return Search(probe, begin(scene, math.ceil(LARGER * cells), colonies, of, seed + 1, device), error).run()


@torch.no_grad()
def begin(scene: Scene, cells: int, colonies: int, of: Sequence[str] | None = None, seed: int = 0, device: str | torch.device = "cpu") -> Probe:
    """The scene as it is probed, grown to where the windows begin."""
    smooth = [e.smooth() if isinstance(e, Circuit) and e.is_stochastic else e for e in scene.listed]
    made = scene.retuned(smooth, scene.dt, scene.accuracy)
    fixed = scene.fixed_colonies
    state = made.seed(fixed if fixed > 1 else colonies, seed=seed, device=device)
    ends = deque(simulate(made, state, cells=cells, until=MOST_STEPS * scene.dt), maxlen=1)
    return Probe(scene, made, ends[0] if ends else state, scene.dt, None if of is None else tuple(of))


class Search:
    """Settings tried from coarse to fine."""

    def __init__(self, probe: Probe, other: Probe, error: float):
        self.probe, self.other, self.error, self.aim = probe, other, error, AIM * error
        self.mechanics = next((e for e in probe.scene.listed if isinstance(e, Mechanics)), None)
        self.circuit = next((e for e in probe.given.listed if isinstance(e, Circuit) and e.method == STIFF), None)
        self.contacts = CONTACTS if self.mechanics is not None else (TIGHT_CONTACTS,)
        self.rtols = CIRCUITS if self.circuit is not None else (TIGHT_CIRCUITS,)
        self.tries: dict[Settings, Try] = {}
        self.refuted: set[Settings] = set()
        self.seen: dict[Settings, dict[str, list[Tensor]]] = {}

    def settings(self, steps: int, contacts: tuple[float, int, float], rtol: float) -> Settings:
        """As knobs of the scene; those of effects that it does not list stay unset."""
        penalty, more, tolerance = contacts
        mechanics = self.mechanics
        return Settings(
            dt=self.probe.dt * WINDOW / steps, rtol=None if self.circuit is None else rtol, tolerance=None if mechanics is None else tolerance,
            passes=None if mechanics is None or more == 0 else mechanics.usual_passes + more,
            penalty=None if mechanics is None or mechanics.stiffness is not None else penalty,
        )  # fmt: skip

    @torch.no_grad()
    def run(self) -> Tuned:
        probe = self.probe
        self.reference, self.unsure = self._reference(probe)
        self.seen_there, unsure_there = self._reference(self.other)
        # what is drawn at random anew for each length of step differs by chance, now more and now less: so both are asked
        self.unsure |= {n: max(e, unsure_there[n]) for n, e in self.unsure.items() if math.isfinite(unsure_there.get(n, math.inf))}
        # the coarser reference is off by twice as much as the finer is: their difference is the finer's own error
        said = lambda e: "a reference failed" if math.isinf(e) else f"two references differ by {_percent(e)}"  # noqa: E731
        left_out = {n: said(e) for n, e in self.unsure.items() if e > self.error / 2}
        self.reference = {n: v for n, v in self.reference.items() if n not in left_out}
        # what every knob tells in must be seen, and what was named
        missing = [n for n in left_out if n in (probe.of or ("volume",))]
        if missing or not self.reference:
            worst = ", ".join(f"{n}: {left_out[n]}" for n in missing or left_out)
            raise checks.refuse("error", self.error, "one that the probe can tell", f"Here {worst}. Ask for more, or probe more colonies or cells.")
        own = self._try(Settings())  # first, since a coarse step that takes sub-steps does not tell what a step costs
        best, confirmed = self._confirmed()
        return Tuned(
            best.settings.apply(self.probe.given), best.settings, self.error, best, own, confirmed, self._parts(best), self.unsure, left_out,
            list(self.tries.values()), probe.dt * WINDOW, probe.start.cells,
        )  # fmt: skip

    def _reference(self, probe: Probe) -> tuple[dict[str, list[Tensor]], dict[str, float]]:
        """What is right, by observable, and how far another reference of half as many steps differs from it."""
        right, other = (probe.observed(self.settings(n, TIGHT_CONTACTS, TIGHT_CIRCUITS))[0] for n in (FINEST, FINEST // 2))
        return right, probe.errors(other, right, apart=True)

    def _confirmed(self) -> tuple[Try, dict[str, float]]:
        """The cheapest that holds the error in the other colonies too, and its errors there, in what can be seen there."""
        seen = self.seen_there
        right = {n: seen[n] for n in self.reference if n in seen and not any(bool(v.isnan().any()) for v in seen[n])}
        while True:
            best = self._cheapest()
            errors = self.other.errors(self.other.observed(best.settings)[0], right)
            if max(errors.values(), default=0.0) <= CONFIRM * self.error:
                return best, errors
            self.refuted.add(best.settings)
            self.aim *= STRICTER

    def _try(self, settings: Settings) -> Try:
        if settings not in self.tries:
            found, seconds, spent = self.probe.observed(settings)
            self.seen[settings] = found
            self.tries[settings] = Try(settings, self.probe.errors(found, self.reference), seconds, spent)
        return self.tries[settings]

    def _cheapest(self) -> Try:
        """Of the tries within what is aimed at, the one that took the least time, once every step that could be cheaper has been looked at."""
        best: Try | None = None
        for steps in STEPS:
            if best is not None and steps * self._least() > best.seconds:
                break
            self._look_at(steps)
            holding = [t for t in self.tries.values() if t.worst <= self.aim and t.settings not in {Settings(), *self.refuted}]
            best = min(holding, key=lambda t: t.seconds, default=None)
        if best is None:
            closest = min(self.tries.values(), key=lambda t: t.worst)
            name = max(closest.errors, key=lambda n: closest.errors[n])
            raise checks.refuse(
                "error", self.error, f"reached by some settings: the closest came to {_percent(closest.worst)}, in {name!r}, with {_words(closest.settings)}",
                "Ask for more, or name what matters (of=…).",
            )  # fmt: skip
        return best

    def _least(self) -> float:
        """What a step would take, s, if every effect took as little as it ever did."""
        each: dict[str, float] = {}
        for t in self.tries.values():
            share = t.seconds / max(1e-9, sum(t.spent.values())) / self.probe.steps(t.settings)
            for name, spent in t.spent.items():
                each[name] = min(each.get(name, math.inf), share * spent)
        return sum(each.values())

    def _look_at(self, steps: int) -> None:
        """Try a window of so many steps with tighter and tighter knobs until the error is held; with the tightest only, where that is far off."""
        if self._try(self.settings(steps, TIGHT_CONTACTS, TIGHT_CIRCUITS)).worst > OFF * self.aim:
            return
        rtol = next(r for r in (*self.rtols, TIGHT_CIRCUITS) if self._circuits_add(steps, r) <= SMALL * self.aim)
        for contacts in (*self.contacts, TIGHT_CONTACTS):
            if self._try(self.settings(steps, contacts, rtol)).worst <= self.aim:
                return

    def _circuits_add(self, steps: int, rtol: float) -> float:
        """What circuits at `rtol` change in the worst observable, contacts as they usually are."""
        usual = CONTACTS[3] if self.mechanics is not None else TIGHT_CONTACTS
        loose, tight = (self.settings(steps, usual, r) for r in (rtol, TIGHT_CIRCUITS))
        for s in (loose, tight):
            self._try(s)
        return max(self.probe.errors(self.seen[loose], {n: v for n, v in self.seen[tight].items() if n in self.reference}, apart=True).values())

    def _parts(self, best: Try) -> dict[str, dict[str, float]]:
        """By knob, what of each observable's error is gone when it alone is tight; for the step, what is left when all others are."""
        s = best.settings
        tight = self.settings(self.probe.steps(s), TIGHT_CONTACTS, TIGHT_CIRCUITS)
        parts = {"step": self._try(tight).errors}
        if self.mechanics is not None:
            parts["contacts"] = self._difference(best, dataclasses.replace(tight, rtol=s.rtol))
        if self.circuit is not None:
            parts["circuits"] = self._difference(best, dataclasses.replace(s, rtol=tight.rtol))
        return parts

    def _difference(self, best: Try, other: Settings) -> dict[str, float]:
        self._try(other)
        found = self.probe.errors(self.seen[best.settings], {n: v for n, v in self.seen[other].items() if n in self.reference})
        if "overlap" in found:
            found["overlap"] = max(0.0, best.errors["overlap"] - self.tries[other].errors["overlap"])
        return found


def _told(tuned: Tuned) -> list[str]:
    """The tables."""
    best, own = tuned.chosen, tuned.own
    head = f"{tuned.scene.name}: {_percent(tuned.error)} in {', '.join(best.errors)}, over {tuned.window:g} h from {tuned.cells} cells in all"
    rows: list[tuple[str, ...]] = [("", "chosen", "part of the error", "of the time")]
    total = sum(best.spent.values()) or 1.0
    for knob, errors in tuned.parts.items():
        name = max(errors, key=lambda n: errors[n])
        share = {"contacts": best.spent.get("mechanics"), "circuits": best.spent.get("circuit")}.get(knob)
        rows.append((knob, _knob(knob, tuned.settings), f"{_percent(errors[name])} ({name})", "" if share is None else f"{100 * share / total:.0f} %"))
    lines = [head, "", *_aligned(rows), ""]
    rows = [("", "error", "in other colonies", "with the scene's own settings", "the reference's own")]
    rows += [
        (n, _percent(e), _percent(tuned.confirmed[n]) if n in tuned.confirmed else "not seen there", _percent(own.errors[n]), _percent(tuned.unsure[n]))
        for n, e in best.errors.items()
    ]
    lines += _aligned(rows)
    lines += [f"{name}: not told so finely, since {why}" for name, why in tuned.left_out.items()]
    ratio = best.seconds / own.seconds
    return [*lines, "", f"{best.seconds:.2g} s for the window, {ratio:.2g} times what the scene's own settings take; {len(tuned.tries)} settings were run"]


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    wide = [max(len(r[k]) for r in rows) for k in range(len(rows[0]))]
    return ["  " + "  ".join(x.ljust(w) for x, w in zip(r, wide, strict=True)).rstrip() for r in rows]


def _knob(knob: str, s: Settings) -> str:
    if knob == "step":
        return f"dt {s.dt:g} h"
    if knob == "circuits":
        return f"rtol {s.rtol:g}"
    penalty = "" if s.penalty is None else f"penalty α·γ {s.penalty:g}, "
    passes = "" if s.passes is None else f"passes {s.passes}, "
    return f"{penalty}{passes}tolerance {s.tolerance:g}"


def _words(settings: Settings) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in settings.given.items())


def _percent(error: float) -> str:
    return "failed" if math.isinf(error) else f"{100 * error:.2g} %"

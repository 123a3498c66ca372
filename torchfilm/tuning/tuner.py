"""The cheapest settings that hold an error: `tune(scene, error=0.01)`.

A few colonies of the scene are grown by its own settings; from that same state a window of some
steps is run again and again: once by far tighter settings, the reference, and then by other
settings, each step by knobs from loose to tight. What a user would read off at the end is compared,
observable by observable: the table is in `torchfilm.tuning.observables`. Each error, with what of
it may be chance, must be within what was asked; of the settings that are, the one that took the
least time is chosen, confirmed in other colonies that are smaller by a third, and measured once
more with each of its knobs tightened, which tells the knobs' parts in the error. Cheaper ones whose
error is within it but for chance are looked at among more colonies, and chosen if it is there.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from torchfilm.scene import Scene
from torchfilm.tools import checks
from torchfilm.tuning.observables import (
    SIGNAL,
    WINDOW,
    AccuracyProbe,
    Error,
    Seen,
    WindowRun,
    begin,
    observables,
    species,
)
from torchfilm.tuning.settings import Settings

# Into how many steps the window is divided: all even, so that its middle is a step too.
STEPS = (6, 8, 12, 16, 18, 20, 24, 30, 40, 48, 60, 76, 96, 120, 150)
FINEST = 240  # the reference, or twice as many
# Knobs from loose to tight: (penalty, passes beyond the least, tolerance) of contacts, and rtol of
# circuits. A larger penalty saves no time, and its overlap grows with the colony beyond what a
# probe of a small one shows. In the order of what they cost.
CONTACTS = (
    (0.1, 0, 0.2),
    (0.1, 0, 0.1),
    (0.03, 0, 0.2),
    (0.1, 0, 0.05),
    (0.03, 0, 0.1),
    (0.1, 0, 0.02),
    (0.03, 0, 0.05),
    (0.03, 0, 0.02),
    (0.01, 0, 0.05),
    (0.1, 0, 0.01),
    (0.03, 0, 0.01),
    (0.01, 0, 0.02),
    (0.01, 0, 0.01),
    (0.03, 1, 0.005),
)
CIRCUITS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
TIGHT_CONTACTS = (0.03, 3, 1e-3)
# circuits, of the error asked for: a ten-thousandth of what they may take of it would not be seen
TIGHT = 1e-3
# The larger colonies are, the more pressure they are under, and the greater are most errors: two to
# four times in a full channel, for colonies larger by half. So settings are sought in colonies
# LARGER times as large as was asked for, and confirmed in others of just that size.
LARGER = 1.5
# Of many settings the cheapest that holds the error is also the luckiest, so that some are refuted;
# where so many are, nothing will be confirmed.
MOST_REFUTED = 20
# What holds the error but for chance is looked at among MORE times as many colonies, if it takes
# less than a WORTH-th of the time; the cheapest so many.
MORE, WORTH, MOST_UNSURE = 3, 1.2, 8
# What of an error may be chance is to be this part of what was asked, at most, or more colonies are
# grown.
UNSURE = 1 / 3
# A long step lets a colony grow too much and a loose solve too little. So looser settings are not
# given up where tighter ones are over what was asked, but where they are OFF times over; at once
# where cells overlap too much, which nothing sets off. Circuits may take a SMALL part of it.
OFF, SMALL = 2.0, 0.3


@dataclass(frozen=True)
class Trial:
    """One setting that was run: its errors by observable, and what its window took, s, in all (on
    the CPU of the thread that ran it) and by effect."""

    settings: Settings
    errors: dict[str, Error]
    seconds: float
    spent: dict[str, float]

    @property
    def worst(self) -> float:
        """The greatest error, with what of it may be chance."""
        return max(e.upper_bound for e in self.errors.values())


@dataclass(frozen=True)
class Tuned:
    """Settings that hold an error, and how that is known.

    scene: with the settings. error: what was asked. chosen: the try that was taken, its errors as
    of more colonies where only these could tell; own: the scene's own settings, for comparison.
    parts: by knob, how much of each observable's error comes from it. confirmed: errors in the
    other colonies. unsure: by observable, how far two references differ; left_out: observables that
    cannot be told so finely, with why. tries: the scene's own and all that might have been chosen,
    in order; runs: how many settings the first probe was run by. window: hours, cells: at its
    start, least: in the smallest colony that has any, finest: steps of the reference. Errors are
    relative, each with its standard error (`Error.value`, `.noise`).
    """

    scene: Scene
    settings: Settings
    error: float
    chosen: Trial
    own: Trial
    confirmed: dict[str, Error]
    parts: dict[str, dict[str, Error]]
    unsure: dict[str, Error]
    left_out: dict[str, str]
    tries: list[Trial]
    runs: int
    window: float
    cells: int
    least: int
    finest: int

    def __str__(self) -> str:
        return "\n".join(_told(self))


def tune(
    scene: Scene,
    error: float = 0.01,
    *,
    cells: int = 100,
    colonies: int = 24,
    of: Sequence[str] | None = None,
    seed: int = 0,
    device: str | torch.device = "cpu",
    watch: Callable[[str], None] | None = None,
) -> Tuned:
    """The cheapest settings with which a scene's observables are within `error` (relative, 0.01 for
    1 %) of what far tighter settings give; some minutes.

    cells: in each of `colonies` colonies (or as many as the scene's parameters are for) what will
    be run: settings hold in a probe that begins there and in one that begins with half as many
    again; a scene that stays smaller is taken as it is where it grows no more. Where chance would
    hide the error, twice or four times as many colonies are grown, and three times those again
    where it hides whether cheaper settings hold it. of: names of the observables that matter, by
    default all: "cells", "volume", "radius", "overlap", species, "signal NAME". Circuits that run
    molecule by molecule are probed by their smooth mean, since noise is no error. watch: is told in
    words what is being done. Raises InputError where nothing holds the error, or where the probe
    cannot tell it; SimulationError where the scene fails on the way to where the probe begins.
    """
    if not isinstance(scene, Scene):
        raise checks.input_error("scene", scene, "a Scene, such as tf.scenes.microcolony()")
    checks.number("error", error, above=0.0, most=0.5)
    for name, given, least, why in (
        ("cells", cells, 1, ""),
        ("colonies", colonies, 2, "By how they differ it tells what of an error may be chance."),
    ):
        if isinstance(given, bool) or not isinstance(given, int) or given < least:
            raise checks.input_error(name, given, f"a whole number from {least}", why)
    of = of or None
    if isinstance(of, str):
        raise checks.input_error("of", of, f"a list of names, such as {[of]}")
    many, watch = math.ceil(LARGER * cells), watch or (lambda words: None)
    watch(f"growing {colonies} colonies to {many} cells")
    probe = begin(scene, many, colonies, of, seed, device)
    if of is not None:
        known = list(
            dict.fromkeys(
                [
                    *observables(probe.start),
                    *species(probe.start),
                    *(SIGNAL + n for n in probe.start.signals),
                ]
            )
        )
        for name in of:
            if name not in known:
                raise checks.input_error("of", name, "among " + ", ".join(known))
    for more in (2, 4) if scene.fixed_colonies == 1 else ():
        if _chance(probe) <= UNSURE * error:
            break
        watch(f"growing {more * colonies} colonies to {many} cells")
        probe = begin(scene, many, more * colonies, of, seed, device)
    watch(f"growing {colonies} others to {cells} cells")
    other = begin(scene, cells, colonies, of, seed + 1, device)
    finer = lambda: begin(scene, many, MORE * probe.start.colonies, of, seed + 2, device)
    return Search(probe, other, error, watch, finer if scene.fixed_colonies == 1 else None).run()


@torch.no_grad()
def _chance(probe: AccuracyProbe) -> float:
    """How much of the error in what must be told, the volume or what was named, may be chance: as
    runs by the scene's own step and by half of it differ."""
    one, other = (probe.observed(Settings(dt=dt)).found for dt in (None, probe.dt / 2))
    return max(
        (e.ci95 for n, e in probe.errors(one, other, apart=True).items() if n in probe.needed),
        default=0.0,
    )


class Search:
    """Settings tried from coarse to fine."""

    def __init__(
        self,
        probe: AccuracyProbe,
        other: AccuracyProbe,
        error: float,
        watch: Callable[[str], None] = lambda words: None,
        more: Callable[[], AccuracyProbe] | None = None,
    ):
        self.probe, self.other, self.error, self.watch, self.more = probe, other, error, watch, more
        self.knobs = _knobs(probe.scene)
        # of the scene as it is given: circuits that run molecule by molecule have no tolerance
        self.stiff = "rtol" in _knobs(probe.given)
        self.contacts = CONTACTS if "tolerance" in self.knobs else (TIGHT_CONTACTS,)
        self.tight = TIGHT * error
        self.rtols = tuple(r for r in CIRCUITS if r > self.tight) if self.stiff else (self.tight,)
        self.finest = FINEST
        self.runs: dict[Settings, WindowRun] = {}
        self.errors: dict[Settings, dict[str, Error]] = {}
        self.tries: dict[Settings, Trial] = {}
        # what came of them in the other colonies
        self.refuted: dict[Settings, dict[str, Error]] = {}
        self.finely: tuple[AccuracyProbe, Seen] | None = (
            None  # more colonies, once they are asked for
        )
        self.unheld: set[Settings] = set()  # what did not hold there

    def settings(self, steps: int, contacts: tuple[float, int, float], rtol: float) -> Settings:
        """As knobs of the scene; those of effects that it does not list stay unset."""
        penalty, more, tolerance = contacts
        knobs = self.knobs
        return Settings(
            dt=self.probe.dt * WINDOW / steps,
            rtol=rtol if self.stiff else None,
            tolerance=tolerance if "tolerance" in knobs else None,
            passes=int(knobs["passes"]) + more if more and "passes" in knobs else None,
            penalty=penalty if "penalty" in knobs else None,
        )

    @torch.no_grad()
    def run(self) -> Tuned:
        left_out = self._refer()
        own = self._try(Settings())
        best, confirmed = self._confirmed()
        return Tuned(
            best.settings.apply(self.probe.given),
            best.settings,
            self.error,
            best,
            own,
            confirmed,
            self._parts(best),
            self.unsure,
            left_out,
            list(self.tries.values()),
            len(self.runs),
            self.probe.dt * WINDOW,
            self.probe.start.cells,
            _smallest(self.probe),
            self.finest,
        )

    def _refer(self) -> dict[str, str]:
        """Run the reference, twice as finely where only that can tell what must be told, and say
        what cannot be told."""
        probe, half = self.probe, self.error / 2
        # the coarser reference is off by twice as much as the finer is: their difference is the
        # finer's own error
        coarser, self.reference = (self._seen_finely(probe, n) for n in (FINEST // 2, FINEST))
        self.unsure = probe.errors(coarser, self.reference, apart=True)
        if any(half < self.unsure[n].value <= self.error for n in probe.needed if n in self.unsure):
            self.finest *= 2
            coarser, self.reference = self.reference, self._seen_finely(probe, self.finest)
            self.unsure = probe.errors(coarser, self.reference, apart=True)
        said = lambda e: (
            "a reference failed" if math.isinf(e.value) else f"two references differ by {e}"
        )
        left_out = {n: said(e) for n, e in self.unsure.items() if max(e.value, e.ci95) > half}
        self.reference = {n: v for n, v in self.reference.items() if n not in left_out}
        missing = [n for n in left_out if n in probe.needed]
        if missing or not self.reference:
            raise self._untold({n: left_out[n] for n in missing or left_out})
        for name, e in probe.errors(self._run(Settings()).found, self.reference).items():
            if e.ci95 > half and name not in probe.needed:
                left_out[name] = f"much of {e} is chance"
                del self.reference[name]
        return left_out

    def _seen_finely(self, probe: AccuracyProbe, steps: int) -> Seen:
        self.watch(f"a reference in {steps} steps")
        return probe.observed(self.settings(steps, TIGHT_CONTACTS, self.tight)).found

    def _confirmed(self) -> tuple[Trial, dict[str, Error]]:
        """The cheapest that holds the error in the other colonies too, and its errors there, in
        what can be seen there. (What of them may be chance has been allowed for in the first.)"""
        right = self._right(self.other)
        while len(self.refuted) < MOST_REFUTED and (best := self._cheapest()) is not None:
            errors = self._elsewhere(self.other, best, right)
            if _greatest(errors) <= self.error:
                return self._surer(right, best.seconds / WORTH) or (best, errors)
            self.refuted[best.settings] = errors
            # where chance has misled once, more colonies tell more than finer steps do
            known = min(
                (t.seconds for t in self.tries.values() if self._holds(t)), default=math.inf
            )
            if len(self.refuted) == 1 and (found := self._surer(right, known)) is not None:
                return found
        found = self._surer(right, math.inf)
        if found is None:
            raise self._out_of_reach()
        return found

    def _surer(self, right: Seen, limit: float) -> tuple[Trial, dict[str, Error]] | None:
        """Of the tries that hold the error but for chance and take less than `limit` seconds, the
        cheapest that holds it to 95 % among more colonies, and in the others as it is."""
        known = {Settings(), *self.refuted, *self.unheld}
        unsure = [
            t
            for t in self.tries.values()
            if t.settings not in known
            and t.seconds < limit
            and _greatest(t.errors) <= self.error < t.worst
        ]
        if not unsure or self.more is None:
            return None
        if self.finely is None:
            self.watch("growing more colonies, to tell more finely")
            probe = self.more()
            self.finely = probe, self._right(probe)
        probe, finely = self.finely
        for tried in sorted(unsure, key=lambda t: t.seconds)[:MOST_UNSURE]:
            self.unheld.add(tried.settings)
            errors = self._elsewhere(probe, tried, finely)
            if max(e.upper_bound for e in errors.values()) <= self.error:
                others = self._elsewhere(self.other, tried, right)
                if _greatest(others) <= self.error:
                    return dataclasses.replace(tried, errors=errors), others
        return None

    def _right(self, probe: AccuracyProbe) -> Seen:
        """The reference in other colonies, of what can be told in the first."""
        seen = self._seen_finely(probe, self.finest)
        right = {
            n: seen[n]
            for n in self.reference
            if n in seen and not any(bool(v.isnan().any()) for v in seen[n])
        }
        missing = {
            n: "a reference failed in the other colonies"
            for n in self.probe.needed
            if n in self.reference and n not in right
        }
        if missing:
            raise self._untold(missing)
        return right

    def _elsewhere(self, probe: AccuracyProbe, tried: Trial, right: Seen) -> dict[str, Error]:
        """What the same settings come to in other colonies."""
        self.watch(f"confirming {_words(tried.settings)}")
        return probe.errors(probe.observed(tried.settings).found, right)

    def _untold(self, why: dict[str, str]) -> checks.InputError:
        worst = (
            ", ".join(f"{name}: {words}" for name, words in why.items())
            or "nothing of what was named is there: it is 0 everywhere"
        )
        return checks.input_error(
            "error",
            self.error,
            "one that the probe can tell",
            f"Here {worst}. Ask for a larger error, or probe more colonies or cells.",
        )

    def _out_of_reach(self) -> checks.InputError:
        own, *others = self.tries.values()
        found = {t.settings: t.errors for t in others if not self._holds(t)} | self.refuted or {
            own.settings: own.errors
        }
        closest = min(found, key=lambda s: max(e.upper_bound for e in found[s].values()))
        name = max(found[closest], key=lambda n: found[closest][n].upper_bound)
        error = found[closest][name]
        return checks.input_error(
            "error",
            self.error,
            f"reached by some settings, in both probes: the closest came to {error}, at most"
            f" {_percent(error.upper_bound)}, in {name!r}, with {_words(closest)}",
            "Ask for a larger error, probe more colonies (the scene's own number, where its"
            " parameters have one value a colony), or name what matters (of=…).",
        )

    def _run(self, settings: Settings) -> WindowRun:
        if settings not in self.runs:
            self.watch(f"setting {len(self.runs) + 1}: {_words(settings)}")
            self.runs[settings] = self.probe.observed(settings)
        return self.runs[settings]

    def _try(self, settings: Settings) -> Trial:
        if settings not in self.tries:
            run = self._run(settings)
            self.tries[settings] = Trial(settings, self._found(settings), run.seconds, run.spent)
        return self.tries[settings]

    def _cheapest(self) -> Trial | None:
        """Of the tries that hold the error and are not refuted, the one that took the least time,
        once every step that could be cheaper has been looked at: from the scene's own to finer ones
        first, until one holds the error and tells what is too dear.
        """
        best: Trial | None = None
        for steps in (*(n for n in STEPS if n >= WINDOW), *(n for n in STEPS if n < WINDOW)):
            if best is None or steps * self._least() <= best.seconds:
                self._look_at(steps, math.inf if best is None else best.seconds)
                best = min(
                    (t for t in self.tries.values() if self._holds(t)),
                    key=lambda t: t.seconds,
                    default=None,
                )
        return best

    def _holds(self, tried: Trial) -> bool:
        return (
            tried.worst <= self.error
            and tried.settings != Settings()
            and tried.settings not in self.refuted
        )

    def _least(self) -> float:
        """What a step would take, s, if every effect took as little as it ever did; 0 as long as
        nothing tells, since all steps were taken in several."""
        each: dict[str, float] = {}
        for settings, run in self.runs.items():
            share = run.seconds / max(1e-9, sum(run.spent.values())) / self.probe.steps(settings)
            for name, spent in run.spent.items() if not run.several else ():
                each[name] = min(each.get(name, math.inf), share * spent)
        return sum(each.values())

    def _look_at(self, steps: int, limit: float) -> None:
        """Trial a window of so many steps with tighter and tighter knobs until the error is held,
        or more than `limit` seconds are taken; not at all what is hopeless."""
        tightest = self.settings(steps, TIGHT_CONTACTS, self.tight)
        if (
            self._hopeless(tightest)
            or self._run(self.settings(steps, self.contacts[0], self.rtols[0])).seconds > limit
        ):
            return
        self._found(tightest)
        if self._hopeless(tightest):
            return
        # (where the usual contacts fail, nothing tells what circuits add)
        rtol = next(
            (r for r in self.rtols if self._circuits_add(steps, r) <= SMALL * self.error),
            self.tight,
        )
        for contacts, r in (
            *((c, rtol) for c in self.contacts),
            (TIGHT_CONTACTS, rtol),
            (TIGHT_CONTACTS, self.tight),
        ):
            settings = self.settings(steps, contacts, r)
            if not self._hopeless(settings):
                tried = self._try(settings)
                if self._holds(tried) or tried.seconds > limit:
                    return

    def _found(self, settings: Settings) -> dict[str, Error]:
        """The errors of settings, by observable."""
        if settings not in self.errors:
            self.errors[settings] = self.probe.errors(self._run(settings).found, self.reference)
        return self.errors[settings]

    def _hopeless(self, settings: Settings) -> bool:
        """Are these looser than others that are far off? By finer steps alone an error falls at
        most with their square."""
        for other, errors in self.errors.items():
            if other.given and _looser(settings, other):
                finer = min(1.0, self.probe.steps(other) / self.probe.steps(settings)) ** 2
                # (what fails with tight contacts may run with loose ones)
                far = {
                    n: finer * (e.value - e.ci95)
                    for n, e in errors.items()
                    if not math.isinf(e.value)
                }
                if any(
                    error > self.error * (1.0 if name == "overlap" else OFF)
                    for name, error in far.items()
                ):
                    return True
        return False

    def _circuits_add(self, steps: int, rtol: float) -> float:
        """What circuits at `rtol` change in the worst observable, contacts as they usually are."""
        usual = CONTACTS[3] if "tolerance" in self.knobs else TIGHT_CONTACTS
        loose, tight = (self._run(self.settings(steps, usual, r)).found for r in (rtol, self.tight))
        return _greatest(
            self.probe.errors(
                loose, {n: v for n, v in tight.items() if n in self.reference}, apart=True
            )
        )

    def _parts(self, best: Trial) -> dict[str, dict[str, Error]]:
        """By knob, what of each observable's error is gone when it alone is tight; for the step,
        what is left when all others are."""
        s = best.settings
        tight = self.settings(self.probe.steps(s), TIGHT_CONTACTS, self.tight)
        parts = {"step": self._found(tight)}
        if "tolerance" in self.knobs:
            parts["contacts"] = self._difference(s, dataclasses.replace(tight, rtol=s.rtol))
        if self.stiff:
            parts["circuits"] = self._difference(s, dataclasses.replace(s, rtol=tight.rtol))
        return parts

    def _difference(self, one: Settings, other: Settings) -> dict[str, Error]:
        found, against = self._run(one).found, self._run(other).found
        return self.probe.errors(
            found, {n: v for n, v in against.items() if n in self.reference}, apart=True
        )


def _knobs(scene: Scene) -> dict[str, float]:
    """The accuracy settings that a scene's effects take, with their usual values."""
    return {
        name: value for effect in scene.effects for name, value in effect.accuracy_knobs().items()
    }


def _smallest(probe: AccuracyProbe) -> int:
    """Cells in the smallest colony that has any."""
    counts = probe.start.counts
    return int(counts[counts > 0].min()) if probe.start.cells else 0


def _greatest(errors: dict[str, Error]) -> float:
    """As measured."""
    return max((e.value for e in errors.values()), default=0.0)


def _looser(one: Settings, other: Settings) -> bool:
    """Is every knob but the step at least as loose as the other's, of the same knobs?"""
    fewer = (one.passes or 0) <= (other.passes or 0)
    return fewer and all(
        (getattr(one, n) or 0.0) >= (getattr(other, n) or 0.0)
        for n in ("penalty", "tolerance", "rtol")
    )


def _told(tuned: Tuned) -> list[str]:
    """The tables."""
    best, own = tuned.chosen, tuned.own
    head = (
        f"{tuned.scene.name}: {_percent(tuned.error)} in {', '.join(best.errors)}, over"
        f" {tuned.window:g} h from {tuned.cells} cells in all"
    )
    head += f", {tuned.least} in the smallest colony"
    rows: list[tuple[str, ...]] = [("", "chosen", "part of the error", "of the time")]
    total = sum(best.spent.values()) or 1.0
    for knob, errors in tuned.parts.items():
        name = max(errors, key=lambda n: errors[n].value)
        share = {
            "contacts": best.spent.get("mechanics"),
            "circuits": best.spent.get("circuit"),
        }.get(knob)
        rows.append(
            (
                knob,
                _knob(knob, tuned.settings),
                f"{_percent(errors[name].value)} ({name})",
                "" if share is None else f"{100 * share / total:.0f} %",
            )
        )
    lines = [head, "", *_aligned(rows), ""]
    rows = [
        ("", "error", "in other colonies", "with the scene's own settings", "the reference's own")
    ]
    rows += [
        (
            n,
            str(e),
            str(tuned.confirmed.get(n, "not seen there")),
            str(own.errors[n]),
            str(tuned.unsure[n]),
        )
        for n, e in best.errors.items()
    ]
    lines += _aligned(rows)
    lines += [
        "  (± standard error by chance, which is allowed for in the first column; the parts may set"
        " each other off)"
    ]
    lines += [
        f"NOT CHECKED: {name}, since {why}. It may be off by more: name it (of) to have it told"
        for name, why in tuned.left_out.items()
    ]
    ratio = best.seconds / own.seconds
    return [
        *lines,
        "",
        (
            f"{best.seconds:.2g} s for the window, {ratio:.2g} times what the scene's own settings"
            f" take; {tuned.runs} settings were run"
        ),
    ]


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    wide = [max(len(r[k]) for r in rows) for k in range(len(rows[0]))]
    return [
        "  " + "  ".join(x.ljust(w) for x, w in zip(r, wide, strict=True)).rstrip() for r in rows
    ]


def _knob(knob: str, s: Settings) -> str:
    if knob == "step":
        return f"dt {s.dt:g} h"
    if knob == "circuits":
        return f"rtol {s.rtol:g}"
    penalty = "" if s.penalty is None else f"penalty α·γ {s.penalty:g}, "
    passes = "" if s.passes is None else f"passes {s.passes}, "
    return f"{penalty}{passes}tolerance {s.tolerance:g}"


def _words(settings: Settings) -> str:
    return (
        ", ".join(f"{name} {value:g}" for name, value in settings.given.items())
        or "the scene's own"
    )


def _percent(error: float) -> str:
    return "failed" if math.isinf(error) else f"{100 * error:.2g} %"

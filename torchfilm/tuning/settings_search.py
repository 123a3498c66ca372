"""The search behind `tune`: settings tried from coarse to fine, refuted, confirmed and compared."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch

from torchfilm.tools import checks
from torchfilm.tuning.candidates import (
    CIRCUITS,
    CONTACTS,
    FINEST,
    MOST_REFUTED,
    MOST_UNSURE,
    OFF,
    SMALL,
    STEPS,
    TIGHT,
    TIGHT_CONTACTS,
    WORTH,
    is_looser,
    knobs_of,
    largest_error,
    smallest_colony,
)
from torchfilm.tuning.observables import WINDOW, AccuracyProbe, Error, Seen, WindowRun
from torchfilm.tuning.settings import Settings
from torchfilm.tuning.tuned import Trial, Tuned, percent, settings_text


class SettingsSearch:
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
        self.knobs = knobs_of(probe.scene)
        # of the scene as it is given: circuits that run molecule by molecule have no tolerance
        self.stiff = "rtol" in knobs_of(probe.given)
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
            smallest_colony(self.probe),
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
            if largest_error(errors) <= self.error:
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
            and largest_error(t.errors) <= self.error < t.worst
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
                if largest_error(others) <= self.error:
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
        self.watch(f"confirming {settings_text(tried.settings)}")
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
            f" {percent(error.upper_bound)}, in {name!r}, with {settings_text(closest)}",
            "Ask for a larger error, probe more colonies (the scene's own number, where its"
            " parameters have one value a colony), or name what matters (of=…).",
        )

    def _run(self, settings: Settings) -> WindowRun:
        if settings not in self.runs:
            self.watch(f"setting {len(self.runs) + 1}: {settings_text(settings)}")
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
            if other.given and is_looser(settings, other):
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
        return largest_error(
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

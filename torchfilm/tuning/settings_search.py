"""The search behind `tune`: it tries settings from coarse to fine, and confirms or refutes them."""

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
    greater,
    is_looser,
    knobs_of,
    largest_error,
    smallest_colony,
)
from torchfilm.tuning.observables import WINDOW, AccuracyProbe, Error, Seen, WindowRun, percent
from torchfilm.tuning.settings import Settings, typed, typed_text
from torchfilm.tuning.tuned import Trial, Tuned


class SettingsSearch:
    """The search for the cheapest settings that keep the error within a limit.

    probe: where settings are tried. other: the colonies that confirm or refute them. error: the
    limit. watch: receives a line of text for each stage. more: grows a larger probe, or None.
    """

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
        # from the scene as given: circuits that run molecule by molecule have no tolerance
        self.stiff = "rtol" in knobs_of(probe.given)
        self.contacts = CONTACTS if "tolerance" in self.knobs else (TIGHT_CONTACTS,)
        self.tight = TIGHT * error
        self.rtols = tuple(r for r in CIRCUITS if r > self.tight) if self.stiff else (self.tight,)
        self.finest = FINEST
        self.runs: dict[Settings, WindowRun] = {}
        self.errors: dict[Settings, dict[str, Error]] = {}
        self.tries: dict[Settings, Trial] = {}
        # their errors in the other colonies
        self.refuted: dict[Settings, dict[str, Error]] = {}
        # the probe with more colonies and its reference, made when first needed
        self.larger_probe: tuple[AccuracyProbe, Seen] | None = None
        # errors of settings that ran in the larger probe, with greater ones of the other colonies
        self.retested: dict[Settings, dict[str, Error]] = {}

    def settings(self, steps: int, contacts: tuple[float, int, float], rtol: float) -> Settings:
        """Settings from these values. Knobs of effects that the scene does not list stay None."""
        penalty, more, tolerance = contacts
        knobs = self.knobs
        return Settings(
            dt=float(f"{self.probe.dt * WINDOW / steps:.12g}"),  # 0.0375, not 0.037500000000000006
            rtol=rtol if self.stiff else None,
            tolerance=tolerance if "tolerance" in knobs else None,
            passes=int(knobs["passes"]) + more if more and "passes" in knobs else None,
            penalty=penalty if "penalty" in knobs else None,
        )

    @torch.no_grad()
    def run(self) -> Tuned:
        left_out = self._run_references()
        own = self._try(Settings())
        best, confirmed = self._confirmed()
        parts = self._parts(best)
        return Tuned(
            scene=best.settings.apply(self.probe.given),
            given=self.probe.given,
            settings=best.settings,
            error=self.error,
            chosen=best,
            own=own,
            confirmed=confirmed,
            parts=parts,
            unsure=self.unsure,
            left_out=left_out,
            tries=self._tries(),
            window=self.probe.dt * WINDOW,
            cells=self.probe.start.cells,
            least=smallest_colony(self.probe),
            finest=self.finest,
        )

    def _tries(self) -> list[Trial]:
        """Everything that ran in the first probe, for comparison too, each with the best that is
        known of its errors: those of the larger probe, and greater ones of the other colonies."""
        tries = []
        for settings, run in self.runs.items():
            errors = self._found(settings) | self.retested.get(settings, {})
            errors = greater(errors, self.refuted.get(settings, {}))
            tries.append(Trial(settings, errors, run.seconds, run.spent))
        return tries

    def _run_references(self) -> dict[str, str]:
        """Runs the references. Returns the observables that they cannot resolve, with the reason.

        The number of steps is doubled if only that resolves the observables that must be resolved.
        """
        probe, half = self.probe, self.error / 2
        # the coarser reference has twice the error of the finer one, so their difference is the
        # error of the finer one
        coarser, self.reference = (self._run_reference(probe, n) for n in (FINEST // 2, FINEST))
        self.unsure = probe.errors(coarser, self.reference, apart=True)
        if any(half < self.unsure[n].value <= self.error for n in probe.needed if n in self.unsure):
            self.finest *= 2
            coarser, self.reference = self.reference, self._run_reference(probe, self.finest)
            self.unsure = probe.errors(coarser, self.reference, apart=True)
        said = lambda e: (
            "a reference failed" if math.isinf(e.value) else f"two references differ by {e}"
        )
        left_out = {n: said(e) for n, e in self.unsure.items() if max(e.value, e.ci95) > half}
        self.reference = {n: v for n, v in self.reference.items() if n not in left_out}
        missing = [n for n in left_out if n in probe.needed]
        if missing or not self.reference:
            raise self._undetermined({n: left_out[n] for n in missing or left_out})
        for name, e in probe.errors(self._run(Settings()).found, self.reference).items():
            if e.ci95 > half and name not in probe.needed:
                left_out[name] = f"much of {e} is random"
                del self.reference[name]
        return left_out

    def _run_reference(self, probe: AccuracyProbe, steps: int) -> Seen:
        self.watch(f"a reference in {steps} steps")
        return probe.observed(self.settings(steps, TIGHT_CONTACTS, self.tight)).found

    def _confirmed(self) -> tuple[Trial, dict[str, Error]]:
        """The cheapest trial within the error in the other colonies too, and its errors there, for
        the observables that have a reference there. The errors there pass by value: the first
        probe has already passed with the upper bound."""
        right = self._reference_in(self.other)
        while len(self.refuted) < MOST_REFUTED and (best := self._cheapest()) is not None:
            errors = self._errors_in(self.other, best, right)
            if largest_error(errors) <= self.error:
                return self._best_retested(right, best.seconds / WORTH) or (best, errors)
            self.refuted[best.settings] = errors
            # after a first lucky candidate, more colonies help more than finer steps
            known = min(
                (t.seconds for t in self.tries.values() if self._passes(t)), default=math.inf
            )
            if len(self.refuted) == 1 and (found := self._best_retested(right, known)) is not None:
                return found
        found = self._best_retested(right, math.inf)
        if found is None:
            raise self._out_of_reach()
        return found

    def _best_retested(self, right: Seen, limit: float) -> tuple[Trial, dict[str, Error]] | None:
        """Tests undecided trials again in more colonies, and returns the cheapest that passes, with
        its errors in the other colonies.

        Undecided: faster than `limit` seconds, and within the error by value, but not by its upper
        bound. To pass, the upper bound in the larger probe and the value in the other colonies must
        be within the error.
        """
        known = {Settings(), *self.refuted, *self.retested}
        unsure = [
            t
            for t in self.tries.values()
            if t.settings not in known
            and t.seconds < limit
            and largest_error(t.errors) <= self.error < t.worst
        ]
        if not unsure or self.more is None:
            return None
        if self.larger_probe is None:
            self.watch("growing more colonies, for smaller standard errors")
            probe = self.more()
            self.larger_probe = probe, self._reference_in(probe)
        probe, reference = self.larger_probe
        for tried in sorted(unsure, key=lambda t: t.seconds)[:MOST_UNSURE]:
            errors = self._errors_in(probe, tried, reference)
            self.retested[tried.settings] = errors
            if max(e.upper_bound for e in errors.values()) <= self.error:
                others = self._errors_in(self.other, tried, right)
                if largest_error(others) <= self.error:
                    return dataclasses.replace(tried, errors=errors), others
                self.retested[tried.settings] = greater(errors, others)
        return None

    def _reference_in(self, probe: AccuracyProbe) -> Seen:
        """The reference in another probe, of the observables that the first probe resolves."""
        seen = self._run_reference(probe, self.finest)
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
            raise self._undetermined(missing)
        return right

    def _errors_in(self, probe: AccuracyProbe, tried: Trial, right: Seen) -> dict[str, Error]:
        """The errors of the same settings in another probe."""
        self.watch(f"confirming {self._text(tried.settings)}")
        return probe.errors(probe.observed(tried.settings).found, right)

    def _undetermined(self, why: dict[str, str]) -> checks.InputError:
        """The error to raise if the probe cannot resolve these observables, by name with why."""
        worst = (
            ", ".join(f"{name}: {words}" for name, words in why.items())
            or "every named observable is 0 everywhere"
        )
        return checks.input_error(
            "error",
            self.error,
            "one that the probe can resolve",
            f"Here {worst}. Give a larger error, or probe more colonies or cells.",
        )

    def _out_of_reach(self) -> checks.InputError:
        """The error to raise if no settings passed in both probes."""
        own, *others = self.tries.values()
        found = {t.settings: t.errors for t in others if not self._passes(t)} | self.refuted or {
            own.settings: own.errors
        }
        closest = min(found, key=lambda s: max(e.upper_bound for e in found[s].values()))
        name = max(found[closest], key=lambda n: found[closest][n].upper_bound)
        error = found[closest][name]
        return checks.input_error(
            "error",
            self.error,
            f"reached by some settings, in both probes: the closest came to {error}, at most"
            f" {percent(error.upper_bound)}, in {name!r}, with {self._text(closest)}",
            "Give a larger error, probe more colonies (unless the scene's parameters give their"
            " number), or name the observables that matter (of=…).",
        )

    def _run(self, settings: Settings) -> WindowRun:
        if settings not in self.runs:
            self.watch(f"setting {len(self.runs) + 1}: {self._text(settings)}")
            self.runs[settings] = self.probe.observed(settings)
        return self.runs[settings]

    def _text(self, settings: Settings) -> str:
        """Settings as the user types them."""
        if settings == Settings():
            return "the scene's own"
        return typed_text(typed(settings.apply(self.probe.given)))

    def _try(self, settings: Settings) -> Trial:
        if settings not in self.tries:
            run = self._run(settings)
            errors = self._found(settings)
            self.tries[settings] = Trial(settings, errors, run.seconds, run.spent)
        return self.tries[settings]

    def _cheapest(self) -> Trial | None:
        """The fastest trial that is within the error and not refuted; None if there is none.

        It first tries every step that could be cheaper: from the scene's own step to finer ones,
        then coarser ones. A passing trial sets the time limit for the others.
        """
        best: Trial | None = None
        for steps in (*(n for n in STEPS if n >= WINDOW), *(n for n in STEPS if n < WINDOW)):
            if best is None or steps * self._least() <= best.seconds:
                self._try_step(steps, math.inf if best is None else best.seconds)
                best = min(
                    (t for t in self.tries.values() if self._passes(t)),
                    key=lambda t: t.seconds,
                    default=None,
                )
        return best

    def _passes(self, tried: Trial) -> bool:
        """Whether a trial other than the scene's own settings is within the error, not refuted."""
        return (
            tried.worst <= self.error
            and tried.settings != Settings()
            and tried.settings not in self.refuted
        )

    def _least(self) -> float:
        """A lower bound of the time of a step, s: the sum of each effect's least time so far.

        Runs with substeps do not count; the bound is 0 until another run exists.
        """
        each: dict[str, float] = {}
        for settings, run in self.runs.items():
            share = run.seconds / max(1e-9, sum(run.spent.values())) / self.probe.steps(settings)
            for name, spent in run.spent.items() if not run.several else ():
                each[name] = min(each.get(name, math.inf), share * spent)
        return sum(each.values())

    def _try_step(self, steps: int, limit: float) -> None:
        """Runs the window in `steps` steps with tighter and tighter knobs, until a trial passes or
        takes more than `limit` seconds. Skips hopeless settings."""
        tightest = self.settings(steps, TIGHT_CONTACTS, self.tight)
        if (
            self._hopeless(tightest)
            or self._run(self.settings(steps, self.contacts[0], self.rtols[0])).seconds > limit
        ):
            return
        self._found(tightest)
        if self._hopeless(tightest):
            return
        # (if the usual contacts fail, the share of circuits is unknown)
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
                if self._passes(tried) or tried.seconds > limit:
                    return

    def _found(self, settings: Settings) -> dict[str, Error]:
        """The errors of settings, by observable, computed once."""
        if settings not in self.errors:
            self.errors[settings] = self.probe.errors(self._run(settings).found, self.reference)
        return self.errors[settings]

    def _hopeless(self, settings: Settings) -> bool:
        """Whether looser knobs cannot pass here, because tighter ones had too large an error.

        Finer steps alone reduce an error at most with the square of the step.
        """
        for other, errors in self.errors.items():
            if other.given and is_looser(settings, other):
                finer = min(1.0, self.probe.steps(other) / self.probe.steps(settings)) ** 2
                # (a run that fails with tight contacts may not fail with loose ones)
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
        """The largest change of an observable by circuits at `rtol`, with the usual contacts."""
        usual = CONTACTS[3] if "tolerance" in self.knobs else TIGHT_CONTACTS
        loose, tight = (self._run(self.settings(steps, usual, r)).found for r in (rtol, self.tight))
        return largest_error(
            self.probe.errors(
                loose, {n: v for n, v in tight.items() if n in self.reference}, apart=True
            )
        )

    def _parts(self, best: Trial) -> dict[str, dict[str, Error]]:
        """By knob, the part of each observable's error that vanishes if only this knob is tight.
        For the step: the error that remains if all other knobs are tight."""
        s = best.settings
        tight = self.settings(self.probe.steps(s), TIGHT_CONTACTS, self.tight)
        parts = {"step": self._found(tight)}
        if "tolerance" in self.knobs:
            parts["contacts"] = self._difference(s, dataclasses.replace(tight, rtol=s.rtol))
        if self.stiff:
            parts["circuits"] = self._difference(s, dataclasses.replace(s, rtol=tight.rtol))
        return parts

    def _difference(self, one: Settings, other: Settings) -> dict[str, Error]:
        """How far two settings differ, by observable."""
        found, against = self._run(one).found, self._run(other).found
        return self.probe.errors(
            found, {n: v for n, v in against.items() if n in self.reference}, apart=True
        )

"""Tests whether `tune` holds its promise on every ready-made scene.

    OMP_NUM_THREADS=1 python experiments/tune_check.py       # all scenes, some twenty minutes
    OMP_NUM_THREADS=1 python experiments/tune_check.py --scene channel --error 3%
    OMP_NUM_THREADS=1 python experiments/tune_check.py --scene channel --out channel.csv
    python experiments/tune_check.py --gather channel.csv microcolony.csv   # join such files

The first and the last command write tune.csv in experiments/benchmarks/accuracy and its table in
docs/accuracy_appendix.md.

The script measures the error of the chosen settings in two runs that `tune` has not used: 24
colonies that begin with 100 cells, and 48 that begin with half as many again. A sweep in the first
run gives a comparison: six steps (and three finer ones, if none of those holds the error), eight
settings of contacts and two tolerances of circuits. The settings that hold the error there are run
in the second run as well, in order of their time, until one holds the error in both. Of so many
settings some hold the error by chance, and some at one size only. One column is the time of the
chosen settings over that of the cheapest ones.

The reference is varied, too: a third of its penalty, a third of its tolerance, and other contacts.
The columns have the largest difference from the reference in an observable. Other contacts are
bilateral ones where pressure limits growth. Bilateral contacts do not hold in free growth; there
contacts have a constant α instead of one that follows the force. The last column has observables in
which errors of the chosen settings cancel: one part, of the step or of contacts, is larger than the
whole error.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from arguments import checked, in_file, not_allowed, out_file

import torchfilm as tf
from torchfilm.cli.inspect import parse_error
from torchfilm.tuning.candidates import TIGHT_CONTACTS
from torchfilm.tuning.observables import AccuracyProbe, Error, Seen, begin
from torchfilm.tuning.settings_search import SettingsSearch

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "accuracy"), str(HERE / "benchmarks")]
import appendix  # noqa: E402
from record import machine, scenes_parser  # noqa: E402

STEPS = (12, 18, 24, 30, 40, 54)
FINER = (72, 96, 128)  # if none of STEPS holds the error
SWEPT = (
    (0.3, 0, 0.05),
    (0.1, 0, 0.2),
    (0.1, 0, 0.05),
    (0.1, 0, 0.02),
    (0.1, 0, 0.01),
    (0.03, 0, 0.02),
    (0.01, 0, 0.02),
    (0.01, 0, 0.01),
)
RTOLS = (1e-1, 1e-3)
COLUMNS = (
    "scene",
    "settings",
    "worst error",
    "in",
    "cheapest of the sweep",
    "its error",
    "settings swept",
    "that hold the error in one run",
    "time over the cheapest",
    "reference, penalty / 3",
    "reference, tolerance / 3",
    "reference, other contacts",
    "errors that cancel in",
)
PRESSED = 100.0  # length drag below which pressure limits growth, so that bilateral contacts hold
CONSTANT = 0.0003  # α of contacts that do not follow the force
MOST_ITERATIONS = 20_000  # of a solve with so small an α


@dataclass(frozen=True)
class TestRun:
    """A run that `tune` has not used, and its reference."""

    probe: AccuracyProbe
    search: SettingsSearch
    reference: Seen

    @staticmethod
    def of(scene: tf.Scene, cells: int, colonies: int, seed: int, finest: int) -> TestRun:
        """Grows the probe and runs the reference with `finest` steps."""
        probe = begin(scene, cells, colonies, seed=seed)
        search = SettingsSearch(probe, probe, 0.01)
        return TestRun(
            probe,
            search,
            probe.observed(search.settings(finest, TIGHT_CONTACTS, search.tight)).found,
        )

    def worst(self, settings: tf.Settings, names: Sequence[str]) -> tuple[Error, str, float]:
        """Returns the largest error, its observable and the seconds of the window."""
        run = self.probe.observed(settings)
        errors = self.probe.errors(run.found, {n: self.reference[n] for n in names})
        name = max(errors, key=lambda n: errors[n].value)
        return errors[name], name, run.seconds

    def doubts(self, finest: int, names: Sequence[str]) -> list[str]:
        """Returns the largest difference of each variation of the reference, as text."""
        if "tolerance" not in self.search.knobs:
            return ["", "", ""]
        penalty, more, tolerance = TIGHT_CONTACTS
        make = lambda *contacts: self.search.settings(finest, contacts, self.search.tight)
        usual = make(penalty, more, tolerance)
        return [
            self._off(scene, settings, names)
            for scene, settings in (
                (self.probe.scene, make(penalty / 3, more, tolerance)),
                (self.probe.scene, make(penalty, more, tolerance / 3)),
                (other_contacts(self.probe.scene, usual), tf.Settings(dt=usual.dt)),
            )
        ]

    def _off(self, scene: tf.Scene, settings: tf.Settings, names: Sequence[str]) -> str:
        """Returns how far a run of this scene is from the reference, as text."""
        found = dataclasses.replace(self.probe, scene=scene).observed(settings).found
        right = {n: self.reference[n] for n in names}
        errors = self.probe.errors(found, right, apart=True)
        name = max(errors, key=lambda n: errors[n].value)
        return f"{errors[name]}, {name}"

    def seconds(self, settings: tf.Settings) -> float:
        """Returns the shortest of three times."""
        return min(self.probe.observed(settings).seconds for _ in range(3))


def other_contacts(scene: tf.Scene, tight: tf.Settings) -> tf.Scene:
    """Returns the scene with the settings of the reference, and with bilateral contacts under
    pressure, else with contacts of constant α."""
    made = []
    for effect in scene.effects:
        if isinstance(effect, tf.Mechanics) and effect.length_drag < PRESSED:
            _, passes, _ = TIGHT_CONTACTS
            effect = dataclasses.replace(effect, contacts="bilateral")
            more = dataclasses.replace(tight, passes=effect.settings.passes + passes)
            effect = effect.with_settings(more)
        elif isinstance(effect, tf.Mechanics):
            effect = effect.with_settings(tight)
            given = {"alpha": CONSTANT, "max_iterations": MOST_ITERATIONS}
            effect = dataclasses.replace(effect, contact_overlap=None, **given)
        else:
            effect = effect.with_settings(tight)
        made.append(effect)
    return scene.replace(*made)


def cancelling(tuned: tf.Tuned) -> str:
    """Returns the observables in which a part of the error exceeds the whole by more than chance
    (two standard errors), with that part."""
    words = []
    for name, whole in tuned.chosen.errors.items():
        parts = {knob: errors[name] for knob, errors in tuned.parts.items() if name in errors}
        knob = max(parts, key=lambda k: parts[k].value, default=None)
        if knob is None:
            continue
        part = parts[knob]
        if part.value - whole.value > 2 * max(part.noise, whole.noise):
            words.append(f"{name}: {knob} {100 * part.value:.2g} %, all {100 * whole.value:.2g} %")
    return "; ".join(words) or "none"


def sweep(run: TestRun, steps: Sequence[int]) -> list[tf.Settings]:
    """Returns all settings of the sweep with these steps."""
    search = run.search
    contacts = SWEPT if "tolerance" in search.knobs else (TIGHT_CONTACTS,)
    rtols = RTOLS if search.stiff else (search.tight,)
    return [
        search.settings(n, contact, rtol)
        for n, contact, rtol in itertools.product(steps, contacts, rtols)
    ]


def check(name: str, error: float) -> dict[str, str]:
    """Returns the row of one scene."""
    scene = tf.scenes.build(name)
    tuned = tf.tune(scene, error)
    names = tuple(tuned.chosen.errors)
    few = TestRun.of(scene, 100, 24, 5, tuned.finest)
    many = TestRun.of(scene, 150, 48, 6, tuned.finest)
    worst, observable, _ = max(
        (run.worst(tuned.settings, names) for run in (few, many)), key=lambda found: found[0].value
    )
    found: dict[tf.Settings, tuple[Error, str, float]] = {}
    words = lambda s: ", ".join(f"{n} {v:g}" for n, v in s.given.items())
    for steps in (STEPS, FINER):
        found |= {s: few.worst(s, names) for s in sweep(few, steps)}
        holding = sorted(
            (s for s, (e, _, _) in found.items() if e.value <= error), key=lambda s: found[s][2]
        )
        both = ((s, its) for s in holding if (its := many.worst(s, names)[0]).value <= error)
        best = next(both, None)
        if best is not None:
            break
    swept = ("none", "", str(len(found)), str(len(holding)), "")
    if best is not None:
        s, its = best
        over = few.seconds(tuned.settings) / few.seconds(s)
        swept = (
            words(s),
            str(max(its, found[s][0], key=lambda e: e.value)),
            str(len(found)),
            str(len(holding)),
            f"{over:.2f}",
        )
    doubts = (*few.doubts(tuned.finest, names), cancelling(tuned))
    value = f"{100 * worst.value:.3g} ± {100 * worst.noise:.1g} %"
    row = (name, words(tuned.settings), value, observable, *swept, *doubts)
    return dict(zip(COLUMNS, row, strict=True))


@checked
def share(text: str) -> str:
    """The text of an error to request."""
    if not parse_error(text) > 0:
        raise not_allowed(text, "a share above 0, such as 1% or 0.01")
    return text


def rows_of(path: Path, parser: argparse.ArgumentParser) -> list[dict[str, str]]:
    """The scenes of a file that this script wrote. Ends the script if it is another table."""
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        if sorted(table.fieldnames or ()) != sorted(COLUMNS):
            found = ", ".join(table.fieldnames or ()) or "nothing"
            parser.error(f"--gather {path}: no file of --out; its columns are {found}")
        return list(table)


def main() -> None:
    parser = scenes_parser(__doc__)
    parser.add_argument("--error", type=share, default="1%", help="error to request")
    parser.add_argument(
        "--out", type=out_file, help="CSV file; default: that of the records, or none with --scene"
    )
    parser.add_argument(
        "--gather",
        nargs="+",
        type=in_file,
        default=[],
        help="CSV files of scenes that were checked separately",
    )
    options = parser.parse_args()
    tf.keep_memory()
    torch.set_grad_enabled(False)
    rows = [row for path in options.gather for row in rows_of(path, parser)]
    for name in () if rows else options.scene or tf.scenes.READY:
        rows.append(check(name, parse_error(options.error)))
        print(rows[-1], flush=True)
    out, write_page = options.out, not options.scene and options.out is None
    if write_page:
        out = appendix.RECORDS / "tune.csv"
    if out:
        with out.open("w", newline="") as file:
            table = csv.DictWriter(file, COLUMNS)
            table.writeheader()
            table.writerows(rows)
    if write_page:
        appendix.add_record("tune", machine(), facts={"error": options.error})
        print(appendix.write())


if __name__ == "__main__":
    main()

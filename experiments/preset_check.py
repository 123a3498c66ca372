"""Measures the errors and the time of the three presets on every ready-made scene.

    OMP_NUM_THREADS=1 python experiments/preset_check.py     # all scenes, some minutes
    OMP_NUM_THREADS=1 python experiments/preset_check.py --scene channel

The first command writes presets.csv in experiments/benchmarks/accuracy and its table in
docs/accuracy_appendix.md.

24 colonies that begin with 100 cells run for 32 steps of the scene, in steps of 1.6, 1 and 1/8 of
its own. Errors are those of `tune`, against 320 steps with much tighter settings, or 640 where 160
differ from 320 by over 0.5 % in an observable. An observable is not checked if that does not
resolve it either, or if chance is as large.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import sys
from pathlib import Path

import torch

import torchfilm as tf
from torchfilm.tuning.candidates import TIGHT_CONTACTS
from torchfilm.tuning.observables import AccuracyProbe, Seen, begin
from torchfilm.tuning.settings import PRESETS
from torchfilm.tuning.settings_search import SettingsSearch

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "accuracy"), str(HERE / "benchmarks")]
import appendix  # noqa: E402
from record import machine, scenes_parser  # noqa: E402

CELLS, COLONIES, SEED = 100, 24, 5
LONGER = 4 / 3  # the window over that of `tune`, so that its half is a whole number of draft steps
FINEST, MOST_FINE = 320, 640
UNSURE = 0.005
SHOWN = ("volume", "overlap")
COLUMNS = (
    "scene",
    "preset",
    *SHOWN,
    "worst of the others",
    "in",
    "not checked",
    "time over standard",
)


def resolved(probe: AccuracyProbe, search: SettingsSearch) -> tuple[Seen, list[str]]:
    """Returns the reference, of the observables that it resolves, and the names of the others."""
    run = lambda steps: probe.observed(search.settings(steps, TIGHT_CONTACTS, search.tight)).found
    coarser, finest = run(FINEST // 2), FINEST
    while True:
        reference = run(finest)
        unsure = probe.errors(coarser, reference, apart=True)
        left_out = [n for n, e in unsure.items() if max(e.value, e.ci95) > UNSURE]
        if finest == MOST_FINE or all(unsure[n].value <= UNSURE for n in left_out):
            return {n: v for n, v in reference.items() if n not in left_out}, left_out
        coarser, finest = reference, 2 * finest


def reason(probe: AccuracyProbe, settings: tf.Settings) -> str:
    """Returns why the first colony fails in the window with these settings."""
    state = probe.start
    model, dt = settings.apply(probe.scene).bind(state=state), settings.dt
    for _ in range(probe.steps(settings)):
        state = model.step(state, dt)
        if failed := tf.failures(state):
            return failed[0].reason
    return "no colony fails in a run of its own"


def check(name: str) -> list[dict[str, str]]:
    """Returns a row for each preset of one scene."""
    scene = tf.scenes.build(name)
    probe = begin(scene, CELLS, COLONIES, seed=SEED)
    probe = dataclasses.replace(probe, dt=probe.dt * LONGER)
    search = SettingsSearch(probe, probe, 0.01)
    reference, left_out = resolved(probe, search)
    rows, seconds = [], {}
    for kind in ("standard", "draft", "reference"):
        settings = tf.preset(kind, scene)
        settings = dataclasses.replace(settings, dt=settings.dt or scene.dt)
        runs = [probe.observed(settings) for _ in range(1 if kind == "reference" else 3)]
        seconds[kind] = min(run.seconds for run in runs)
        errors = probe.errors(runs[0].found, reference)
        others = {n: e for n, e in errors.items() if n not in SHOWN}
        worst = max(others, key=lambda n: others[n].value)
        if math.isinf(others[worst].value):
            print(f"{name}, {kind} fails: {reason(probe, settings)}", flush=True)
        rows.append({
            "scene": name,
            "preset": kind,
            **{n: str(errors.get(n, "not checked")) for n in SHOWN},
            "worst of the others": str(others[worst]),
            "in": worst,
            "not checked": ", ".join(left_out) or "none",
            "time over standard": f"{seconds[kind] / seconds['standard']:.2g}",
        })  # fmt: skip
    return sorted(rows, key=lambda row: list(PRESETS).index(row["preset"]))


def main() -> None:
    options = scenes_parser(__doc__).parse_args()
    tf.keep_memory()
    torch.set_grad_enabled(False)
    rows = []
    for name in options.scene or tf.scenes.READY:
        rows += check(name)
        print(*rows[-3:], sep="\n", flush=True)
    if options.scene:
        return
    with (appendix.RECORDS / "presets.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)
    appendix.add_record("presets", machine())
    print(appendix.write())


if __name__ == "__main__":
    main()

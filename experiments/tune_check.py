"""Does `tune` hold what it promises? On every ready-made scene: the error of the chosen settings in
a run that it has not seen, and what a wider sweep finds.

    OMP_NUM_THREADS=1 python experiments/tune_check.py                         # some twenty minutes; writes its part of docs/accuracy.md, and a CSV
    OMP_NUM_THREADS=1 python experiments/tune_check.py --scene channel --error 3%
    OMP_NUM_THREADS=1 python experiments/tune_check.py --scene channel --out channel.csv       # one after another, or side by side, and then
    python experiments/tune_check.py --gather channel.csv microcolony.csv …                    # the page of what was found

The runs that it has not seen have other seeds: 24 colonies that begin with 100 cells, and 48 that
begin with half as many again. A sweep of six steps (and three finer ones, where none of those holds
the error) with eight settings of contacts and two tolerances of circuits is made in the first. From
the one that took the least time on, those that hold the error there are tried in the second as
well, until one holds it in both: of so many settings some hold it by luck, and some at one size
only. It is timed beside the chosen one, and what that one takes over what the sweep's takes is the
last column.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

import torchfilm as tf
from torchfilm.cli.inspect import parse_error
from torchfilm.tuning.observables import AccuracyProbe, Error, Seen, begin
from torchfilm.tuning.tuner import TIGHT_CONTACTS, Search

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "benchmarks"))
from record import machine, write_page  # noqa: E402

STEPS = (12, 18, 24, 30, 40, 54)
FINER = (72, 96, 128)  # where none of those holds the error
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
)


@dataclass(frozen=True)
class Run:
    """A run that `tune` has not seen, and what is right there."""

    probe: AccuracyProbe
    search: Search
    reference: Seen

    @staticmethod
    def of(scene: tf.Scene, cells: int, colonies: int, seed: int, finest: int) -> Run:
        probe = begin(scene, cells, colonies, seed=seed)
        search = Search(probe, probe, 0.01)
        return Run(
            probe,
            search,
            probe.observed(search.settings(finest, TIGHT_CONTACTS, search.tight)).found,
        )

    def worst(self, settings: tf.Settings, names: Sequence[str]) -> tuple[Error, str, float]:
        """The greatest error, of which observable, and the seconds that the window took."""
        run = self.probe.observed(settings)
        errors = self.probe.errors(run.found, {n: self.reference[n] for n in names})
        name = max(errors, key=lambda n: errors[n].value)
        return errors[name], name, run.seconds

    def seconds(self, settings: tf.Settings) -> float:
        """The least of three."""
        return min(self.probe.observed(settings).seconds for _ in range(3))


def sweep(run: Run, steps: Sequence[int]) -> list[tf.Settings]:
    """All combinations with these steps."""
    search = run.search
    contacts = SWEPT if search.mechanics is not None else (TIGHT_CONTACTS,)
    rtols = RTOLS if search.circuit is not None else (search.tight,)
    return [
        search.settings(n, contact, rtol)
        for n, contact, rtol in itertools.product(steps, contacts, rtols)
    ]


def check(name: str, error: float) -> dict[str, str]:
    """One scene's row."""
    scene = tf.scenes.build(name)
    tuned = tf.tune(scene, error)
    names = tuple(tuned.chosen.errors)
    few, many = Run.of(scene, 100, 24, 5, tuned.finest), Run.of(scene, 150, 48, 6, tuned.finest)
    worst, of, _ = max(
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
        of_best = next(both, None)
        if of_best is not None:
            break
    swept = ("none", "", str(len(found)), str(len(holding)), "")
    if of_best is not None:
        s, its = of_best
        over = few.seconds(tuned.settings) / few.seconds(s)
        swept = (
            words(s),
            str(max(its, found[s][0], key=lambda e: e.value)),
            str(len(found)),
            str(len(holding)),
            f"{over:.2f}",
        )
    told = (name, words(tuned.settings), str(worst), of, *swept)
    return dict(zip(COLUMNS, told, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scene",
        action="append",
        choices=tuple(tf.scenes.READY),
        help="one scene; may be given again",
    )
    parser.add_argument("--error", default="1%")
    parser.add_argument(
        "--out",
        type=Path,
        help="CSV; by default the one beside the benchmarks, and with --scene none",
    )
    parser.add_argument(
        "--page",
        type=Path,
        help="page whose table is written anew; by default docs/accuracy.md, and with --scene none",
    )
    parser.add_argument(
        "--gather",
        nargs="+",
        type=Path,
        default=[],
        help="CSV of scenes that were checked by themselves, for the page",
    )
    chosen = parser.parse_args()
    tf.keep_memory()
    torch.set_grad_enabled(False)
    rows, error = (
        [row for path in chosen.gather for row in csv.DictReader(path.open(newline=""))],
        parse_error(chosen.error),
    )
    for name in () if rows else chosen.scene or tf.scenes.READY:
        rows.append(check(name, error))
        print(rows[-1], flush=True)
    out, page = chosen.out, chosen.page
    if not chosen.scene:
        out, page = (
            out or HERE / "benchmarks" / "accuracy" / "tune.csv",
            page or HERE.parent / "docs" / "accuracy.md",
        )
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("w", newline="") as file:
            table = csv.DictWriter(file, COLUMNS)
            table.writeheader()
            table.writerows(rows)
    if page:
        noted = machine()
        lines = [
            "| " + " | ".join(COLUMNS) + " |",
            "|---" * len(COLUMNS) + "|",
            *("| " + " | ".join(r.values()) + " |" for r in rows),
        ]
        how = (
            f"Asked for {chosen.error}. Measured {noted['date'][:10]} at commit {noted['commit']},"
            f" torch {noted['torch']}, {noted['threads']} thread(s)."
        )
        write_page(page, "\n".join([how, "", *lines]), "tune: experiments/tune_check.py")


if __name__ == "__main__":
    main()

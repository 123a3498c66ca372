"""Which search finds a design with the fewest colonies, and how many designs an hour there are.

    python experiments/benchmarks/search.py methods            # every method on every target at equal numbers of colonies: about an hour on two cores
    python experiments/benchmarks/search.py methods --targets stripe --methods sobol cmaes --seeds 3 --colonies 500
    python experiments/benchmarks/search.py rate               # one design at a time, in batches, and on recorded growth
    python experiments/benchmarks/search.py unseen             # the winners that `methods` found, on 32 seeds that no search has seen

The searches of one method differ by the method's own seed and share the colonies' four seeds; those
of all seeds are evaluated side by side in one batch, so that seconds are a share of a common batch.
A search succeeds when a design's mean loss over its four replicates is at most the target's
threshold. Colonies grown to part of the full size count by that part. Each run is appended to a
JSON file with its machine, versions and commit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from record import machine

import torchfilm as tf
from design import CMAES, Bayesian, DomainSize, Objective, Racing, Sobol, Task

sys.path.insert(0, str(Path(__file__).parents[1]))
import bands
import boundary_stripe
import domain_size
import ring

# scene, parameters, target, colony; the loss that counts as found; searches and colonies each
TARGETS = {
    "stripe": (
        "boundary_detector",
        boundary_stripe.PARAMETERS,
        boundary_stripe.TARGET,
        boundary_stripe.COLONY,
        0.07,
        10,
        2000,
    ),
    "bands": (bands.flag, bands.PARAMETERS, bands.TARGET, bands.COLONY, 0.15, 5, 600),
    "ring": (ring.band_detector, ring.PARAMETERS, ring.TARGET, ring.COLONY, 0.1, 5, 600),
    "domains": (
        "toggle_switch",
        domain_size.PARAMETERS,
        DomainSize(("red", "green"), 12.0),
        domain_size.COLONY,
        0.02,
        5,
        100,
    ),
}
# batches of 24, since a large one costs less a colony; a wide first cloud, since these landscapes
# have more than one valley
CLOUD = {"population": 24, "sigma": 0.5}
METHODS = {
    "sobol": Sobol,
    "cmaes": lambda: CMAES(**CLOUD),
    "cmaes by default": CMAES,
    "racing": lambda: Racing(inner=CMAES(**CLOUD)),
    "bayesian": Bayesian,
}
REPLICATES = 4


class Run:
    """One search among those that are evaluated side by side."""

    def __init__(self, objective: Objective, name: str, seed: int):
        self.method, self.objective = METHODS[name](), objective
        self.method.start(objective.task.space, seed, objective.task.replicates)
        self.colonies, self.seconds, self.loss, self.point = 0.0, 0.0, float("inf"), None
        self.course: list[tuple[float, float, float]] = []

    def tell(self, batch, loss: np.ndarray, seconds: float) -> None:
        self.method.tell(batch, loss)
        count = batch.replicates or self.objective.task.replicates
        self.colonies += len(loss) * count * batch.size
        self.seconds += seconds
        if batch.size == 1.0 and count == self.objective.task.replicates and loss.min() < self.loss:
            self.loss, self.point = float(loss.min()), batch.points[loss.argmin()]
        self.course.append((self.colonies, self.seconds, self.loss))


def together(objective: Objective, runs: list[Run], colonies: int) -> None:
    """Every search until its colonies are spent, the batches of all in one."""
    while open_runs := [r for r in runs if r.colonies < colonies]:
        groups: dict[tuple[float, int], list] = {}
        for run in open_runs:
            batch = run.method.ask()
            groups.setdefault(
                (batch.size, batch.replicates or objective.task.replicates), []
            ).append((run, batch))
        for (size, count), mine in groups.items():
            found = objective.evaluate(
                np.concatenate([b.points for _, b in mine]), streams=range(count), size=size
            )
            parts = np.split(found.loss, np.cumsum([len(b.points) for _, b in mine])[:-1])
            for (run, batch), loss in zip(mine, parts, strict=True):
                run.tell(batch, loss, found.seconds * len(loss) / len(found.loss))
        print(
            f"\r{min(r.colonies for r in open_runs):6.0f} of {colonies} colonies, best"
            f" {min(r.loss for r in runs):.4f}",
            end="",
            file=sys.stderr,
            flush=True,
        )
    print("\r" + " " * 60 + "\r", end="", file=sys.stderr)


def objective_of(target: str, **options) -> Objective:
    scene, parameters, wanted, colony, *_ = TARGETS[target]
    return Objective(Task(scene, parameters, wanted, **colony, replicates=REPLICATES, **options))


def methods(options: argparse.Namespace) -> dict:
    """Success, loss and colonies of every method on every target."""
    out: dict = {}
    print(
        f"{'target':<9}{'method':<19}{'found':>7}{'colonies to it':>17}{'loss: median':>14}{'worst':>8}{'seconds a search':>18}"
    )
    for target in options.targets:
        *_, threshold, seeds, colonies = TARGETS[target]
        seeds, colonies = options.seeds or seeds, options.colonies or colonies
        objective = objective_of(target)
        for name in options.methods:
            runs = [Run(objective, name, seed) for seed in range(seeds)]
            together(objective, runs, colonies)
            needed = [next((c for c, _, loss in r.course if loss <= threshold), None) for r in runs]
            reached = sorted(n for n in needed if n is not None)
            out.setdefault(target, {})[name] = {
                "threshold": threshold,
                "colonies": colonies,
                "needed": needed,
                "loss": [r.loss for r in runs],
                "seconds": [r.seconds for r in runs],
                "best": [objective.task.space.values(r.point) for r in runs],
                "course": [r.course for r in runs],
            }
            middle = f"{np.median([n if n is not None else np.inf for n in needed]):.0f}"
            losses = [r.loss for r in runs]
            print(
                f"{target:<9}{name:<19}{len(reached):>4} of"
                f" {seeds:<2}{middle:>14}{np.median(losses):>14.4f}{max(losses):>8.4f}"
                f"{np.mean([r.seconds for r in runs]):>18.1f}",
                flush=True,
            )
    return out


def unseen(options: argparse.Namespace) -> dict:
    """The best design of each search on record on 32 seeds that it was not searched on."""
    known: dict = {}
    for record in json.loads(options.out.read_text()):
        for target, found in record.get("methods", {}).items():
            known.setdefault(target, {}).update(found)
    out: dict = {}
    for target, found in known.items():
        objective = objective_of(target)
        for name, record in found.items():
            points = np.array([objective.task.space.point(values) for values in record["best"]])
            losses = objective.evaluate(points, streams=range(100, 132)).losses
            out.setdefault(target, {})[name] = losses.mean(1).tolist()
            held = int((losses.mean(1) <= record["threshold"]).sum())
            print(
                f"{target:<9}{name:<19}searched {np.median(record['loss']):.4f}, unseen"
                f" {np.median(losses.mean(1)):.4f}, {held} of {len(points)} hold",
                flush=True,
            )
    return out


def rate(options: argparse.Namespace) -> dict:
    """Designs an hour: one at a time, in batches, and in batches on recorded growth."""
    out: dict = {}
    for cells in options.cells:
        for title, count, replay in (
            ("one at a time", 1, False),
            ("batch", options.designs, False),
            ("batch on recorded growth", options.designs, True),
        ):
            scene, parameters, wanted, colony, *_ = TARGETS["stripe"]
            task = Task(
                scene,
                parameters,
                wanted,
                **{**colony, "cells": cells},
                replicates=REPLICATES,
                replay=replay,
            )
            objective = Objective(task)
            points = np.random.default_rng(0).random((count, objective.task.space.size))
            if replay:
                objective.evaluate(points[:1])  # grow the course: once for a whole search
            begun = time.perf_counter()
            objective.evaluate(points)
            seconds = time.perf_counter() - begun
            out.setdefault(str(cells), {})[title] = {
                "designs": count,
                "seconds": seconds,
                "designs_an_hour": 3600 * count / seconds,
            }
            print(
                f"{cells:>5} cells, {title:<26}{count:>4} designs × {REPLICATES} in {seconds:7.2f}"
                f" s: {3600 * count / seconds:9.0f} designs an hour",
                flush=True,
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("methods", "unseen", "rate"))
    parser.add_argument("--targets", nargs="*", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument(
        "--methods", nargs="*", choices=list(METHODS), default=["sobol", "cmaes", "racing"]
    )
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--colonies", type=int)
    parser.add_argument("--cells", type=int, nargs="*", default=[100, 500])
    parser.add_argument("--designs", type=int, default=64)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    tf.keep_memory()
    found = {"methods": methods, "unseen": unseen, "rate": rate}[options.part](options)
    kept = json.loads(options.out.read_text()) if options.out.exists() else []
    options.out.write_text(json.dumps([*kept, {**machine(), options.part: found}], indent=1) + "\n")


if __name__ == "__main__":
    main()

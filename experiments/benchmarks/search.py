"""Compares search methods by the colonies that they need, and measures designs per hour.

    python experiments/benchmarks/search.py methods    # about an hour on two cores
    python experiments/benchmarks/search.py methods --targets stripe --methods sobol cmaes --seeds 3
    python experiments/benchmarks/search.py rate
    python experiments/benchmarks/search.py unseen

`methods` runs every method on every target with equal numbers of colonies. `rate` measures designs
per hour: one design at a time, in batches, and on recorded growth. `unseen` scores the designs that
`methods` found on 32 seeds that no search has used.

The searches of one method differ by the seed of the method and share four seeds of the colonies.
One batch evaluates all of them together, so their seconds are shares of a common batch. A search
succeeds when the mean loss of a design over its four replicates is at most the threshold of the
target. A colony grown to a fraction of the full size counts as that fraction. The script appends
each run to a JSON file with its machine, versions and commit.
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

# scene, parameters, target, colony, threshold of the loss, searches, colonies of each
TARGETS = {
    "stripe": (
        "boundary_detector",
        boundary_stripe.PARAMETERS,
        boundary_stripe.TARGET,
        {"cells": 100, "dt": 0.05, "fixed": {"width": 16.0, "rtol": 1e-2}},
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
# Batches of 24, because a large batch costs less per colony; a wide initial distribution, because
# the losses have several minima.
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
    """One search of those that share batches."""

    def __init__(self, objective: Objective, name: str, seed: int):
        self.method, self.objective = METHODS[name](), objective
        self.method.start(objective.task.space, seed, objective.task.replicates)
        self.colonies, self.seconds, self.loss, self.point = 0.0, 0.0, float("inf"), None
        self.history: list[tuple[float, float, float]] = []

    def tell(self, batch, loss: np.ndarray, seconds: float) -> None:
        """Passes the losses of a batch to the method and notes the best design."""
        self.method.tell(batch, loss)
        count = batch.replicates or self.objective.task.replicates
        self.colonies += len(loss) * count * batch.size
        self.seconds += seconds
        if batch.size == 1.0 and count == self.objective.task.replicates and loss.min() < self.loss:
            self.loss, self.point = float(loss.min()), batch.points[loss.argmin()]
        self.history.append((self.colonies, self.seconds, self.loss))


def together(objective: Objective, runs: list[Run], colonies: int) -> None:
    """Runs all searches until each has used its colonies, with joint batches."""
    while open_runs := [r for r in runs if r.colonies < colonies]:
        groups: dict[tuple[float, int], list] = {}
        for run in open_runs:
            batch = run.method.ask()
            groups.setdefault(
                (batch.size, batch.replicates or objective.task.replicates), []
            ).append((run, batch))
        for (size, count), members in groups.items():
            found = objective.evaluate(
                np.concatenate([b.points for _, b in members]), streams=range(count), size=size
            )
            parts = np.split(found.loss, np.cumsum([len(b.points) for _, b in members])[:-1])
            for (run, batch), loss in zip(members, parts, strict=True):
                run.tell(batch, loss, found.seconds * len(loss) / len(found.loss))
        print(
            f"\r{min(r.colonies for r in open_runs):6.0f} of {colonies} colonies, best"
            f" {min(r.loss for r in runs):.4f}",
            end="",
            file=sys.stderr,
            flush=True,
        )
    print("\r" + " " * 60 + "\r", end="", file=sys.stderr)


def objective_of(name: str) -> Objective:
    """Returns the objective of a target."""
    scene, parameters, target, colony, *_ = TARGETS[name]
    return Objective(Task(scene, parameters, target, **colony, replicates=REPLICATES))


def methods(options: argparse.Namespace) -> dict:
    """Returns success, loss and colonies of every method on every target."""
    out: dict = {}
    print(
        f"{'target':<9}{'method':<19}{'found':>7}{'colonies':>17}{'median loss':>14}"
        f"{'worst':>8}{'s per search':>18}"
    )
    for target in options.targets:
        *_, threshold, seeds, colonies = TARGETS[target]
        seeds, colonies = options.seeds or seeds, options.colonies or colonies
        objective = objective_of(target)
        for name in options.methods:
            runs = [Run(objective, name, seed) for seed in range(seeds)]
            together(objective, runs, colonies)
            needed = [
                next((c for c, _, loss in r.history if loss <= threshold), None) for r in runs
            ]
            reached = sorted(n for n in needed if n is not None)
            out.setdefault(target, {})[name] = {
                "threshold": threshold,
                "colonies": colonies,
                "needed": needed,
                "loss": [r.loss for r in runs],
                "seconds": [r.seconds for r in runs],
                "best": [objective.task.space.values(r.point) for r in runs],
                "course": [r.history for r in runs],
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
    """Scores the best design of each recorded search on 32 seeds that the search did not use."""
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
                f"{target:<9}{name:<19}search seeds {np.median(record['loss']):.4f}, new seeds"
                f" {np.median(losses.mean(1)):.4f}, {held} of {len(points)} hold",
                flush=True,
            )
    return out


def rate(options: argparse.Namespace) -> dict:
    """Returns designs per hour: one at a time, in batches, and in batches on recorded growth."""
    out: dict = {}
    for cells in options.cells:
        for title, count, replay in (
            ("one at a time", 1, False),
            ("batch", options.designs, False),
            ("batch on recorded growth", options.designs, True),
        ):
            scene, parameters, target, colony, *_ = TARGETS["stripe"]
            task = Task(
                scene,
                parameters,
                target,
                **{**colony, "cells": cells},
                replicates=REPLICATES,
                replay=replay,
            )
            objective = Objective(task)
            points = np.random.default_rng(0).random((count, objective.task.space.size))
            if replay:
                objective.evaluate(points[:1])  # records the growth, once for a whole search
            begin = time.perf_counter()
            objective.evaluate(points)
            seconds = time.perf_counter() - begin
            out.setdefault(str(cells), {})[title] = {
                "designs": count,
                "seconds": seconds,
                "designs_an_hour": 3600 * count / seconds,
            }
            print(
                f"{cells:>5} cells, {title:<26}{count:>4} designs × {REPLICATES} in {seconds:7.2f}"
                f" s: {3600 * count / seconds:9.0f} designs per hour",
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

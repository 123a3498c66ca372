"""Compares search methods on eight tasks by the colonies that they need, asks what small colonies
and few replicates say of a design, and measures designs per hour.

    python experiments/benchmarks/search.py tasks      # an hour or two on two cores
    python experiments/benchmarks/search.py tasks --tasks stripe ring --methods auto --seeds 3
    python experiments/benchmarks/search.py tasks --methods auto --stop    # minutes
    python experiments/benchmarks/search.py tasks --methods racing bayesian modelled --seeds 2
    python experiments/benchmarks/search.py ranks --tasks "domain size"
    python experiments/benchmarks/search.py data --methods gauss-newton bayesian --colonies 400
    python experiments/benchmarks/search.py rate

`tasks` runs searches that differ by their seed: random starts and random colonies. Each has 2,000
colonies, finals included. The best design so far, at every batch that improved it, is grown on 16
seeds that no search uses. Colonies to success are those simulated when it first held the threshold
there; a search succeeds where the design that it returns holds it. With `--stop` a search ends as
soon as a design holds the threshold on fresh seeds of its own, by the same course until then, so
that this number alone takes a tenth of the time. `tasks.py` has the tasks and
says how the thresholds were set. `ranks` grows Sobol designs at several sizes with several
replicates, and compares their order with that in 16 other colonies of full size. `data` fits the
four parameters of `fit_colony.py` to colonies of 3.5 h. `rate` measures designs per hour: one
design at a time, in batches, and on recorded growth. The script appends each run to a JSON file
with its machine, versions and commit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from fits import FITS
from record import machine
from scipy.stats import kendalltau
from tasks import CELLS, REPLICATES, SHARE, TASKS, UNSEEN, SearchTask

import torchfilm as tf
from design import CMAES, Bayesian, GaussNewton, Local, Objective, Racing, Search, Sobol, Task
from design.methods.base import sobol_points
from design.trivial import trivial_losses

sys.path.insert(0, str(Path(__file__).parents[1]))
from arguments import out_file, whole

# Batches of 24, because a large batch costs less per colony; a wide initial distribution, because
# the losses have several minima.
CLOUD = {"population": 24, "sigma": 0.5}
METHODS = {
    "auto": lambda: "auto",
    "sobol": lambda: Sobol(batch=24),
    "cmaes": lambda: CMAES(**CLOUD),
    "racing": lambda: Racing(inner=CMAES(**CLOUD)),
    "bayesian": lambda: Bayesian(batch=6),
    "modelled": lambda: Racing(inner=Bayesian(batch=6)),
    "gauss-newton": GaussNewton,
    "local": Local,
}


def threshold(task: SearchTask) -> float:
    """The loss of a success: a share of the best trivial answer in the middle of the space."""
    checked = task.task()
    objective = Objective(checked)
    middle = np.full(checked.space.size, 0.5)
    found = objective.colonies(middle, streams=UNSEEN)
    return SHARE * min(trivial_losses(checked.target, found).values())


def improvements(search: Search) -> list[tuple[float, np.ndarray]]:
    """The best design after each batch that improved it: colonies simulated, and its point."""
    out, best, spent = [], np.inf, 0.0
    for entry in search.study.entries:
        spent += entry.colonies
        if search.study.is_full(entry) and entry.loss.min() < best:
            best = float(entry.loss.min())
            out.append((spent, entry.points[entry.loss.argmin()]))
    return out


def one_search(
    task: SearchTask, method: str, seed: int, colonies: int, wanted: float, stop: bool
) -> dict:
    """Returns the outcome of one search, on seeds that it never saw."""
    begin = time.perf_counter()
    search = Search(**task.options(), method=METHODS[method](), seed=seed)
    best = search.run(colonies, stop_at=wanted if stop else None, progress=False)
    seconds = time.perf_counter() - begin
    course = improvements(search)
    points = np.array([*(point for _, point in course), best.point])
    losses = search.objective.evaluate(points, streams=UNSEEN).loss
    held = [spent for (spent, _), loss in zip(course, losses[:-1], strict=True) if loss <= wanted]
    return {
        "seed": seed,
        "needed": min(held, default=None),
        "success": bool(losses[-1] <= wanted),
        "unseen": float(losses[-1]),
        "searched": best.searched_loss,
        "band": best.band,
        "seconds": seconds,
        "values": best.values,
        "course": [[spent, float(x)] for (spent, _), x in zip(course, losses, strict=False)],
    }


def tasks(options: argparse.Namespace) -> dict:
    """Returns the outcomes of every method on every task."""
    out: dict = {}
    print(
        f"{'task':<20}{'threshold':>10}  {'method':<8}{'held':>8}{'colonies':>10}{'unseen':>9}"
        f"{'s a search':>12}"
    )
    for name in options.tasks:
        task = TASKS[name]
        wanted = threshold(task)
        out[name] = {"threshold": wanted, "cells": CELLS, "colonies": options.colonies}
        out[name]["stop"] = options.stop
        for method in options.methods:
            runs = [
                one_search(task, method, seed, options.colonies, wanted, options.stop)
                for seed in range(options.first, options.first + options.seeds)
            ]
            out[name][method] = runs
            needed = [np.inf if r["needed"] is None else r["needed"] for r in runs]
            print(
                f"{name:<20}{wanted:>10.4f}  {method:<8}{sum(r['success'] for r in runs):>3} of"
                f" {len(runs):<2}{np.median(needed):>9.0f}"
                f"{np.median([r['unseen'] for r in runs]):>9.4f}"
                f"{np.mean([r['seconds'] for r in runs]):>12.1f}",
                flush=True,
            )
    return out


def ranks(options: argparse.Namespace) -> dict:
    """Returns, of each task, what losses at each size and with as many replicates say of designs:
    Kendall's tau with the mean of 16 other colonies of full size, and that mean for the design with
    the lowest loss; means over all groups of so many replicates."""
    out: dict = {}
    for name in options.tasks:
        objective = Objective(TASKS[name].task())
        points = sobol_points(objective.task.space, 7, 0, options.designs)
        true = objective.evaluate(points, streams=UNSEEN).loss
        for size in (0.25, 0.5, 1.0):
            losses = objective.evaluate(points, streams=range(16), size=size).losses
            for count in (1, 4, 8, 16):
                groups = losses.reshape(len(points), -1, count).mean(2).T
                tau = float(np.mean([kendalltau(group, true).statistic for group in groups]))
                picked = float(np.mean([true[group.argmin()] for group in groups]))
                found = {"tau": tau, "picked": picked, "best": float(true.min())}
                out.setdefault(name, {})[f"size {size:g}, {count} replicates"] = found
                print(
                    f"{name}, size {size:g}, {count:>2} replicates: tau {tau:.2f}, the best of"
                    f" {len(points)} designs has {picked:.3f} in truth (of {true.min():.3f})",
                    flush=True,
                )
    return out


def data(options: argparse.Namespace) -> dict:
    """Returns the losses of fits of each method, in 16 colonies that no search saw, and of the
    hidden parameters there."""
    fit, truth = FITS[options.fit]()
    objective = Objective(fit.task())
    hidden = objective.task.space.point(truth)
    found = objective.evaluate(hidden[None], streams=UNSEEN).loss[0]
    out: dict = {"fit": options.fit, "colonies": options.colonies, "truth": float(found)}
    print(f"{options.fit}: the hidden parameters have a loss of {found:.2f}", flush=True)
    for method in options.methods:
        seeds = range(options.first, options.first + options.seeds)
        out[method] = [one_search(fit, method, k, options.colonies, 0.0, False) for k in seeds]
        losses = " ".join(f"{r['unseen']:.2f}" for r in out[method])
        print(f"{method:<12} {options.colonies} colonies, losses {losses}", flush=True)
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
            stripe = TASKS["stripe"].options() | {"fixed": {"width": 16.0, "rtol": 1e-2}}
            objective = Objective(Task(**stripe | {"cells": cells, "replay": replay}))
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
    parser.add_argument("part", choices=("tasks", "ranks", "data", "rate"))
    parser.add_argument("--tasks", nargs="*", choices=list(TASKS), default=list(TASKS))
    parser.add_argument(
        "--methods", nargs="*", choices=list(METHODS), default=["auto", "sobol", "cmaes"]
    )
    parser.add_argument("--fit", choices=list(FITS), default="four", help="of data")
    parser.add_argument("--seeds", type=whole, default=10)
    parser.add_argument("--first", type=whole, default=1, help="of the seeds")
    parser.add_argument("--colonies", type=whole, default=2000)
    parser.add_argument("--stop", action="store_true", help="at the threshold, on fresh seeds")
    parser.add_argument("--cells", type=whole, nargs="*", default=[100, 500])
    parser.add_argument("--designs", type=whole, default=64)
    parser.add_argument("--threads", type=whole, default=2)
    parser.add_argument("--out", type=out_file, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    tf.keep_memory()
    found = {"tasks": tasks, "ranks": ranks, "data": data, "rate": rate}[options.part](options)
    kept = json.loads(options.out.read_text()) if options.out.exists() else []
    options.out.write_text(json.dumps([*kept, {**machine(), options.part: found}], indent=1) + "\n")


if __name__ == "__main__":
    main()

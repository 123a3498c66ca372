"""What the overlap between cells costs: one colony from one cell, by α, passes, tolerance and kind of contact.

    python experiments/accuracy_mechanics.py --cells 2000

Prints a table in Markdown; docs/mechanics.md holds one of its runs. Time is the whole run's, in seconds.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import torchfilm as tf

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from growth import scene

VARIANTS: dict[str, dict] = {
    "default": {},
    "α = 1/γ (the paper's)": {"alpha": 0.1},
    "α = 0.01/γ": {"alpha": 0.001},
    "1 pass": {"passes": 1},
    "2 passes": {"passes": 2},
    "4 passes": {"passes": 4},
    "tolerance 0.3": {"tolerance": 0.3},
    "tolerance 0.01": {"tolerance": 0.01},
    "unilateral": {"unilateral": True},
}


def run(dim: int, cells: int, settings: dict) -> str:
    base = scene(dim)
    effects = [dataclasses.replace(e, **settings) if isinstance(e, tf.Mechanics) else e for e in base.listed]
    made = tf.Scene(*effects, dt=base.dt)
    iterations, begun = 0, time.perf_counter()
    means, worst = [], 0.0
    for state in tf.simulate(made, made.seed(seed=1), cells=cells):
        iterations += int(state.reports["mechanics"].iterations.max())
        if state.cells > cells // 2 and state.step % 10 == 0:
            found = tf.measure.overlaps(state)
            means.append(float(found.mean))
            worst = max(worst, float(found.worst))
    seconds = time.perf_counter() - begun
    return f"{sum(means) / len(means):.4f} | {worst:.2f} | {iterations / state.step:.0f} | {seconds:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=2000)
    parser.add_argument("--dim", type=int, choices=(2, 3), action="append")
    chosen = parser.parse_args()
    tf.keep_memory()
    for dim in chosen.dim or (2, 3):
        print(f"\n| {dim}-D, to {chosen.cells} cells | mean overlap, µm | worst, µm | CG iterations a step | time, s |\n|---|---|---|---|---|")
        for name, settings in VARIANTS.items():
            print(f"| {name} | {run(dim, chosen.cells, settings)} |", flush=True)


if __name__ == "__main__":
    main()

"""Measures the time of growth: one colony to N cells, and B colonies to N cells each.

    python experiments/benchmarks/growth.py                     # the full set, some minutes
    python experiments/benchmarks/growth.py --quick             # small sizes
    python experiments/benchmarks/growth.py --case 2d-32000 --device cuda
    python experiments/benchmarks/growth.py --case 2d-32x1000 --processes 2     # one per core
    python experiments/benchmarks/growth.py --case 2d-32x1000 --tolerance 0.2   # as in draft

Colonies grow in 2-D and in 3-D between agarose and coverslip. Growth 1/h by the length law,
Δt 0.025 h, division at 3.5–4.0 µm, μ = 1, γ = 10, α = 0.1/γ; other settings are the defaults. The
script appends each case to a JSON file with its machine, versions and commit. `floor_seconds` is a
lower bound of the solver's time: the time to read the contact rows once for every product with J or
its transpose, at the speed at which this machine copies memory.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import torch
from record import machine

import torchfilm as tf
from torchfilm.physics.jacobian import ContactJacobian

CASES = {
    "2d-3000": (2, 1, 3000), "2d-10000": (2, 1, 10000), "2d-32000": (2, 1, 32000),
    "3d-3000": (3, 1, 3000), "3d-10000": (3, 1, 10000), "3d-32000": (3, 1, 32000),
    "2d-32x1000": (2, 32, 1000), "3d-32x1000": (3, 32, 1000),
}  # fmt: skip
QUICK = ("2d-3000", "3d-3000")


def scene(dim: int) -> tf.Scene:
    """Returns the scene in the plane or in space."""
    walls = (
        []
        if dim == 2
        else [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]
    )
    return tf.Scene(
        tf.Growth(rate=1.0, law="length"),
        tf.Division(length=tf.Uniform(3.5, 4.0)),
        tf.Mechanics(dim=dim, walls=walls),
        dt=0.025,
        name=f"growth {dim}-D",
    )


class RowCounter:
    """Counts the bytes of contact rows that products with J and its transpose read."""

    def __init__(self) -> None:
        self.bytes, self.products = 0, 0
        self._apply, self._transpose = ContactJacobian.apply, ContactJacobian.apply_transpose

    def __enter__(self) -> RowCounter:
        def counted(method):
            def call(rows, x):
                self.products += 1
                self.bytes += rows.row_first.nbytes + rows.row_second.nbytes + rows.row_wall.nbytes
                return method(rows, x)

            return call

        ContactJacobian.apply, ContactJacobian.apply_transpose = (
            counted(self._apply),
            counted(self._transpose),
        )
        return self

    def __exit__(self, *_: object) -> None:
        ContactJacobian.apply, ContactJacobian.apply_transpose = self._apply, self._transpose


def copy_speed(device: str) -> float:
    """Returns the speed of a copy of 16 MB, bytes read per second, best of 20."""
    source = torch.ones(4_000_000, device=device)
    target, best = torch.empty_like(source), float("inf")
    for _ in range(20):
        start = time.perf_counter()
        target.copy_(source)
        if source.is_cuda:
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - start)
    return source.nbytes / best


def grow(
    name: str, device: str, seed: int, tolerance: float | None, part: tuple[int, int] = (0, 1)
) -> dict:
    """Runs a case, or part k of n of its colonies. Returns costs and results."""
    dim, colonies, cells = CASES[name]
    tuned = tf.Settings(tolerance=tolerance).apply(scene(dim))
    k, parts = part
    model = tuned.bind(colonies=colonies, seed=seed, device=device)
    start = model.start().select(range(k * colonies // parts, (k + 1) * colonies // parts))
    timings, marks, iterations, passes, cell_steps = tf.Timings(), [], 0, 0, 0
    begin = time.perf_counter()
    with RowCounter() as counter:
        for state in tf.simulate(tuned, start, cells=cells, timings=timings):
            report = state.reports["mechanics"]
            iterations += int(report.iterations.max())
            passes += int(report.passes.max())
            cell_steps += state.cells
            if state.cells >= 100 * 2 ** len(marks) * state.colonies:
                marks.append(
                    {
                        "cells": state.cells,
                        "seconds": round(time.perf_counter() - begin, 2),
                        "time_h": round(state.time, 3),
                    }
                )
    seconds = time.perf_counter() - begin
    found = tf.measure.overlaps(state)
    return {
        "cells": state.cells,
        "colonies": state.colonies,
        "seconds": seconds,
        "simulated_h": round(state.time, 3),
        "steps": state.step,
        "cell_steps": cell_steps,
        "cg_iterations": iterations,
        "passes": passes,
        "effects_s": {k: round(v, 2) for k, v in timings.seconds.items()},
        "overlap_sum_um": float((found.mean * found.count).sum()),
        "contacts": int(found.count.sum()),
        "overlap_worst_um": round(float(found.worst.max()), 4),
        "depth_um": round(float(tf.measure.depth(state).max()), 2),
        "radius_um": round(float(tf.measure.colony_radius(state).mean()), 1),
        "products": counter.products,
        "bytes": counter.bytes,
        "marks": marks,
    }


def one_thread() -> None:
    """Prepares a worker process."""
    torch.set_num_threads(1)
    tf.keep_memory()


def in_processes(
    name: str, device: str, seed: int, tolerance: float | None, processes: int
) -> list[dict]:
    """Runs a case in several processes of one thread, each with its own colonies.

    Returns the results of each; the first has the total time.
    """
    with ProcessPoolExecutor(processes, get_context("spawn"), one_thread) as pool:
        list(pool.map(time.sleep, [1.0] * processes))  # until all have started
        begin = time.perf_counter()
        parts = list(
            pool.map(
                partial(grow, name, device, seed, tolerance),
                [(k, processes) for k in range(processes)],
            )
        )
    return [parts[0] | {"seconds": time.perf_counter() - begin}, *parts[1:]]


def run(name: str, device: str, seed: int, tolerance: float | None, processes: int) -> dict:
    """Returns the totals of all parts and the details of the part with most work."""
    parts = (
        [grow(name, device, seed, tolerance)]
        if processes == 1
        else in_processes(name, device, seed, tolerance, processes)
    )
    total = lambda name: sum(p[name] for p in parts)
    seconds = parts[0]["seconds"]
    totals = {
        "case": name,
        "device": device,
        "processes": processes,
        "tolerance": tolerance,
        "cells": total("cells"),
        "colonies": total("colonies"),
        "seconds": round(seconds, 2),
        "cell_steps": total("cell_steps"),
        "us_per_cell_step": round(1e6 * seconds / total("cell_steps"), 2),
        "overlap_mean_um": round(total("overlap_sum_um") / max(1, total("contacts")), 5),
        "overlap_worst_um": max(p["overlap_worst_um"] for p in parts),
        "floor_seconds": round(total("bytes") / copy_speed(device), 3),
    }
    longest = max(parts, key=lambda p: p["cell_steps"])
    return totals | {
        k: v
        for k, v in longest.items()
        if k not in (*totals, "overlap_sum_um", "contacts", "bytes")
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--case", action="append", choices=sorted(CASES), help="one case; may be repeated"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--tolerance", type=float, help="of the contact solve; default: that of Mechanics, 0.05"
    )
    parser.add_argument(
        "--processes",
        type=int,
        default=1,
        help="number of processes that share the colonies, one thread each",
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("growth.json"))
    options = parser.parse_args()
    tf.keep_memory()
    records = json.loads(options.out.read_text()) if options.out.exists() else []
    for name in options.case or (QUICK if options.quick else CASES):
        result = run(
            name,
            options.device,
            options.seed,
            options.tolerance,
            min(options.processes, CASES[name][1]),
        )
        print(
            f"{name:<12} {result['seconds']:>7.1f} s  {result['cells']:>6} cells "
            f" {result['steps']:>5} steps  {result['us_per_cell_step']:>6.2f} µs/cell/step  overlap"
            f" {result['overlap_mean_um']:.4f} / {result['overlap_worst_um']:.3f} µm  CG"
            f" {result['cg_iterations'] / result['steps']:.1f} a step  floor"
            f" {result['floor_seconds']:.1f} s  {result['effects_s']}",
            flush=True,
        )
        records.append(machine() | result)
        options.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

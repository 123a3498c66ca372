"""How long growth takes: one colony to N cells, and B colonies to N cells each, in 2-D and in 3-D
between agarose and coverslip.

    python experiments/benchmarks/growth.py                     # the full set, some minutes
    python experiments/benchmarks/growth.py --quick             # small sizes
    python experiments/benchmarks/growth.py --case 2d-32000 --device cuda
    python experiments/benchmarks/growth.py --case 2d-32x1000 --processes 2     # its colonies in batches, one on each core
    python experiments/benchmarks/growth.py --case 2d-32x1000 --tolerance 0.2   # the contact solve of the draft preset

Growth 1/h by the length law, Δt 0.025 h, division at 3.5–4.0 µm, μ = 1, γ = 10, α = 0.1/γ;
everything else is the default. Each case is appended to a JSON file with its machine, versions and
commit. `floor_seconds` is the least that the solver could take: the contact rows read once for
every product with J or its transpose, at the speed at which this machine copies memory.
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
    """Counts bytes of contact rows that products with J and its transpose read."""

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
    """Bytes read per second by a plain copy of 16 MB, best of 20."""
    source = torch.ones(4_000_000, device=device)
    target, best = torch.empty_like(source), float("inf")
    for _ in range(20):
        begun = time.perf_counter()
        target.copy_(source)
        if source.is_cuda:
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - begun)
    return source.nbytes / best


def grow(
    name: str, device: str, seed: int, tolerance: float | None, part: tuple[int, int] = (0, 1)
) -> dict:
    """The case, or of its colonies the k-th of n parts, to the end: what it took and what came of
    it."""
    dim, colonies, cells = CASES[name]
    made = tf.Settings(tolerance=tolerance).apply(scene(dim))
    k, parts = part
    start = made.seed(colonies, seed=seed, device=device).select(
        range(k * colonies // parts, (k + 1) * colonies // parts)
    )
    timings, marks, iterations, passes, cell_steps = tf.Timings(), [], 0, 0, 0
    begun = time.perf_counter()
    with RowCounter() as counter:
        for state in tf.simulate(made, start, cells=cells, timings=timings):
            report = state.reports["mechanics"]
            iterations += int(report.iterations.max())
            passes += int(report.passes.max())
            cell_steps += state.cells
            if state.cells >= 100 * 2 ** len(marks) * state.colonies:
                marks.append(
                    {
                        "cells": state.cells,
                        "seconds": round(time.perf_counter() - begun, 2),
                        "time_h": round(state.time, 3),
                    }
                )
    seconds = time.perf_counter() - begun
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
    torch.set_num_threads(1)
    tf.keep_memory()


def side_by_side(
    name: str, device: str, seed: int, tolerance: float | None, processes: int
) -> list[dict]:
    """The case in as many processes of one thread, each with its own colonies; the first of them
    says how long all took."""
    with ProcessPoolExecutor(processes, get_context("spawn"), one_thread) as pool:
        list(pool.map(time.sleep, [1.0] * processes))  # till all have started
        begun = time.perf_counter()
        parts = list(
            pool.map(
                partial(grow, name, device, seed, tolerance),
                [(k, processes) for k in range(processes)],
            )
        )
    return [parts[0] | {"seconds": time.perf_counter() - begun}, *parts[1:]]


def run(name: str, device: str, seed: int, tolerance: float | None, processes: int) -> dict:
    """What all parts come to together, and how it went in the one with most to do."""
    parts = (
        [grow(name, device, seed, tolerance)]
        if processes == 1
        else side_by_side(name, device, seed, tolerance, processes)
    )
    all_of = lambda what: sum(p[what] for p in parts)
    seconds = parts[0]["seconds"]
    together = {
        "case": name,
        "device": device,
        "processes": processes,
        "tolerance": tolerance,
        "cells": all_of("cells"),
        "colonies": all_of("colonies"),
        "seconds": round(seconds, 2),
        "cell_steps": all_of("cell_steps"),
        "us_per_cell_step": round(1e6 * seconds / all_of("cell_steps"), 2),
        "overlap_mean_um": round(all_of("overlap_sum_um") / max(1, all_of("contacts")), 5),
        "overlap_worst_um": max(p["overlap_worst_um"] for p in parts),
        "floor_seconds": round(all_of("bytes") / copy_speed(device), 3),
    }
    longest = max(parts, key=lambda p: p["cell_steps"])
    return together | {
        k: v
        for k, v in longest.items()
        if k not in (*together, "overlap_sum_um", "contacts", "bytes")
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--case", action="append", choices=sorted(CASES), help="one case; may be given again"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--tolerance",
        type=float,
        help="of the contact solve, by default what Mechanics takes, 0.05",
    )
    parser.add_argument(
        "--processes",
        type=int,
        default=1,
        help="to share a case's colonies among, each on one thread",
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("growth.json"))
    chosen = parser.parse_args()
    tf.keep_memory()
    records = json.loads(chosen.out.read_text()) if chosen.out.exists() else []
    for name in chosen.case or (QUICK if chosen.quick else CASES):
        result = run(
            name,
            chosen.device,
            chosen.seed,
            chosen.tolerance,
            min(chosen.processes, CASES[name][1]),
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
        chosen.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

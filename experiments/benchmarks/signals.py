"""How long a step of transport takes, and how far each method is from the exact lattice solution.

    OMP_NUM_THREADS=2 python experiments/benchmarks/signals.py               # 32³, 64³ and 128³, a minute or so
    python experiments/benchmarks/signals.py --size 64 --method exponential --device cuda

A unit amount is set free in the middle voxel of n³, K = 1 µm²/h, h = 1 µm, no flux through the
faces. A step is r = K Δt/h² = 1/4; the error is the greatest after 4 steps (τ = 1), over the exact
value at the centre, 0.0293630. `implicit, mask` has one voxel in ten blocked, and no exact
solution. Times are of one step of one signal in one colony: the least and the median of many. Each
run is appended to a JSON file with its machine, versions and commit.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections import deque
from pathlib import Path

import numpy as np
import torch
from record import machine
from scipy.special import ive

import torchfilm as tf
from torchfilm.signals.assembly import build_operator
from torchfilm.signals.iterative import convolve
from torchfilm.signals.operator import Operator, apply
from torchfilm.signals.transport import METHODS, prepare

SIZES = (32, 64, 128)
CASES = (*METHODS, "implicit, mask", "apply", "conv3d")
R, STEPS = 0.25, 4
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def exact(n: int) -> np.ndarray:
    """Π e^{−2τ} I_k(2τ) at τ = R·STEPS, (n, n, n); far walls do not matter yet."""
    one = ive(np.abs(np.arange(n) - n // 2), 2 * R * STEPS)
    return one[:, None, None] * one[None, :, None] * one[None, None, :]


def timed(act, device: str, seconds: float) -> tuple[float, float, int]:
    """Least and median ms of `act`, repeated for about so long, and how often."""
    act()
    taken: list[float] = []
    end = time.perf_counter() + seconds
    while len(taken) < 5 or (time.perf_counter() < end and len(taken) < 500):
        begun = time.perf_counter()
        act()
        if device == "cuda":
            torch.cuda.synchronize()
        taken.append(1e3 * (time.perf_counter() - begun))
    return min(taken), statistics.median(taken), len(taken)


def box(n: int, case: str, dtype: torch.dtype, device: str) -> Operator:
    mask = None
    if case.endswith("mask"):
        mask = (torch.rand(n, n, n, generator=torch.Generator().manual_seed(1)) > 0.1).to(device)
    return build_operator(
        (n, n, n), (1.0, 1.0, 1.0), diffusion=1.0, mask=mask, dtype=dtype, device=device
    )


def run(n: int, case: str, dtype: torch.dtype, device: str, seconds: float) -> dict:
    made = box(n, case, dtype, device)
    u = torch.zeros(1, n, n, n, dtype=dtype, device=device)
    u[0, n // 2, n // 2, n // 2] = 1.0
    spread = torch.rand(1, n, n, n, generator=torch.Generator().manual_seed(2)).to(device, dtype)
    record = {
        "case": "transport",
        "size": n,
        "method": case,
        "dtype": str(dtype).removeprefix("torch."),
        "device": device,
        "r": R,
    }
    if case in ("apply", "conv3d"):
        rate = apply if case == "apply" else convolve
        least, median, count = timed(lambda: rate(made, spread), device, seconds)
        return record | {
            "least_ms": round(least, 4),
            "median_ms": round(median, 4),
            "repeats": count,
        }
    begun = time.perf_counter()
    stepper = prepare(made, R, case.split(",")[0])
    record["prepare_ms"] = round(1e3 * (time.perf_counter() - begun), 2)
    least, median, count = timed(lambda: stepper.step(spread), device, seconds)
    record |= {"least_ms": round(least, 4), "median_ms": round(median, 4), "repeats": count}
    for _ in range(STEPS):
        u = stepper.step(u)
    found = u[0].double().cpu().numpy()
    record |= {"lowest": float(found.min()), "amount_error": float(found.sum() - 1)}
    if made.mask is None:
        expected = exact(n)
        record["error"] = float(np.abs(found - expected).max() / expected.max())
    return record


def row(record: dict) -> str:
    error = f"{record['error']:.1e}" if "error" in record else "-"
    lowest, amount = (
        f"{record[k]:.1e}" if k in record else "-" for k in ("lowest", "amount_error")
    )
    return (
        f"{record['size']:>4}³ {record['method']:<15} {record['least_ms']:>9.3f}"
        f" {record['median_ms']:>9.3f} {error:>9} {lowest:>9} {amount:>9}"
    )


def transport(chosen: argparse.Namespace) -> list[dict]:
    """Every method at every size."""
    records = []
    print(
        f"     {'method':<15} {'least ms':>9} {'median':>9} {'error':>9} {'lowest':>9}"
        f" {'amount':>9}   {chosen.dtype}, {torch.get_num_threads()} threads"
    )
    for n in chosen.size or SIZES:
        for case in chosen.method or CASES:
            records.append(run(n, case, DTYPES[chosen.dtype], chosen.device, chosen.seconds))
            print(row(records[-1]), flush=True)
    return records


def band(chosen: argparse.Namespace) -> list[dict]:
    """The paper's Fig. 5 from two founders: circuits in every cell, AHL on a grid, contacts in a
    channel."""
    scene, timings = tf.scenes.boundary_detector(), tf.Timings()
    begun = time.perf_counter()
    start = scene.seed(1, seed=0, dtype=DTYPES[chosen.dtype], device=chosen.device)
    state = deque(tf.simulate(scene, start, cells=chosen.cells, timings=timings), maxlen=1).pop()
    seconds = time.perf_counter() - begun
    shares = {k: round(v, 2) for k, v in timings.seconds.items()}
    print(
        f"Fig. 5 to {state.cells} cells: {seconds:.1f} s, {state.step} steps, {state.time:g} h;"
        f" {shares}"
    )
    return [
        {
            "method": "fig5",
            "cells": state.cells,
            "steps": state.step,
            "simulated_h": state.time,
            "seconds": round(seconds, 2),
            "effects_s": shares,
        }
    ]


PARTS = {"transport": transport, "band": band}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--size", action="append", type=int, help="voxels along an edge; may be given again"
    )
    parser.add_argument(
        "--method", action="append", choices=CASES, help="one method; may be given again"
    )
    parser.add_argument("--dtype", default="float32", choices=sorted(DTYPES))
    parser.add_argument(
        "--part", action="append", choices=sorted(PARTS), help="one part; may be given again"
    )
    parser.add_argument("--cells", type=int, default=5000, help="of Fig. 5")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long to repeat each")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("signals.json"))
    chosen = parser.parse_args()
    tf.keep_memory()
    records = json.loads(chosen.out.read_text()) if chosen.out.exists() else []
    for name in chosen.part or PARTS:
        records += [machine() | record for record in PARTS[name](chosen)]
        chosen.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Measures the time of a step of transport and the error of each method.

    OMP_NUM_THREADS=2 python experiments/benchmarks/signals.py      # about a minute
    python experiments/benchmarks/signals.py --size 64 --method exponential --device cuda

The grids have 32³, 64³ and 128³ voxels. A unit amount starts in the centre voxel of n³,
K = 1 µm²/h, h = 1 µm, no flux through the faces. A step is r = K Δt/h² = 1/4. The error against the
exact lattice solution is the maximum after 4 steps (τ = 1), over the exact value at the centre,
0.0293630. `implicit, mask` blocks one voxel in ten and has no exact solution. Times are those of
one step of one signal in one colony: minimum and median of many. The script appends each run to a
JSON file with its machine, versions and commit. `--part kernels` compares torch with kernels.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections import deque
from pathlib import Path

import numpy as np
import torch
from record import machine
from scipy.special import ive

import torchfilm as tf
from torchfilm.signals.grid import Grid
from torchfilm.signals.transport import COMPILED, METHODS, Carrier, carry, prepare
from torchfilm.signals.transport_operator import Operator, apply
from torchfilm.signals.transport_rates import build_operator

sys.path.insert(0, str(Path(__file__).parents[1]))
from arguments import out_file, own_device, positive, whole

SIZES = (32, 64, 128)
CASES = (*METHODS, "implicit, mask", "apply")
R, STEPS = 0.25, 4
# of `kernels`: shape of the grids, and colonies; the last are those of a search for a stripe
GRIDS = (((64, 64, 64), 1), ((64, 64, 1), 64), ((64, 4, 12), 256))
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def exact(n: int) -> np.ndarray:
    """Returns Π e^{−2τ} I_k(2τ) at τ = R·STEPS, (n, n, n); distant faces have no effect yet."""
    one = ive(np.abs(np.arange(n) - n // 2), 2 * R * STEPS)
    return one[:, None, None] * one[None, :, None] * one[None, None, :]


def timed(action, device: str, seconds: float) -> tuple[float, float, int]:
    """Repeats `action` for about `seconds`. Returns minimum and median ms and the repeats."""
    action()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 5 or (time.perf_counter() < end and len(times) < 500):
        begin = time.perf_counter()
        action()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - begin))
    return min(times), statistics.median(times), len(times)


def box(n: int, case: str, dtype: torch.dtype, device: str) -> Operator:
    """Returns the transport operator of a case."""
    mask = None
    if case.endswith("mask"):
        mask = (torch.rand(n, n, n, generator=torch.Generator().manual_seed(1)) > 0.1).to(device)
    return build_operator(
        (n, n, n), (1.0, 1.0, 1.0), diffusion=1.0, mask=mask, dtype=dtype, device=device
    )


def run(n: int, case: str, dtype: torch.dtype, device: str, seconds: float) -> dict:
    """Runs one method at one size. Returns its record."""
    transport_operator = box(n, case, dtype, device)
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
    if case == "apply":
        least, median, count = timed(lambda: apply(transport_operator, spread), device, seconds)
        return record | {
            "least_ms": round(least, 4),
            "median_ms": round(median, 4),
            "repeats": count,
        }
    begin = time.perf_counter()
    stepper = prepare(transport_operator, R, case.split(",")[0])
    record["prepare_ms"] = round(1e3 * (time.perf_counter() - begin), 2)
    least, median, count = timed(lambda: stepper.step(spread), device, seconds)
    record |= {"least_ms": round(least, 4), "median_ms": round(median, 4), "repeats": count}
    for _ in range(STEPS):
        u = stepper.step(u)
    found = u[0].double().cpu().numpy()
    record |= {"lowest": float(found.min()), "amount_error": float(found.sum() - 1)}
    if transport_operator.mask is None:
        expected = exact(n)
        record["error"] = float(np.abs(found - expected).max() / expected.max())
    return record


def row(record: dict) -> str:
    """Returns a line of the printed table."""
    error = f"{record['error']:.1e}" if "error" in record else "-"
    lowest, amount = (
        f"{record[k]:.1e}" if k in record else "-" for k in ("lowest", "amount_error")
    )
    return (
        f"{record['size']:>4}³ {record['method']:<15} {record['least_ms']:>9.3f}"
        f" {record['median_ms']:>9.3f} {error:>9} {lowest:>9} {amount:>9}"
    )


def transport(options: argparse.Namespace) -> list[dict]:
    """Runs every method at every size."""
    records = []
    print(
        f"     {'method':<15} {'least ms':>9} {'median':>9} {'error':>9} {'lowest':>9}"
        f" {'amount':>9}   {options.dtype}, {torch.get_num_threads()} threads"
    )
    for n in options.size or SIZES:
        for case in options.method or CASES:
            records.append(run(n, case, DTYPES[options.dtype], options.device, options.seconds))
            print(row(records[-1]), flush=True)
    return records


def band(options: argparse.Namespace) -> list[dict]:
    """Runs the paper's Fig. 5 from two founders: circuits, AHL on a grid, contacts in a channel."""
    scene, timings = tf.scenes.boundary_detector(), tf.Timings()
    begin = time.perf_counter()
    run = tf.simulate(
        scene,
        seed=0,
        dtype=DTYPES[options.dtype],
        device=options.device,
        cells=options.cells,
        timings=timings,
    )
    state = deque(run, maxlen=1).pop()
    seconds = time.perf_counter() - begin
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


def kernels(options: argparse.Namespace) -> list[dict]:
    """Runs a step of transport by torch and by compiled kernels, in turn."""
    dtype, records = DTYPES[options.dtype], []
    for shape, colonies in GRIDS:
        made = build_operator(shape, (1.0, 1.0, 1.0), diffusion=1.0, colonies=colonies, dtype=dtype)
        grid = Grid(
            torch.zeros(colonies, 3, dtype=torch.float64),
            torch.tensor([shape] * colonies),
            (1.0, 1.0, 1.0),
        )
        u = torch.rand(grid.nodes, generator=torch.Generator().manual_seed(2)).to(dtype)
        for method in sorted(COMPILED):
            stepper, record = prepare(made, R, method), {}
            for who in ("torch", "compiled"):
                carriers = [Carrier(stepper, shape, who == "compiled")]
                step = lambda carriers=carriers: carry(grid, carriers, u)  # noqa: B023
                record[who] = round(timed(step, "cpu", options.seconds)[0], 4)
            records.append(
                {
                    "case": "kernels",
                    "grids": f"{'x'.join(map(str, shape))}, {colonies}",
                    "method": method,
                    "dtype": options.dtype,
                    "r": R,
                    **{f"{who}_least_ms": ms for who, ms in record.items()},
                }
            )
            print(
                f"{records[-1]['grids']:>16} {method:<12} torch {record['torch']:8.3f} ms,"
                f" kernels {record['compiled']:8.3f} ms",
                flush=True,
            )
    return records


PARTS = {"transport": transport, "kernels": kernels, "band": band}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--size", action="append", type=whole, help="voxels along an edge; may be repeated"
    )
    parser.add_argument(
        "--method", action="append", choices=CASES, help="one method; may be repeated"
    )
    parser.add_argument("--dtype", default="float32", choices=sorted(DTYPES))
    parser.add_argument(
        "--part", action="append", choices=sorted(PARTS), help="one part; may be repeated"
    )
    parser.add_argument("--cells", type=whole, default=5000, help="size of the colony of Fig. 5")
    parser.add_argument("--seconds", type=positive, default=2.0, help="time to repeat each case")
    parser.add_argument("--device", type=own_device, default="cpu")
    parser.add_argument("--out", type=out_file, default=Path(__file__).with_name("signals.json"))
    options = parser.parse_args()
    tf.keep_memory()
    records = json.loads(options.out.read_text()) if options.out.exists() else []
    for name in options.part or PARTS:
        records += [machine() | record for record in PARTS[name](options)]
        options.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

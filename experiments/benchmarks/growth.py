"""Measures the time of growth, and how clean contacts stay: colonies from one cell to N cells each.

    python experiments/benchmarks/growth.py                     # the usual set, some minutes
    python experiments/benchmarks/growth.py --quick --out runs/growth.json    # small sizes
    python experiments/benchmarks/growth.py --case 2d-32000 --regime free --threads 2
    python experiments/benchmarks/growth.py --case 2d-1000000 --regime pressed --limit 3600
    python experiments/benchmarks/growth.py --case 2d-3000 --backend torch --device cuda

Colonies grow in 2-D and in 3-D between agarose and coverslip. Growth 1/h by the length law, Δt
0.025 h, division at 3.5–4.0 µm, μ = 1; regimes: free (γ = 1e5, the default), pressed (γ = 10, the
paper's) and, if asked for, bilateral (γ = 10, the paper's contacts, too). All other settings are
the defaults. The time is that of `tf.simulate` with its checks and reports, and that of the
processor, which other work disturbs less. Overlaps are measured every fifth step, with the clock
stopped. A run that has taken --limit seconds of the processor ends there, and its record tells how
many cells it came to. Growth is the volume over that of the same colony without mechanics, where it
grows freely. A first record has the time of one product with JᵀJ and that to copy its rows. The
script appends each case to a JSON file with its machine, versions and commit.
"""

from __future__ import annotations

import argparse
import json
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import torch
from record import machine, write_page

import torchfilm as tf

sys.path.insert(0, str(Path(__file__).parents[1]))
from arguments import out_file, own_device, positive, whole

CASES = {
    "2d-1000": (2, 1, 1000), "2d-3000": (2, 1, 3000), "2d-10000": (2, 1, 10000),
    "2d-32000": (2, 1, 32000), "2d-100000": (2, 1, 100000), "2d-1000000": (2, 1, 1000000),
    "2d-32x1000": (2, 32, 1000), "2d-64x100": (2, 64, 100), "3d-3000": (3, 1, 3000),
    "3d-32000": (3, 1, 32000),
}  # fmt: skip
USUAL = ("2d-1000", "2d-3000", "2d-10000", "2d-32x1000", "2d-64x100", "3d-3000")
QUICK = ("2d-1000", "2d-64x100")
REGIMES: dict[str, dict] = {
    "free": {"length_drag": 1e5},
    "pressed": {"length_drag": 10.0},
    "bilateral": {"length_drag": 10.0, "contacts": "bilateral"},
}
USUAL_REGIMES = ("free", "pressed")
LOOK = 5  # steps between two looks at the overlaps


def scene(dim: int, regime: str | None, backend: str | None) -> tf.Scene:
    """Returns the scene in the plane or in space; without mechanics where regime is None."""
    film = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]
    effects: list[tf.Effect] = [
        tf.Growth(rate=1.0, law="length"),
        tf.Division(length=tf.Uniform(3.5, 4.0)),
    ]
    if regime is not None:
        walls = film if dim == 3 else []
        effects.append(tf.Mechanics(walls, dim=dim, backend=backend, **REGIMES[regime]))
    return tf.Scene(*effects, dim=dim, dt=0.025, name=f"growth {dim}-D")


def grow(name: str, regime: str, backend: str | None, device: str, seed: int, limit: float) -> dict:
    """Returns costs and results of a case, ended after `limit` seconds of the processor."""
    dim, colonies, cells = CASES[name]
    model = scene(dim, regime, backend).bind(colonies, seed=seed, device=device)
    kept = {"timings": tf.Timings()}
    course, marks, iterations, passes, cell_steps, looked = [], [], 0, 0, 0, 0.0
    begin, processor, looked_cpu = time.perf_counter(), time.process_time(), 0.0
    for state in tf.simulate(model.scene, model.start(), cells=cells, **kept):
        report = state.reports["mechanics"]
        iterations += int(report.iterations.max())
        passes += int(report.passes.max())
        cell_steps += state.cells
        if state.cells >= 100 * 2 ** len(marks) * colonies:
            seconds = time.perf_counter() - begin - looked
            marks.append({
                "cells": state.cells, "seconds": round(seconds, 3),
                "processor_s": round(time.process_time() - processor - looked_cpu, 3),
                "steps": state.step, "cell_steps": cell_steps, "iterations": iterations,
            })  # fmt: skip
        if state.step % LOOK == 0:
            stop, stop_cpu = time.perf_counter(), time.process_time()
            found = tf.measure.overlaps(state)
            if int(found.count.sum()):
                course.append((float(found.mean[found.count > 0].mean()), float(found.worst.max())))
            looked += time.perf_counter() - stop
            looked_cpu += time.process_time() - stop_cpu
        if time.process_time() - processor - looked_cpu > limit:
            break
    seconds = time.perf_counter() - begin - looked
    processor = time.process_time() - processor - looked_cpu
    growth = None  # under pressure a colony takes so long that the free one would be too large
    if regime == "free":
        given = {"until": state.time, "colonies": colonies, "seed": seed}
        free = tf.simulate(scene(dim, None, None), **given).last()
        growth = round(float(state.volume.sum() / free.volume.sum().to(device)), 4)
    mean, worst = np.array(course).T
    return {
        "case": name, "regime": regime, "backend": backend_of(model, device), "device": device,
        "threads": torch.get_num_threads(), "seconds": round(seconds, 3),
        "processor_s": round(processor, 3), "cells": state.cells,
        "colonies": colonies, "steps": state.step, "cell_steps": cell_steps,
        "us_per_cell_step": round(1e6 * seconds / cell_steps, 2),
        "iterations_per_step": round(iterations / state.step, 1),
        "passes_per_step": round(passes / state.step, 3),
        "simulated_h": round(state.time, 3),
        "growth_over_free": growth,
        "overlap_course_um": round(float(mean.mean()), 5), "overlap_end_um": round(mean[-1], 5),
        "overlap_worst_um": {
            q: round(float(np.quantile(worst, float(q))), 3) for q in ("0.5", "0.99", "1")
        },
        "effects_s": {k: round(v, 3) for k, v in kept["timings"].seconds.items()}, "marks": marks,
    }  # fmt: skip


def backend_of(model, device: str) -> str:
    """Returns who computes the contacts: "compiled" or "torch"."""
    mechanics = next(e for e in model.scene.effects if isinstance(e, tf.Mechanics))
    return mechanics.backend_on(torch.device(device))


def product_over_copy(cells: int = 10000) -> dict[str, float]:
    """Returns the times of a product with JᵀJ and of a copy of its rows, s, best of 50, for a
    lattice of touching cells in the plane."""
    from torchfilm.kernels import contacts, neighbours, solve
    from torchfilm.kernels.compiling import for_python
    from torchfilm.kernels.memory import no_memory

    side, dof = round(cells**0.5), (0,) * 4
    grid = np.stack(np.meshgrid(np.arange(side) * 3.95, np.arange(side) * 0.99), -1)
    x = grid.reshape(-1, 2) + 0.02 * np.random.default_rng(0).random((side * side, 2))
    n = len(x)
    axis, half, radius = np.tile([1.0, 0.0], (n, 1)), np.full(n, 1.5), np.full(n, 0.5)
    scale = np.ones((n, 4))
    given = no_memory(), x, axis, half, radius, np.zeros(3)
    first, second = for_python(neighbours.near_pairs)(*given, 0.3, dof)
    near = for_python(contacts.near_contacts)(*given, first, second, 0.3, dof)
    found = (first, second, *near)
    room = contacts.ROWS * len(near[0])
    H, gaps = np.empty((2 * room, 4), np.float32), np.empty(room, np.float32)
    one, two = np.empty(room, np.int32), np.empty(room, np.int32)
    places = H, gaps, one, two, np.empty(room, np.uint8)
    count = for_python(contacts.pair_rows)(*given, scale, found, 0, places, 0.3, dof)
    p, out = np.ones((n, 4), np.float32), np.zeros((n, 4), np.float32)
    on = np.arange(count, dtype=np.int32)
    H = H[: 2 * count].copy()
    target = np.empty_like(H)

    def best(call) -> float:
        times = []
        for _ in range(50):
            begin = time.perf_counter()
            call()
            times.append(time.perf_counter() - begin)
        return min(times)

    add_product = for_python(solve.add_product)
    product = best(lambda: add_product(H, one, two, on, p, out, dof))
    copy = best(lambda: np.copyto(target, H))
    return {"rows": count, "product_us": round(1e6 * product, 1), "copy_us": round(1e6 * copy, 1)}


def show(result: dict) -> None:
    worst = result["overlap_worst_um"]
    print(
        f"{result['case']:<11} {result['regime']:<8} {result['backend']:<9}"
        f" {result['seconds']:>7.2f} s {result['us_per_cell_step']:>6.2f} µs/cell/step "
        f" {result['iterations_per_step']:>6.1f} iterations "
        f" growth {result['growth_over_free']} "
        f" overlap {result['overlap_course_um']:.4f}, worst {worst['0.5']} / {worst['0.99']} /"
        f" {worst['1']} µm  {result['effects_s']}",
        flush=True,
    )


def table(records: list[dict]) -> str:
    """Returns a Markdown table of the newest record of each case, regime, backend and threads."""
    newest = {
        (r["case"], r["regime"], r["backend"], r["threads"], r["device"]): r
        for r in records
        if "regime" in r
    }
    lines = [
        "| colonies × cells | regime | who computes | time, s | µs a cell and step |"
        " iterations a step | volume over free | mean overlap, µm | worst, µm: median / 99 % / 1 |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for key in sorted(newest, key=lambda k: (list(CASES).index(k[0]), k[1:])):
        r, (dim, colonies, cells) = newest[key], CASES[key[0]]
        who = f"{r['backend']}, {r['threads']} thread{'s' * (r['threads'] > 1)}, {r['device']}"
        worst = " / ".join(f"{r['overlap_worst_um'][q]:.3f}" for q in ("0.5", "0.99", "1"))
        seconds = r.get("processor_s", r["seconds"]) if r["threads"] == 1 else r["seconds"]
        ended = "" if r["cells"] >= colonies * cells else f" (ended at {r['cells']})"
        growth = "–" if r["growth_over_free"] is None else f"{r['growth_over_free']:.3f}"
        lines.append(
            f"| {colonies} × {cells}{ended}, {dim}-D | {r['regime']} | {who} | {seconds:.2f} |"
            f" {1e6 * seconds / r['cell_steps']:.1f} | {r['iterations_per_step']:.0f} | {growth} |"
            f" {r['overlap_course_um']:.4f} | {worst} |"
        )
    return "\n".join(lines)


def cost_of_size(record: dict) -> np.ndarray:
    """Returns rows of cells, µs a cell and step, and iterations a step, from mark to mark."""
    clock = "processor_s" if "processor_s" in record["marks"][0] else "seconds"
    names = ("cells", clock, "steps", "cell_steps", "iterations")
    marks = np.array([[m[n] for n in names] for m in record["marks"]], float)
    (_, seconds, steps, cell_steps, iterations), cells = np.diff(marks, axis=0).T, marks[:, 0]
    middle = np.sqrt(cells[1:] * cells[:-1])
    return np.stack([middle, 1e6 * seconds / cell_steps, iterations / steps])


def picture(records: list[dict], file: Path) -> str:
    """Draws the cost of a cell and step, and iterations a step, against the number of cells, for
    the largest colony of each regime in 2-D. Returns the measured exponents, in words."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    words = []
    for regime, color in (("free", "tab:blue"), ("pressed", "tab:orange")):
        mine = [
            r
            for r in records
            if r.get("regime") == regime and r["case"].startswith("2d") and r["colonies"] == 1
            and r["backend"] == "compiled" and r["threads"] == 1 and "steps" in r["marks"][0]
        ]  # fmt: skip
        if not mine:
            continue
        record = max(reversed(mine), key=lambda r: r["cells"])
        cells, time_, iterations = cost_of_size(record)
        large = cells >= 1000
        for ax, y in zip(axes, (time_, iterations), strict=True):
            ax.loglog(cells, y, "o-", color=color, label=f"{regime}, to {record['cells']} cells")
        slopes = [
            np.polyfit(np.log(cells[large]), np.log(y[large]), 1)[0] for y in (time_, iterations)
        ]
        words.append(
            f"{regime}: from 1,000 cells on, time as N^{1 + slopes[0]:.2f} and iterations as"
            f" N^{slopes[1]:.2f}"
        )
    axes[0].set(xlabel="cells N", ylabel="µs a cell and step")
    axes[1].set(xlabel="cells N", ylabel="iterations a step")
    axes[0].legend()
    figure.savefig(file, dpi=120)
    return "; ".join(words)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--case", action="append", choices=sorted(CASES), help="one case; may be repeated"
    )
    parser.add_argument(
        "--regime",
        action="append",
        choices=sorted(REGIMES),
        help="default: free, pressed; may be repeated",
    )
    parser.add_argument("--backend", choices=("compiled", "torch"))
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    parser.add_argument("--device", type=own_device, default="cpu")
    parser.add_argument("--threads", type=whole, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--limit", type=positive, default=np.inf, help="of a run, s of processor time"
    )
    parser.add_argument(
        "--page", action="store_true", help="write docs/performance.md, run nothing"
    )
    parser.add_argument("--out", type=out_file, default=Path(__file__).with_name("growth.json"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    tf.keep_memory()
    records = json.loads(options.out.read_text()) if options.out.exists() else []
    if options.page:
        page = Path(__file__).parents[2] / "docs" / "performance.md"
        write_page(page, table(records), "experiments/benchmarks/growth.py --page")
        drawn = picture(records, page.parent / "pictures" / "performance.png")
        image = "![Cost of a cell and step against the number of cells](pictures/performance.png)"
        law = textwrap.fill(f"One step of N cells, {drawn}.", 100)
        write_page(page, f"{image}\n\n{law}", "cost against size")
        return
    if options.device == "cpu" and options.backend != "torch":
        records.append(machine() | {"case": "product with JᵀJ"} | product_over_copy())
        print(records[-1])
    for name in options.case or (QUICK if options.quick else USUAL):
        dim, _, _ = CASES[name]
        for regime in options.regime or USUAL_REGIMES:
            # compile, and load what the first steps load
            warm = scene(dim, regime, options.backend).bind(device=options.device)
            list(tf.simulate(warm.scene, warm.start(), cells=8))
            result = grow(
                name, regime, options.backend, options.device, options.seed, options.limit
            )
            show(result)
            records.append(machine() | result)
            options.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

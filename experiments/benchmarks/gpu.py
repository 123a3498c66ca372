"""Measures steps of the same states on the CPU and on a GPU, there by kernels and by torch.

    python experiments/benchmarks/gpu.py                        # all cases, some minutes
    python experiments/benchmarks/gpu.py --case "64 x 100"
    python experiments/benchmarks/gpu.py --device cpu --case "1 x 1000"   # kernels and torch
    python experiments/benchmarks/gpu.py --derivatives          # torch, CPU and GPU

Colonies grow on the CPU to the given number of cells each. Then three take the same steps from
there: kernels, for a state on the CPU; the same for one on the GPU, which is copied to and fro; and
torch on the GPU. The table gives the least time of a step. Contacts are those of free growth,
one-sided, 2-D, float32; the other cases are ready-made scenes. With --derivatives torch takes steps
of free contacts, solved to 1e-5, and back to a growth rate for each colony. The script appends each
case to a JSON file with its machine, versions and commit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from record import machine

import torchfilm as tf

sys.path.insert(0, str(Path(__file__).parents[1]))
from arguments import out_file, own_device

STEPS = 6
# by name: the ready-made scene, None for free growth; colonies; cells of each
CASES = {
    "1 x 1000": (None, 1, 1000), "64 x 100": (None, 64, 100), "64 x 1000": (None, 64, 1000),
    "512 x 1000": (None, 512, 1000), "repressilator 64 x 100": ("repressilator", 64, 100),
    "quorum sensing 16 x 100": ("quorum_sensing", 16, 100),
}  # fmt: skip
WITH_DERIVATIVES = (1, 100), (16, 100), (1, 1000), (64, 100), (64, 1000)


def scene_of(name: str | None, backend: str | None) -> tf.Scene:
    """Returns a scene all of whose effects are computed by a backend."""
    growth = tf.Growth(rate=1.0, law="length"), tf.Division(length=tf.Uniform(3.5, 4.0))
    free = tf.Scene(*growth, tf.Mechanics(dim=2), dim=2, dt=0.025)
    scene = free if name is None else tf.scenes.build(name)
    by = lambda e: replace(e, backend=backend) if hasattr(e, "backend") else e
    return scene.replace(*(by(e) for e in scene.effects))


def timed(model: tf.Model, state: tf.State) -> tuple[float, int]:
    """Returns the least time of a step, ms, and the CG iterations of all steps."""
    times, iterations = [], 0
    wait = torch.cuda.synchronize if state.device.type == "cuda" else lambda: None
    for _ in range(STEPS):
        wait()
        begin = time.perf_counter()
        state = model.step(state)
        wait()
        times.append(1e3 * (time.perf_counter() - begin))
        iterations += int(state.reports["mechanics"].iterations.max())
    return min(times), iterations


def measure(case: str, device: str) -> dict:
    """Runs one case. Returns its record."""
    name, colonies, cells = CASES[case]
    scene = scene_of(name, None)
    state = tf.simulate(scene, colonies=colonies, cells=cells, seed=1).last()
    kernels, _ = timed(scene.bind(colonies, seed=1), state)
    there = state.to(device)
    copied, _ = timed(scene.bind(colonies, seed=1, device=device), there)
    torchs = scene_of(name, "torch").bind(colonies, seed=1, device=device)
    by_torch, iterations = timed(torchs, there)
    return {
        "case": case, "cells": state.cells, "device": device, "kernels_ms": round(kernels, 1),
        "copied_ms": round(copied, 1), "torch_ms": round(by_torch, 1),
        "iterations_per_step": round(iterations / STEPS, 1),
    }  # fmt: skip


def derivatives(colonies: int, cells: int, device: str) -> dict:
    """Returns the record of steps by torch, and back, from cells that lie about at random."""
    rate = torch.full((colonies,), 1.0, device=device, requires_grad=True)
    scene = tf.Scene(
        tf.Growth(rate=rate, law="length"), tf.Division(length=tf.Uniform(3.5, 4.0)),
        tf.Mechanics(dim=2, tolerance=1e-5, backend="torch"), dim=2, dt=0.025,
        founders=tf.inoculum(cells, 1.6 * cells**0.5, seed=1),
    )  # fmt: skip
    model = scene.bind(colonies, seed=1, device=device)
    state = model.start()
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    with torch.no_grad():
        state = model.step(model.step(state))
    times = []
    for _ in range(2):
        wait()
        begin, end = time.perf_counter(), state
        for _ in range(STEPS):
            end = model.step(end)
        wait()
        there = time.perf_counter()
        end.position.square().sum().backward(retain_graph=True)
        wait()
        times.append((there - begin, time.perf_counter() - there))
    forward, back = (1e3 * min(each) / STEPS for each in zip(*times, strict=True))
    return {
        "case": f"derivatives, {colonies} x {cells}", "cells": state.cells, "device": device,
        "forward_ms": round(forward, 1), "backward_ms": round(back, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", nargs="*", choices=list(CASES), default=list(CASES))
    parser.add_argument("--device", type=own_device, default="cuda")
    parser.add_argument("--derivatives", action="store_true")
    parser.add_argument("--out", type=out_file, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    records = json.loads(options.out.read_text()) if options.out.exists() else []
    if options.derivatives:
        for colonies, cells in WITH_DERIVATIVES:
            for device in dict.fromkeys(("cpu", options.device)):
                found = derivatives(colonies, cells, device)
                print(
                    f"{found['case']:26} {device:>6} {found['forward_ms']:11.1f} ms a step,"
                    f" {found['backward_ms']:11.1f} ms back"
                )
                records.append(machine() | found)
        options.out.write_text(json.dumps(records, indent=1) + "\n")
        return
    torch.set_grad_enabled(False)
    there = options.device
    print(f"{'case':26} {'cells':>8} {'cpu':>14} {there + ', kernels':>14} {there + ', torch':>14}")
    for case in options.case:
        found = measure(case, options.device)
        print(
            f"{case:26} {found['cells']:8} {found['kernels_ms']:11.1f} ms"
            f" {found['copied_ms']:11.1f} ms {found['torch_ms']:11.1f} ms"
        )
        records.append(machine() | found)
        options.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

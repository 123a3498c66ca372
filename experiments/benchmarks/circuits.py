"""Measures a step of circuits by compiled functions and by torch, in one run.

    OMP_NUM_THREADS=1 python experiments/benchmarks/circuits.py      # about five minutes
    python experiments/benchmarks/circuits.py --case "tau_leap" --colonies 64 --cells 100
    python experiments/benchmarks/circuits.py --explicit     # explicit methods against the default
    python experiments/benchmarks/circuits.py --exchange     # a circuit with its exchange

Each case is the repressilator, grown from one founder a colony to `cells` cells a colony in the
mean. The same step of the same state is then taken by both backends in turn, so that a machine that
does other work slows both. The table gives the least time of the whole step, of the circuit's
solver alone, and their ratios, and whether all fields are the same to the bit. The script appends
each run to a JSON file with its machine, versions and commit. With --explicit it steps two smooth
circuits by the default method and by explicit ones in turn, compiled, and only prints. With
--exchange it prints the time of the boundary detector's circuit with its exchange, at the last of a
run's steps: as published, stiff, and with constants drawn for each of 64 colonies from the ranges
of a search.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import torch
from record import machine

import torchfilm as tf
from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.effects.circuit_kernels import CircuitKernels
from torchfilm.tools.timing import Timings

sys.path.insert(0, str(Path(__file__).parents[1]))
import boundary_stripe
from arguments import out_file, whole

DT = 0.05
BACKENDS = ("compiled", "torch")
# by method: settings of the circuit
CASES = {"tau_leap": {}, "direct": {}, "rosenbrock": {}, "rk4": {"steps": 4}}
EXPLICIT = (("rosenbrock", {}), *((m, {"steps": 1}) for m in ("euler", "heun2", "rk4")))
EXPLICIT += (("rk4", {"steps": 4}),)


def scene_of(
    method: str, backend: str, settings: dict | None = None, name: str = "repressilator"
) -> tf.Scene:
    """Returns a ready-made scene by a method and a backend."""
    scene = tf.scenes.build(name)
    settings = CASES[method] if settings is None else settings
    change = {"method": method, "backend": backend, **settings}
    return with_circuit(scene, change)


def with_circuit(scene: tf.Scene, change: dict) -> tf.Scene:
    """Returns the scene with other settings of its circuit."""
    return scene.replace(
        *(e._with(**change) if isinstance(e, tf.Circuit) else e for e in scene.effects)
    )


# The parts of a circuit's step that advance its cells, by kernels alone and with torch.
SOLVERS = ((CircuitKernels, "run"), (BoundCircuit, "_by_torch"))


def timed_step(model: tf.Model, state: tf.State) -> tuple[float, float, tf.State]:
    """Returns the seconds of a step, those of the circuit's solver, and the next state."""
    inside = []

    def timed(solver):
        def run(*args):
            begin = time.perf_counter()
            found = solver(*args)
            inside.append(time.perf_counter() - begin)
            return found

        return run

    plain = [getattr(kind, name) for kind, name in SOLVERS]
    for (kind, name), solver in zip(SOLVERS, plain, strict=True):
        setattr(kind, name, timed(solver))
    try:
        begin = time.perf_counter()
        after = model.step(state, DT)
        return time.perf_counter() - begin, sum(inside), after
    finally:
        for (kind, name), solver in zip(SOLVERS, plain, strict=True):
            setattr(kind, name, solver)


def measure(method: str, options: argparse.Namespace) -> dict:
    """Runs one case. Returns its record."""
    models = {b: scene_of(method, b).bind(options.colonies, seed=1) for b in BACKENDS}
    state = models["compiled"].start()
    while state.cells < options.cells * options.colonies:
        state = models["compiled"].step(state, DT)
    times = {b: [timed_step(models[b], state) for _ in range(1)] for b in BACKENDS}  # warm
    for _ in range(options.repeats):
        for b in BACKENDS:
            times[b].append(timed_step(models[b], state))
    one, other = (times[b][0][2] for b in BACKENDS)
    least = {b: [1e3 * min(t[k] for t in times[b][1:]) for k in (0, 1)] for b in BACKENDS}
    return {
        "method": method,
        "colonies": options.colonies,
        "cells": state.cells,
        "events": int(one.reports["circuit"].steps.sum()),
        "step_ms": {b: round(least[b][0], 2) for b in BACKENDS},
        "solver_ms": {b: round(least[b][1], 2) for b in BACKENDS},
        "step_ratio": round(least["torch"][0] / least["compiled"][0], 1),
        "solver_ratio": round(least["torch"][1] / least["compiled"][1], 1),
        "same_bits": all(torch.equal(x, other.fields[n]) for n, x in one.fields.items()),
    }


def print_explicit(name: str, options: argparse.Namespace) -> None:
    """Prints the times of the default method and of explicit ones in a ready-made scene."""
    models = [
        scene_of(method, "compiled", settings, name).bind(options.colonies, seed=1)
        for method, settings in EXPLICIT
    ]
    state = models[0].start()
    while state.cells < options.cells * options.colonies:
        state = models[0].step(state, DT)
    times = [[timed_step(model, state)] for model in models]  # warm
    for _ in range(options.repeats):
        for model, found in zip(models, times, strict=True):
            found.append(timed_step(model, state))
    least = [[1e3 * min(t[k] for t in found[1:]) for k in (0, 1)] for found in times]
    for (method, settings), found, (step, solver) in zip(EXPLICIT, times, least, strict=True):
        steps = float(found[0][2].reports["circuit"].steps.float().mean())
        print(
            f"{name:<14}{method:<11}{steps:4.1f} steps a cell; solver {solver:6.2f} ms,"
            f" {solver / least[0][1]:.2f} of the default's; step {step:6.1f} ms,"
            f" {step / least[0][0]:.2f}{'' if settings else ', the default'}",
            flush=True,
        )


def drawn_constants(colonies: int) -> dict[str, torch.Tensor]:
    """Returns constants of each colony as the search for a stripe may draw them."""
    draw = torch.Generator().manual_seed(0)
    share = torch.rand(len(boundary_stripe.PARAMETERS), colonies, generator=draw)
    return {
        p.name: torch.tensor([p.value(x) for x in own.tolist()])
        for p, own in zip(boundary_stripe.PARAMETERS, share, strict=True)
    }


def print_exchange() -> None:
    """Prints the time of a circuit with its exchange, by both backends in turn."""
    sets = {
        "100 cells, as published": (1, {}),
        "100 cells, stiff": (1, {"k1": 50.0, "D1": 50.0}),
        "64 x 100 cells, as published": (64, {}),
        "64 x 100 cells, drawn": (64, drawn_constants(64)),
    }
    for words, (colonies, constants) in sets.items():
        scene = tf.scenes.boundary_detector(**constants, rtol=1e-2)
        models = {b: with_circuit(scene, {"backend": b}).bind(colonies, seed=0) for b in BACKENDS}
        state, times = models["compiled"].start(), {b: [] for b in BACKENDS}
        while state.cells < 100 * colonies:
            later = models["compiled"].step(state, DT)
            if state.cells > 60 * colonies:  # the last ten steps or so
                for b, model in models.items():
                    spent = Timings()
                    model.step(state, DT, spent)
                    times[b].append(1e3 * spent.seconds["circuit"])
            state = later
        least = {b: min(x) for b, x in times.items()}
        print(
            f"{words:<30}{state.cells:>7} cells; torch {least['torch']:8.2f} ms, compiled"
            f" {least['compiled']:7.3f} ms, ratio {least['torch'] / least['compiled']:.0f}",
            flush=True,
        )


def row(record: dict) -> str:
    """Returns a line of the printed table."""
    step, solver = record["step_ms"], record["solver_ms"]
    return (
        f"{record['method']:<12}{record['cells']:>7}{record['events']:>10}"
        f"{step['torch']:>13.1f}{step['compiled']:>10.1f}{record['step_ratio']:>7.1f}"
        f"{solver['torch']:>11.1f}{solver['compiled']:>10.1f}{record['solver_ratio']:>7.1f}"
        f"  {'same bits' if record['same_bits'] else 'other bits'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--case", action="append", choices=tuple(CASES), help="one method; may be repeated"
    )
    parser.add_argument("--explicit", action="store_true")
    parser.add_argument("--exchange", action="store_true")
    parser.add_argument("--colonies", type=whole, default=64)
    parser.add_argument("--cells", type=whole, default=100, help="cells a colony, in the mean")
    parser.add_argument("--repeats", type=whole, default=5)
    parser.add_argument("--out", type=out_file, default=Path(__file__).with_name("circuits.json"))
    options = parser.parse_args()
    tf.keep_memory()
    if options.exchange:
        print_exchange()
        return
    if options.explicit:
        for name in ("toggle_switch", "repressilator"):
            print_explicit(name, options)
        return
    print(
        f"{'method':<12}{'cells':>7}{'steps':>10}{'step: torch':>13}{'compiled':>10}{'ratio':>7}"
        f"{'solver':>11}{'compiled':>10}{'ratio':>7}   ms, {torch.get_num_threads()} threads"
    )
    records = json.loads(options.out.read_text()) if options.out.exists() else []
    for method in options.case or CASES:
        records.append(machine() | measure(method, options))
        print(row(records[-1]), flush=True)
        options.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()

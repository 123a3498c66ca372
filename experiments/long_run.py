"""An open channel at steady state, for as long as one likes: does memory grow, do amounts drift?

    python experiments/long_run.py --steps 100000 --out runs/long_run.csv

Cells grow, divide and leave a channel at its open end. About the closed end (x < 8 µm) they stand
in a reservoir and take up AHL; farther on they exchange it with the medium on a grid and carry it
out at the end, and it switches LuxI on. Nothing makes or takes AHL, so what is in cells and medium,
what left with cells and what came from the reservoir add up to what there was: the drift of that
sum is told relative to all that has passed. Writes a line of CSV every 500 steps (in a short run
every hundredth of it), and prints one for docs/stability.md.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from dataclasses import dataclass
from pathlib import Path

import torch

import torchfilm as tf
from torchfilm.effect import REMOVAL

LENGTH, WIDTH = 32.0, 4.0
COLUMNS = (
    "step",
    "hours",
    "rss_mb",
    "cells",
    "tensors_mb",
    "held",
    "passed",
    "drift",
    "luxi",
    "seconds",
)


def lux(u, s, p, cell):
    into = 20.0 * (s.ahl - u.ahl) * cell.area
    return {
        "luxi": 0.01 + 5.0 * tf.kinetics.activation(u.ahl, 0.3, 2) - 2.0 * u.luxi,
        "ahl": into / cell.volume,
    }, {"ahl": -into}


@dataclass(frozen=True)
class Carried(tf.Effect):
    """Adds up the AHL of cells that are about to leave, in the field `carried` (B,), conc·µm³."""

    stage = REMOVAL - 1
    title = "carried"

    def declares(self, dim: int) -> tuple[tf.Field, ...]:
        return (
            tf.Field(
                "carried",
                "AHL that left with cells",
                "conc·µm³",
                scope="colony",
                dtype=torch.float64,
            ),
        )

    def step(self, state: tf.State, dt: float) -> tf.State:
        leaves = state.position[:, 0] > LENGTH
        amount = torch.where(leaves, state.ahl.double() * state.circuit_volume.double(), 0.0)
        return state.with_fields(carried=state.carried.index_add(0, state.colony, amount))


def channel() -> tf.Scene:
    half = WIDTH / 2
    return tf.Scene(
        tf.Growth(rate=tf.Uniform(0.8, 1.2)),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2, walls=[tf.Channel(WIDTH, low_end=0.0)]),
        tf.Circuit(lux, species=("luxi", "ahl"), daughters="amount", rtol=0.01),
        tf.Medium(
            ahl=tf.Signal(diffusion=50.0, reservoir=1.0),
            box=((8.0, -half), (LENGTH, half)),
            spacing=2.0,
            outside="reservoir",
        ),
        Carried(),
        tf.Removal(low=(-1.0, -WIDTH), high=(LENGTH, WIDTH)),
        founders=tf.Cells([[2.0, 0.0]], [[1.0, 0.0]]),
    )


def resident() -> float:
    """Memory that this process holds, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def tensors(state: tf.State) -> float:
    """Memory of a state's own tensors, MB."""
    every = [
        v for v in (*vars(state).values(), *state.fields.values()) if isinstance(v, torch.Tensor)
    ]
    return sum(v.numel() * v.element_size() for v in every) / 2**20


def balance(state: tf.State) -> tuple[float, float, float]:
    """What is held in cells and medium, what has passed (in from the reservoir), and the sum that
    should stay 0, conc·µm³."""
    assert state.layout is not None
    held = float(
        (state.ahl.double() * state.circuit_volume.double()).sum()
        + state.signals["ahl"].double().sum() * state.layout.grid.voxel_volume
    )
    given = float(state.ahl_reservoir.double().sum())
    return held, -given, held + given + float(state.carried.sum())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="stop earlier, after as long"
    )
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    parser.add_argument("--out", type=Path, default=Path("runs/long_run.csv"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    tf.keep_memory()
    scene, begun, rows = channel(), time.perf_counter(), []
    start = scene.seed(seed=1, dtype=getattr(torch, chosen.dtype))
    every = max(1, min(500, chosen.steps // 100))
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    with chosen.out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for state in tf.simulate(scene, start, until=chosen.steps * scene.dt):
            seconds = time.perf_counter() - begun
            if state.step % every == 0:
                held, passed, left = balance(state)
                row = (
                    state.step,
                    state.time,
                    resident(),
                    state.cells,
                    tensors(state),
                    held,
                    passed,
                    left / passed,
                    float(state.luxi.mean()),
                    seconds,
                )
                rows.append(row)
                table.writerow(row)
                file.flush()
            if seconds > 60 * chosen.minutes:
                break
    settled = [r for r in rows if r[0] >= rows[-1][0] / 5]
    memory, count, luxi = ([r[k] for r in settled] for k in (2, 3, 8))
    print(
        f"{state.step:,} steps ({state.time:.0f} h, {settled[-1][9]:.0f} s) in {chosen.dtype}. From"
        f" a fifth of the run on: {min(count)}-{max(count)} cells, LuxI"
        f" {min(luxi):.3g}-{max(luxi):.3g}, memory {memory[0]:.1f} MB then and {memory[-1]:.1f} MB"
        f" at the end ({min(memory):.1f}-{max(memory):.1f}). {settled[-1][6]:.4g} conc·µm³ passed;"
        f" at most {max(abs(r[7]) for r in rows):.2g} of it is not accounted for."
    )


if __name__ == "__main__":
    main()

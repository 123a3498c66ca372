"""Tests memory use and conservation of amounts in a long run of an open channel at steady state.

    python experiments/long_run.py --steps 100000 --out runs/long_run.csv
    python experiments/long_run.py --contacts bilateral --length-drag 10    # as docs/stability.md

Cells grow, divide and leave a channel at its open end. Near the closed end (x < 8 µm) they are in a
reservoir and take up AHL. Farther on they exchange AHL with the medium on a grid and carry it out
at the end. AHL switches LuxI on. No process produces or degrades AHL. So the AHL in cells and
medium, that carried out and that from the reservoir add up to a constant. The script reports the
drift of this sum relative to the AHL that has passed. It writes a CSV line every 500 steps (in a
short run every hundredth of it) and prints a line for docs/stability.md.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from arguments import out_file, positive, whole

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
    """AHL crosses the membrane and activates LuxI; no process produces AHL."""
    into = 20.0 * (s.ahl - u.ahl) * cell.area
    return {
        "luxi": 0.01 + 5.0 * tf.kinetics.activation(u.ahl, 0.3, 2) - 2.0 * u.luxi,
        "ahl": into / cell.volume,
    }, {"ahl": -into}


@dataclass(frozen=True)
class Carried(tf.Effect):
    """Sums the AHL of cells that are about to leave, in the field `carried`, (B,), conc·µm³."""

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

    def reads(self) -> tuple[str, ...]:
        return ("position", "ahl", "circuit_volume", "carried")

    def writes(self) -> tuple[str, ...]:
        return ("carried",)

    def step(self, state: tf.State, dt: float, values) -> tf.State:
        leaves = state.position[:, 0] > LENGTH
        amount = torch.where(leaves, state.ahl.double() * state.circuit_volume.double(), 0.0)
        return state.with_fields(carried=state.carried.index_add(0, state.colony, amount))


def channel(contacts: str, length_drag: float | None) -> tf.Scene:
    """Returns the scene: a channel with a reservoir at its closed end."""
    walls = [tf.Channel(WIDTH, low_end=0.0)]
    half = WIDTH / 2
    return tf.Scene(
        tf.Growth(rate=tf.Uniform(0.8, 1.2)),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(walls, dim=2, contacts=contacts, length_drag=length_drag),
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
    """Returns the resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def tensors(state: tf.State) -> float:
    """Returns the memory of the tensors of a state, MB."""
    found = [
        v for v in (*vars(state).values(), *state.fields.values()) if isinstance(v, torch.Tensor)
    ]
    return sum(v.numel() * v.element_size() for v in found) / 2**20


def balance(state: tf.State) -> tuple[float, float, float]:
    """Returns three amounts of AHL, conc·µm³.

    They are: that in cells and medium, that which has passed in from the reservoir, and the sum
    that should stay 0.
    """
    assert state.layout is not None
    held = float(
        (state.ahl.double() * state.circuit_volume.double()).sum()
        + state.signals["ahl"].double().sum() * state.layout.grid.voxel_volume
    )
    released = float(state.ahl_reservoir.double().sum())
    return held, -released, held + released + float(state.carried.sum())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=whole, default=100_000)
    parser.add_argument(
        "--minutes", type=positive, default=float("inf"), help="stop after this time at the latest"
    )
    parser.add_argument("--contacts", choices=("one-sided", "bilateral"), default="one-sided")
    parser.add_argument("--length-drag", type=positive, help="default: that of the contacts")
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    parser.add_argument("--out", type=out_file, default="runs/long_run.csv")
    options = parser.parse_args()
    torch.set_num_threads(1)
    tf.keep_memory()
    scene, begin, rows = channel(options.contacts, options.length_drag), time.perf_counter(), []
    dtype = getattr(torch, options.dtype)
    every = max(1, min(500, options.steps // 100))
    with options.out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for state in tf.simulate(scene, seed=1, dtype=dtype, until=options.steps * scene.dt):
            seconds = time.perf_counter() - begin
            if state.step % every == 0:
                held, passed, drift = balance(state)
                row = (
                    state.step,
                    state.time,
                    resident(),
                    state.cells,
                    tensors(state),
                    held,
                    passed,
                    drift / passed,
                    float(state.luxi.mean()),
                    seconds,
                )
                rows.append(row)
                table.writerow(row)
                file.flush()
            if seconds > 60 * options.minutes:
                break
    settled = [r for r in rows if r[0] >= rows[-1][0] / 5]
    memory, count, luxi = ([r[k] for r in settled] for k in (2, 3, 8))
    print(
        f"{state.step:,} steps ({state.time:.0f} h, {settled[-1][9]:.0f} s) in {options.dtype}."
        f" After a fifth of the run: {min(count)}-{max(count)} cells, LuxI"
        f" {min(luxi):.3g}-{max(luxi):.3g}, memory {memory[0]:.1f} MB, at the end"
        f" {memory[-1]:.1f} MB (range {min(memory):.1f}-{max(memory):.1f}). AHL passed:"
        f" {settled[-1][6]:.4g} conc·µm³; largest relative drift:"
        f" {max(abs(r[7]) for r in rows):.2g}."
    )


if __name__ == "__main__":
    main()

"""Growth of microcolonies under two length drags, against the same colonies without mechanics.

    OMP_NUM_THREADS=1 python experiments/growth_regimes.py       # ten seconds
    OMP_NUM_THREADS=1 python experiments/growth_regimes.py --quick

Six colonies of the scene `microcolony` grow from one cell with a length drag of 1e5 (the default,
free growth) and of 10 (the paper's, growth limited by pressure), until each has 2,000 cells or
after 24 h. Without mechanics the same colonies, from the same seed, grow at the rate of their
cells. The script writes the curves as JSON and draws the picture of docs/growth_regimes.md. With
--out the picture is beside the JSON, and that of the page stays as it is. With --quick it stops at
200 cells, and the default of --out is runs/growth_regimes.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from arguments import out_file
from matplotlib import pyplot as plt

import torchfilm as tf
from torchfilm import measure

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from record import machine

HERE = Path(__file__).parent
COLONIES, SEED, HOURS = 6, 0, 24.0
DRAGS = {"length drag 1e5 (default)": 1e5, "length drag 10 (the paper's)": 10.0}
FREE, FREE_HOURS = "without mechanics", 10.0
COLOURS = ("tab:blue", "tab:orange")


@dataclass(frozen=True)
class Course:
    """Colonies over time: hours (T,); cells, volume µm³ and mean overlap µm of each, (T, B)."""

    hours: np.ndarray
    cells: np.ndarray
    volume: np.ndarray
    overlap: np.ndarray
    seconds: float

    def record(self) -> dict:
        """Returns lists, rounded."""
        return {
            "seconds": round(self.seconds, 1),
            "hours": self.hours.round(4).tolist(),
            "cells": self.cells.tolist(),
            "volume_um3": self.volume.round(2).tolist(),
            "overlap_mean_um": self.overlap.round(5).tolist(),
        }


def course(scene: tf.Scene, hours: float, cells: int | None) -> Course:
    """Returns the growth of a batch, which ends at `cells` in every colony or after `hours`."""
    begin, rows = time.perf_counter(), []
    for state in tf.simulate(scene, until=hours, cells=cells, colonies=COLONIES, seed=SEED):
        volume = torch.zeros(COLONIES, dtype=torch.float64)
        volume.index_add_(0, state.colony, state.volume.double())
        overlap = measure.overlaps(state).mean if cells else torch.zeros(COLONIES)
        rows.append((state.time, state.counts.numpy(), volume.numpy(), overlap.numpy()))
    times, counts, volumes, overlaps = (np.array(column) for column in zip(*rows, strict=True))
    return Course(times, counts, volumes, overlaps, time.perf_counter() - begin)


def relative(grown: Course, free: Course) -> np.ndarray:
    """Returns volume over that of the same colony without mechanics, while both are known."""
    both = min(len(grown.hours), len(free.hours))
    return grown.volume[:both] / free.volume[:both]


def summary(name: str, grown: Course, free: Course) -> str:
    """Returns a line for each of some numbers of cells: hours, relative volume, mean overlap."""
    lines, part = [], relative(grown, free).mean(1)
    mean = grown.cells.mean(1)
    for cells in (100, 300, 1000, 2000):
        if mean[-1] < cells:
            continue
        k = int(np.argmax(mean >= cells))
        shown = f"{part[k]:.3f}" if k < len(part) else "-"
        overlap = grown.overlap[k].mean()
        lines.append(f"{name}: {cells} cells at {grown.hours[k]:.2f} h, {shown}, {overlap:.4f} µm")
    return "\n".join(lines)


def draw(courses: dict[str, Course], path: Path) -> None:
    """Draws cells against time, and volume relative to free growth against time and cells."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    free = courses[FREE]
    left.semilogy(free.hours, free.cells, color="silver", lw=5.0)
    left.plot([], [], color="silver", lw=5.0, label=FREE)
    for (name, found), colour in zip(courses.items(), COLOURS, strict=False):
        part = relative(found, free)
        left.semilogy(found.hours, found.cells, color=colour, lw=0.8)
        left.plot([], [], color=colour, label=name)
        middle.plot(found.hours[: len(part)], part, color=colour, lw=0.8)
        right.semilogx(found.cells[: len(part)], part, color=colour, lw=0.8)
    most = max(courses[name].cells.max() for name in DRAGS)
    left.set(xlabel="time, h", ylabel="cells in a colony", ylim=(1, 2 * most))
    left.legend(fontsize=8, loc="lower right")
    for axes, what in ((middle, "time, h"), (right, "cells in a colony")):
        axes.axhline(1.0, color="silver", lw=5.0, zorder=0)
        axes.set(xlabel=what, ylabel="volume / volume without mechanics", ylim=(0, 1.1))
    right.set(xlim=(8, 2 * most))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="200 cells")
    parser.add_argument("--out", type=out_file, help="JSON file; the picture is beside it")
    options = parser.parse_args()
    file = "growth_regimes.json"
    out = options.out or (out_file(f"runs/{file}") if options.quick else None)
    tf.keep_memory()
    cells, free_hours = (200, 7.0) if options.quick else (2000, FREE_HOURS)
    courses = {
        name: course(tf.scenes.microcolony(length_drag=drag), HOURS, cells)
        for name, drag in DRAGS.items()
    }
    scene = tf.scenes.microcolony()
    alone = [effect for effect in scene.effects if not isinstance(effect, tf.Mechanics)]
    courses[FREE] = course(tf.Scene(*alone, dt=scene.dt, dim=2), free_hours, None)
    for name in DRAGS:
        print(summary(name, courses[name], courses[FREE]))
    record = {"machine": machine(), "colonies": COLONIES, "seed": SEED}
    record |= {"courses": {name: found.record() for name, found in courses.items()}}
    (out or HERE / "benchmarks" / file).write_text(json.dumps(record) + "\n")
    pictures = HERE.parent / "docs" / "pictures"
    draw(courses, (out or pictures / file).with_suffix(".png"))


if __name__ == "__main__":
    main()

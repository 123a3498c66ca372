"""Cycles of lysis: populations that grow, burst together and release their cargo.

    OMP_NUM_THREADS=1 python experiments/lysis_cycles.py                     # a minute
    OMP_NUM_THREADS=1 python experiments/lysis_cycles.py --hours 8 --picture runs/lysis.png

Eight colonies of the scene `synchronized_lysis` run for 24 h. The script prints the hours at which
each colony has the most cells, and the mean and spread of the time between them. It draws the
course of all colonies: docs/pictures/lysis.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from arguments import out_file, positive
from matplotlib import pyplot as plt

import torchfilm as tf

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "lysis.png"
COLONIES, SEED = 8, 0
APART = 1.5  # hours between two bursts, at least
SETTLED = 6.0  # hours after which the cycles are as later ones


def peaks(hours: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Returns the hours (K,) at which a colony of `cells` (T,) has more of them than at any other
    time within APART."""
    near = [np.abs(hours - t) <= APART for t in hours]
    whole = (hours >= APART) & (hours <= hours[-1] - APART)
    tops = [k for k in np.flatnonzero(whole) if cells[k] == cells[near[k]].max()]
    # of equal numbers within APART the first: one burst
    apart = np.diff(hours[tops], prepend=-np.inf) > APART
    return hours[tops][apart]


def draw(hours: np.ndarray, rows: dict[str, np.ndarray], path: Path) -> None:
    """Draws rows (T, B) against time; the first colony in blue."""
    figure, panels = plt.subplots(len(rows), 1, sharex=True, figsize=(8, 5), layout="constrained")
    for axes, (name, values) in zip(panels, rows.items(), strict=True):
        axes.plot(hours, values[:, 1:], color="silver", lw=0.8)
        axes.plot(hours, values[:, 0], color="tab:blue", lw=1.5)
        axes.set(ylabel=name, xlim=(0, hours[-1]), ylim=(0, None))
    panels[-1].set_xlabel("time, h")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=positive, default=24.0)
    parser.add_argument("--picture", type=out_file, default=PICTURE)
    options = parser.parse_args()
    scene, names = tf.scenes.synchronized_lysis(), ("cells", "AHL, conc", "cargo outside, conc")
    found = []
    for state in tf.simulate(scene, until=options.hours, colonies=COLONIES, seed=SEED):
        means = (state.signals[n].reshape(COLONIES, -1).mean(1) for n in ("ahl", "cargo"))
        found.append([state.time, (state.counts, *means)])
    hours = np.array([time for time, _ in found])
    rows = {n: np.array([x[k].numpy() for _, x in found]) for k, n in enumerate(names)}
    between = []
    for b in range(COLONIES):
        tops = peaks(hours, rows["cells"][:, b])
        between += np.diff(tops).tolist()
        when = ", ".join(f"{t:.1f}" for t in tops)
        print(f"colony {b}: " + (f"most cells at {when} h" if when else "no burst yet"))
    if between:
        print(f"between bursts: {np.mean(between):.2f} ± {np.std(between):.2f} h")
    else:
        print("between bursts: no colony has burst twice; give more --hours")
    last = rows["cells"][hours > SETTLED]
    if len(last):
        print(f"cells after {SETTLED:g} h: {last.min()} to {last.max()}")
    draw(hours, rows, options.picture)


if __name__ == "__main__":
    main()

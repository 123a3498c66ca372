"""From a table of segmented cells to growth rate and division length: one fit, in minutes.

    OMP_NUM_THREADS=1 python experiments/fit_colony.py
    OMP_NUM_THREADS=1 python experiments/fit_colony.py --simulations 200 --out runs/fit

The script grows colonies of hidden parameters and writes what a segmentation program would: a table
with a row for each cell, in pixels, degrees and arbitrary fluorescence. From this table alone it
infers the parameters with their intervals, and compares them with the truth. It writes table.csv,
fit.json, fit.png and simulations.h5 into the folder --out; run again, it takes the simulations
from there. With all simulations it also replaces the record and the picture of docs/inference.md.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from pathlib import Path

import torch
from arguments import at_least, out_folder

import torchfilm as tf
from design import Observed, Parameter, infer
from design.inference import LEAST

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from record import machine

HERE = Path(__file__).parent
HOURS, COLONIES, SEED = 4.0, 4, 2026
PIXEL = 0.065  # µm
SIMULATIONS, FLOWS = 2000, 3  # few simulations need more flows, to be no surer than right
TRUTH = {"rate": 1.15, "division": 3.4, "variation": 0.12, "make": 3.0}
PARAMETERS = [
    Parameter("rate", 0.7, 1.5, log=True),
    Parameter("division", 2.5, 5.0),
    Parameter("variation", 0.02, 0.4, log=True),
    Parameter("make", 0.5, 20.0, log=True),
]


def express(u, s, p, cell):
    """A reporter that cells make at a rate of their own; growth dilutes it."""
    return {"gfp": p.make - 0.2 * u.gfp}


def colony(rate=1.0, division=4.0, variation=0.1, make=5.0):
    """Growth at `rate` (1/h, median over the cells, sigma `variation`), division at `division` µm
    ± 10 %, and a reporter made at `make` ± 30 %."""
    return tf.Scene(
        tf.Growth(rate=tf.LogNormal(rate, variation)),
        tf.Division(length=tf.LogNormal(division, 0.1)),
        tf.Mechanics(dim=2),
        tf.Circuit(express, species=("gfp",), make=tf.LogNormal(make, 0.3)),
        dt=0.05,
    )


def write_table(path: Path) -> int:
    """Writes the table of the hidden colonies; returns its number of cells."""
    scene = colony(**TRUTH)
    state = tf.simulate(scene, until=HOURS, colonies=COLONIES, seed=SEED).last()
    angle = torch.rad2deg(torch.atan2(state.axis[:, 1], state.axis[:, 0]))
    columns = {
        "colony": state.colony,
        "x_px": state.position[:, 0] / PIXEL,
        "y_px": state.position[:, 1] / PIXEL,
        "length_px": (state.length + 2.0 * state.radius) / PIXEL,  # as masks have it
        "angle_deg": angle,
        "gfp": state.gfp,
    }
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(c.tolist() for c in columns.values()), strict=True))
    return state.cells


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--simulations", type=at_least(LEAST), default=SIMULATIONS)
    parser.add_argument("--out", type=out_folder, default="runs/fit")
    options = parser.parse_args()
    tf.keep_memory()
    table = options.out / "table.csv"
    cells = write_table(table)
    begin = time.perf_counter()
    observed = Observed.from_table(
        table, species=["gfp"], pixel_size=PIXEL, length_with_caps=True, time=HOURS
    )
    print(observed.table())
    posterior = infer(
        colony, PARAMETERS, observed, simulations=options.simulations,
        path=options.out / "simulations.h5", flows=FLOWS,
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    print(posterior.table())
    print(f"{seconds:.0f} s; truth: {TRUTH}")
    record = {
        "machine": machine(),
        "simulations": options.simulations,
        "colonies": COLONIES,
        "cells": cells,
        "seconds": round(seconds, 1),
        "truth": TRUTH,
        "mean": posterior.mean,
        "interval_90": posterior.interval(0.9),
        "surprises": posterior.surprises,
    }
    (options.out / "fit.json").write_text(json.dumps(record, indent=1) + "\n")
    posterior.plot(options.out / "fit.png", truth=TRUTH)
    if options.simulations >= SIMULATIONS:
        (HERE / "benchmarks" / "fit_colony.json").write_text(json.dumps(record, indent=1) + "\n")
        posterior.plot(HERE.parent / "docs" / "pictures" / "posterior.png", truth=TRUTH)


if __name__ == "__main__":
    main()

"""A French flag: three genes read one gradient, and each should light one third of the colony.

    python experiments/bands.py --colonies 1000

A morphogen enters at the left face and decays. A high concentration switches blue on and a low
concentration red. Green has one promoter that the morphogen activates and one that it represses; it
is on between the two. The search varies the four thresholds and their sharpness.
"""

from __future__ import annotations

import argparse

import torch
from arguments import out_stem, whole

import torchfilm as tf
from design import CMAES, Bands, Parameter, Search

REACH = 10.0  # µm over which the morphogen falls to 1/e
SIDE = 32.0  # µm from the centre to each face


def genes(u, s, p, cell):
    """Three fluorescent proteins, controlled by the morphogen through Hill functions."""
    m = s.morphogen
    on = lambda threshold: m**p.n / (threshold**p.n + m**p.n)
    return {
        "blue": p.make * on(p.blue_above) - p.decay * u.blue,
        "green": p.make * on(p.green_above) * (1 - on(p.green_below)) - p.decay * u.green,
        "red": p.make * (1 - on(p.red_below)) - p.decay * u.red,
    }


def flag(blue_above=0.5, green_above=0.2, green_below=0.5, red_below=0.2, n=4.0) -> tf.Scene:
    """Returns a colony that grows in a gradient.

    The thresholds are fractions of the concentration of the morphogen at the left face.
    """
    steady = lambda places: torch.exp(-(places[:, 0] + SIDE) / REACH)
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(
            genes,
            species=("blue", "green", "red"),
            blue_above=blue_above,
            green_above=green_above,
            green_below=green_below,
            red_below=red_below,
            n=n,
            make=10.0,
            decay=4.0,
            rtol=1e-2,
        ),
        tf.Medium(
            morphogen=tf.Signal(diffusion=10 * REACH**2, decay=10.0, initial=steady),
            box=((-SIDE, -SIDE), (SIDE, SIDE)),
            spacing=4.0,
            boundary=tf.BoundaryConditions(x=(tf.Dirichlet(1.0), tf.NoFlux())),
        ),
        name="flag",
    )


PARAMETERS = [
    *(
        Parameter(name, 1e-3, 1.0, log=True)
        for name in ("blue_above", "green_above", "green_below", "red_below")
    ),
    Parameter("n", 1.0, 8.0),
]
TARGET = Bands(("blue", "green", "red"), (-40.0, -4.0, 4.0, 40.0), floor=0.1)
COLONY = {"cells": 100, "dt": 0.05}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--colonies", type=whole, default=1000, help="number to simulate")
    parser.add_argument(
        "--out", type=out_stem, default="bands", help="path of the files to write, without suffix"
    )
    options = parser.parse_args()
    tf.keep_memory()
    search = Search(flag, PARAMETERS, TARGET, **COLONY, method=CMAES(population=24), replicates=4)
    best = search.run(options.colonies, study=options.out.with_suffix(".h5"))
    print(best.table())
    print(
        best.save(options.out.with_suffix(".json")),
        best.plot().save(options.out.with_suffix(".png")),
    )


if __name__ == "__main__":
    try:
        main()
    except tf.InputError as error:
        raise SystemExit(str(error)) from None

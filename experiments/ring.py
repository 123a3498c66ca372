"""A ring: cells light up at some distance from a source in the centre (Basu et al. 2005), where
the signal is neither too high nor too low.

    python experiments/ring.py --colonies 1000

The search chooses a promoter and its constants. A "steep" promoter binds four molecules of the
signal, a "shallow" one two.
"""

from __future__ import annotations

import argparse

from arguments import out_stem, whole

import torchfilm as tf
from design import CMAES, Choice, Parameter, Ring, Search

POWERS = {"shallow": 2.0, "steep": 4.0}


def detector(u, s, p, cell):
    """GFP where the signal is above one threshold and below another.

    A repressor, whose production takes time, switches GFP off at high signal.
    """
    low, high = (
        s.signal**p.n / (p.above**p.n + s.signal**p.n),
        s.signal**p.n / (p.below**p.n + s.signal**p.n),
    )
    return {
        "repressor": 20.0 * high - p.decay * u.repressor,
        "gfp": p.make * low / (1 + u.repressor**2) - p.decay * u.gfp,
    }


def centre(places):
    """Returns 1 within 3 µm of the centre, else 0."""
    return (places[:, :2].square().sum(1) < 9.0).to(places.dtype)


def band_detector(above=0.05, below=0.3, make=10.0, decay=2.0, promoter="steep") -> tf.Scene:
    """Returns a colony of band detectors around a source."""
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(
            detector,
            species=("repressor", "gfp"),
            above=above,
            below=below,
            make=make,
            decay=decay,
            n=POWERS[promoter],
            rtol=1e-2,
        ),
        tf.Medium(
            signal=tf.Signal(diffusion=250.0, decay=10.0, source=centre),
            box=((-34, -34), (34, 34)),
            spacing=4.0,
        ),
        name="band_detector",
    )


PARAMETERS = [
    Parameter("above", 1e-5, 1e-1, log=True),
    Parameter("below", 1e-5, 1e-1, log=True),
    Parameter("make", 1.0, 100.0, log=True),
    Parameter("decay", 0.5, 10.0, log=True),
    Choice("promoter", tuple(POWERS)),
]
TARGET = Ring("gfp", radius=9.0, width=4.0, floor=0.2)
COLONY = {"cells": 150, "dt": 0.05}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--colonies", type=whole, default=1000, help="number to simulate")
    parser.add_argument(
        "--out", type=out_stem, default="ring", help="path of the files to write, without suffix"
    )
    options = parser.parse_args()
    tf.keep_memory()
    search = Search(
        band_detector, PARAMETERS, TARGET, **COLONY, method=CMAES(population=24), replicates=4
    )
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

"""A layer of a biofilm lights up: from 3 to 8 µm below its top, where there is some nutrient, but
not much.

    python experiments/film_band.py --colonies 200

The search chooses the two thresholds of a band detector for the nutrient, on which the film grows.
"""

from __future__ import annotations

import argparse

from arguments import out_stem, whole

import torchfilm as tf
from design import Bands, Parameter, Search


def detector(u, s, p, cell):
    """GFP where the nutrient is above one threshold and below another."""
    above = tf.kinetics.activation(s.nutrient, p.above, 4)
    return {"gfp": 20.0 * above * tf.kinetics.repression(s.nutrient, p.below, 4) - 4.0 * u.gfp}


def film(above=0.1, below=0.3) -> tf.Scene:
    """A slice of a biofilm, some 25 µm high after 14 h, of cells with the detector."""
    grows = tf.scenes.biofilm(diffusion=2e4, width=40.0, height=40.0)
    circuit = tf.Circuit(detector, species="gfp", above=above, below=below)
    return tf.Scene(*grows.effects, circuit, founders=grows.founders, dt=grows.dt, name="film")


PARAMETERS = [Parameter("above", 1e-3, 1.0, log=True), Parameter("below", 1e-3, 1.0, log=True)]
TARGET = Bands(("gfp",), (3.0, 8.0), along="top", floor=0.5)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--colonies", type=whole, default=200, help="number to simulate")
    parser.add_argument(
        "--out", type=out_stem, default="film", help="path of the files to write, without suffix"
    )
    options = parser.parse_args()
    tf.keep_memory()
    search = Search(film, PARAMETERS, TARGET, until=14.0, replicates=2)
    best = search.run(options.colonies, study=options.out.with_suffix(".h5"))
    print(best.table())
    best.plot(options.out.with_suffix(".png"))


if __name__ == "__main__":
    try:
        main()
    except tf.InputError as error:
        raise SystemExit(str(error)) from None

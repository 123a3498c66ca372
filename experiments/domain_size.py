"""Searches toggle switches that divide a colony into patches of a given size.

    python experiments/domain_size.py --size 12 --colonies 400

Two genes repress each other; the circuit simulates single molecules. Founders start at the tipping
point. A cell that has switched to one side passes this state to its descendants. The strength of
the switch, its turnover and its number of molecules decide how early cells switch and whether they
switch back.
"""

from __future__ import annotations

import argparse

from arguments import out_stem, positive, whole

import torchfilm as tf
from design import DomainSize, Parameter, Search

PARAMETERS = [
    Parameter("strength", 3.0, 30.0, log=True),
    Parameter("speed", 0.3, 10.0, log=True),
    Parameter("molecules_per_unit", 1.0, 100.0, log=True),
]
COLONY = {"cells": 100, "dt": 0.05}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--size", type=positive, default=12.0, help="target size of the patches, µm"
    )
    parser.add_argument("--colonies", type=whole, default=400, help="number to simulate")
    parser.add_argument(
        "--out",
        type=out_stem,
        default="domain_size",
        help="path of the files to write, without suffix",
    )
    options = parser.parse_args()
    tf.keep_memory()
    search = Search(
        "toggle_switch",
        PARAMETERS,
        DomainSize(("red", "green"), options.size),
        **COLONY,
        replicates=8,  # colonies of single molecules differ by luck
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

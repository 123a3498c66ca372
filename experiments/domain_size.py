"""How large are the patches into which a colony of toggle switches falls? Find switches that make
them as large as wanted.

    python experiments/domain_size.py --size 12 --colonies 400

Two genes repress each other, molecule by molecule. Founders start at the tipping point; a cell that
has fallen to one side takes its descendants along. How early they fall, and whether they fall back,
is up to the switch: its strength, how fast it turns over, where it starts, and how many molecules
it has.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torchfilm as tf
from design import CMAES, DomainSize, Parameter, Search

PARAMETERS = [
    Parameter("strength", 3.0, 30.0, log=True),
    Parameter("speed", 0.3, 3.0, log=True),
    Parameter("molecules_per_unit", 1.0, 100.0, log=True),
]
COLONY = {"cells": 100, "dt": 0.05}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=float, default=12.0, help="wanted, µm")
    parser.add_argument("--colonies", type=int, default=400)
    parser.add_argument(
        "--out", type=Path, default=Path("domain_size"), help="stem of the files that are written"
    )
    options = parser.parse_args()
    tf.keep_memory()
    search = Search(
        "toggle_switch",
        PARAMETERS,
        DomainSize(("red", "green"), options.size),
        **COLONY,
        method=CMAES(population=16),
        replicates=4,
    )
    best = search.run(options.colonies, study=options.out.with_suffix(".h5"))
    print(best.table())
    print(best.save(options.out.with_suffix(".json")), best.plot(options.out.with_suffix(".png")))


if __name__ == "__main__":
    main()

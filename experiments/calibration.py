"""Simulation-based calibration of `design.infer`: do 90 % regions cover 90 % of hidden truths?

    OMP_NUM_THREADS=1 python experiments/calibration.py          # five minutes
    OMP_NUM_THREADS=1 python experiments/calibration.py --simulations 500 --truths 40 --out runs/sbc

The scene and its four parameters are those of fit_colony.py; each truth is one colony of a few to
a few hundred cells, whose statistics have ages, too. The posteriors of all truths come from one
estimator. Five times as many truths tell chance from fault. With all simulations and truths the
script replaces the record beside the other benchmarks and the picture of docs/inference.md.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from arguments import at_least, out_folder, whole
from fit_colony import HOURS, PARAMETERS, SEED, TRUTH, colony

import torchfilm as tf
from design import Observed, Posterior, infer
from design.inference import LEAST

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from record import machine

HERE = Path(__file__).parent
SIMULATIONS, TRUTHS = 5000, 200
MORE = 5  # times as many truths, for a coverage with less noise
LEVELS = (0.5, 0.8, 0.9, 0.95)
WANTED = (0.86, 0.94)  # coverage of 90 % regions


def observe(path: Path) -> Observed:
    """Returns one observed colony, with ages; it says which statistics are compared."""
    scene = colony(**TRUTH)
    recorder = tf.Recorder(path, scene, every=100, overwrite=True)
    for _ in tf.simulate(scene, until=HOURS, seed=SEED, record=recorder):
        pass
    return Observed.from_results(path, species=["gfp"])


def calibrate(simulations: int, truths: int, out: Path) -> tuple[dict, Posterior]:
    """Returns the record of a calibration; draws its picture."""
    begin = time.perf_counter()
    posterior = infer(
        colony,
        PARAMETERS,
        observe(out / "observed.h5"),
        simulations=simulations,
        path=out / "simulations.h5",
    )
    learnt = time.perf_counter()
    found = posterior.check(truths)
    done = time.perf_counter()
    print(found.table())
    found.plot(out / "ranks.png")
    covered = found.coverage(0.9)
    more = posterior.check(MORE * truths)
    print(more.table())
    record = {
        "machine": machine(),
        "simulations": simulations,
        "truths": truths,
        "failed": found.failed,
        "seconds": {
            "simulate and learn": round(learnt - begin, 1),
            "check": round(done - learnt, 1),
        },
        "coverage": {f"{level:g}": found.coverage(level) for level in LEVELS},
        "coverage of more truths": {"truths": MORE * truths, "0.9": more.coverage(0.9)},
        "wanted": WANTED,
        "met": {name: WANTED[0] <= share <= WANTED[1] for name, share in covered.items()},
        "ranks": found.ranks.tolist(),
        "density_ranks": found.density_ranks.tolist(),
    }
    if simulations >= SIMULATIONS and truths >= TRUTHS:
        found.plot(HERE.parent / "docs" / "pictures" / "calibration.png")
    return record, posterior


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--simulations", type=at_least(LEAST), default=SIMULATIONS)
    parser.add_argument("--truths", type=whole, default=TRUTHS)
    parser.add_argument("--out", type=out_folder, default="runs/calibration")
    options = parser.parse_args()
    tf.keep_memory()
    record, _ = calibrate(options.simulations, options.truths, options.out)
    text = json.dumps(record) + "\n"
    (options.out / "calibration.json").write_text(text)
    if options.simulations >= SIMULATIONS and options.truths >= TRUTHS:
        (HERE / "benchmarks" / "calibration.json").write_text(text)


if __name__ == "__main__":
    main()

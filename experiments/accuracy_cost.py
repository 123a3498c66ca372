"""What accuracy costs: work–precision studies of mechanics, circuits, signals and splitting.

    OMP_NUM_THREADS=1 python experiments/accuracy_cost.py                   # all studies
    OMP_NUM_THREADS=1 python experiments/accuracy_cost.py --study circuits  # one group
    OMP_NUM_THREADS=1 python experiments/accuracy_cost.py --quick --out runs/accuracy
    python experiments/accuracy_cost.py --write-only                        # no studies

Each study changes one knob at a time, then several together. It measures errors against a tighter
and independent reference. Short runs, in which the cells stay the same, give orders of convergence.
Long runs are chaotic; there the study compares statistics over seeds, with confidence bands.
Costs are seconds on this machine and counts of operations, which do not depend on hardware.

The script writes CSV files and records.json to experiments/benchmarks/accuracy, and from them
docs/accuracy_appendix.md with its pictures. `--write-only` writes the page and the pictures from
the existing records. The studies are in experiments/accuracy. The prose of the appendix is in
experiments/accuracy/appendix_template.md. docs/accuracy.md is written by hand.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from arguments import out_folder

import torchfilm as tf

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "accuracy"), str(HERE / "benchmarks")]
import appendix  # noqa: E402
import circuits  # noqa: E402
import mechanics  # noqa: E402
import signals  # noqa: E402
import splitting  # noqa: E402
from record import machine  # noqa: E402
from study import Study, plot, table, write_csv  # noqa: E402

# Each is stored as soon as it is done.
STUDIES: dict[str, Callable[[bool], Iterator[Study]]] = {
    "mechanics": mechanics.studies,
    "circuits": circuits.studies,
    "signals": signals.studies,
    "splitting": splitting.studies,
}


def store(study: Study, folder: Path | None) -> None:
    """Writes a study's CSV file and picture: to `folder`, or to the records of the appendix."""
    if folder is None:
        appendix.add_study(study, machine())
        plot(study, appendix.picture(study.name))
        appendix.write()
    else:
        write_csv(study, folder / f"{study.name}.csv")
        plot(study, folder / f"accuracy_{study.name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--study",
        action="append",
        choices=tuple(STUDIES),
        help="one group of studies; may be repeated",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="few settings on small colonies, as a test; writes to runs/accuracy, not to the page",
    )
    parser.add_argument(
        "--out",
        type=out_folder,
        help="folder for CSV files and pictures; leaves the page unchanged",
    )
    parser.add_argument(
        "--write-only",
        action="store_true",
        help="write the appendix and its pictures from the existing records; run no study",
    )
    options = parser.parse_args()
    if options.write_only:
        if options.study or options.quick or options.out:
            parser.error("--write-only takes no other option")
        print(appendix.write(pictures=True))
        return
    tf.keep_memory()
    torch.set_grad_enabled(False)
    folder = options.out or (Path("runs/accuracy") if options.quick else None)
    for group in options.study or STUDIES:
        start = time.perf_counter()
        for study in STUDIES[group](options.quick):
            store(study, folder)
            seconds = time.perf_counter() - start
            print(f"\n{study.title} ({seconds:.0f} s of {group})\n{table(study)}", flush=True)


if __name__ == "__main__":
    main()

"""What accuracy costs: work–precision studies of mechanics, circuits, signals and their splitting,
each knob alone and then several together.

    OMP_NUM_THREADS=1 python experiments/accuracy_cost.py                    # all; writes docs/accuracy.md, its pictures and CSV
    OMP_NUM_THREADS=1 python experiments/accuracy_cost.py --study circuits --quick --out runs/accuracy

Each study measures its errors against a tighter and independent reference. Where topology stays
(short runs) orders are measured; where runs are long and chaotic, statistics over seeds with their
confidence bands. Costs are seconds of this machine and, free of hardware, applications of
operators. The studies are in experiments/accuracy, one file each; the words around their tables in
docs/accuracy.md are written by hand.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

import torchfilm as tf

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "accuracy"), str(HERE / "benchmarks")]
import circuits  # noqa: E402
import mechanics  # noqa: E402
import signals  # noqa: E402
import splitting  # noqa: E402
from record import machine, write_page  # noqa: E402
from study import Study, plot, table, write_csv  # noqa: E402

STUDIES: dict[str, Callable[[bool], list[Study]]] = {
    "mechanics": mechanics.studies,
    "circuits": circuits.studies,
    "signals": signals.studies,
    "splitting": splitting.studies,
}


def told(study: Study, picture: str) -> str:
    """A study's part of the page, in Markdown."""
    noted = machine()
    how = (
        f"Measured {noted['date'][:10]} at commit {noted['commit']}, torch {noted['torch']},"
        f" {noted['threads']} thread(s), {noted['processor']}."
    )
    return "\n\n".join(
        [
            f"{study.words} Errors are {study.reference}. {how}",
            f"![{study.title}]({picture})",
            table(study),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--study",
        action="append",
        choices=tuple(STUDIES),
        help="one group of studies; may be given again",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="few settings on small colonies, to see that it runs; writes no page",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for CSV and pictures instead of those of the page, which is then not written",
    )
    chosen = parser.parse_args()
    tf.keep_memory()
    torch.set_grad_enabled(False)
    out = chosen.out or (Path("runs/accuracy") if chosen.quick else None)
    for group in chosen.study or STUDIES:
        begun = time.perf_counter()
        for study in STUDIES[group](chosen.quick):
            write_csv(study, (out or HERE / "benchmarks" / "accuracy") / f"{study.name}.csv")
            picture = (out or HERE.parent / "docs" / "pictures") / f"accuracy_{study.name}.png"
            plot(study, picture)
            print(
                f"\n{study.title} ({time.perf_counter() - begun:.0f} s since the group"
                f" began)\n{table(study)}",
                flush=True,
            )
            if out is None:
                write_page(
                    HERE.parent / "docs" / "accuracy.md",
                    told(study, f"pictures/{picture.name}"),
                    f"{study.name}: experiments/accuracy_cost.py",
                )


if __name__ == "__main__":
    main()

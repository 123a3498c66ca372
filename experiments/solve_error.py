"""Measures the error of contact forces that a solve leaves, beside the tolerance that it was given.

    python experiments/solve_error.py            # some minutes; writes a table of docs/mechanics.md
    python experiments/solve_error.py --print    # the table alone, as with other sizes or seeds

A solve estimates its error, and stops where the estimate is within `tolerance`. Here colonies grow
in 2-D and in 3-D between agarose and coverslip, freely and with the paper's length drag. At certain
sizes each solve of one step (the first pass, and those that repeat it) is carried on to an estimate
of 1e-3. What the energy falls by on the way, E − E*, is the energy of what the first had left:
its relative error is √(2 (E − E*) / overlap²), overlaps counted as in the stopping rule.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import torch
from arguments import at_least, whole
from torch import Tensor

import torchfilm as tf
from torchfilm.physics import one_sided
from torchfilm.physics.one_sided_solve import Minimum, minimise
from torchfilm.physics.problem import ContactProblem

HERE = Path(__file__).parent
sys.path.append(str(HERE / "benchmarks"))
from growth import scene  # noqa: E402
from record import write_page  # noqa: E402

SIZES = (100, 150, 200, 300, 400, 600, 800, 1000, 1500, 2000, 3000, 4000, 5000, 7000)
LARGE = 1000  # cells; the table tells solves of more from those of fewer
TIGHT, MOST = 1e-3, 100_000  # estimated error and iterations of what a solve is measured against
REGIMES = "free", "pressed"
SEEDS = 2


@dataclass(frozen=True)
class Solve:
    """One solve: how many cells it moved, and its relative error, which was to be `tolerance`."""

    cells: int
    error: float
    tolerance: float


def energy(problem: ContactProblem, end: Minimum) -> float:
    """Returns E of a minimum: see `torchfilm.kernels.solve`."""
    forces = end.after.double().clamp(max=0.0)
    return 0.5 * float((forces**2).sum() + (problem.alpha * end.y.double() ** 2).sum())


def error_left(problem: ContactProblem, end: Minimum, cap: Tensor) -> float:
    """Returns the relative error of a minimum of one colony."""
    tight = minimise(problem, end.y, TIGHT, cap, MOST)
    counted = torch.minimum(end.after.double().clamp(max=0.0) ** 2, cap**2)
    fall = energy(problem, end) - energy(problem, tight)
    # where nothing overlaps any more, relative to contacts as deep as counted: see `minimise`
    return (2.0 * max(fall, 0.0) / float(counted.sum() or cap**2)) ** 0.5


def solves(regime: str, dim: int, seed: int, sizes: tuple[int, ...]) -> Iterator[Solve]:
    """Yields the solves of one step at each of the sizes, cells, on the way of one colony."""
    found: list[Solve] = []

    def watched(problem, y, tolerance, cap, limit):
        end = minimise(problem, y, tolerance, cap, limit)
        if int((problem.gap < 0).sum()):
            error = error_left(problem.detached(), end, cap)
            found.append(Solve(len(problem.scale), error, tolerance))
        return end

    model = scene(dim, regime, "torch").bind()
    left = list(sizes)
    for state in tf.simulate(scene(dim, regime, "compiled"), seed=seed, cells=left[-1]):
        if left and state.cells >= left[0]:
            left = [size for size in left if size > state.cells]
            with mock.patch.object(one_sided, "minimise", watched):
                model.step(state, 0.025)
            yield from found
            found.clear()


def table(found: dict[tuple[str, int], list[Solve]]) -> str:
    """Returns the table of the page."""
    lines = [
        "| growth | solves | tolerance | error: median | nine of ten within | worst |",
        "|---|---|---|---|---|---|",
    ]
    for (regime, dim), some in found.items():
        for words, large in ((f"up to {LARGE} cells", False), ("of more", True)):
            errors = torch.tensor([s.error for s in some if (s.cells > LARGE) == large])
            if len(errors):
                median, most, worst = errors.quantile(torch.tensor([0.5, 0.9, 1.0])).tolist()
                lines.append(
                    f"| {regime}, {dim}-D | {len(errors)} {words} | {some[0].tolerance:g} |"
                    f" {median:.3f} | {most:.3f} | {worst:.3f} |"
                )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--print", action="store_true", help="write no page")
    parser.add_argument("--seeds", type=whole, default=SEEDS, help="colonies of each kind")
    parser.add_argument("--cells", type=at_least(SIZES[0]), default=SIZES[-1], help="largest size")
    options = parser.parse_args()
    sizes = tuple(size for size in SIZES if size <= options.cells)
    found: dict[tuple[str, int], list[Solve]] = {}
    for dim in (2, 3):
        for regime in REGIMES:
            some = found.setdefault((regime, dim), [])
            for seed in range(1, options.seeds + 1):
                some += solves(regime, dim, seed, sizes)
            print(table({(regime, dim): some}), flush=True)
    usual = (options.seeds, options.cells) == (SEEDS, SIZES[-1])  # of other runs no page tells
    if usual and not options.print:
        page = HERE.parent / "docs" / "mechanics.md"
        write_page(page, table(found), "experiments/solve_error.py")


if __name__ == "__main__":
    main()

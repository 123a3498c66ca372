"""Two strains that sort by what sticks to what, for several strengths of their adhesins.

    OMP_NUM_THREADS=1 python experiments/strain_sorting.py                     # half a minute
    OMP_NUM_THREADS=1 python experiments/strain_sorting.py --hours 4 --picture runs/sorting.png

Colonies of the scene `strain_sorting`, four for each strength, run for 20 h. The script prints the
share of contacts that are between cells of one strain, every five hours and at the end, with the
standard deviation over colonies, and the speed at which the script ran. It draws one colony of each
strength at the end: docs/pictures/strain_sorting.png.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from arguments import out_file, positive

import torchfilm as tf
from torchfilm import pictures

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "strain_sorting.png"
STRENGTHS, REPLICATES, SEED = (0.0, 20.0, 50.0, 300.0), 4, 0
EVERY = 500  # steps between two lines, 5 h
CONTACT = 0.1  # µm: surfaces that are nearer than this touch


def say(state: tf.State) -> None:
    """Prints the shares of contacts within a strain, by strength."""
    shares = tf.measure.alike_neighbours(state, CONTACT).view(-1, REPLICATES)
    both = zip(shares.mean(1).tolist(), shares.std(1).tolist(), strict=True)
    text = ", ".join(f"{mean:.2f} ± {spread:.2f}" for mean, spread in both)
    print(f"{state.time:4.1f} h: {text}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=positive, default=20.0)
    parser.add_argument("--picture", type=out_file, default=PICTURE)
    options = parser.parse_args()
    each = torch.tensor(STRENGTHS).repeat_interleave(REPLICATES)
    scene = tf.scenes.strain_sorting(strength=each.tolist())
    print(f"strength, μ·µm²/h: {', '.join(f'{x:g}' for x in STRENGTHS)}")
    begun = time.perf_counter()
    for state in tf.simulate(scene, until=options.hours, colonies=len(each), seed=SEED):
        if state.step % EVERY == 0:
            say(state)
    if state.step % EVERY:
        say(state)
    seconds = time.perf_counter() - begun
    print(f"{1e6 * seconds / state.step / state.cells:.1f} µs for a cell and step")
    shown = [k * REPLICATES for k in range(len(STRENGTHS))]
    pictures.show(
        state, scene=scene, colour="cell_type", colonies=shown, out=options.picture, dpi=110,
        title="strengths " + ", ".join(f"{x:g}" for x in STRENGTHS) + " μ·µm²/h",
    )  # fmt: skip


if __name__ == "__main__":
    main()

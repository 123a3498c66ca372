"""A colony on a surface: how strongly cells stick to it decides when a second layer begins.

    python experiments/sticky_floor.py

Cells that grow on a flat floor with nothing above, in four strengths of adhesion to the floor,
eight colonies of each. The script prints a table of three sizes: the share of the cells that touch
the floor, the height of the colonies, and their radius. It draws one colony of each strength with
1600 cells, from the side: docs/pictures/sticky_floor.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from arguments import out_file

import torchfilm as tf
from torchfilm import pictures

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "sticky_floor.png"
STRENGTHS, REPLICATES, SIZES, SEED = (0.0, 10.0, 30.0, 100.0), 8, (100, 400, 1600), 1
DRAWN = 1600  # cells
CONTACT = 0.1  # µm: an end that is nearer to the floor than this touches it


def scene_of(strengths: list[float]) -> tf.Scene:
    """A cell that grows on a floor at z = 0, in a colony for each strength."""
    return tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(
            dim=3, walls=[tf.Plane(z=0.0, facing="+z")],
            adhesion=[tf.Adhesion(strengths, to="walls")],  # a strength of 0 holds nothing
        ),
        founders=tf.Cells([[0.0, 0.0, 0.5]], [[1.0, 0.0, 0.0]], 2.0),
    )  # fmt: skip


def measures(state: tf.State) -> torch.Tensor:
    """The share of each colony's cells that touch the floor, its height and radius, µm: (B, 3)."""
    rise = 0.5 * state.axis[:, 2].abs() * state.length
    low, high = state.position[:, 2] - rise - state.radius, state.position[:, 2] + rise
    touching = torch.bincount(state.colony, (low < CONTACT).double(), minlength=state.colonies)
    height = state.groups.max((high + state.radius).double())
    return torch.stack([touching / state.counts, height, tf.measure.colony_radius(state)], 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--picture", type=out_file, default=PICTURE)
    options = parser.parse_args()
    each = torch.tensor(STRENGTHS).repeat_interleave(REPLICATES).tolist()
    scene = scene_of(each)
    print("cells, strength (μ·µm²/h): share on the floor, height and radius (µm)")
    for size in SIZES:
        state = tf.simulate(scene, cells=size, colonies=len(each), seed=SEED).last()
        means = measures(state).view(len(STRENGTHS), REPLICATES, -1).mean(1)
        for strength, (share, height, radius) in zip(STRENGTHS, means.tolist(), strict=True):
            print(f"{size:5d}, {strength:3g}: {share:.2f}, {height:4.1f}, {radius:4.1f}")
        if size == DRAWN:
            shown = [k * REPLICATES for k in range(len(STRENGTHS))]
            pictures.show(
                state, scene=scene, view="xz", colonies=shown, out=options.picture, dpi=110,
                title="strengths " + ", ".join(f"{x:g}" for x in STRENGTHS) + " μ·µm²/h",
            )  # fmt: skip


if __name__ == "__main__":
    main()

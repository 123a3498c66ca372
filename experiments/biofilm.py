"""Slices of biofilms that are fed from above, for several diffusion coefficients of the nutrient.

    OMP_NUM_THREADS=1 python experiments/biofilm.py                     # half a minute
    OMP_NUM_THREADS=1 python experiments/biofilm.py --hours 8 --picture runs/biofilm.png
    OMP_NUM_THREADS=1 python experiments/biofilm.py --rest              # a minute
    OMP_NUM_THREADS=1 python experiments/biofilm.py --losses            # some seconds

Colonies of the scene `biofilm`, four for each coefficient, run for 20 h. The script prints
thickness and roughness of the films every five hours and at the end, with the standard deviation
over colonies, and the speed at which it ran. It draws one colony of each coefficient at the end:
docs/pictures/biofilm.png. With --rest it prints how thick films are that erode, once they have come
to rest. With --losses it draws two films that erode, starve, die and slough:
docs/pictures/biofilm_losses.png.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from arguments import out_file, positive
from torch import Tensor

import torchfilm as tf
from torchfilm import pictures

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
HOURS, EVERY = 20.0, 100  # h; steps between two lines, 5 h
DIFFUSION, REPLICATES, SEED = (1e3, 3e3, 1e4, 1e5), 4, 0
MANY = 20  # cells that slough at once
EROSION, AT_REST, END = (0.005, 0.01, 0.02, 0.04), 25.0, 40.0  # 1/(µm·h), h, h


def in_words(of_colonies: Tensor) -> str:
    """Mean and standard deviation over the colonies of each coefficient."""
    each = of_colonies.view(-1, REPLICATES)
    both = zip(each.mean(1).tolist(), each.std(1).tolist(), strict=True)
    return ", ".join(f"{mean:.2f} ± {spread:.2f}" for mean, spread in both)


def at_rest() -> None:
    """Print the thickness of films that erode, once growth and loss balance."""
    each = torch.tensor(EROSION).repeat_interleave(REPLICATES)
    print(f"erosion, 1/(µm·h): {', '.join(f'{x:g}' for x in EROSION)}")
    for diffusion in DIFFUSION[-2:]:
        scene = tf.scenes.biofilm(
            diffusion=diffusion, width=40.0, height=160.0, first=4, erosion=each.tolist()
        )
        found = [
            tf.measure.film(state).thickness
            for state in tf.simulate(scene, until=END, seed=SEED)
            if state.time > AT_REST and state.step % 10 == 0
        ]
        print(f"diffusion {diffusion:g} µm²/h: thickness {in_words(torch.stack(found).mean(0))} µm")


def say(state: tf.State) -> None:
    """Print thickness and roughness, by coefficient."""
    film = tf.measure.film(state)
    print(f"{state.time:4.1f} h: thickness {in_words(film.thickness)} µm")
    print(f"        roughness {in_words(film.roughness)}")


def losses(picture: Path) -> None:
    """Draw two films that erode, and in which cells that starve die, before one of them sloughs."""
    scene = tf.scenes.biofilm(
        diffusion=1e4, width=40.0, first=4, erosion=[0.005, 0.02], maintenance=0.05
    )
    scene = scene.replace(*scene.effects, tf.Lysis(when="starvation", rate=0.2), tf.Sloughing())
    before = None
    for state in tf.simulate(scene, until=40.0, seed=1):
        lost = int(state.reports["sloughing"].cells.max())
        if lost > MANY and before is not None:
            print(f"{state.time:.2f} h: {lost} cells slough")
            break
        before = state
    assert before is not None
    pictures.show(
        before, scene=scene, colour="growth_rate", background="nutrient", dpi=100,
        out=picture,
        title="erosion 0.005 and 0.02/(µm·h), maintenance 0.05/h",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=positive, help=f"default: {HOURS:g}")
    parser.add_argument("--picture", type=out_file, help="default: one of docs/pictures")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--losses", action="store_true", help="films that die at the floor")
    either.add_argument("--rest", action="store_true", help="films that erode, at rest")
    options = parser.parse_args()
    if options.hours and (options.losses or options.rest):
        parser.error("--losses and --rest end by themselves: leave --hours out")
    if options.picture and options.rest:
        parser.error("--rest draws no picture: leave --picture out")
    if options.rest:
        return at_rest()
    if options.losses:
        return losses(options.picture or PICTURES / "biofilm_losses.png")
    each = torch.tensor(DIFFUSION).repeat_interleave(REPLICATES)
    scene = tf.scenes.biofilm(diffusion=each.tolist())
    print(f"diffusion, µm²/h: {', '.join(f'{x:g}' for x in DIFFUSION)}")
    begun, cell_steps = time.perf_counter(), 0
    for state in tf.simulate(scene, until=options.hours or HOURS, seed=SEED):
        cell_steps += state.cells
        if state.step % EVERY == 0:
            say(state)
    if state.step % EVERY:
        say(state)
    seconds = time.perf_counter() - begun
    print(f"{1e6 * seconds / cell_steps:.1f} µs for a cell and step")
    shown = [k * REPLICATES for k in range(len(DIFFUSION))]
    pictures.show(
        state, scene=scene, colour="growth_rate", background="nutrient", whole=True,
        colonies=shown, dpi=100, out=options.picture or PICTURES / "biofilm.png",
        title="diffusion " + ", ".join(f"{x:g}" for x in DIFFUSION) + " µm²/h",
    )  # fmt: skip


if __name__ == "__main__":
    main()

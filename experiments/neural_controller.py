"""Trains a small network that decides in each cell, to draw a band that stays 3 to 6 µm below the
edge of a growing colony; then distils it to a circuit of Hill functions.

    python experiments/neural_controller.py                  # a quarter of an hour on one core
    python experiments/neural_controller.py --steps 20 --colonies 60 --out runs/neural

Cells eat a food that comes from outside, so its level says how deep a cell lies. A network reads
food and two species, and gives the rates of both and of eating. It is trained by gradient through
circuits, exchange and diffusion on three recorded colonies (64 to 256 cells, scored five times).
The circuit of parts starts at a least-squares fit of the network's rates; a search of the colonies'
loss goes on from there. All are compared on eight colonies that neither has seen. It writes
STEM.json (the weights, data only), STEM_parts.json (for `torchfilm run`) and STEM.png.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from arguments import checked, in_file, out_stem, whole
from scipy.optimize import least_squares
from torch import Tensor

import torchfilm as tf
from design import (
    CMAES,
    Bands,
    FinishedColonies,
    Lasting,
    Parameter,
    Search,
    load_weights,
    save_weights,
)
from design.search import Best
from design.targets.base import levels
from design.trivial import trivial_losses

BAND = Bands(("gfp",), (3.0, 6.0), along="edge", floor=0.2)  # µm below the edge
BEGIN = 4.0  # h: the gradient reaches back to here; a reporter forgets in a quarter of an hour
HOURS = (4.8, 5.2, 5.6, 6.0, 6.2)  # of some 64, 100, 130, 210 and 256 cells
SEED, COLONIES = 0, 3  # on which controller and circuit are trained
NEW_SEED, NEW_COLONIES = 100, 8  # never seen
LOSS = 4.0  # 1/h, of both species of the controller


def colony(rates: Callable, species: tuple[str, ...], **constants: float | Tensor) -> tf.Scene:
    """Cells in one plane around which food is kept at 1: at the faces, and slowly everywhere.

    Two equal stages a step suffice: no rate is above 30/h, and a step is 0.05 h.
    """
    far = tf.Dirichlet(1.0)
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(rates, species=species, method="heun2", **constants),
        tf.Medium(
            food=tf.Signal(diffusion=30.0, decay=0.15, source=0.15, initial=1.0),
            box=((-30, -30), (30, 30)),
            spacing=2.5,
            boundary=tf.BoundaryConditions(x=far, y=far),
        ),
        dt=0.05,
    )


# --- the controller -------------------------------------------------------------------------------


class Controller(torch.nn.Module):
    """Rates of a reporter, of a species that only the network uses, and of eating."""

    def __init__(self, hidden: int = 12):
        super().__init__()
        self.net = torch.nn.Sequential(
            torch.nn.Linear(3, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 3)
        )

    def decide(self, food: Tensor, gfp: Tensor, memory: Tensor) -> tuple[Tensor, ...]:
        """Production of both species, conc/h, and eating, 1/h.

        The inputs are of the order of 1. Production has no upper bound, so that its slope never
        vanishes where cells are lit that should be dark.
        """
        seen = torch.stack([(torch.log(0.01 + food) + 2.0) / 0.6, gfp - 0.5, memory - 0.5], 1)
        out = self.net(seen)
        made = LOSS * torch.nn.functional.softplus(out)
        return made[:, 0], made[:, 1], 10.0 + 20.0 * torch.sigmoid(out[:, 2])

    def forward(self, u, s, p, cell):
        gfp, memory, eating = self.decide(s.food, u.gfp, u.memory)
        rates = {"gfp": gfp - LOSS * u.gfp, "memory": memory - LOSS * u.memory}
        return rates, {"food": -eating * s.food * cell.volume}


def replay_of(scene: tf.Scene, seed: int, colonies: int) -> tf.Replay:
    """The scene on the recorded growth of some colonies."""
    recording = tf.GrowthRecording(scene, streams=range(colonies), seed=seed)
    return tf.Replay(scene.bind(colonies, seed=seed), recording)


def states_of(replay: tf.Replay) -> list[tf.State]:
    """The states that are scored, with a gradient from BEGIN on."""
    with torch.no_grad():
        state = tf.rollout(replay, until=BEGIN)
    states = []
    for hour in HOURS:
        state = tf.rollout(replay, state, until=hour, segment=None)  # some 30 MB
        states.append(state)
    return states


def loss_of(states: list[tf.State]) -> Tensor:
    """The loss of each colony, (B,), the mean over times."""
    return torch.stack([BAND.loss(s) for s in states]).mean(0)


def train(controller: Controller, replay: tf.Replay, steps: int) -> list[float]:
    """Adam; the loss before each step."""
    optimiser = torch.optim.Adam(controller.parameters(), lr=0.1)
    slower = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    losses, start = [], time.perf_counter()
    for k in range(steps):
        optimiser.zero_grad()
        loss = loss_of(states_of(replay)).mean()
        loss.backward()
        optimiser.step()
        slower.step()
        losses.append(float(loss.detach()))
        if k % 10 == 0 or k == steps - 1:
            print(f"step {k:3d}: loss {losses[-1]:.4f}, {time.perf_counter() - start:.0f} s")
    return losses


# --- the circuit of parts -------------------------------------------------------------------------


def promoter(u, s, p, cell):
    """A reporter that food activates and much food represses; cells eat at a constant rate."""
    lit = tf.kinetics.activation(s.food, p.low, p.steep)
    dark = tf.kinetics.repression(s.food, p.high, p.steeper)
    return {"gfp": p.make * lit * dark - p.loss * u.gfp}, {"food": -p.eating * s.food * cell.volume}


def circuit_of_parts(
    make=8.0, low=0.1, steep=3.0, high=0.25, steeper=3.0, loss=LOSS, eating=20.0
) -> tf.Scene:
    """A colony whose cells carry this promoter."""
    return colony(
        promoter, ("gfp",), make=make, low=low, steep=steep, high=high, steeper=steeper,
        loss=loss, eating=eating,
    )  # fmt: skip


PARAMETERS = [
    Parameter("make", 1.0, 1000.0, log=True),  # conc/h
    Parameter("low", 0.01, 1.0, log=True),  # food at half activation
    Parameter("steep", 1.0, 8.0),
    Parameter("high", 0.01, 1.0, log=True),  # food at half repression
    Parameter("steeper", 1.0, 8.0),
    Parameter("loss", 1.0, 10.0, log=True),  # 1/h
    Parameter("eating", 5.0, 30.0, log=True),  # 1/h
]


@torch.no_grad()
def fitted(controller: Controller, states: list[tf.State]) -> dict[str, float]:
    """Constants of the promoter for which it makes as much reporter as the controller does, in all
    cells at all scored times, by least squares; its eating is the controller's mean."""
    food = torch.cat([levels(s, "out.food") for s in states])
    gfp, memory = (torch.cat([levels(s, n) for s in states]) for n in ("gfp", "memory"))
    made, _, eating = controller.decide(food, gfp, memory)
    x, y = food.double().numpy(), made.double().numpy()

    def misses(logs: np.ndarray) -> np.ndarray:
        make, low, steep, high, steeper = np.exp(logs)
        return make / (1 + (low / x) ** steep) / (1 + (x / high) ** steeper) - y

    names = [p.name for p in PARAMETERS[:5]]
    low, high = np.log([(p.low, p.high) for p in PARAMETERS[:5]]).T
    guess = np.log([2 * y.max(), np.quantile(x, 0.3), 3.0, np.quantile(x, 0.7), 3.0])
    guess = np.clip(guess, low + 1e-3, high - 1e-3)
    logs = least_squares(misses, guess, bounds=(low, high)).x
    found = dict(zip(names, np.exp(logs).tolist(), strict=True))
    return found | {"loss": LOSS, "eating": float(eating.mean())}


def distilled(start: dict[str, float], colonies: int) -> Best:
    """The best circuit of parts of a search on the controller's colonies that starts at `start`, in
    a cloud of a twentieth of each range."""
    return Search(
        circuit_of_parts,
        PARAMETERS,
        Lasting(BAND, since=HOURS[0]),
        until=HOURS[-1],
        replicates=COLONIES,
        seed=SEED,
        start=start,
        method=CMAES(sigma=0.05),
    ).run(colonies)


# --- what came of it ------------------------------------------------------------------------------


@torch.no_grad()
def on_new_colonies(scene: tf.Scene) -> list[tf.State]:
    """The scored states of colonies that nothing was trained on."""
    return states_of(replay_of(scene, NEW_SEED, NEW_COLONIES))


def trivial(states: list[tf.State]) -> dict[str, float]:
    """Losses of trivial answers, means over times; the best even level may differ each time."""
    found = [trivial_losses(BAND, [FinishedColonies(s, None)]) for s in states]
    return {name: float(np.mean([f[name] for f in found])) for name in found[0]}


def say(name: str, states: list[tf.State]) -> str:
    """A line of the table: loss, its spread over colonies, at the first and the last time."""
    each = loss_of(states)
    at = [f"{float(BAND.loss(s).mean()):.3f}" for s in (states[0], states[-1])]
    contrast = float(BAND.measures(states[-1])["contrast"].median())
    return (
        f"{name:22s} {float(each.mean()):.3f} ± {float(each.std()):.3f}   {at[0]} → {at[1]}"
        f"   {contrast:.1f}"
    )


@checked
def weights_file(text: str) -> Path:
    """A file of weights of the controller."""
    path = in_file(text)
    load_weights(Controller(), path)
    return path


def draw(rows: dict[str, list[tf.State]], path: Path) -> None:
    """One new colony at three times, of each answer; dashed: where the band should be."""
    from matplotlib.figure import Figure

    from torchfilm.pictures.draw import colour_bar, draw_cells, scale_bar

    shown = (0, 2, len(HOURS) - 1)
    figure = Figure(figsize=(9.0, 3.0 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), len(shown), squeeze=False)
    for line, (name, states) in zip(axes, rows.items(), strict=True):
        brightest = float(max(s.gfp[s.colony == 0].max() for s in states))
        for ax, k in zip(line, shown, strict=True):
            one = states[k].select(torch.tensor([0]))
            cells = {
                n: getattr(one, n).detach().numpy()
                for n in ("position", "axis", "length", "radius", "gfp")
            }
            limits, window = {"gfp": (0.0, brightest)}, (-22.0, 22.0, -22.0, 22.0)
            scales = draw_cells(ax, cells, colour="gfp", limits=limits, window=window)
            BAND.draw(ax, one, 0)
            loss = float(BAND.loss(one))
            ax.set_title(f"{name}, {HOURS[k]:g} h: loss {loss:.2f}", fontsize=9)
        # the scale of a row, within its last panel
        colour_bar(line[-1].inset_axes((0.62, 0.06, 0.33, 0.04)), replace(scales[0], unit="conc"))
    scale_bar(axes[-1, 0])
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=whole, default=100, help="steps of Adam")
    parser.add_argument("--colonies", type=whole, default=600, help="that the search may grow")
    parser.add_argument(
        "--weights", type=weights_file, help="take these weights and train no further"
    )
    parser.add_argument(
        "--out", type=out_stem, default="neural", help="path of the files to write, no suffix"
    )
    options = parser.parse_args()
    tf.keep_memory()
    torch.manual_seed(0)
    controller = Controller()
    scene = colony(controller, ("gfp", "memory"))
    before = on_new_colonies(scene)
    replay = replay_of(scene, SEED, COLONIES)
    if options.weights is None:
        train(controller, replay, options.steps)
    else:
        load_weights(controller, options.weights)
    print(save_weights(controller, options.out.with_suffix(".json")))
    with torch.no_grad():
        start = fitted(controller, states_of(replay))
    best = distilled(start, options.colonies)
    print(best.save(options.out.with_name(options.out.name + "_parts.json")))
    print("\n".join(f"{n}: {start[n]:.3g} fitted, {best.values[n]:.3g} searched" for n in start))
    rows = {
        "before training": before,
        "controller": on_new_colonies(scene),
        "fit to its rates": on_new_colonies(circuit_of_parts(**start)),
        "circuit of parts": on_new_colonies(best.scene()),
    }
    print(f"on {NEW_COLONIES} new colonies:     loss ± spread   first → last time   contrast")
    print("\n".join(say(name, states) for name, states in rows.items()))
    for name, loss in trivial(before).items():
        print(f"{name:22s} {loss:.3f}")
    picture = options.out.with_suffix(".png")
    draw({n: rows[n] for n in ("before training", "controller", "circuit of parts")}, picture)
    print(picture)


if __name__ == "__main__":
    main()

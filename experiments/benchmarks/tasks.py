"""The eight tasks of the benchmark of searches: scenes, parameters, targets and thresholds.

A search has succeeded where the mean loss of its design, on 16 seeds that it never saw, is at most
the threshold. Thresholds were written down before the searches were run, by one rule: a quarter of
the loss of the best answer that knows nothing of the target (all cells dark, all lit, every second
one lit, all at the best even level), in colonies of the middle of the space.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchfilm as tf
from design import Choice, DomainSize, Image, Lasting, Oscillation, Parameter, Ring, Target, Task

sys.path.insert(0, str(Path(__file__).parents[1]))
import bands
import boundary_stripe
import domain_size
import ring

CELLS, REPLICATES, SHARE = 300, 4, 0.25
UNSEEN = range(2_000_000, 2_000_016)  # streams that no search and no final uses


@dataclass(frozen=True)
class SearchTask:
    """scene, parameters, target, and how a colony is grown: as for `design.Search`."""

    scene: Callable[..., tf.Scene] | str
    parameters: Sequence[Parameter | Choice]
    target: Target
    colony: dict[str, Any] = field(default_factory=dict)

    def options(self) -> dict[str, Any]:
        """The arguments of `design.Search` and `design.Task`."""
        return {
            "scene": self.scene,
            "parameters": self.parameters,
            "target": self.target,
            "replicates": REPLICATES,
            "cells": CELLS,
            "dt": 0.05,
            **self.colony,
        }

    def task(self) -> Task:
        return Task(**self.options())


# --- a cross on two gradients ---------------------------------------------------------------------

SIDE, REACH = 40.0, 12.0  # µm: half the box; over which a morphogen falls to 1/e


def crossing(u, s, p, cell):
    """GFP in a band of either of two morphogens, one along x and one along y."""
    within = lambda m, above, below: (
        (m**p.n / (above**p.n + m**p.n)) * (1.0 - m**p.n / (below**p.n + m**p.n))
    )
    x, y = within(s.right, p.x_above, p.x_below), within(s.up, p.y_above, p.y_below)
    lit = x + y - x * y
    return {"gfp": p.make * lit - p.decay * u.gfp}


def cross(
    x_above=0.02, x_below=0.1, y_above=0.02, y_below=0.1, n=4.0, make=10.0, decay=4.0
) -> tf.Scene:
    """Returns a colony between two gradients, from the left and from below."""
    steady = lambda axis: lambda places: torch.exp(-(places[:, axis] + SIDE) / REACH)
    morphogen = lambda axis: tf.Signal(
        diffusion=10 * REACH**2,
        decay=10.0,
        initial=steady(axis),
        boundary=tf.BoundaryConditions(**{"xy"[axis]: (tf.Dirichlet(1.0), tf.NoFlux())}),
    )
    circuit = tf.Circuit(
        crossing, species=("gfp",), x_above=x_above, x_below=x_below, y_above=y_above,
        y_below=y_below, n=n, make=make, decay=decay, rtol=1e-2,
    )  # fmt: skip
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        circuit,
        tf.Medium(
            right=morphogen(0), up=morphogen(1), box=((-SIDE, -SIDE), (SIDE, SIDE)), spacing=5.0
        ),
        name="cross",
    )


def cross_mask() -> tuple[tuple[float, ...], ...]:
    """16 × 16 pixels of a cross, its bars a quarter as wide as the image."""
    bar = np.abs(np.arange(16) - 7.5) < 2
    return tuple(map(tuple, np.maximum.outer(bar, bar).astype(float).tolist()))


# --- a spot where the nutrient is used up ---------------------------------------------------------


def hungry(u, s, p, cell):
    """GFP where the nutrient is low; a repressor of it where it is very low."""
    low = p.half**p.n / (p.half**p.n + s.nutrient.clamp(min=0.0) ** p.n)
    return {"gfp": p.make * low - p.decay * u.gfp}


def spot(half=0.1, n=4.0, make=10.0, decay=2.0, diffusion=100.0) -> tf.Scene:
    """Returns a colony that eats a nutrient from the edge of its box."""
    edge = tf.Dirichlet(1.0)
    return tf.Scene(
        tf.Monod("nutrient", rate=1.0, half=0.05, growth_yield=1.0),
        tf.Growth(),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(hungry, species=("gfp",), half=half, n=n, make=make, decay=decay, rtol=1e-2),
        tf.Medium(
            nutrient=tf.Signal(diffusion=diffusion, initial=1.0),
            box=((-SIDE, -SIDE), (SIDE, SIDE)),
            spacing=5.0,
            depth=1.0,
            boundary=tf.BoundaryConditions(x=edge, y=edge),
        ),
        name="spot",
    )


# --- the tasks ------------------------------------------------------------------------------------


def band_that_stays(above=0.05, below=0.3, make=10.0, decay=2.0, promoter="steep") -> tf.Scene:
    """Returns the band detectors of the ring, with a circuit of either promoter."""
    return ring.band_detector(above, below, make, decay, promoter)


def in_step(alpha=216.0, beta=5.0, speed=2.0) -> tf.Scene:
    """Returns repressilators without noise."""
    return tf.scenes.repressilator(alpha=alpha, beta=beta, speed=speed, noise=False)


LOG = {"log": True}
TASKS = {
    "stripe": SearchTask(
        "boundary_detector",
        boundary_stripe.PARAMETERS,
        boundary_stripe.TARGET,
        {"fixed": {"width": 24.0, "rtol": 1e-2}},
    ),
    "band that stays": SearchTask(
        band_that_stays,
        ring.PARAMETERS,
        Lasting(Ring("gfp", radius=8.0, width=4.0, floor=0.2), since=6.0),
    ),
    "French flag": SearchTask(bands.flag, bands.PARAMETERS, bands.TARGET),
    "ring": SearchTask(
        ring.band_detector, ring.PARAMETERS, Ring("gfp", radius=12.0, width=5.0, floor=0.2)
    ),
    "spot on a nutrient": SearchTask(
        spot,
        [
            Parameter("half", 1e-3, 1.0, **LOG),
            Parameter("n", 1.0, 8.0),
            Parameter("make", 1.0, 100.0, **LOG),
            Parameter("decay", 0.5, 10.0, **LOG),
            Parameter("diffusion", 10.0, 1000.0, **LOG),
        ],
        Ring("gfp", radius=3.0, width=6.0, floor=0.2),
        {"cells": 200},  # grown anew for each design
    ),
    "domain size": SearchTask(
        "toggle_switch", domain_size.PARAMETERS, DomainSize(("red", "green"), 12.0),
        {"replicates": 8},  # colonies of single molecules differ by luck
    ),
    "image": SearchTask(
        cross,
        [
            *(Parameter(f"{axis}_{side}", 1e-3, 1.0, **LOG)
              for axis in "xy" for side in ("above", "below")),
            Parameter("n", 1.0, 8.0),
            Parameter("make", 1.0, 100.0, **LOG),
            Parameter("decay", 0.5, 10.0, **LOG),
        ],
        Image("gfp", cross_mask(), (40.0, 40.0), floor=0.2),
    ),
    "oscillation in step": SearchTask(
        in_step,
        [
            Parameter("alpha", 10.0, 1000.0, **LOG),
            Parameter("beta", 0.5, 20.0, **LOG),
            Parameter("speed", 0.5, 10.0, **LOG),
        ],
        Oscillation("laci", period=3.0, floor=1.0),
    ),
}  # fmt: skip

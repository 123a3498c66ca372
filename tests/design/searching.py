"""Small scenes to search, at the top level of a module so that they can be pickled, and targets
with losses that equal a measured number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

import torchfilm as tf
from design import Objective, Target, Task

DT = 0.1


def objective_of(scene, parameters, target, **options) -> Objective:
    """The objective of a task with these arguments."""
    return Objective(Task(scene, parameters, target, **options))


def filling(u, s, p, cell):
    return {"gfp": p.make * (1.0 + 0.02 * cell.x * cell.x) - p.decay * u.gfp}


def grown(rate, make=1.0, decay=1.0, *more, low=3.0, high=4.0):
    """Colonies that produce one species, more of it at the ends. Without mechanics they are fast;
    these tests do not need it."""
    circuit = tf.Circuit(filling, species=("gfp",), make=make, decay=decay)
    return tf.Scene(
        tf.Growth(rate=rate), tf.Division(length=tf.Uniform(low, high)), circuit, *more, dt=DT
    )


def lit(make=1.0, decay=1.0):
    """No searched parameter affects growth."""
    return grown(2.0, make, decay, tf.Mechanics(dim=2))


def paced(rate=1.0, make=1.0):
    """The growth rate is searched, so that every design has its own pace."""
    return grown(rate, make)


def uneven(make=1.0):
    """Growth rates differ widely: with seed 10, stream 1 takes more than three times as long as
    stream 0."""
    return grown(tf.Uniform(0.2, 4.0), make)


def banned(low=3.0, make=1.0):
    """The scene refuses `low` between 3.2 and 3.4, where no bound and no middle lies."""
    odd = (torch.as_tensor(low) > 3.2) & (torch.as_tensor(low) < 3.4)
    return grown(2.0, make, low=low + torch.where(odd, 1.0, 0.0), high=4.0)


def exploding(u, s, p, cell):
    rate = p.make - u.gfp
    return {"gfp": torch.where((p.make > 5.0) & (u.gfp > 1.0), torch.inf, rate)}


def fragile(make=1.0):
    """The rates are not finite during the run where `make` is above 5."""
    circuit = tf.Circuit(exploding, species=("gfp",), make=make)
    return tf.Scene(tf.Growth(rate=2.0), tf.Division(length=tf.Uniform(3.0, 4.0)), circuit, dt=DT)


def short(added=2.0):
    """Cells divide while too short for two new caps, where less than 0.7 µm is added."""
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(added=added),
        founders=tf.Cells.single(2, length=0.3),
        dt=DT,
    )


def built(genes=1, promoter="weak", make=1.0):
    """The number of species and their strength need a scene of their own."""
    strength = {"weak": 1.0, "strong": 3.0}[promoter]

    def rates(u, s, p, cell):
        return {f"g{k}": strength * (k + 1) * p.make - getattr(u, f"g{k}") for k in range(genes)}

    circuit = tf.Circuit(rates, species=tuple(f"g{k}" for k in range(genes)), make=make)
    return tf.Scene(tf.Growth(rate=2.0), tf.Division(length=tf.Uniform(3.0, 4.0)), circuit, dt=DT)


@dataclass(frozen=True)
class Level(Target):
    """The distance of the mean level of a species from `wanted`."""

    species: str = "gfp"
    wanted: float = 0.0

    @property
    def names(self):
        return (self.species,)

    def check(self, state):
        if self.species not in state.fields:
            raise tf.checks.input_error(
                "species", self.species, "one of " + ", ".join(state.fields)
            )

    def loss(self, state, history=None):
        return (mean(state, self.species) - self.wanted).abs()

    def measures(self, state, history=None):
        return {"mean_level": mean(state, self.species)}


@dataclass(frozen=True)
class Spread(Target):
    """The mean square distance of the cells from the origin, µm²; it reads no species."""

    def loss(self, state, history=None):
        return (
            state.groups.sum(state.position.double().square().sum(1, keepdim=True)).squeeze(1)
            / state.counts
        )


@dataclass(frozen=True)
class Count(Target):
    """The number of cells."""

    def loss(self, state, history=None):
        return state.counts.double()


def mean(state, name):
    return state.groups.sum(state.fields[name].double().unsqueeze(1)).squeeze(1) / state.counts


def alone(scene, target, stream, *, seed=0, **end) -> tuple[float, tf.State]:
    """The loss of one colony that runs alone, step by step, and its last state."""
    *_, state = tf.simulate(scene, scene.bind(1, seed=seed, streams=[stream]).start(), **end)
    return float(target.loss(state)[0]), state


def spots(rows, size, seed=0):
    """Points (rows, size) in the unit cube."""
    return np.random.default_rng(seed).uniform(size=(rows, size))

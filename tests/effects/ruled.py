"""Shared by the tests of rules: two cells, steps, comparison, and a field with two numbers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from helpers import step

import torchfilm as tf
from torchfilm.effect import Effect


def pair_of_cells(dim: int = 2, gap: float = 20.0) -> tf.Cells:
    position = torch.zeros(2, dim)
    position[1, 0] = gap
    axis = torch.zeros(2, dim)
    axis[:, 1] = 1.0
    return tf.Cells(position, axis)


def run(scene: tf.Scene, state: tf.State, steps: int, dt: float = 0.1) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
    return state


def same(a: tf.State, b: tf.State) -> bool:
    """Bit for bit the same cells and fields."""
    names = ("colony", "uid", "parent", "position", "axis", "length", "radius", "next_uid")
    return all(torch.equal(getattr(a, n), getattr(b, n)) for n in names) and all(
        torch.equal(v, b.fields[n]) for n, v in a.fields.items()
    )


def short_update(cells):
    cells.growth_rate = 0.035
    cells.divide_flag = cells.volume > 3


@dataclass(frozen=True)
class Species(Effect):
    """Two species in each cell, for the paper's `divide`."""

    stage = 50
    title = "species"

    def declares(self, dim):
        return (tf.Field("species", "concentrations", shape=(2,), initial=1.0),)

    def step(self, state, dt, values):
        return state

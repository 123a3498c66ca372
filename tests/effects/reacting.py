"""Shared by the tests of smooth circuits: two circuits, resting cells, steps."""

from __future__ import annotations

import torch
from helpers import step

import torchfilm as tf

F64 = torch.float64


def idle(u, s, p, cell):
    return {}


def made(u, s, p, cell):
    return {"m": p.k - p.g * u.m}


def resting(circuit: tf.Circuit, count: int = 1, *more: tf.Effect, **founders) -> tf.Scene:
    """Cells that neither grow nor move, 3 µm apart."""
    cells = tf.Cells([[0.0, 3.0 * k] for k in range(count)], [[1.0, 0.0]] * count, **founders)
    return tf.Scene(circuit, *more, founders=cells)


def advance(scene: tf.Scene, state: tf.State, steps: int, dt: float = 0.1) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
        assert all(bool((r.status == 0).all()) for r in state.reports.values())
    return state

"""How many passes a step takes, how finely each is solved, and that neither depends on the batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import run, seeded

import torchfilm as tf

# Sixty short rods thrown into a box of 5 µm: the first moves would turn some of them by far more than MAX_TURN, as in the middle of a large colony.
RODS, SIDE = 60, 5.0


def thrown(*colonies: float) -> tf.Cells:
    """A colony of such rods for each of the given stretches of the box."""
    parts = []
    for number, stretch in enumerate(colonies):
        rng = np.random.default_rng(number)
        axis = rng.normal(size=(RODS, 3))
        parts.append((stretch * SIDE * rng.random((RODS, 3)), axis / np.linalg.norm(axis, axis=1, keepdims=True)))
    position, axis = (np.concatenate(part) for part in zip(*parts, strict=True))
    return tf.Cells(position, axis, length=1.5, radius=0.5, colony=np.repeat(np.arange(len(colonies)), RODS))


def first_step(device, dtype, **options) -> tf.State:
    scene = tf.Scene(tf.Mechanics(dim=3, **options))
    return run(scene, seeded(scene, thrown(1.0, 6.0), device, dtype), 1, dt=0.025)


def test_moves_cut_short_ask_for_more_passes(device, dtype):
    """Two passes are the default in space, in a crowd up to four; rods far apart need no third. More of the overlap is gone after them."""
    state = first_step(device, dtype)
    crowded, sparse = state.reports["mechanics"].passes.tolist()
    assert 3 <= crowded <= 4 and sparse <= 2
    two = first_step(device, dtype, passes=2)
    assert two.reports["mechanics"].passes.tolist() == [2, sparse]
    assert float(tf.measure.overlaps(state).mean[0]) < 0.75 * float(tf.measure.overlaps(two).mean[0])


@pytest.mark.parametrize("passes", [1, 2, 3])
def test_no_more_passes_than_asked(device, dtype, passes):
    report = first_step(device, dtype, passes=passes).reports["mechanics"]
    assert int(report.passes.max()) == passes
    assert float(report.share[0]) < 1 or passes == 3  # there was more to do


def test_a_pass_is_as_fine_as_asked(device, dtype):
    """The worst residual is at most the tolerance of that at rest, 0.05 unless another is given, whichever pass it is."""
    assert 1e-3 < float(first_step(device, dtype, passes=1).reports["mechanics"].residual.max()) <= 0.05
    assert float(first_step(device, dtype, passes=2, tolerance=1e-3).reports["mechanics"].residual.max()) <= 1e-3


def test_passes_do_not_depend_on_the_batch(device, dtype):
    """Colonies of three, two and fewer passes beside each other: each has the bits that it has by itself."""
    scene = tf.Scene(tf.Mechanics(dim=3))
    start = seeded(scene, thrown(1.0, 1.6, 6.0, 0.9), device, dtype)
    state = run(scene, start, 3, dt=0.025)
    for k in range(4):
        alone = run(scene, start.select([k]), 3, dt=0.025)
        together = state.select([k])
        for what in ("position", "axis", "length"):
            assert torch.equal(getattr(alone, what), getattr(together, what)), (k, what)

"""How many passes a step takes, how finely each is solved, and that neither depends on the batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import run, seeded

import torchfilm as tf
from torchfilm.effects.mechanics import _Run
from torchfilm.physics.contacts import contacts_of, gaps_nearby

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


def deepest(state: tf.State) -> float:
    """Of the crowded colony, µm."""
    return float(tf.measure.overlaps(state).worst[0])


def test_later_passes_part_what_the_first_left_deep(device, dtype):
    """Further passes leave the crowd's mean overlap less, until none is deeper than 0.02 µm, which is asked where passes are."""
    more = [first_step(device, dtype, passes=passes) for passes in (1, 2, 4, 8)]
    mean = [float(tf.measure.overlaps(s).mean[0]) for s in more]
    assert mean[0] > mean[1] > mean[2] > mean[3]
    last = first_step(device, dtype, passes=200)
    assert deepest(last) <= 0.02 + 1e-6 < deepest(more[3])
    assert int(last.reports["mechanics"].passes[0]) < 200


def test_two_passes_are_the_default_in_space(device, dtype):
    """Down to a fifth of the radius; those that the crowd has, it needs."""
    state = first_step(device, dtype)
    assert state.reports["mechanics"].passes.tolist()[0] == 2 and deepest(state) > 0.1
    assert torch.equal(state.position, first_step(device, dtype, passes=2, overlap=0.1).position)


def test_the_overlap_that_is_left_can_be_named(device, dtype):
    assert deepest(first_step(device, dtype, passes=100, overlap=0.05)) <= 0.05 + 1e-6


def test_a_later_pass_moves_only_what_is_too_deep(device, dtype):
    """Beside the crowd, in one colony with it, a pair that the first pass parts to within the limit: the second moves the crowd's cells that are
    deeper than the limit, or were cut short, and no other."""
    crowd = thrown(1.0)
    far = np.array([[40, 0, 0], [40, 0.8, 0]]), np.array([[1.0, 0, 0], [1, 0, 0]])
    cells = tf.Cells(np.concatenate([crowd.position, far[0]]), np.concatenate([crowd.axis, far[1]]), length=1.5, radius=0.5)
    scenes = [tf.Scene(tf.Mechanics(dim=3, passes=n, overlap=0.1)) for n in (1, 2)]
    one, two = (run(scene, seeded(scene, cells, device, dtype), 1, dt=0.025) for scene in scenes)
    moved = (two.position != one.position).any(1) | (two.axis != one.axis).any(1)
    first, second, gap = gaps_nearby(one.position, one.axis, one.length, one.radius, one.colony, 1)
    deep = torch.zeros_like(moved)
    deep[torch.cat([first[gap < -0.1], second[gap < -0.1]])] = True
    assert bool(moved[deep].all()) and not bool(moved[-2:].any())
    assert 0 < int((moved & ~deep).sum()) <= int(one.reports["mechanics"].limited[0]) < RODS
    assert not bool(moved[:RODS].all())


@pytest.mark.parametrize("overlap", [None, 0.02, 0.3])
def test_what_is_left_deep_is_found_wherever_it_is(dtype, overlap):
    """By the search near what has moved, the same cells and the same contacts as by looking at every pair: for cells of many sizes, thrown together."""
    cells = thrown(1.0, 1.6)
    rng = np.random.default_rng(3)
    cells = tf.Cells(
        cells.position, cells.axis, length=rng.choice([0.0, 0.5, 2.0, 12.0], 2 * RODS), radius=rng.uniform(0.2, 0.6, 2 * RODS), colony=cells.colony
    )
    scene = tf.Scene(tf.Mechanics(dim=3, passes=2, overlap=overlap))
    state = seeded(scene, cells, "cpu", dtype)
    both = torch.ones(2, dtype=torch.bool)
    run_of = _Run(scene.effects[0], state, 0.025, torch.ones(2, dtype=torch.int64), torch.zeros(2, dtype=torch.int64))
    before, walls = run_of._all_that_touches(both)
    every = torch.ones(2 * RODS, dtype=torch.bool)
    move, report = run_of._solve(contacts_of(before), walls, state.length, every, 0)
    run_of._move(move, state.length, every, report, both)
    pairs, _, left = run_of._left_deep(both, before)
    after, _ = run_of._all_that_touches(both)
    limit = 0.5 * (run_of.overlap[after.first] + run_of.overlap[after.second])
    wanted = run_of.cut.clone()
    wanted[torch.cat([after.first[after.gap < -limit], after.second[after.gap < -limit]])] = True
    assert torch.equal(left, wanted) and 0 < int(left.sum()) < 2 * RODS
    as_set = lambda t: {(min(p), max(p)) for p in zip(t.first.tolist(), t.second.tolist(), strict=True)}  # noqa: E731
    assert as_set(pairs) == {p for p in as_set(after) if left[list(p)].any()}


@pytest.mark.parametrize("passes", [1, 2, 3])
def test_no_more_passes_than_asked(device, dtype, passes):
    """Though there is more to do."""
    state = first_step(device, dtype, passes=passes)
    assert int(state.reports["mechanics"].passes.max()) == passes
    assert deepest(state) > 0.1


def test_a_pass_is_as_fine_as_asked(device, dtype):
    """The worst residual is at most the tolerance of that at rest, 0.05 unless another is given, whichever pass it is."""
    assert 1e-3 < float(first_step(device, dtype, passes=1).reports["mechanics"].residual.max()) <= 0.05
    assert float(first_step(device, dtype, passes=2, tolerance=1e-3).reports["mechanics"].residual.max()) <= 1e-3


def test_passes_do_not_depend_on_the_batch(device, dtype):
    """Colonies that take many passes and few beside each other: each has the bits that it has by itself."""
    scene = tf.Scene(tf.Mechanics(dim=3, passes=5))
    start = seeded(scene, thrown(1.0, 1.6, 6.0, 0.9), device, dtype)
    state = run(scene, start, 3, dt=0.025)
    for k in range(4):
        alone = run(scene, start.select([k]), 3, dt=0.025)
        together = state.select([k])
        for what in ("position", "axis", "length"):
            assert torch.equal(getattr(alone, what), getattr(together, what)), (k, what)

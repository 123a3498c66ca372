"""Shared by the tests of results: a scene that a restart must carry on whole, its runs, and
comparison bit for bit."""

from __future__ import annotations

import numpy as np
import torch

import torchfilm as tf
from torchfilm.state import PER_CELL

UNTIL, DT, EVERY = 3.0, 0.05, 7


def removing(cells):
    cells.mark = cells.mark + cells.random()
    cells.remove_flag = (cells.uid == 3) & (cells.time > 2.0)


def make_scene() -> tf.Scene:
    """Divisions at random, a rule with draws of its own, and removals: everything that a restart
    must carry on."""
    return tf.Scene(
        tf.Rules(removing, variables={"mark": 0.0}),
        tf.Growth(rate=tf.Uniform(0.8, 1.2)),
        tf.Division(length=tf.Uniform(3.0, 4.0)),
        tf.Mechanics(dim=2),
        dt=DT,
    )


def record(
    scene: tf.Scene, state: tf.State, path, until: float = UNTIL, **options
) -> list[tf.State]:
    """All states of a run, the first included."""
    recorder = tf.Recorder(path, scene, **{"every": EVERY, **options})
    return [state, *tf.simulate(scene, state, until=until, record=recorder)]


def assert_same_state(a: tf.State, b: tf.State) -> None:
    """Every array equal bit for bit, and of one type."""
    for name in (*PER_CELL, "colony_id", "next_uid"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype and torch.equal(x, y), name
    assert set(a.fields) == set(b.fields)
    for name, x in a.fields.items():
        assert x.dtype == b.fields[name].dtype and torch.equal(x, b.fields[name]), name
    assert (a.step, a.time, a.seed) == (b.step, b.time, b.seed)


def assert_same_file(path, other, frames: list[int] | None = None) -> None:
    """The same frames (all, or those of the given steps in the first) and the same lineage."""
    with tf.Results(path) as a, tf.Results(other) as b:
        steps = b.steps.tolist()
        for k, step in enumerate(a.steps.tolist()):
            if frames is None or step in frames:
                j = steps.index(step)
                x, y = a.frame(k), b.frame(j)
                assert set(x) == set(y) and a.times[k] == b.times[j]
                for name in x:
                    assert x[name].dtype == y[name].dtype and np.array_equal(x[name], y[name]), (
                        step,
                        name,
                    )
        one, two = a.lineage(), b.lineage()
        for name in ("colony", "cell", "parent", "born", "ended", "fate"):
            x, y = getattr(one, name), getattr(two, name)
            # frames at other steps may give the hours of an event another last bit
            near = np.allclose(x, y, rtol=1e-12, equal_nan=True) if x.dtype.kind == "f" else x == y
            assert np.all(near), name

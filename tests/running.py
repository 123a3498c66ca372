"""Shared by the tests of runs: a colony with mechanics, and a cell that grows alone."""

from __future__ import annotations

import torchfilm as tf


def scene_of(**mechanics) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=tf.Uniform(0.8, 1.2)),
        tf.Division(length=tf.Uniform(3.0, 4.0)),
        tf.Mechanics(**{"dim": 2, **mechanics}),
        dt=0.05,
    )


def alone() -> tf.Scene:
    return tf.Scene(tf.Growth(rate=1.0), dt=0.1)

"""Scenes whose settings tests tune."""

from __future__ import annotations

import torchfilm as tf


def made(u, s, p, cell):
    return {"m": p.k - 2.0 * u.m}


def dividing(**circuit) -> tf.Scene:
    """Cells that do not touch anything: growth, division and a circuit are all there is."""
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Circuit(made, species=("m",), k=10.0, **circuit),
        dt=0.05,
    )

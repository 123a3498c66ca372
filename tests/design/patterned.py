"""Colonies with given cells, for the tests of targets."""

from __future__ import annotations

import numpy as np
import torch

import torchfilm as tf

# µm: an edge width at which the target level is exactly 0 or 1 from 0.1 µm on
SHARP = 1e-3


def placed(
    position, *, colony=None, cell_type=None, colonies=1, length=0.0, dtype=torch.float64, **levels
) -> tf.State:
    """Balls of radius 0.5 µm (or rods along x) at the given places, with their levels by name."""
    position = np.asarray(position, dtype=np.float64)
    levels = {
        name: np.broadcast_to(np.asarray(v, dtype=np.float64), len(position))
        for name, v in levels.items()
    }
    axis = np.eye(position.shape[1])[0]
    cells = tf.Cells(position, axis, length, 0.5, cell_type=cell_type, colony=colony, extra=levels)
    return tf.Scene(tf.Growth(), founders=cells).bind(colonies, dtype=dtype).start()


def row(x, **levels) -> tf.State:
    """One colony of balls on the x axis."""
    return placed(np.stack([np.asarray(x, dtype=float), np.zeros(len(x))], 1), **levels)


def crowded(
    seed=0, colonies=4, count=30, dim=2, names=("yfp", "cfp"), size=8.0, dtype=torch.float64
) -> tf.State:
    """Colonies of different numbers of rods, of two types about x = 0, with random levels."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(colonies), count + 7 * np.arange(colonies))
    position = rng.uniform(-size, size, (len(owner), dim))
    kind = (position[:, 0] + rng.normal(0, 1, len(owner)) > 0).astype(int)
    levels = {name: rng.uniform(0.1, 2.0, len(owner)) for name in names}
    return placed(
        position,
        colony=owner,
        cell_type=kind,
        colonies=colonies,
        length=rng.uniform(1, 3, len(owner)),
        dtype=dtype,
        **levels,
    )


def graded(target, state: tf.State, history=None) -> bool:
    """gradcheck of the loss with respect to the levels of all species of the target."""
    names = (
        target.names
        if hasattr(target, "names")
        else target.species
        if isinstance(target.species, tuple)
        else (target.species,)
    )
    given = [state.fields[name].clone().requires_grad_() for name in names]
    return torch.autograd.gradcheck(
        lambda *levels: target.loss(
            state.with_fields(**dict(zip(names, levels, strict=True))), history
        ),
        given,
    )

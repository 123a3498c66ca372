"""Targets of a user's own, whose losses may pass no gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from searching import lit, mean, objective_of

import torchfilm as tf
from design import Parameter
from design.targets import Target

WINDOW = ((-8.0, -8.0), (8.0, 8.0))
TWO = [Parameter("make", 0.1, 10.0, log=True), Parameter("decay", 0.1, 5.0)]
POINTS = np.array([[0.3, 0.6], [0.8, 0.2]])


def seen(state):
    """The light of each colony as a camera sees it."""
    image = tf.measure.image(state, "gfp", pixel_size=0.25, window=WINDOW)
    return 0.25**2 * image[:, 0].sum((1, 2))


@dataclass(frozen=True)
class Mixed(Target):
    """A term that passes a gradient beside one that passes none."""

    def loss(self, state, history=None):
        return 10.0 * seen(state).detach() - mean(state, "gfp")


class Seen(Target):
    differentiable = True

    def loss(self, state, history=None):
        return seen(state)


@pytest.mark.parametrize("target", [Mixed(), Seen()])
def test_slopes_are_those_of_the_loss(target):
    """By differences, unless the target says that it has derivatives."""
    objective = objective_of(lit, TWO, target, cells=6, replicates=2, dtype=torch.float64)
    if target.differentiable:
        assert not objective.why_differences
    else:
        assert "Mixed.differentiable" in objective.why_differences
    found = objective.evaluate(POINTS, slopes=True).slopes.gradient
    for k in range(2):
        step = np.zeros(2)
        step[k] = 1e-3
        more, less = (objective.evaluate(POINTS + s).loss for s in (step, -step))
        assert found[:, k] == pytest.approx((more - less) / 2e-3, rel=1e-2)

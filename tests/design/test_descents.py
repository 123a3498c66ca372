"""Single steps of a descent, and the points of its differences."""

from __future__ import annotations

import numpy as np
import pytest

from design import Parameter
from design.derivatives import STEP, neighbours
from design.methods.local import FIRST, Descent
from design.parameters import Space


def test_differences_lie_within_the_bounds():
    space = Space([Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)])
    found = neighbours(space, np.array([0.0, 1.0]))
    assert found.min() >= 0.0 and found.max() <= 1.0
    assert found[1::2] - found[::2] == pytest.approx(2 * STEP * np.eye(2))


@pytest.mark.parametrize("share, factor", [(1.0, 1 / 3), (0.5, 1.0), (0.25, 1.125)])
def test_damping_follows_what_a_step_brings_of_its_promise(share, factor):
    descent = Descent(np.zeros(1), 1.0, most=1, proposed=np.array([0.1]), promised=0.4)
    descent.learn(1.0 - 0.4 * share)
    assert descent.damping == pytest.approx(FIRST * factor) and not descent.over


def test_the_curvature_stays_positive_after_a_step_along_which_the_slope_grows():
    descent = Descent(
        np.full(2, 0.5), 1.0, most=1, moved=np.array([0.1, 0.0]), gradient=np.array([-1.0, 0.5]),
        curvature=np.eye(2),
    )  # fmt: skip
    descent.set_slopes(np.array([-1.5, 0.5]), np.full((2, 2), np.nan))
    assert np.linalg.eigvalsh(descent.curvature).min() > 0.0

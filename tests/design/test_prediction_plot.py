"""The picture of what a posterior predicts, beside observed cells."""

from __future__ import annotations

import numpy as np
import pytest

import torchfilm as tf
from design import Observed
from design.prediction import Prediction
from tests.design.searching import paced


@pytest.fixture(scope="module")
def observed():
    *_, state = tf.simulate(paced(1.0, 1.0), until=3.0, colonies=4, seed=2)
    return Observed.from_state(state, species=("gfp",))


def predicted(observed, off):
    """Twenty simulations that scatter by a standard error of the data, the first statistic `off`
    by so many."""
    draws = np.random.default_rng(0).normal(size=(20, len(observed.values)))
    draws[:, 0] += off
    error = np.array(observed.spread) / 2.0  # of four colonies
    return Prediction(observed, np.zeros((20, 1)), np.array(observed.values) + error * draws)


def test_statistics_of_cells_are_drawn_in_standard_errors(observed, tmp_path):
    picture = predicted(observed, 8.0).plot(tmp_path / "pulls.png")
    assert (tmp_path / "pulls.png").stat().st_size > 5000
    (ax,) = picture.figure.axes
    assert [t.get_text() for t in ax.get_yticklabels()] == list(observed.plan.names)
    middles = [line for line in ax.lines if len(line.get_xdata()) == 1]
    assert len(middles) == len(observed.values)
    found = [line.get_xdata()[0] for line in middles]
    assert found[0] == pytest.approx(8.0, abs=0.6) and max(map(abs, found[1:])) < 1.0
    assert middles[0].get_marker() == "D" and middles[1].get_marker() == "o"
    assert ax.get_xscale() == "linear"
    ends = next(line for line in ax.lines if len(line.get_xdata()) == 2).get_xdata()
    assert ends[0] < found[0] < ends[1] and ends[1] - ends[0] == pytest.approx(3.3, rel=0.4)


def test_what_is_far_off_is_drawn_by_logarithms(observed):
    (ax,) = predicted(observed, -300.0).plot().figure.axes
    assert ax.get_xscale() == "symlog"

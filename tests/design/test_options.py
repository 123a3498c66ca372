"""The probability of each option of a choice, given data: in closed form, and as a density."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

from design import Choice
from design.neural_posterior import NeuralPosterior
from design.options import MOST, Options
from design.parameters import Space
from design.posterior import Posterior

needs_sbi = pytest.mark.skipif(find_spec("sbi") is None, reason='needs pip install -e ".[infer]"')


def test_combinations_of_options_are_classes():
    options = Options.of((None, 3, None, 2))
    assert options == Options((1, 3), (3, 2)) and options.classes == 6
    assert options.rest(4) == [0, 2]
    points = np.random.default_rng(0).random((50, 4))
    classes = options.of_points(points)
    assert set(classes) <= set(range(6))
    levels = np.stack([np.floor(points[:, 1] * 3), np.floor(points[:, 3] * 2)], 1)
    assert np.array_equal(classes, levels[:, 0] * 2 + levels[:, 1])
    within = np.random.default_rng(1).random((50, 2))
    found = options.coordinates(classes, within)
    assert found * [3, 2] == pytest.approx(levels + within)
    assert options.of_points(np.ones((1, 4))) == [5]
    # none, and too many to tell apart
    assert Options.of((None, None)).classes == 1
    assert Options.of((None, MOST + 1)) == Options() == Options.of(())


def binary(count, seed=0, shares=0.5):
    """A choice and a number: the statistics are x = ±1 + noise, and the number + noise."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 2))
    points[:, 0] = 0.5 * points[:, 0] + 0.5 * (rng.random(count) < shares)
    sign = np.where(points[:, 0] < 0.5, -1.0, 1.0)
    noise = rng.normal(size=(count, 2)) * [1.0, 0.05]
    return points, np.stack([sign, points[:, 1]], 1) + noise


@needs_sbi
@pytest.mark.parametrize("share", [0.5, 0.2])
def test_the_share_of_an_option_is_its_probability(share):
    """Bayes: P(+) = s e^x/(s e^x + (1 − s) e^−x)."""
    learnt = NeuralPosterior.learn(
        *binary(3000, shares=share), levels=(2, None), seed=0, flows=2, epochs=40
    )
    x = np.array([-1.5, -0.5, 0.0, 0.5, 1.5])
    rows = np.stack([x, np.full(5, 0.4)], 1)
    drawn = learnt.sample(rows, 4000, seed=1)
    plus = (drawn[..., 0] >= 0.5).mean(1)
    wanted = share * np.exp(x) / (share * np.exp(x) + (1 - share) * np.exp(-x))
    assert plus == pytest.approx(wanted, abs=0.06)
    # evenly within a level, and the number as the data tell it
    within = drawn[2, :, 0] % 0.5
    assert within.mean() == pytest.approx(0.25, abs=0.01) and within.max() > 0.49
    assert drawn[2, :, 1].mean() == pytest.approx(0.4, abs=0.03)
    assert drawn[2, :, 1].std() == pytest.approx(0.05, rel=0.5)
    grid = (np.stack(np.meshgrid(np.arange(40), np.arange(400)), -1).reshape(-1, 2) + 0.5) / [
        40, 400,
    ]  # fmt: skip
    density = np.exp(learnt.log_density(grid[None], rows[3:4]))[0]
    assert density.mean() == pytest.approx(1.0, abs=0.02)
    assert density[grid[:, 0] >= 0.5].sum() / density.sum() == pytest.approx(plus[3], abs=0.03)


@needs_sbi
def test_choices_alone_need_no_flow():
    points, statistics = binary(2000)
    learnt = NeuralPosterior.learn(
        points[:, :1], statistics[:, :1], levels=(2,), seed=0, flows=2, epochs=40
    )
    assert learnt.flows == () and learnt.classifier is not None
    drawn = learnt.sample(np.array([[0.5], [-3.0]]), 4000, seed=0)
    assert (drawn[..., 0] >= 0.5).mean(1) == pytest.approx([np.e / (np.e + 1), 0.0], abs=0.05)
    density = np.exp(learnt.log_density(np.array([[[0.2], [0.7]]]), np.array([[0.5]])))[0]
    assert density.sum() == pytest.approx(2.0)


@needs_sbi
def test_the_number_may_depend_on_the_option():
    """x = θ with one option, 1 − θ with the other: given x, two peaks, one for each."""
    rng = np.random.default_rng(0)
    points = rng.random((1500, 2))
    seen = np.where(points[:, 0] < 0.5, points[:, 1], 1 - points[:, 1])
    statistics = (seen + 0.02 * rng.normal(size=1500))[:, None]
    learnt = NeuralPosterior.learn(points, statistics, levels=(2, None), seed=0, flows=2, epochs=80)
    drawn = learnt.sample(np.array([[0.25]]), 2000, seed=0)[0]
    first = drawn[:, 0] < 0.5
    assert 0.4 < first.mean() < 0.6
    assert np.median(drawn[first, 1]) == pytest.approx(0.25, abs=0.03)
    assert np.median(drawn[~first, 1]) == pytest.approx(0.75, abs=0.03)
    assert np.array_equal(drawn, learnt.sample(np.array([[0.25]]), 2000, seed=0)[0])


def test_samples_of_a_choice_keep_the_kinds_of_its_options():
    """A text and a number: the most frequent option is one that the scene takes."""
    space = Space([Choice("mode", ("auto", 3))])
    points = np.array([[0.75], [0.75], [0.25]])
    posterior = Posterior(SimpleNamespace(space=space), None, None, None, None, points)
    assert posterior.mean == {"mode": 3} and space.point(posterior.mean) == [0.75]
    assert list(posterior.samples["mode"]) == [3, 3, "auto"]

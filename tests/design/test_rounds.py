"""Inference in rounds: where each looks, that it is the density of the same parameters, and that a
file goes on with it."""

from __future__ import annotations

from importlib.util import find_spec

import h5py
import numpy as np
import pytest
import scipy.stats
from searching import Level, lit, objective_of

import torchfilm as tf
from design import Choice, Measured, Parameter, infer
from design.inference import LEAST
from design.neural_posterior import WIDE, NeuralPosterior, _compressed
from design.parameters import Space
from design.posterior import _first
from design.prior import Prior
from design.region import BEYOND, MARGIN, Region
from design.region import LEAST as LEAST_WIDTH
from design.simulations import _points

needs_sbi = pytest.mark.skipif(find_spec("sbi") is None, reason='needs pip install -e ".[infer]"')
ONE = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
LOSS = [Parameter("loss", 0.01, 10.0, log=True)]
OPTIONS = {"simulations": 400, "flows": 1, "epochs": 60, "samples": 500, "progress": False}


def washout(loss=0.5, dose=1.0) -> tf.Scene:
    """One cell, whose gfp is exp(−loss · t)."""
    rates = lambda u, s, p, cell: {"gfp": -p.loss * p.dose * u.gfp}
    circuit = tf.Circuit(rates, species="gfp", initial={"gfp": 1.0}, loss=loss, dose=dose)
    return tf.Scene(circuit, dim=2, dt=0.25, founders=ONE)


def seen(wanted=0.5, time=1.0) -> Measured:
    level = lambda state: state.groups.sum(state.gfp)
    return Measured({"gfp": level}, wanted={"gfp": wanted}, spread={"gfp": 0.01}, time=time)


def test_a_region_holds_the_samples_and_a_margin():
    samples = np.stack([np.linspace(0.4, 0.6, 1001), np.linspace(0.0, 1.0, 1001)], 1)
    found = Region.whole(2).around(samples, [0], 7)
    width = 0.2 * (1 - 2 * BEYOND)
    assert found.start == 7 and not found.is_whole and Region.whole(2).is_whole
    assert found.low == pytest.approx([0.5 - width / 2 - MARGIN * width, 0.0])
    assert found.high == pytest.approx([0.5 + width / 2 + MARGIN * width, 1.0])
    points = np.array([[0.5, 0.9], [0.2, 0.9]])
    assert found.holds(points).tolist() == [True, False]
    assert found.narrow(found.widen(points[:1])) == pytest.approx(points[:1])
    # never beyond the region before
    wide = found.around(np.random.default_rng(0).random((500, 2)), [0, 1], 9)
    assert (wide.low >= found.low).all() and (wide.high <= found.high).all()


@pytest.mark.parametrize("at", [0.0, 1.0])
def test_a_region_has_a_width(at):
    """Data beyond what a bound gives: all samples lie there."""
    found = Region.whole(1).around(np.full((100, 1), at), [0], 5)
    assert found.high - found.low == pytest.approx([LEAST_WIDTH])
    assert found.holds(np.array([[at]])).all()
    again = found.around(np.full((100, 1), at), [0], 9)
    assert np.array_equal([again.low, again.high], [found.low, found.high])
    inside = Region.whole(1).around(np.full((100, 1), 0.3), [0], 5)
    assert [*inside.low, *inside.high] == pytest.approx([0.2995, 0.3005])


@needs_sbi
def test_data_beyond_the_bounds_end_at_a_bound():
    """gfp = exp(−loss) is 0.99 at most within the bounds."""
    found = infer(washout, LOSS, seen(1.5), rounds=2, replicates=1, **OPTIONS)
    assert found.interval()["loss"][1] < 0.1 and found.surprises


def test_designs_of_a_region_follow_the_prior_within_it():
    space = Space(
        [Parameter("a", 1.0, 100.0, log=True), Parameter("b", 0.0, 1.0), Choice("c", ("x", "y"))]
    )
    prior = Prior(space, {"a": scipy.stats.lognorm(0.5, scale=10.0), "c": {"x": 0.2, "y": 0.8}})
    draws = np.random.default_rng(1).random((4000, 3))
    units = prior.units(prior.points(draws))
    assert units[:, :2] == pytest.approx(draws[:, :2], abs=1e-9)
    region = Region(np.array([0.45, 0.2, 0.0]), np.array([0.6, 0.3, 1.0]), 1000)
    found = _points(prior, draws, [Region.whole(3), region])
    assert np.array_equal(found[:1000], prior.points(draws)[:1000])
    within = prior.points(np.random.default_rng(2).random((40_000, 3)))
    within = within[region.holds(within)]
    assert region.holds(found[1000:]).all() and len(within) > 500
    for k in (0, 1):
        assert scipy.stats.ks_2samp(found[1000:, k], within[:, k]).pvalue > 1e-3
    assert (found[1000:, 2] >= 0.5).mean() == pytest.approx(0.8, abs=0.03)


def test_each_round_has_draws_of_its_own():
    prior = Prior(Space([Parameter("a", 0.0, 1.0), Parameter("b", 1.0, 10.0, log=True)]))
    draws = np.random.default_rng(0).random((20, 2))
    region = Region(np.array([0.2, 0.4]), np.array([0.6, 0.5]), 12)
    found = _points(prior, draws, [Region.whole(2), region])
    assert region.widen(found[12:]) == pytest.approx(draws[12:])


@needs_sbi
@pytest.mark.parametrize("narrow", [False, True])
def test_the_density_is_that_of_its_samples(narrow):
    """Its integral over the region is 1, with a regression below the flows and without."""
    rng = np.random.default_rng(0)
    region = Region(np.array([0.3]), np.array([0.5])) if narrow else Region.whole(1)
    points = region.narrow(rng.random((300, 1)))
    statistics = points + 0.02 * rng.normal(size=points.shape)
    learnt = NeuralPosterior.learn(
        points, statistics, unit=np.array([0.02]), region=region, seed=0, flows=1, epochs=40
    )
    assert bool(learnt.flows[0].regression.weights.any()) == narrow
    grid = region.narrow((np.arange(4000)[:, None] + 0.5) / 4000)
    for row in (np.array([[0.4]]), np.array([[0.33]])):
        density = np.exp(learnt.log_density(grid[None], row))[0]
        width = float(region.high[0] - region.low[0])
        assert density.mean() * width == pytest.approx(1.0, abs=0.01)
        drawn = learnt.sample(row, 4000, seed=1)[0]
        beyond = region.high + 0.01 if narrow else np.array([1.01])
        assert learnt.log_density(beyond[None, None], row)[0, 0] == -np.inf
        assert region.holds(drawn).all()
        mean = (density * grid[:, 0]).sum() / density.sum()
        assert drawn.mean() == pytest.approx(mean, abs=0.002)


@needs_sbi
def test_a_second_round_is_as_narrow_as_the_data():
    """gfp = exp(−loss) with an error of 0.01: ln loss = ln ln 2 ± 0.01/(0.5 ln 2)."""
    found = infer(washout, LOSS, seen(), rounds=2, replicates=1,
                  **OPTIONS)  # fmt: skip
    low, high = found.interval()["loss"]
    assert low < np.log(2.0) < high
    exact = 2 * 1.645 * 0.01 / (0.5 * np.log(2.0))
    assert 0.7 * exact < np.log(high / low) < 2.0 * exact
    second = found.estimator.region
    assert second.start == 200 and second.high[0] - second.low[0] < 0.3
    later = found.simulations.points[200:]
    assert second.holds(later).all() and not second.holds(found.simulations.points[:200]).all()
    said = found.table()
    assert "in 2 rounds; the last within loss 0." in said
    with pytest.raises(tf.InputError, match="learnt in rounds, for its own data alone"):
        found.given(seen(0.4))
    # truths of the calibration come from where the posterior was learnt
    checked = found.check(30, samples=99)
    assert checked.ranks.shape == (30, 1) and abs(checked.ranks.mean() / 99 - 0.5) < 0.2


@needs_sbi
def test_a_file_knows_the_rounds(tmp_path, monkeypatch):
    path, learnt = tmp_path / "rounds.h5", []
    real = NeuralPosterior.learn

    def learn(*given, **options):
        learnt.append(options["region"].start)
        return real(*given, **options)

    monkeypatch.setattr(NeuralPosterior, "learn", staticmethod(learn))
    options = OPTIONS | {"simulations": 3 * LEAST, "epochs": 3, "rounds": 3, "replicates": 1}
    whole = infer(washout, LOSS, seen(), path=path, **options)
    assert learnt == [0, LEAST, 2 * LEAST]
    with h5py.File(path) as file:
        assert file["regions"].shape == (3, 2, 1)
        assert file["starts of regions"][...].tolist() == learnt
    learnt.clear()
    again = infer(washout, LOSS, seen(), path=path, **options)
    assert learnt == [2 * LEAST] and np.array_equal(again.points, whole.points)
    # as if it had been stopped in the second round
    with h5py.File(path, "r+") as file:
        for name in ("points", "statistics", "cells"):
            kept = file[name][: LEAST + 10]
            del file[name]
            file[name] = kept
        for name in ("regions", "starts of regions"):
            kept = file[name][:2]
            del file[name]
            file[name] = kept
    learnt.clear()
    again = infer(washout, LOSS, seen(), path=path, **options)
    assert learnt == [LEAST, 2 * LEAST] and np.array_equal(again.points, whole.points)
    for other, words in (
        ({"rounds": 1}, "simulations and rounds"),
        ({"rounds": 2}, "simulations and rounds"),
        ({"observed": seen(0.4)}, "observed numbers"),
    ):
        given = {"observed": seen()} | options | other
        with pytest.raises(tf.InputError, match=f"this one differs in {words}"):
            infer(washout, LOSS, given.pop("observed"), path=path, **given)


@needs_sbi
def test_each_round_needs_simulations():
    rule = f"simulations = 120 is not allowed.*{LEAST} for each of 3 rounds"
    with pytest.raises(tf.InputError, match=rule):
        infer(washout, LOSS, seen(), simulations=120, rounds=3)
    with pytest.raises(tf.InputError, match="rounds = 0"):
        infer(washout, LOSS, seen(), rounds=0)


def test_statistics_that_vary_far_more_than_their_errors_are_compressed():
    x = np.array([[-40.0, 3.0], [0.1, 3.0]])
    found = _compressed(x, np.array([0.1, np.inf]))
    assert found == pytest.approx(np.array([[np.arcsinh(-400.0), 3.0], [np.arcsinh(1.0), 3.0]]))


@needs_sbi
def test_only_statistics_that_vary_far_more_than_their_errors_have_a_unit(monkeypatch):
    monkeypatch.setattr("design.neural_posterior._learn_flows", lambda *about: ())
    points = np.linspace(0.1, 0.9, 9)[:, None]
    unit = points.std() / np.array([WIDE + 1.0, WIDE - 1.0])
    learnt = NeuralPosterior.learn(
        points, np.c_[points, points], unit=unit, seed=0, flows=1, epochs=1
    )
    assert learnt.unit.tolist() == [unit[0], np.inf]


@pytest.mark.parametrize("replicates", [1, 40, 4000])
def test_checks_and_predictions_have_random_numbers_of_their_own(replicates):
    task = objective_of(
        lit, [Parameter("make", 0.1, 10.0, log=True)], Level(), cells=4, replicates=replicates
    ).task
    firsts = [_first(task, stream) for stream in (2, 3, 4)]
    assert all(b - a >= 2**15 for a, b in zip([0, *firsts], firsts, strict=False))
    assert (firsts[-1] + 2**15) * replicates <= 2**32

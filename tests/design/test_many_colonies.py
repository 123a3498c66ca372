"""Inference from many observed colonies: what a mean of them tells, and random numbers for all."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from searching import fragile, grown

import torchfilm as tf
from design import Conditions, Measured, Observed, Parameter, Search, Task, infer
from design.posterior import DRAWN, PREDICTED, STREAM, _first
from design.prediction import Prediction
from design.simulations import simulate_points
from design.targets.observed_conditions import cells_each, checked_data, standard_errors
from torchfilm.tools.checks import InputError

RATE = [Parameter("rate", 0.8, 2.0, log=True)]


def colony(rate=1.5, dose=1.0):
    return grown(tf.LogNormal(rate, 0.2), dose)


def seen(colonies, until=2.0, rate=1.4):
    *_, state = tf.simulate(colony(rate), until=until, dt=0.1, colonies=colonies, seed=8)
    found = Observed.from_state(state, species=("gfp",))
    return found.without("extent", "density", "alignment", "gfp profile", "gfp neighbours")


@pytest.mark.parametrize("each", [1, 4, 128, 230, 5_000, 100_000])
def test_every_colony_has_random_numbers_of_its_own(each):
    """Those of learning, and of each stream, begin apart, and all are below 2**32."""
    task = SimpleNamespace(replicates=each, conditions=1)
    firsts = [_first(task, stream) for stream in (STREAM, PREDICTED, DRAWN)]
    rows = firsts[1] - firsts[0]
    assert rows == firsts[2] - firsts[1] and (firsts[-1] + rows) * each <= 2**32
    assert rows >= min(2**20, 2**32 // each // 32) and firsts[0] >= 16 * rows
    halves = SimpleNamespace(replicates=each, conditions=2)
    assert _first(halves, STREAM) == _first(SimpleNamespace(replicates=2 * each, conditions=1), 2)


@pytest.mark.parametrize("colonies", [3, 12])
def test_a_right_model_has_a_loss_of_about_2_whatever_the_colonies(colonies):
    """Of a rate that is off by a seventh, it is far more where many were observed."""
    data = seen(colonies)
    task = Task(colony, RATE, data, dt=0.1, replicates=colonies, replay=False)

    def median(rate):
        point = task.space.point({"rate": rate})
        found = simulate_points(task, np.repeat(point[None], 30, 0), 0)
        return np.median(Prediction(data, found.points, found.statistics).losses)

    assert 0.7 < median(1.4) < 4.0
    assert median(1.6) > (3.0 if colonies == 3 else 10.0)


def test_the_error_of_a_mean_is_less_by_the_root_of_the_colonies():
    one = seen(4)
    assert standard_errors(one) == pytest.approx(np.array(one.spread) / 2)
    bulk = lambda state: state.groups.sum(state.gfp)
    number = Measured({"bulk": bulk}, {"bulk": 3.0}, {"bulk": 0.5}, time=2.0, colonies=9)
    both = checked_data(Conditions([({"dose": 1.0}, one), ({"dose": 2.0}, number)]))
    # what is measured comes with its error
    assert standard_errors(both) == pytest.approx([*np.array(one.spread) / 2, 0.5])
    near = np.array(one.values) + np.array(one.spread)
    assert Prediction(one, np.zeros((1, 1)), near[None]).losses == pytest.approx([4.0])
    # of a simulation of one colony: half of 1/4 + 1
    alone = Prediction(one, np.zeros((1, 1)), near[None], replicates=1)
    assert alone.losses == pytest.approx([1.6])
    assert standard_errors(both, 1)[-1] == 0.5


def test_what_was_seen_before_the_end_is_no_number_of_cells_at_the_end():
    def data(until):
        *_, state = tf.simulate(colony(), until=until, dt=0.1, colonies=3, seed=8)
        return Observed.from_state(state).without("extent", "density", "alignment", "cells")

    apart = Conditions([({"dose": 1.0}, data(1.0)), ({"dose": 2.0}, data(2.0))])
    assert cells_each(checked_data(apart)) == 0.0  # not known
    alike = Conditions([({"dose": 1.0}, data(2.0)), ({"dose": 2.0}, data(2.0))])
    last = data(2.0)
    assert cells_each(checked_data(alike)) == pytest.approx(last.cells / 3)


def test_truths_that_all_fail_are_an_error(monkeypatch):
    *_, state = tf.simulate(fragile(1.0), until=1.0, dt=0.1, colonies=3)
    data = Observed.from_state(state, species=("gfp",)).without("density", "extent", "alignment")
    make = [Parameter("make", 0.5, 9.0)]  # above 5 they fail
    options = {"simulations": 160, "epochs": 2, "flows": 1, "progress": False}
    known = infer(fragile, make, data, dt=0.1, **options)
    bad = lambda task, *args, **options: np.full((4, 1), 0.9)
    monkeypatch.setattr("design.posterior.random_points", bad)
    with pytest.raises(InputError, match=r"all 4 simulations failed: .*gfp"):
        known.check(truths=4)


def express(u, s, p, cell):
    return {"gfp": p.make - u.gfp}


def reporter(make=3.0):
    circuit = tf.Circuit(express, species="gfp", make=make)
    one = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    return tf.Scene(circuit, dim=2, dt=0.1, founders=one)


@pytest.mark.parametrize("colonies", [4, 64])
def test_intervals_of_a_mean_are_those_of_its_error(colonies):
    """One cell in each colony, whose level is 3 (1 − 1/e) ± 0.2 after an hour."""
    levels = 3.0 * (1.0 - np.exp(-1.0)) + 0.2 * np.random.default_rng(1).standard_normal(colonies)
    table = {"gfp": levels, "colony": np.arange(colonies)}
    data = Observed.from_table(table, species=("gfp",), time=1.0).without("cells", "gfp variation")
    best = Search(reporter, [Parameter("make", 1.0, 9.0)], data, replicates=1).run(
        colonies=60, progress=False
    )
    told = best.intervals()
    error = levels.std(ddof=1) / np.sqrt(colonies) / (1.0 - np.exp(-1.0))
    assert np.sqrt(told.covariance[0, 0]) == pytest.approx(error, rel=0.01)
    assert told.values[0] == pytest.approx(levels.mean() / (1.0 - np.exp(-1.0)), rel=0.01)

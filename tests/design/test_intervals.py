"""Intervals around a best fit, against least squares of the same readings in closed form."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import curve_fit

import torchfilm as tf
from design import Conditions, Intervals, Measured, ObservedCourse, OnFraction, Parameter, Search
from design.intervals import _above, intervals_of

ONE = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
TIMES = np.arange(1, 9) * 0.5
TRUTH = (3.0, 0.9)


def washout(start=1.0, loss=0.5, idle=1.0, dose=1.0) -> tf.Scene:
    rates = lambda u, s, p, cell: {"gfp": 0.0 * p.dose * p.idle - p.loss * u.gfp}
    circuit = tf.Circuit(
        rates, species="gfp", initial={"gfp": start}, loss=loss, idle=idle, dose=dose, rtol=1e-8
    )
    return tf.Scene(circuit, dim=2, dt=0.1, founders=ONE)


def gfp(state: tf.State) -> torch.Tensor:
    return state.groups.sum(state.gfp)


def level(time, start, loss):
    return start * np.exp(-loss * time)


READINGS = level(TIMES, *TRUTH) + 0.05 * np.random.default_rng(0).normal(size=len(TIMES))


def course(some=slice(None), shift=0.0) -> ObservedCourse:
    return ObservedCourse.of_measures(
        {"gfp": gfp}, times=TIMES[some], values={"gfp": READINGS[some] + shift},
        spread={"gfp": 0.05}, smooth=True,
    )  # fmt: skip


SPACE = {
    "start": Parameter("start", 0.1, 100.0, log=True),
    "loss": Parameter("loss", 0.01, 5.0),
    "idle": Parameter("idle", 0.1, 5.0),
}


def fitted(target, *names, **options):
    space = [SPACE[n] for n in names]
    search = Search(washout, space, target, replicates=2, dtype=torch.float64, **options)
    return search.run(colonies=300, progress=False)


def test_a_fit_above_its_minimum_is_told():
    """½ gᵀ H⁻¹ g is by how much the loss is above that of the least squares."""
    target = course()
    search = Search(washout, [SPACE["start"], SPACE["loss"]], target, dtype=torch.float64)
    best = search.run(colonies=600, progress=False)
    assert best.intervals().above < 1e-6
    assert "has not come to the bottom" not in best.intervals().table()
    values = {"start": best.values["start"] * 1.05, "loss": best.values["loss"]}
    point = search.objective.task.space.point(values)
    loss = float(search.objective.evaluate(point[None]).loss[0])
    off = intervals_of(search.objective, point, values, loss)
    assert off.above == pytest.approx(loss - best.loss, rel=0.1)
    assert f"some {off.above:.2g} above the minimum near it. Search longer." in off.table()


@pytest.mark.parametrize("bound, outward", [(0.0, 1.0), (1.0, -1.0)])
def test_a_bound_stops_a_way_down_beyond_it(bound, outward):
    of = lambda slope: _above(np.array([bound]), np.array([slope]), np.eye(1))
    assert of(outward) == 0.0 and of(-outward) == 0.5


@pytest.mark.parametrize("conditions", [False, True])
def test_they_are_those_of_least_squares(conditions):
    """Also where the readings are under two conditions, of which one has more."""
    target = course()
    if conditions:
        first, rest = course(slice(0, 3)), course(slice(3, None))
        target = Conditions([({"dose": 1.0}, first), ({"dose": 2.0}, rest)])
    best = fitted(target, "start", "loss")
    found = best.intervals()
    values, covariance = curve_fit(level, TIMES, READINGS, [2, 1], 0.05, absolute_sigma=True)
    assert list(best.values.values()) == pytest.approx(values.tolist(), rel=1e-3)
    # of ln start, and of the loss
    scale = np.diag([1 / values[0], 1.0])
    assert found.covariance == pytest.approx(scale @ covariance @ scale, rel=5e-3)
    assert found.readings == len(TIMES)
    low, high = found.interval(0.9)["loss"]
    assert high - low == pytest.approx(2 * 1.6449 * math.sqrt(covariance[1, 1]), rel=5e-3)
    low, high = found.interval(0.9)["start"]
    assert math.log(high / low) == pytest.approx(
        2 * 1.6449 * math.sqrt(covariance[0, 0]) / values[0], rel=5e-3
    )
    said = found.table(0.5)
    assert "50 % interval" in said and "of a right model with right spreads about 0.75" in said
    assert "too narrow" not in said and "have a correlation" not in said


def test_nine_of_ten_hold_the_truth():
    """Of 200 sets of readings, from the covariance at the truth: 180 ± 4."""
    best = fitted(course(), "start", "loss")
    error = np.sqrt(np.diag(best.intervals().covariance))
    draws, held = np.random.default_rng(1), 0
    for _ in range(200):
        data = level(TIMES, *TRUTH) + 0.05 * draws.normal(size=len(TIMES))
        (_, loss), _ = curve_fit(level, TIMES, data, TRUTH, 0.05, absolute_sigma=True)
        held += abs(loss - TRUTH[1]) < 1.6449 * error[1]
    assert 165 <= held <= 192


def test_what_the_data_do_not_tell():
    best = fitted(course(), "start", "idle")
    found = best.intervals()
    assert found.interval()["idle"] == (-math.inf, math.inf)
    assert math.isnan(found.correlation[0, 1]) and np.isfinite(found.covariance[0, 0])
    assert "beyond both bounds: these data do not tell it" in found.table()


def test_a_model_that_does_not_fit_is_said():
    found = fitted(course(shift=np.where(TIMES > 2, 1.0, 0.0)), "start", "loss").intervals()
    assert "it is more, so that these intervals are too narrow" in found.table()


@pytest.mark.parametrize(
    ("target", "words"),
    [
        (OnFraction("gfp", 0.5, level=1.0), "observed = OnFraction.* must be an Observed"),
        (Measured({"gfp": gfp}, {"gfp": 1.0}, {"gfp": 0.1}, time=1.0), "smooth=True.*design.infer"),
        (
            Measured({"gfp": gfp}, {"gfp": (1.0, 2.0)}, {"gfp": 0.1}, time=1.0, smooth=True),
            "must be one number, as data have one",
        ),
    ],
)
def test_what_has_no_intervals(target, words):
    options = {"until": 1.0} if isinstance(target, OnFraction) else {}
    space = [SPACE["start"]]
    search = Search(washout, space, target, replicates=1, dtype=torch.float64, **options)
    with pytest.raises(tf.InputError, match=words):
        search.run(colonies=12, progress=False).intervals()


def made(covariance, loss=1.0, readings=20, values=(1.0, 1.0)) -> Intervals:
    space = (Parameter("a", 0.5, 2.0), Parameter("b", 0.5, 2.0))
    return Intervals(space, values, np.array(covariance), readings, loss)


def test_what_a_table_says():
    """Of 20 readings and two parameters the loss is 0.9 ± 0.3."""
    related = made([[0.01, -0.0095], [-0.0095, 0.01]])
    assert "a and b have a correlation of -0.95" in related.table()
    for loss, far in ((0.95, False), (1.75, False), (1.85, True)):
        said = made(np.diag([0.01, 0.01]), loss).table()
        assert ("too narrow" in said) == far and "have a correlation" not in said
    # 1 ± 0.6: below the lower bound, not above the upper one
    assert "beyond both" not in made(np.diag([0.13, 0.01])).table()
    assert "beyond both" in made(np.diag([0.5, 0.01])).table()


def test_data_of_which_some_have_no_time():
    """A search takes them, and so do intervals."""
    at = lambda time: Measured({"gfp": gfp}, {"gfp": 1.5}, {"gfp": 0.1}, time=time, smooth=True)
    some = Conditions([({"dose": 1.0}, at(None)), ({"dose": 2.0}, at(2.0))])
    assert fitted(some, "start").intervals().readings == 2

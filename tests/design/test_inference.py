"""Inference: simulations and their file, posteriors, and their calibration."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib.util import find_spec
from multiprocessing import get_context

import h5py
import numpy as np
import pytest
import torch
from scipy import stats
from searching import grown

import torchfilm as tf
from design import Calibration, Choice, Observed, Parameter, Task, infer, neural_posterior
from design.neural_posterior import NeuralPosterior
from design.parameters import Space
from design.posterior import Posterior
from design.posterior_plot import draw_corner
from design.prediction import Prediction
from design.prior import Prior
from design.region import Region
from design.simulations import simulate_designs, simulate_points

RATE = [Parameter("rate", 0.8, 2.0, log=True)]
NEEDS_SBI = 'needs pip install -e ".[infer]"'
needs_sbi = pytest.mark.skipif(find_spec("sbi") is None, reason=NEEDS_SBI)


def colony(rate=1.5, make=1.0):
    """Without mechanics, so that it is fast."""
    return grown(tf.LogNormal(rate, 0.2), make)


@pytest.fixture(scope="module")
def data():
    *_, state = tf.simulate(colony(rate=1.4), until=2.0, colonies=2, seed=8)
    return Observed.from_state(state).without("extent", "density", "alignment")


def task_of(data, parameters=RATE, **options):
    options = {"until": 2.0, "dt": 0.1, "replicates": 2, "replay": False, **options}
    return Task(colony, parameters, data, **options)


def alike(one, other):
    return np.array_equal(one.points, other.points) and np.array_equal(
        one.statistics, other.statistics, equal_nan=True
    )


# --- simulations ----------------------------------------------------------------------------------


def test_a_simulation_does_not_depend_on_its_batch(data):
    task = task_of(data)
    every = simulate_designs(task, 12)
    assert every.points.shape == (12, 1) and every.sound.all()
    later = simulate_points(task, every.points[7:10], 7)
    assert np.array_equal(later.statistics, every.statistics[7:10])
    assert len(np.unique(simulate_points(task, np.full((6, 1), 0.5), 0).statistics, axis=0)) == 6


def test_simulations_resume(data, tmp_path, monkeypatch):
    monkeypatch.setattr("design.simulations.BATCH", 4)
    task, path = task_of(data), tmp_path / "simulations.h5"
    whole, counts = simulate_designs(task, 10), []
    simulate_designs(task, 6, path=path)
    found = simulate_designs(task, 10, path=path, seen=counts.append)
    assert alike(found, whole) and counts == [6, 10]
    assert alike(simulate_designs(task, 5, path=path), whole.take(slice(0, 5)))
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        assert alike(simulate_designs(task, 10, executor=pool), whole)
    with h5py.File(path) as file:
        places = {"regions", "starts of regions"}
        assert set(file) == {"points", "statistics", "cells", "names", "values"} | places
        assert file["values/rate"][0] == pytest.approx(task.space.values(whole.points[0])["rate"])


def test_the_file_serves_other_data_but_no_other_simulations(data, tmp_path):
    path = tmp_path / "simulations.h5"
    one = simulate_designs(task_of(data), 4, path=path)
    *_, state = tf.simulate(colony(rate=1.0), until=2.0, colonies=2, seed=9)
    other = Observed.from_state(state, like=data)
    assert other.values != data.values
    assert alike(simulate_designs(task_of(other), 4, path=path), one)
    for options, word in (
        ({"dt": 0.05}, "dt"),
        ({"seed": 1}, "seed"),
        ({"replicates": 1}, "replicates"),
        ({"parameters": [Parameter("rate", 0.5, 2.0, log=True)]}, "parameters"),
    ):
        with pytest.raises(tf.InputError, match=f"differs in .*{word}"):
            simulate_designs(task_of(data, **options), 4, path=path)
    later = replace(data, time=3.0)
    with pytest.raises(tf.InputError, match=r"differs in .*until"):
        simulate_designs(task_of(later, until=3.0), 4, path=path)
    with pytest.raises(tf.InputError, match="differs in target"):
        simulate_designs(task_of(data.without("cells")), 4, path=path)
    path.write_text("no HDF5")
    with pytest.raises(tf.InputError, match="cannot be read"):
        simulate_designs(task_of(data), 4, path=path)


def fragile(rate=1.5, make=1.0):
    """The scene refuses some rates."""
    bad = (torch.as_tensor(rate) > 1.5) & (torch.as_tensor(rate) < 1.6)
    return grown(torch.where(bad, -1.0, torch.as_tensor(rate)), make)


def test_designs_that_fail_are_left_out(data):
    task = Task(fragile, [Parameter("rate", 1.0, 2.0)], data, until=2.0, replicates=2, replay=False)
    points = np.array([[0.2], [0.55], [0.8]])
    found = simulate_points(task, points, 0)
    assert found.sound.tolist() == [True, False, True] and list(found.reasons) == [1]
    assert "rate" in found.failures()[0][0] and found.failures()[0][1] == 1
    both = found.followed_by(found)
    assert list(both.reasons) == [1, 4] and both.take(slice(2, 5)).reasons.keys() == {2}


# --- posteriors -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def posterior(data):
    if find_spec("sbi") is None:
        pytest.skip(NEEDS_SBI)
    state = torch.random.get_rng_state()
    found = infer(
        colony, RATE, data, simulations=300, dt=0.1, flows=2, epochs=60, samples=500,
        progress=False,
    )  # fmt: skip
    assert torch.equal(torch.random.get_rng_state(), state)
    return found


@needs_sbi
def test_flows_are_learnt_by_one_thread_and_it_is_shown(data, capsys, monkeypatch):
    """Threads make no difference, and slow such small flows down; the bar names the flow."""
    seen, real = [], neural_posterior._learn_flow

    def learn(*about):
        seen.append(torch.get_num_threads())
        return real(*about)

    monkeypatch.setattr(neural_posterior, "_learn_flow", learn)
    monkeypatch.setattr(tf.progress, "LINES", 0.0)  # in a file each change is a line
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        infer(colony, RATE, data, simulations=50, dt=0.1, flows=2, epochs=2, samples=10,
              progress=True)  # fmt: skip
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert seen == [1, 1]
    shown = capsys.readouterr().err
    assert all(f"learning flow {k} of 2" in shown for k in (1, 2)) and "2/2 flows" in shown


def test_the_posterior_finds_the_hidden_rate(posterior):
    low, high = posterior.interval(0.95)["rate"]
    assert low < 1.4 < high and high / low < 1.6
    assert low < posterior.mean["rate"] < high
    sample = posterior.samples["rate"]
    assert sample.shape == (500,) and sample.min() >= 0.8 and sample.max() <= 2.0
    # log scale: the mean is the geometric one
    assert posterior.mean["rate"] == pytest.approx(np.exp(np.log(sample).mean()))
    assert posterior.surprises == [] and "90 % interval" in posterior.table()
    assert "Posterior(mean=" in repr(posterior)


def test_one_estimator_serves_other_data(posterior, data):
    *_, state = tf.simulate(colony(rate=1.0), until=2.0, colonies=2, seed=11)
    slow = posterior.given(Observed.from_state(state, like=data))
    assert slow.mean["rate"] < 1.2 < posterior.mean["rate"]
    with pytest.raises(tf.InputError, match="of the same statistics"):
        posterior.given(Observed.from_state(state))


def test_data_that_no_simulation_reaches_are_named(posterior, data):
    far = replace(data, values=(20.0, *data.values[1:]))
    found = posterior.given(far)
    assert len(found.surprises) == 1 and found.surprises[0].startswith("log_cells is 20")
    assert "does not reach the data" in found.table()


def test_calibration_counts_covered_truths(posterior, tmp_path):
    found = posterior.check(40, samples=99)
    assert found.ranks.shape == (40, 1) and found.density_ranks.shape == (40,)
    assert (found.ranks >= 0).all() and (found.ranks <= 99).all()
    assert all(share > 0.7 for share in found.coverage().values())
    assert "40 truths" in found.table()
    assert found.plot(tmp_path / "ranks.png").path.stat().st_size > 1000
    assert posterior.plot(tmp_path / "corner.png", truth={"rate": 1.4}).path.stat().st_size > 1000


@pytest.mark.parametrize("samples", [9, 12, 49, 99, 1000])
def test_coverage_of_even_ranks_is_the_level(samples):
    ranks = np.arange(samples + 1)
    made = Calibration(("a",), ranks[:, None], ranks, samples, failed=2)
    assert made.coverage(0.9) == pytest.approx({"a": 0.9, "all together": 0.9})
    assert made.coverage(0.5) == pytest.approx({"a": 0.5, "all together": 0.5})
    assert "2 truths failed" in made.table()


class _Below:
    """Samples below all truths, with a density that grows with the rate."""

    region = Region.whole(1)

    def sample(self, statistics, count, *, seed):
        return np.zeros((len(statistics), count, 1))

    def log_density(self, points, statistics):
        return points[..., 0]


def sampled(data, points, prior=None) -> Posterior:
    """A posterior with these samples, for which nothing was learnt."""
    task = task_of(data)
    return Posterior(task, Prior(task.space, prior), None, _Below(), data, points)


def test_an_interval_leaves_out_as_much_on_either_side(data):
    made = sampled(data, np.linspace(0.0, 1.0, 101)[:, None])
    ends = [RATE[0].value(share) for share in (0.05, 0.95)]
    assert made.interval(0.9)["rate"] == pytest.approx(ends)


def test_ranks_are_numbers_of_samples_below_a_truth_and_of_more_likely_ones(data):
    found = sampled(data, np.zeros((1, 1))).check(3, samples=9)
    assert found.ranks.tolist() == [[9]] * 3 and found.density_ranks.tolist() == [0] * 3


def test_the_truths_of_a_calibration_follow_the_prior(data, monkeypatch):
    truths = []

    def simulate(task, points, first):
        truths.append(points)
        return simulate_points(task, points, first)

    monkeypatch.setattr("design.posterior.simulate_points", simulate)
    sampled(data, np.zeros((1, 1)), {"rate": stats.norm(1.4, 0.01)}).check(4, samples=9)
    rates = [RATE[0].value(float(x)) for x in truths[0][:, 0]]
    assert rates == pytest.approx([1.4] * 4, abs=0.05)


def kinds(kind="fast", copies=1, make=1.0):
    return grown(tf.LogNormal({"slow": 0.8, "fast": 1.8}[kind], 0.2), make * copies)


def test_the_picture_of_a_posterior_says_what_it_shows():
    space = Space([Parameter("rate", 0.7, 1.6), Choice("kind", ("slow", "fast"))])
    points = np.random.default_rng(0).uniform(size=(50, 2))
    figure = draw_corner(space, points, points[0])
    title = " ".join(figure._suptitle.get_text().split())
    assert "90 % interval" in title and "red: truth" in title
    labels = {ax.get_xlabel() for ax in figure.axes} | {ax.get_ylabel() for ax in figure.axes}
    assert {"rate\n(from 0.7 to 1.6)", "kind\n(2 options)", "samples"} <= labels
    alone = draw_corner(Space([Parameter("rate", 0.7, 1.6)]), points[:, :1], None)
    assert "pairs" not in alone._suptitle.get_text() and "truth" not in alone._suptitle.get_text()


@needs_sbi
def test_choices_and_whole_numbers_are_inferred(tmp_path):
    *_, state = tf.simulate(kinds("slow", 3), until=2.0, colonies=2, seed=8)
    data = Observed.from_state(state, species=["gfp"]).without("extent", "density", "alignment")
    found = infer(
        kinds, [Choice("kind", ("slow", "fast")), Parameter("copies", 1, 4, whole=True)], data,
        simulations=600, flows=1, epochs=60, samples=200, progress=False,
    )  # fmt: skip
    assert found.mean == {"kind": "slow", "copies": 3}
    assert set(found.samples["kind"]) <= {"slow", "fast"} and "of the samples" in found.table()
    assert set(found.interval()) == {"copies"}
    found.plot(tmp_path / "corner.png", truth={"kind": "slow", "copies": 3})


@needs_sbi
@pytest.mark.parametrize(
    "options, message",
    [
        ({"simulations": 20}, "simulations"),
        ({"samples": 0}, "samples"),
        ({"flows": 0}, "flows"),
        ({"epochs": 0}, "epochs"),
        ({"observed": 3}, "observed"),
        ({"replicates": 0}, "replicates"),
    ],
)
def test_bad_arguments_are_refused(data, options, message):
    observed = options.pop("observed", data)
    with pytest.raises(tf.InputError, match=message):
        infer(colony, RATE, observed, **{"progress": False, **options})


def hopeless(rate=1.5):
    """The scene refuses all rates but the bounds and the middle, which a task tries."""
    rate = torch.as_tensor(rate)
    tried = ((rate - 1.5).abs() < 1e-4) | (rate < 1.0001) | (rate > 1.9999)
    return grown(torch.where(tried, rate, -1.0), 1.0)


@needs_sbi
def test_too_many_failures_are_refused(data, monkeypatch):
    monkeypatch.setattr("design.inference.LEAST", 5)
    with pytest.raises(tf.InputError, match=r"0 of 5 simulations succeeded.*rate"):
        infer(hopeless, [Parameter("rate", 1.0, 2.0)], data, simulations=5, progress=False)


def test_without_sbi_the_error_names_the_extra(monkeypatch, data):
    monkeypatch.setattr("design.neural_posterior.find_spec", lambda name: None)
    with pytest.raises(tf.InputError, match=r'pip install -e "\.\[infer\]"'):
        infer(colony, RATE, data)


@needs_sbi
def test_a_poor_flow_is_learnt_again(monkeypatch):
    """A flow that is far wider than what the regression leaves."""
    rng = np.random.default_rng(0)
    points = rng.random((400, 1))
    statistics = np.c_[points + 0.02 * rng.normal(size=(400, 1)), rng.normal(size=(400, 1))]
    seeds, real = [], neural_posterior._learn_flow

    def learn(theta, x, seed, epochs):
        seeds.append(seed)
        return _Flat() if seed in (1, 3) else real(theta, x, seed, epochs)

    monkeypatch.setattr(neural_posterior, "_learn_flow", learn)
    given = {"seed": 0, "epochs": 60}
    found = NeuralPosterior.learn(points, statistics, flows=2, **given)
    assert seeds == [0, 1, 3, 5] and len(found.flows) == 2
    assert np.ptp(found.sample(statistics[:1], 500, seed=0)) < 0.4
    seeds.clear()
    alone = NeuralPosterior.learn(points, statistics, flows=1, **{**given, "seed": 1})
    assert seeds == [1, 2] and np.ptp(alone.sample(statistics[:1], 500, seed=0)) < 0.4


@needs_sbi
def test_an_estimator_that_learns_nothing_is_warned_of(monkeypatch):
    rng = np.random.default_rng(0)
    points = rng.random((200, 1))
    monkeypatch.setattr(neural_posterior, "_learn_flow", lambda theta, x, seed, epochs: _Flat())
    with pytest.warns(UserWarning, match="learnt less from the simulations than a linear reg"):
        NeuralPosterior.learn(points, points + 0.001 * rng.random((200, 1)), seed=0, flows=2,
                              epochs=5)  # fmt: skip


class _Flat(torch.nn.Module):
    """A wide normal density, whatever the statistics."""

    def log_prob(self, theta, condition):
        return torch.distributions.Normal(0.0, 30.0).log_prob(theta).sum(-1)


@needs_sbi
def test_predictions_look_like_the_data_where_the_model_is_right(data):
    found = infer(
        colony, RATE, data, simulations=300, dt=0.1, flows=1, epochs=60, samples=300,
        progress=False,
    )  # fmt: skip
    seen = found.predict(40)
    assert seen.statistics.shape == (40, len(data.values)) and not seen.failed
    assert set(seen.places) == set(data.plan.names)
    low, high = seen.interval(0.99)["log_cells"]
    assert low <= data.values[0] <= high
    assert "outside; " in seen.table() and "loss of a simulation" in seen.table()
    wrong = replace(data, values=(data.values[0] + 5.0, *data.values[1:]))
    off = replace(seen, observed=wrong)
    assert float(np.median(seen.losses)) < 0.5 * float(np.median(off.losses))
    assert off.places["log_cells"] == 1.0 and "outside\n" in off.table() + "\n"
    assert np.array_equal(seen.statistics, found.predict(40).statistics)


def test_the_loss_and_the_places_of_predictions_by_hand():
    seen = Observed.from_table({"gfp": [1.0, 2.0]}, species=["gfp"]).without("cells")
    assert seen.colonies == 1 and len(seen.values) == 2
    apart = np.array([[0.0, 0.0], [0.0, 3.0]]) * seen.spread
    made = Prediction(seen, np.zeros((2, 1)), seen.values + apart)
    assert made.losses == pytest.approx([0.0, 4.5])
    same = replace(made, statistics=np.tile(seen.values, (2, 1)))
    assert list(same.places.values()) == [0.5, 0.5]


@needs_sbi
def test_data_of_another_time_are_refused(data):
    found = infer(
        colony, RATE, data, simulations=60, dt=0.1, flows=1, epochs=5, samples=20, progress=False
    )
    later = replace(data, time=data.time + 0.5)
    with pytest.raises(tf.InputError, match=f"data of {data.time:g} h"):
        found.given(later)
    assert found.given(replace(data, time=None)).points.shape == found.points.shape


@needs_sbi
def test_an_end_other_than_that_of_the_data_is_refused(data):
    for name, end in {"cells": 2, "until": data.time + 1.0}.items():
        with pytest.raises(tf.InputError, match=f"{name} = {end:g}.* left out, since the data"):
            infer(colony, RATE, data, dt=0.1, progress=False, **{name: end})


def test_colonies_that_stop_before_the_data_have_failed(data):
    task = Task(colony, RATE, data, until=data.time, cells=3, replicates=2, dt=0.1, replay=False)
    found = simulate_points(task, np.array([[0.9]]), 0)
    assert not found.sound.any() and "and was observed at" in found.reasons[0]


@needs_sbi
def test_few_simulations_of_many_statistics_are_not_compared_with_a_regression():
    """A regression of 60 points on 40 numbers fits them far better than others."""
    rng = np.random.default_rng(1)
    points = rng.random((60, 1))
    statistics = np.c_[points, rng.normal(size=(60, 39))]
    learnt = NeuralPosterior.learn(points, statistics, seed=0, flows=1, epochs=3)
    assert learnt.sample(statistics[:1], 5, seed=0).shape == (1, 5, 1)


def test_a_file_of_other_statistics_is_refused(data, tmp_path):
    task = task_of(data)
    path = tmp_path / "simulations.h5"
    simulate_designs(task, 2, path=path)
    with h5py.File(path, "r+") as file:
        names = file["names"][...]
        del file["names"]
        file.create_dataset("names", data=names[:-1])
    with pytest.raises(tf.InputError, match="this one differs in statistics"):
        simulate_designs(task, 2, path=path)


@needs_sbi
def test_parameters_of_which_the_data_tell_a_combination_are_named(data):
    def twice(first=1.0, second=1.0):
        return colony(rate=first * second)

    pair = [Parameter("first", 0.8, 1.25, log=True), Parameter("second", 0.8, 1.25, log=True)]
    found = infer(
        twice, pair, data, simulations=100, dt=0.1, flows=1, epochs=5, samples=50, progress=False
    )
    rng = np.random.default_rng(0)
    one = rng.uniform(0.2, 0.8, 50)
    tied = replace(found, points=np.c_[one, 1.0 - one + 0.01 * rng.normal(size=50)])
    assert tied.correlations["first", "second"] < -0.95
    assert "first and second have a correlation of -" in tied.table()
    loose = replace(found, points=rng.random((50, 2)))
    assert "have a correlation" not in loose.table()


def populated(mean=20.0, cells=60):
    """Cells of a drawn level, none of which divides."""
    level = tf.LogNormal(mean, 0.3)
    place = np.stack([6.0 * np.arange(cells), np.zeros(cells)], 1)
    founders = tf.Cells(place, np.tile([[1.0, 0.0]], (cells, 1)))
    circuit = tf.Circuit(relaxing, species="gfp", level=level)
    return tf.Scene(circuit, founders=founders, dim=2, dt=0.5)


def relaxing(u, s, p, cell):
    return {"gfp": 20.0 * (p.level - u.gfp)}


@needs_sbi
@pytest.mark.parametrize("observed, words", [(12, "too narrow"), (50, ""), (300, "too wide")])
def test_other_numbers_of_cells_than_were_observed_are_named(observed, words):
    """Data of a flow cytometer: the levels of some cells of a large population."""
    levels = 20.0 * np.exp(0.3 * np.random.default_rng(1).normal(size=observed))
    table = Observed.from_table({"gfp": levels}, species=("gfp",), time=1.0)
    given = {"simulations": 60, "flows": 1, "epochs": 5, "samples": 20, "progress": False}
    mean = [Parameter("mean", 10.0, 40.0, log=True)]
    fit = lambda: infer(populated, mean, table.without("cells"), **given)
    if not words:
        assert fit().other_sizes == ""
        return
    with pytest.warns(UserWarning, match=f"60 cells of each simulated.* {observed} of.* {words}"):
        found = fit()
    assert words in found.table()

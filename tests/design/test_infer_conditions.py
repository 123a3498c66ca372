"""Inference from data of several conditions, such as a dose response."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import (
    Conditions,
    Measured,
    Observed,
    ObservedCourse,
    Parameter,
    Search,
    Stripe,
    Task,
    infer,
)
from design.simulations import simulate_designs, simulate_points
from design.targets.observed_conditions import ObservedConditions, cells_each
from design.targets.observed_measures import as_data

K = [Parameter("half", 0.2, 5.0, log=True)]
DOSES = 0.2, 1.0, 5.0


def induced(u, s, p, cell):
    return {"gfp": p.make * p.iptg / (p.half + p.iptg) - u.gfp}


def sensor(iptg=1.0, half=1.0, make=4.0):
    circuit = tf.Circuit(induced, species="gfp", iptg=iptg, half=half, make=make)
    growth = tf.Growth(rate=tf.Normal(1.2, 0.1))
    return tf.Scene(growth, tf.Division(length=4.0), circuit, dim=2, dt=0.1)


def seen(iptg, until=2.0, colonies=2, seed=3, **given) -> Observed:
    *_, state = tf.simulate(
        sensor(iptg=iptg, **given), until=until, colonies=colonies, seed=seed, dt=0.1
    )
    observed = Observed.from_state(state, species=["gfp"])
    return observed.without("extent", "density", "alignment", "length", "gfp profile")


@pytest.fixture(scope="module")
def data() -> Conditions:
    return Conditions([({"iptg": dose}, seen(dose, seed=k)) for k, dose in enumerate(DOSES)])


def task_of(data, **options) -> Task:
    return Task(sensor, K, data, until=2.0, dt=0.1, replicates=2, replay=False, **options)


def test_statistics_are_those_of_each_condition(data):
    """Of the colonies with the same random numbers, each under its condition, grown by hand."""
    found = simulate_designs(task_of(data), 3)
    names = ObservedConditions(data).plan.names
    assert found.sound.all() and found.statistics.shape == (3, len(names))
    for row, point in enumerate(found.points):
        half = K[0].value(float(point[0]))
        doses = torch.tensor(DOSES * 2)
        scene = sensor(iptg=doses, half=torch.full_like(doses, half))
        model = scene.bind(colonies=6, streams=[row * 6 + k for k in range(6)])
        state = model.start()
        while state.time < 2.0 - 1e-9:
            state = model.step(state)
        gfp = state.gfp.double()
        means = [float(gfp[state.colony == k].mean()) for k in range(6)]
        for k, dose in enumerate(DOSES):
            at = names.index(f"gfp_mean (iptg = {dose:g})")
            assert found.statistics[row, at] == pytest.approx(
                (means[k] + means[k + 3]) / 2, rel=1e-5
            )


def test_the_batch_and_the_file_do_not_matter(data, tmp_path):
    task = task_of(data)
    found = simulate_designs(task, 5, path=tmp_path / "doses.h5")
    again = simulate_designs(task, 7, path=tmp_path / "doses.h5")
    assert np.array_equal(found.statistics, again.statistics[:5]) and len(again) == 7
    other = Conditions(
        [({"iptg": 2 * dose}, part) for (_, part), dose in zip(data.terms, DOSES, strict=True)]
    )
    with pytest.raises(tf.InputError, match="differs in"):
        simulate_designs(task_of(other), 5, path=tmp_path / "doses.h5")


def test_several_times_under_several_conditions():
    course = lambda dose: ObservedCourse([seen(dose, 1.0), seen(dose, 2.0)])
    data = Conditions([({"iptg": dose}, course(dose)) for dose in (0.2, 5.0)])
    found = simulate_designs(task_of(data), 2)
    names = ObservedConditions(data).plan.names
    assert found.sound.all() and "gfp_mean at 1 h (iptg = 5)" in names
    early, late = (names.index(f"gfp_mean at {t} h (iptg = 5)") for t in (1, 2))
    assert (found.statistics[:, early] < found.statistics[:, late]).all()


def test_a_colony_that_fails_under_one_condition_fails_its_design():
    def dying(iptg=1.0, half=1.0):
        killed = tf.Lysis(rate=torch.where(torch.as_tensor(iptg) > 4.0, 50.0, 0.0))
        made = sensor(iptg=iptg, half=half)
        return tf.Scene(*made.effects, killed, dim=2, dt=0.1)

    data = Conditions([({"iptg": dose}, seen(dose)) for dose in (0.2, 1.0)])
    late = Conditions([({"iptg": 0.2}, seen(0.2)), ({"iptg": 5.0}, seen(5.0))])
    options = {"until": 2.0, "dt": 0.1, "replicates": 2, "replay": False}
    assert simulate_designs(Task(dying, K, data, **options), 2).sound.all()
    found = simulate_designs(Task(dying, K, late, **options), 2)
    assert not found.sound.any() and found.reasons


@pytest.mark.skipif(find_spec("sbi") is None, reason='needs pip install -e ".[infer]"')
def test_the_posterior_of_a_dose_response_covers_the_truth(data):
    found = infer(
        sensor, K, data, simulations=200, rounds=2, dt=0.1, flows=1, epochs=80, samples=500,
        progress=False,
    )  # fmt: skip
    low, high = found.interval()["half"]
    assert low < 1.0 < high and high / low < 1.5
    assert "under each of 3 conditions at 2 h" in found.table() and not found.surprises
    with pytest.raises(tf.InputError, match="data of the same statistics"):
        found.given(data.parts[0])


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (lambda: Stripe("gfp", at=0.0, width=4.0), "of data under every condition"),
        (lambda: replace(seen(1.0), time=None), r"time of Conditions = \[2.0, None\]"),
    ],
)
def test_what_cannot_be_simulated_together_is_refused(second, words):
    data = Conditions([({"iptg": 0.2}, seen(0.2)), ({"iptg": 1.0}, second())])
    with pytest.raises(tf.InputError, match=words):
        infer(sensor, K, data, dt=0.1, progress=False)


def test_a_search_fits_the_same_data(data):
    search = Search(sensor, K, data, until=2.0, dt=0.1, replicates=2, seed=1)
    best = search.run(colonies=60, progress=False)
    assert best.values["half"] == pytest.approx(1.0, rel=0.3)


def test_the_cells_of_a_colony_are_a_mean_over_conditions():
    ten = Observed.from_table({"length_um": np.linspace(2.0, 4.0, 10)})
    both = Conditions([({"iptg": dose}, ten) for dose in (0.2, 1.0)])
    assert cells_each(ObservedConditions(both)) == 10.0


# --- measured numbers ----------------------------------------------------------------------------


def bulk(state):
    """What a plate reader has: the mean over all cells by volume."""
    return state.groups.sum(state.gfp.double() * state.volume) / state.groups.sum(state.volume)


def read(value: float, error: float) -> Measured:
    return Measured({"bulk": bulk}, {"bulk": value}, {"bulk": error})


def level(iptg=1.0, make=20.0):
    """Cells that are all alike, and at rest."""
    circuit = tf.Circuit(at_rest, species="gfp", iptg=iptg, make=make)
    return tf.Scene(circuit, founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), dim=2, dt=0.5)


def at_rest(u, s, p, cell):
    return {"gfp": 50.0 * (p.make * p.iptg - u.gfp)}


MAKE = [Parameter("make", 10.0, 30.0)]
QUICK = {"until": 1.0, "dt": 0.5, "progress": False}


def test_simulations_have_the_errors_of_the_data(tmp_path):
    """One for each simulation, the same in any batch; conditions have their own."""
    two = Conditions([({"iptg": 1.0}, read(20.0, 2.0)), ({"iptg": 2.0}, read(40.0, 0.5))])
    target = ObservedConditions(two).conditions
    task = Task(level, MAKE, target, until=1.0, dt=0.5, replicates=1, replay=False)
    found = simulate_designs(task, 300)
    make = np.array([MAKE[0].value(float(x)) for x in found.points[:, 0]])
    apart = found.statistics - np.stack([make, 2 * make], 1)
    assert apart.std(0) == pytest.approx([2.0, 0.5], rel=0.15)
    assert np.abs(apart.mean(0)) == pytest.approx([0.0, 0.0], abs=0.4)
    assert abs(np.corrcoef(apart.T)[0, 1]) < 0.2
    again = simulate_points(task, found.points[5:9], 5)
    assert np.array_equal(again.statistics, found.statistics[5:9])


@pytest.mark.skipif(find_spec("sbi") is None, reason='needs pip install -e ".[infer]"')
def test_the_posterior_of_a_measured_number_is_as_wide_as_its_error():
    """20 ± 1.5, with a flat prior: the interval of 90 % is 20 ± 1.645 · 1.5."""
    found = infer(level, MAKE, read(20.0, 1.5), simulations=2000, samples=2000, flows=1, **QUICK)
    low, high = found.interval()["make"]
    assert (low, high) == pytest.approx((17.53, 22.47), abs=0.6)
    narrow = found.predict(40).statistics
    assert narrow.std() == pytest.approx(2**0.5 * 1.5, rel=0.35)
    other = found.given(read(24.0, 1.5)).interval()["make"]
    assert other == pytest.approx((low + 4.0, high + 4.0), abs=0.7)
    with pytest.raises(tf.InputError, match="data of the same statistics"):
        found.given(read(20.0, 0.5))


def test_a_measured_range_is_no_data():
    wide = Measured({"bulk": bulk}, {"bulk": (1.0, 2.0)}, {"bulk": 1.0})
    with pytest.raises(tf.InputError, match=r"Measured\.wanted\['bulk'\] = .*one number, as data"):
        infer(level, MAKE, wide, **QUICK)


def killed(rate=1.0):
    founders = tf.Cells([[3.0 * k, 0.0] for k in range(6)], [[1.0, 0.0]] * 6)
    return tf.Scene(tf.Lysis(rate=rate), founders=founders, dim=2, dt=0.1)


@pytest.mark.filterwarnings("ignore:a colony without cells is as it is wanted")
def test_colonies_in_which_all_have_died_are_data_where_they_count():
    """With a high rate none is left, which is what was seen."""
    count = lambda state: state.counts.double()
    rates = [Parameter("rate", 0.01, 30.0, log=True)]
    for extinct in (True, False):
        seen = Measured({"left": count}, {"left": 0.0}, {"left": 1e-6}, extinct=extinct)
        task = Task(
            killed, rates, as_data(seen), until=1.0, dt=0.1, replicates=1, replay=False
        )  # fmt: skip
        found = simulate_points(task, np.array([[1.0], [0.0]]), 0)
        assert found.sound.tolist() == [extinct, True]
        assert found.statistics[1, 0] == pytest.approx(6.0, abs=0.1)
    assert cells_each(as_data(seen)) == 0.0
    with pytest.raises(tf.InputError, match="leave measures out"):
        as_data(seen).without("left")

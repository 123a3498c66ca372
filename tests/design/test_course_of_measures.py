"""Measures of one's own at several times, such as those of a plate reader."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from searching import grown, objective_of

import torchfilm as tf
from design import (
    Conditions,
    Measured,
    Observed,
    ObservedCourse,
    Parameter,
    Search,
    Task,
    Weighted,
    infer,
)
from design.simulations import simulate_designs
from design.targets.observed_conditions import ObservedConditions, averaged, errors

MAKE = [Parameter("make", 0.5, 2.0, log=True)]
BOTH = [*MAKE, Parameter("decay", 0.3, 3.0, log=True)]
TIMES = (0.5, 1.0, 2.0)
OPTIONS = {"dt": 0.1, "replicates": 2}


def colony(make=1.0, decay=1.0):
    return grown(1.5, make, decay)


def bulk(state):
    """The mean level over all cells of a colony, by volume."""
    return state.groups.sum(state.gfp * state.volume) / state.groups.sum(state.volume)


def volume(state):
    return state.groups.sum(state.volume)


def late_only(state):
    return bulk(state) if state.time > 1.5 else torch.full((state.colonies,), math.nan)


def of(functions, values, spread, **options):
    return ObservedCourse.of_measures(
        functions, times=TIMES, values=values, spread=spread, **options
    )


def levels(make, decay) -> list[float]:
    seen = {round(s.time, 6): s for s in tf.simulate(colony(make, decay), until=2.0, dt=0.1)}
    return [float(bulk(seen[t])) for t in TIMES]


def test_each_time_has_what_was_measured_there():
    values = {"bulk": [0.4, math.nan, 0.9], "volume": [3.0, 6.0, 24.0]}
    course = of({"bulk": bulk, "volume": volume}, values, {"bulk": 0.1, "volume": [1, 2, 3]})
    assert course.plan.names == (
        "bulk at 0.5 h", "volume at 0.5 h", "volume at 1 h", "bulk at 2 h", "volume at 2 h",
    )  # fmt: skip
    assert course.values == (0.4, 3.0, 6.0, 0.9, 24.0)
    assert course.spread == tuple(errors(course)) == (0.1, 1.0, 2.0, 0.1, 3.0)
    assert course.describe() == "measured at 0.5, 1, 2 h: bulk, volume"
    states = list(tf.simulate(colony(), until=2.0, dt=0.1, colonies=2))
    found = course.statistics(states[-1], torch.stack([course.note(s) for s in states]))
    at = {round(s.time, 6): s for s in states}
    wanted = [bulk(at[0.5]), volume(at[0.5]), volume(at[1.0]), bulk(at[2.0]), volume(at[2.0])]
    assert torch.equal(found, torch.stack(wanted, 1).double())
    assert "volume at 1 h" in course.evidence and "at 2 h" in course.table()


def test_a_time_without_any_value_is_no_frame():
    course = of({"bulk": bulk}, {"bulk": [0.4, math.nan, 0.9]}, {"bulk": 0.1})
    assert course.times == (0.5, 2.0)


def test_a_fit_has_exact_derivatives_and_finds_the_truth():
    """Two constants show in three times: least squares with derivatives find both."""
    course = of({"bulk": bulk}, {"bulk": levels(1.4, 0.6)}, {"bulk": 0.01}, smooth=True)
    objective = objective_of(colony, BOTH, course, **OPTIONS)
    point = np.array([[0.4, 0.5]])
    found = objective.evaluate(point, slopes=True).slopes
    assert objective.why_differences == "" and found is not None
    for k in range(2):
        step = np.eye(2)[k] * 1e-3
        near = objective.evaluate(np.stack([point[0] - step, point[0] + step])).loss
        assert found.gradient[0, k] == pytest.approx((near[1] - near[0]) / 2e-3, rel=1e-2)
    best = Search(colony, BOTH, course, seed=0, **OPTIONS).run(colonies=200)
    assert best.loss < 0.3  # seeds differ by some tenths of a spread
    assert best.values["make"] == pytest.approx(1.4, rel=0.01)
    assert best.values["decay"] == pytest.approx(0.6, rel=0.05)


def test_without_smooth_there_are_differences():
    course = of({"bulk": bulk}, {"bulk": levels(1.4, 0.6)}, {"bulk": 0.01})
    objective = objective_of(colony, BOTH, course, **OPTIONS)
    assert "smooth=True" in objective.why_differences


def test_a_measure_that_was_no_number_fails_its_colony():
    course = of({"late": late_only}, {"late": [0.4, 0.6, 0.9]}, {"late": 0.1})
    found = objective_of(colony, MAKE, course, **OPTIONS).evaluate(np.array([[0.5]]))
    assert found.loss[0] == course.failed
    assert found.reasons[0, 0] == (
        "the target's loss was nan: late at 0.5 h was not a number, as the colony had ended, or had"
        " no cells, or the measure was NaN"
    )


def test_a_first_look_does_not_compare_the_last_time():
    """A colony of 1.2 h has the values of 0.5 and 1 h, and not those of 2 h."""
    known = levels(1.0, 1.0)
    course = of({"bulk": bulk}, {"bulk": [*known[:2], 50.0]}, {"bulk": 0.01})
    objective = objective_of(colony, MAKE, course, **OPTIONS)
    truth = objective.task.space.point({"make": 1.0})[None]
    assert objective.evaluate(truth, size=0.6).loss[0] < 0.1
    assert objective.evaluate(truth).loss[0] > 1e3


@pytest.mark.parametrize("size", [0.1, 0.25])
def test_a_first_look_reaches_the_first_time(size):
    known = levels(1.0, 1.0)
    course = of({"bulk": bulk}, {"bulk": [known[0], 50.0, 50.0]}, {"bulk": 0.01})
    objective = objective_of(colony, MAKE, course, **OPTIONS)
    points = np.array([objective.task.space.point({"make": m}) for m in (1.0, 2.0)])
    assert objective.task.end(size) == (None, 0.5)
    near, far = objective.evaluate(points, size=size).loss
    assert near < 0.1 < 100.0 < far


@pytest.mark.filterwarnings("ignore:a colony without cells is as it is wanted")
def test_colonies_that_die_may_be_data():
    """All cells burst before the end, as an antibiotic makes them; there is nothing left to fit."""
    dying = lambda make=1.0: tf.Scene(*colony(make).effects, tf.Lysis(rate=1e9), dt=0.1)
    for extinct, loss in ((True, 0.0), (False, None)):
        course = of({"volume": volume}, {"volume": [0.0] * 3}, {"volume": 1.0}, extinct=extinct)
        found = objective_of(dying, MAKE, course, **OPTIONS).evaluate(np.array([[0.5]]))
        assert found.loss[0] == (course.failed if loss is None else loss)
        assert bool(found.reasons) != extinct


def test_a_course_ends_with_its_last_time():
    course = of({"bulk": bulk}, {"bulk": [1, 2, 3]}, {"bulk": np.float32(1.0)})
    *_, state = tf.simulate(colony(), until=1.0, dt=0.1)
    assert "observed at 2 h" in course.unfit(state)[0]


def test_one_time_ends_a_colony():
    data = Measured({"bulk": bulk}, {"bulk": 0.5}, {"bulk": 0.1}, time=1.0)
    assert Task(colony, MAKE, data, **OPTIONS).until == 1.0
    with pytest.raises(tf.InputError, match=r"until = 2.0 .*1 h, when the target was observed"):
        Task(colony, MAKE, data, until=2.0, **OPTIONS)
    *_, state = tf.simulate(colony(), until=1.5, dt=0.1)
    assert "observed at 1 h" in data.unfit(state)[0]
    with pytest.raises(tf.InputError, match=r"Measured.time = 0"):
        Measured({"bulk": bulk}, {"bulk": 0.5}, {"bulk": 0.1}, time=0)


def test_data_of_two_times_within_goals_are_refused_under_conditions():
    at = lambda time: Measured({"bulk": bulk}, {"bulk": 0.5}, {"bulk": 0.1}, time=time)
    with pytest.raises(tf.InputError, match="of one time: others are observed until 2 h"):
        Conditions([({"decay": 1.0}, Weighted([(at(1.0), 1.0)])), ({"decay": 2.0}, at(2.0))])


def seen(time, colonies) -> Observed:
    *_, state = tf.simulate(colony(), until=time, dt=0.1, colonies=colonies, seed=4)
    return Observed.from_state(state, species=["gfp"])


def test_times_and_conditions_may_have_different_numbers_of_colonies():
    """Each statistic is a mean over as many simulated colonies as were observed of it."""
    parts = [seen(1.0, 1), Measured({"bulk": bulk}, {"bulk": 0.6}, {"bulk": 1e-9}, time=1.5)]
    course = ObservedCourse([*parts, seen(2.0, 3)])
    sizes = [len(f.values) for f in course.frames]
    assert course.colonies == 3
    assert averaged(course, 3) == [1] * (sizes[0] + 1) + [3] * sizes[2]
    assert averaged(course, 1) == [1] * sum(sizes)
    task = Task(colony, MAKE, course, dt=0.1, replicates=3, replay=False)
    found = simulate_designs(task, 2)
    alone = [simulate_designs(Task(colony, MAKE, f, dt=0.1, replicates=n, replay=False), 2)
             for f, n in zip(course.frames, (1, 1, 3), strict=True)]  # fmt: skip
    # the same random numbers only where as many colonies are simulated
    assert np.array_equal(found.statistics[:, -sizes[2] :], alone[2].statistics)
    # the first design starts from the same random numbers
    assert np.allclose(found.statistics[0, : sizes[0]], alone[0].statistics[0], rtol=1e-12)
    doses = Conditions([({"decay": 1.0}, seen(2.0, 2)), ({"decay": 2.0}, seen(2.0, 3))])
    data = ObservedConditions(doses)
    assert data.colonies == 3 and set(averaged(data, 3)) == {2, 3}


@pytest.mark.skipif(find_spec("sbi") is None, reason='needs pip install -e ".[infer]"')
def test_a_posterior_has_the_errors_of_the_data():
    """The posterior of one constant that the data are linear in, against the exact one."""
    truth = np.array(levels(1.0, 1.0))
    noise = 0.1
    course = of({"bulk": bulk}, {"bulk": truth}, {"bulk": noise})
    found = infer(
        colony, [Parameter("make", 0.0, 3.0)], course, simulations=600, dt=0.1, flows=1,
        epochs=150, samples=2000, progress=False,
    )  # fmt: skip
    exact = noise / math.sqrt(np.square(truth).sum())
    assert found.mean["make"] == pytest.approx(1.0, abs=exact)
    assert float(np.std(found.samples["make"])) == pytest.approx(exact, rel=0.4)
    again = of({"bulk": bulk}, {"bulk": 1.2 * truth}, {"bulk": noise})
    assert found.given(again).mean["make"] == pytest.approx(1.2, abs=exact)
    found.predict(2)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"functions": {}}, "functions = .*a dict of functions"),
        ({"times": "now"}, "times = 'now'"),
        ({"times": (1.0, 0.5, 2.0)}, "above that of the frame before, 1 h"),
        ({"values": {"other": [1, 2, 3]}}, "values = .*by the names 'bulk'"),
        ({"values": {"bulk": [1, 2]}}, r"values\['bulk'\] = .*3 numbers, one for each time"),
        ({"values": {"bulk": 1.0}}, r"values\['bulk'\] = 1.0"),
        ({"values": {"bulk": [1, math.nan, math.nan]}}, "of two times at least"),
        ({"values": {"bulk": [1, math.inf, 2]}}, r"wanted\['bulk'\] = inf"),
        ({"spread": {"bulk": 0.0}}, r"spread\['bulk'\] = 0"),
        ({"spread": {"bulk": [1, 2]}}, r"spread\['bulk'\] = .*a number, or 3 numbers"),
    ],
)
def test_bad_input(given, words):
    sound = {
        "functions": {"bulk": bulk}, "times": TIMES, "values": {"bulk": [1, 2, 3]},
        "spread": {"bulk": 1.0},
    }  # fmt: skip
    given = sound | given
    with pytest.raises(tf.InputError, match=words):
        ObservedCourse.of_measures(given.pop("functions"), **given)

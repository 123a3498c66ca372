"""Numbers of each of several observed colonies as data."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from searching import grown

import torchfilm as tf
from design import Conditions, Measured, ObservedCourse, Parameter, Search, Sobol, Task
from design.data_means import means_off
from design.simulations import simulate_designs
from design.targets.observed_conditions import checked_data, errors, standard_errors

SEEN = [3.0, 5.0, 4.0, 8.0]  # of mean 5 and standard deviation √(14/3)
TABLE = [[1.0, 2.0, 3.0], [math.nan] * 3, [2.0, 2.0, 2.0]]
TIMES = (0.5, 1.0, 2.0)


def colony(make=1.0):
    return grown(1.5, make, 1.0)


def level(state):
    return state.groups.sum(state.gfp) / state.counts


def twice(state):
    return 2 * level(state)


def course(values=TABLE, **given):
    return ObservedCourse.of_measures(
        {"level": level}, times=TIMES, values={"level": values}, **given
    )


@pytest.mark.parametrize("kind", [list, np.array, torch.tensor])
def test_their_mean_is_wanted_and_the_spread_is_how_much_they_differ(kind):
    data = Measured.of_colonies({"level": level}, {"level": kind(SEEN)}, time=2.0)
    assert data.wanted == {"level": (5.0, 5.0)} and data.time == 2.0
    assert data.spread["level"] == pytest.approx(math.sqrt(14 / 3), rel=1e-6)
    assert data.colonies == 4 and data.error == {"level": 0.0}


def test_colonies_that_do_not_differ_have_a_spread_of_a_hundredth():
    data = Measured.of_colonies({"level": level}, {"level": [4, 4, 4]})
    assert data.spread == {"level": pytest.approx(0.04)}


def test_colonies_like_the_observed_ones_have_a_loss_of_one_and_a_bit():
    """Of n colonies and independent ones, ⟨(x − mean)²⟩ = σ² (1 + 1/n)."""
    rng = np.random.default_rng(0)
    losses = []
    for _ in range(400):
        data = Measured.of_colonies({"a": lambda state: state.x}, {"a": rng.normal(3, 2, 20)})
        ((low, _),), (spread,) = data.wanted.values(), data.spread.values()
        losses.append(((rng.normal(3, 2) - low) / spread) ** 2)
    assert np.mean(losses) == pytest.approx(1.1, abs=0.3)


def test_a_course_takes_numbers_by_time_and_colony():
    first, last = course().frames
    for frame, time, row in (first, 0.5, TABLE[0]), (last, 2.0, TABLE[2]):
        alone = checked_data(Measured.of_colonies({"level": level}, {"level": row}, time=time))
        assert (frame.time, frame.values, frame.colonies) == (time, alone.values, 3)
        assert errors(frame) == [0.0]
    assert first.spread == (1.0,)
    assert last.spread == (pytest.approx(0.02),)
    assert course(error={"level": 0.2}).frames[0].plan.errors == (0.2,)


def test_the_least_spread_is_that_of_its_time():
    """A colony that grows a hundredfold: early times are as sharp as they are."""
    grows = course([[2.0, 2.0, 3.0], [0.0, 0.0, 0.0], [900.0, 1000.0, 1100.0]])
    assert [f.spread[0] for f in grows.frames] == pytest.approx([3**-0.5, 11.0, 100.0])


def test_simulations_have_no_errors_that_exact_numbers_do_not_have():
    exact = Measured.of_colonies({"level": level}, {"level": SEEN}, time=1.0)
    rough = Measured.of_colonies({"level": level}, {"level": SEEN}, error={"level": 9.0}, time=1.0)
    plain = Measured({"level": level}, exact.wanted, exact.spread, colonies=4, time=1.0)
    found = {}
    for name, data in ("exact", exact), ("rough", rough), ("plain", plain):
        task = Task(colony, [Parameter("make", 0.5, 2.0)], data, dt=0.1, replicates=4)
        found[name] = simulate_designs(task, 8).statistics[:, 0]
    assert found["exact"].min() > 0.1 and found["exact"].max() < 1.5  # as colonies are
    assert np.abs(found["rough"] - found["exact"]).max() > 3.0
    assert np.abs(found["plain"] - found["exact"]).max() > 0.5


def test_standard_errors_are_of_colonies_and_of_measurement():
    def of(**given):
        data = Measured({"level": level}, {"level": 5.0}, {"level": 2.0}, colonies=4, **given)
        return standard_errors(checked_data(data)).tolist()

    assert of() == [2.0]  # the spread is the error of measurement
    assert of(error={"level": 0.0}) == [1.0]  # 2/√4
    assert of(error={"level": 0.75}) == [1.25]
    assert of(error={"level": 2.0}) == [pytest.approx(5**0.5)]
    both = Measured.of_colonies(
        {"b": twice, "a": level}, {"a": SEEN, "b": SEEN}, error={"a": 0.1, "b": 0.2}
    )
    assert errors(checked_data(both)) == [0.2, 0.1]


def test_a_table_says_why_single_colonies_miss_a_mean_by_far():
    def table(target):
        search = Search(
            colony, [Parameter("make", 1.0, 1.001)], target, until=1.0, dt=0.1, replicates=2,
            seed=0, method=Sobol(batch=2), finals=None,
        )  # fmt: skip
        return search.run(colonies=4, progress=False).table()

    far, words = {"level": 9.0}, "a colony is farther from a mean over several"
    mean = ObservedCourse([
        Measured({"level": level}, far, {"level": 1.0}, time=t, colonies=6) for t in (0.5, 1.0)
    ])  # fmt: skip
    assert words in table(mean)
    each = ObservedCourse([
        Measured.of_colonies({"level": level}, {"level": [8.0, 9.0, 10.0]}, time=t)
        for t in (0.5, 1.0)
    ])  # fmt: skip
    found = table(each)
    assert words not in found and "have a loss of about 1" in found


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"level": [1.0, 2.0]}, r"numbers of 3 colonies at least, since fewer"),
        ({"level": [0.0, 0.0, 0.0]}, "numbers of which one is not 0.* say extinct=True"),
        ({"level": [1.0, math.nan, 2.0]}, r"values\['level'\]"),
        ({"level": 1.0}, r"values\['level'\]"),
        ({"other": [1.0, 2.0, 3.0]}, "by the names 'level'"),
        ([1.0, 2.0, 3.0], "by the names 'level'"),
    ],
)
def test_bad_numbers_of_colonies(values, words):
    with pytest.raises(tf.InputError, match=words):
        Measured.of_colonies({"level": level}, values)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"spread": {"level": 1.0}}, "spread = .* left out where values are given of each colony"),
        ({"colonies": 4}, "colonies = 4 .* left out, as the values are of 3 colonies"),
        (
            {"values": [[1, 2, 3], [1, 2, math.nan], [1, 2, 3]]},
            "NaN of all where a time is missing",
        ),
        ({"values": [[1, 2, 3], [1, 2, 3]]}, "by time and colony, 3 rows"),
        ({"values": [[1, 2], [1, 2], [3, 4]]}, "numbers of 3 colonies at least"),
        ({"values": [["a", "b", "c"]] * 3}, "by time and colony, 3 rows"),
        ({"error": {"level": -1.0}}, r"error\['level'\] = -1"),
        ({"error": {"other": 1.0}}, "by the names 'level'"),
    ],
)
def test_bad_numbers_by_time_and_colony(given, words):
    with pytest.raises(tf.InputError, match=words):
        course(**given)


def test_measures_of_one_time_are_of_as_many_colonies():
    functions = {"a": level, "b": twice}
    with pytest.raises(tf.InputError, match=r"'a': 3, 'b': 4.* as many numbers of each"):
        Measured.of_colonies(functions, {"a": [1, 2, 3], "b": [1, 2, 3, 4]})
    with pytest.raises(tf.InputError, match=r"'a': 3, 'b': 4.* of as many colonies each"):
        ObservedCourse.of_measures(
            functions, times=(1, 2), values={"a": [[1, 2, 3]] * 2, "b": [[1, 2, 3, 4]] * 2}
        )
    with pytest.raises(tf.InputError, match=r"functions = \{\}"):
        Measured.of_colonies({}, {})
    for error in ({}, 0):
        with pytest.raises(tf.InputError, match=r"Measured.error = "):
            Measured.of_colonies({"a": level}, {"a": [1, 2, 3]}, error=error)
    for error in ({"a": 1.0}, 1.0):
        with pytest.raises(tf.InputError, match=r"Measured.error = .*names 'a', 'b'"):
            Measured(functions, {"a": 1, "b": 1}, {"a": 1, "b": 1}, error=error)


def test_data_under_conditions_may_be_numbers_of_colonies():
    data = Conditions([
        ({"make": x}, Measured.of_colonies({"level": level}, {"level": [x, x + 0.1, x - 0.1]}))
        for x in (1.0, 2.0)
    ])  # fmt: skip
    assert errors(checked_data(data)) == [0.0, 0.0]
    assert standard_errors(checked_data(data)) == pytest.approx([0.1 / math.sqrt(3)] * 2)


def counted(state):
    return state.counts.double()


def test_colonies_that_all_died_out_are_data():
    dead = Measured.of_colonies({"n": counted}, {"n": [0] * 16}, time=2.0, extinct=True)
    assert dead.wanted["n"] == (0.0, 0.0) and dead.spread["n"] == 0.25  # as if one had 1 cell
    frames = ObservedCourse.of_measures(
        {"n": counted},
        times=TIMES,
        extinct=True,
        values={"n": [[4, 4, 4, 4], [2, 3, 0, 0], [0, 0, 0, 0]]},
    ).frames
    assert [f.spread[0] for f in frames] == pytest.approx([0.5, 1.5, 0.5])
    tenths = Measured.of_colonies({"level": level}, {"level": [0.5] * 4}, time=2.0, extinct=True)
    assert tenths.spread["level"] == 0.005


def test_colonies_without_cells_are_warned_of_where_they_would_fail():
    warned = "1 of 4 colonies are 0.* say extinct=True"
    with pytest.warns(UserWarning, match=warned):
        Measured.of_colonies({"n": counted}, {"n": [3, 0, 1, 2]}, time=2.0)
    values = [[4, 4, 4, 4], [2, 3, 5, 6], [0, 4, 8, 9]]
    with pytest.warns(UserWarning, match=warned):
        ObservedCourse.of_measures({"n": counted}, times=TIMES, values={"n": values})
    # those of one kind are gone, not all cells
    two = {"n": counted, "twice": counted}
    Measured.of_colonies(two, {"n": [3, 0, 1, 2], "twice": [1, 2, 1, 2]}, time=2.0)


def test_a_report_says_where_means_are_off():
    rng = np.random.default_rng(0)
    data = Measured.of_colonies({"n": counted}, {"n": [9, 14, 3, 30, 11, 2, 25, 12]}, time=2.0)
    data = checked_data(data)
    value, spread = data.evidence["n"]
    near = value + spread * rng.normal(size=40) * 0.5
    assert means_off(data, {"n": near - near.mean() + value}) == ""
    words = means_off(data, {"n": near - near.mean() + value - 2.0 * spread})
    error = math.hypot(spread / 8**0.5, near.std(ddof=1) / 40**0.5)
    assert f"{2.0 * spread / error:.1f} standard errors apart" in words and "of n is" in words
    assert means_off(data, {"n": [0.0, 0.0]}) == "" == means_off(data, {"other": near})
    alone = Measured({"n": counted}, {"n": 5.0}, {"n": 1.0}, time=2.0)
    assert means_off(checked_data(alone), {"n": near}) == ""

"""Colonies in which all cells have died: failures, or what is wanted."""

from __future__ import annotations

import warnings

import pytest

import torchfilm as tf
from design import (
    Conditions,
    Constrained,
    Lasting,
    Measured,
    ObservedCourse,
    Parameter,
    Search,
    Stripe,
    infer,
)
from design.report import constrained
from design.targets.measured import extinct_words

UNTIL = 1.5


def cells(state):
    return state.counts.double()


def first_length(state):
    return state.length[:1].expand(state.colonies).double()  # none of a colony without cells


def culture(kill=3.0, dose=1.0):
    return tf.Scene(
        tf.Growth(rate=0.7), tf.Division(length=4.0), tf.Lysis(rate=kill * dose),
        founders=tf.inoculum(6, radius=40.0), dim=2, dt=0.05,
    )  # fmt: skip


def measured(value, spread=1.0, function=cells, **options) -> Measured:
    return Measured({"n": function}, {"n": value}, {"n": spread}, **options)


def said_of(target) -> str:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        target.check(culture().bind(3).start())
    return " ".join(str(w.message) for w in caught)


@pytest.mark.parametrize(
    "wanted, spread, is_said",
    [(0.0, 1.0, True), (0.1, 1.0, False), ((0.0, 3.0), 1.0, True), ((-1.0, 3.0), 0.1, True),
     (1.0, 1.0, False), (5.0, 1.0, False), ((2.0, 3.0), 1.0, False)],
)  # fmt: skip
def test_what_a_colony_without_cells_reaches_is_warned_of(wanted, spread, is_said):
    target = measured(wanted, spread)
    assert ("extinct=True" in said_of(target)) == is_said
    assert said_of(target) == ""  # once
    assert said_of(measured(wanted, spread, extinct=True)) == ""


def test_a_measure_that_is_no_number_without_cells_reaches_nothing():
    assert said_of(measured((-1.0, 1.0), function=lambda s: 0.0 / s.counts.double())) == ""


def test_constraints_are_found_inside():
    strict = Constrained(measured(2.0), at_most={"n": 5.0})
    assert constrained(strict) and constrained(Lasting(strict, since=0.5))
    assert not constrained(Lasting(measured(2.0), since=0.5))


def test_a_function_that_takes_no_empty_state_is_let_be():
    assert said_of(measured(0.0, function=first_length)) == ""


def test_reports_say_what_measures_dead_colonies():
    target = measured(2.0, 0.1)
    search = Search(
        culture, [Parameter("kill", 2.0, 8.0)], target, until=UNTIL, replicates=2, method="sobol"
    )
    found = str(search.run(colonies=24).table())
    assert "most frequent failure: no cells remain" in found
    assert "colonies without cells have failed; extinct=True of the measures" in found
    assert "misses constraints" not in found


def test_simulations_that_died_count_as_one_reason():
    pairs = [({"dose": d}, measured(v)) for d, v in ((0.1, 5.0), (0.4, 2.0))]
    prior = [Parameter("kill", 0.5, 5.0)]
    found = infer(culture, prior, Conditions(pairs), until=UNTIL, simulations=90, seed=2)
    assert [why for why, _ in found.simulations.failures()] == ["no cells remain"]
    said = str(found.table())
    count = found.simulations.failures()[0][1]
    assert f"{count} simulations failed: no cells remain" in said
    assert "colonies without cells have failed; extinct=True" in said


def test_only_what_could_measure_them_is_named():
    gone = ["no cells remain at 0.5 h"]
    course = ObservedCourse([measured(1.0, time=0.5), measured(2.0, time=1.0)])
    assert extinct_words(measured(2.0), gone) and extinct_words(course, gone)
    assert extinct_words(Lasting(measured(2.0), since=0.5), gone)
    assert not extinct_words(measured(2.0, extinct=True), gone)
    assert not extinct_words(measured(2.0), ["at 0.5 h: n is not a number"])
    assert not extinct_words(Stripe("gfp", at=3.0, width=2.0), gone)


def test_a_course_of_one_value_is_refused():
    with pytest.raises(tf.InputError, match=r"2 times, of which 1 have a value.*Measured"):
        ObservedCourse.of_measures(
            {"n": cells}, times=(1.0, 2.0), values={"n": (6.0, float("nan"))}, spread={"n": 1.0}
        )

"""Data of several times."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from searching import grown, lit

import torchfilm as tf
from design import (
    Conditions,
    Objective,
    Observed,
    ObservedCourse,
    Parameter,
    Search,
    Task,
    Weighted,
    infer,
)

MAKE = [Parameter("make", 0.5, 2.0, log=True)]


def colony(make=1.0):
    return grown(tf.LogNormal(1.5, 0.1), make)


def seen(time: float, make: float = 1.0, seed: int = 8) -> Observed:
    *_, state = tf.simulate(colony(make), until=time, dt=0.1, colonies=2, seed=seed)
    return Observed.from_state(state, species=["gfp"])


@pytest.fixture(scope="module")
def course() -> ObservedCourse:
    return ObservedCourse([seen(1.0), seen(2.0)])


def notes(course: ObservedCourse, make: float, seed: int) -> tuple[tf.State, torch.Tensor]:
    states = list(tf.simulate(colony(make), until=2.0, dt=0.1, colonies=2, seed=seed))
    return states[-1], torch.stack([course.note(s) for s in states])


def test_statistics_are_those_of_each_frame(course):
    state, history = notes(course, 1.0, seed=8)
    found = course.statistics(state, history)
    assert found.shape == (2, len(course.values)) == (2, len(course.plan.names))
    # the observed colonies themselves
    assert np.allclose(found.mean(0).numpy(), course.values, rtol=1e-12)
    assert float(course.loss(state, history).max()) < 5.0
    first = course.frames[0]
    assert first.plan.names[0] == "log_cells" and course.plan.names[0] == "log_cells at 1 h"
    measured = course.measures(state, history)
    assert measured["cells at 2 h"].tolist() == pytest.approx(state.counts.tolist())
    assert set(measured) == set(course.evidence)
    assert "at 1, 2 h" in course.describe() and "gfp_mean at 1 h" in course.table()


def test_the_loss_is_that_of_all_statistics(course):
    state, history = notes(course, 1.3, seed=9)
    found = course.statistics(state, history).numpy()
    apart = (found - np.array(course.values)) / np.array(course.spread)
    wanted = np.square(np.clip(apart, -100, 100)).mean(1)
    assert course.loss(state, history).tolist() == pytest.approx(wanted.tolist(), rel=1e-12)


def test_the_residuals_are_those_of_the_frames_that_were_reached(course):
    states = list(tf.simulate(colony(1.3), until=1.0, dt=0.1, colonies=2, seed=9))
    found = course.residuals(states[-1], torch.stack([course.note(s) for s in states]))
    wanted = course.frames[0].loss(states[-1])
    assert found.square().sum(1).tolist() == pytest.approx(wanted.tolist())


def test_cells_were_observed_with_an_error_of_their_number(course):
    cells = math.exp(course.values[0])
    wanted = (cells, cells * course.spread[0])
    assert course.evidence["cells at 1 h"] == pytest.approx(wanted)


def test_times_that_differ_from_cell_to_cell_are_warned_of():
    table = {"time_h": [1.0, 1.0, 1.1, 1.2, 1.3, 1.4], "length_um": [2.0] * 6}
    with pytest.warns(UserWarning, match="5 times in 6 rows.*round those"):
        ObservedCourse.from_table(table)


def test_colonies_that_are_gone_are_warned_of(tmp_path):
    """A fit to those that live on would find too few deaths."""
    table = {"time_h": [1.0, 1.0, 1.0, 2.0, 2.0], "colony": ["a", "b", "c", "b", "c"],
             "length_um": [2.0, 2.1, 2.2, 2.3, 2.4]}  # fmt: skip
    with pytest.warns(UserWarning, match=r"1 of 3 colonies .* any more at 2 h \(a\).*extinct=True"):
        ObservedCourse.from_table(table)
    later = {name: column[1:] for name, column in table.items()}  # b and c from the first on
    ObservedCourse.from_table(later)


def test_lengths_in_nanometres_are_warned_of():
    table = {"time_h": [1.0, 1.0, 2.0, 2.0], "length_px": [40.0, 44.0, 50.0, 52.0]}
    with pytest.warns(UserWarning, match=r"longer than 100 µm \(median\).*not in nm"):
        ObservedCourse.from_table(table, pixel_size=65.0)
    ObservedCourse.from_table(table, pixel_size=0.065)


def test_a_colony_that_was_not_seen_has_no_statistics(course):
    states = list(tf.simulate(colony(), until=2.0, dt=0.1, colonies=2, seed=8))
    late = torch.stack([course.note(s) for s in states[15:]])
    assert bool(course.statistics(states[-1], late)[:, 0].isnan().all())
    with pytest.raises(tf.InputError, match="need the notes of all steps"):
        course.statistics(states[-1])


def test_ages_are_compared_in_the_last_frame():
    def table(time):
        rows = {"x": [0.0, 3.0], "y": [0.0, 0.0], "length": [2.0, 2.5], "age": [0.3, 0.5]}
        return Observed.from_table(rows, length_unit="um", time_unit="h", time=time)

    made = ObservedCourse([table(1.0), table(2.0)])
    assert [f.plan.ages for f in made.frames] == [False, True]
    state, history = notes(made, 1.0, seed=8)
    found = dict(zip(made.plan.names, made.statistics(state, history)[0].tolist(), strict=True))
    assert 0.0 < found["age_50_h at 2 h"] < 1.0 and "age_50_h at 1 h" not in found


def test_a_search_fits_a_course():
    """What a reporter is made with shows in both frames; a search at the truth fits, and another
    does not."""
    observed = ObservedCourse([seen(1.0, 1.2), seen(2.0, 1.2)]).without("density", "extent")
    options = {"until": 2.0, "dt": 0.1, "replicates": 2}
    objective = Objective(Task(colony, MAKE, observed, **options))
    truth, off = (objective.task.space.point({"make": m}) for m in (1.2, 0.6))
    losses = objective.evaluate(np.stack([truth, off])).loss
    assert losses[0] < 3.0 < 10.0 < losses[1]
    best = Search(colony, MAKE, observed, seed=0, **options).run(colonies=60)
    assert best.values["make"] == pytest.approx(1.2, rel=0.1)
    assert "gfp_mean at 1 h" in best.table()


def test_derivatives_go_through_all_frames(course):
    """By tangents, against differences; the growth is the same for all designs."""
    observed = course.without("density", "extent", "length", "alignment")
    task = Task(colony, MAKE, observed, until=2.0, dt=0.1, replicates=2)
    objective = Objective(task)
    point = np.array([[0.6]])
    found = objective.evaluate(point, slopes=True)
    assert objective.why_differences == "" and found.slopes is not None
    near = objective.evaluate(point + np.array([[-1e-3], [1e-3]])).loss
    assert float(found.slopes.gradient[0, 0]) == pytest.approx(float(near[1] - near[0]) / 2e-3,
                                                               rel=1e-2)  # fmt: skip


@pytest.mark.skipif(find_spec("sbi") is None, reason="needs sbi")
def test_a_posterior_of_a_course(course):
    found = infer(
        colony, MAKE, course, simulations=200, dt=0.1, flows=1, epochs=60, samples=200,
        progress=False,
    )  # fmt: skip
    low, high = found.interval(0.99)["make"]
    assert low < 1.0 < high and high / low < 1.5
    seen_again = found.predict(10)
    assert seen_again.statistics.shape == (10, len(course.values))
    other = ObservedCourse(
        [replace(f, values=tuple(v + 0.01 for v in f.values)) for f in course.frames]
    )
    assert not np.array_equal(found.given(other).points, found.points)


def test_colonies_are_the_same_in_any_batch(course):
    """A task's colonies, in one batch and one by one."""
    task = Task(colony, MAKE, course, until=2.0, dt=0.1, replicates=2)
    points = np.array([[0.2], [0.7]])
    objective = Objective(task)
    both = objective.evaluate(points).losses
    each = [objective.evaluate(p[None]).losses[0] for p in points]
    assert np.array_equal(both, np.stack(each))


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (lambda a, b: [a], "two or more Observed"),
        (lambda a, b: [b, a], r"frames\[1\].time = 1.0 is not allowed.*above that of the frame"),
        (lambda a, b: [a, replace(b, time=None)], r"frames\[1\].time = None"),
        (lambda a, b: [a, 3], r"frames\[1\] = 3 is not allowed"),
        (lambda a, b: [a, ObservedCourse([a, b])], "an Observed"),
    ],
)
def test_what_is_no_course(frames, words, course):
    with pytest.raises(tf.InputError, match=words):
        ObservedCourse(frames(*course.frames))


def test_a_time_between_steps_is_refused(course):
    odd = ObservedCourse([replace(course.frames[0], time=1.03), course.frames[1]])
    with pytest.raises(tf.InputError, match=r"dt = 0.1 is not allowed.*1.03 h, when the target"):
        Task(colony, MAKE, odd, until=2.0, dt=0.1)
    with pytest.raises(tf.InputError, match="until"):
        Task(colony, MAKE, course, until=1.0, dt=0.1)
    with pytest.raises(tf.InputError, match="without"):
        course.without("gfp_mean")
    assert math.isclose(course.time, 2.0)


def test_frames_as_goals_or_in_a_list_are_refused(course):
    one, other = course.frames
    for target in (Weighted([(one, 1.0), (other, 1.0)]), Weighted([(one, 1.0), (course, 2.0)])):
        with pytest.raises(tf.InputError, match=r"data of 1, 2 h.*ObservedCourse"):
            Task(colony, MAKE, target, until=2.0, dt=0.1)
    if find_spec("sbi") is not None:
        with pytest.raises(tf.InputError, match=r"not a list.*ObservedCourse\(\[…\]\)"):
            infer(colony, MAKE, [one, other], dt=0.1)


def test_a_course_beside_another_goal(course):
    goal = Weighted([(course, 1.0), (course.frames[1], 0.5)])
    task = Task(colony, MAKE, goal, until=2.0, dt=0.1, replicates=2)
    alone = Task(colony, MAKE, course, until=2.0, dt=0.1, replicates=2)
    last = Task(colony, MAKE, course.frames[1], until=2.0, dt=0.1, replicates=2)
    point = np.array([[0.3]])
    found, first, second = (
        float(Objective(t).evaluate(point).loss[0]) for t in (task, alone, last)
    )
    assert found == pytest.approx(first + 0.5 * second, rel=1e-9)


def test_a_first_look_scores_the_frames_that_it_reaches(course):
    """Racing grows colonies for a part of the time."""
    task = Task(colony, MAKE, course, until=2.0, dt=0.1, replicates=2)
    looked = Objective(task).evaluate(np.array([[0.5], [1.0]]), size=0.6)
    assert not looked.reasons and looked.loss[0] < looked.loss[1] < course.failed


def test_a_course_is_no_model_for_another_table(course):
    *_, state = tf.simulate(colony(), until=1.0, dt=0.1)
    with pytest.raises(tf.InputError, match=r"Observed\(like\)"):
        Observed.from_state(state, species=["gfp"], like=course)


def test_times_count_within_goals(course):
    odd = ObservedCourse([replace(course.frames[0], time=1.03), course.frames[1]])
    with pytest.raises(tf.InputError, match="when the target was observed, is a step"):
        Task(colony, MAKE, Weighted([(odd, 1.0)]), until=2.0, dt=0.1)
    with pytest.raises(tf.InputError, match="at least 2 h, when the target was observed"):
        Task(colony, MAKE, Weighted([(course, 1.0)]), until=1.0, dt=0.1)


def test_a_search_ends_when_the_data_were_observed():
    *_, state = tf.simulate(lit(), until=1.0, colonies=2, seed=3, dt=0.1)
    data = replace(Observed.from_state(state), time=1.0)
    make = [Parameter("make", 0.1, 10.0)]
    twice = Conditions([({"decay": 1.0}, data), ({"decay": 2.0}, data)])
    assert Task(lit, make, data, dt=0.1).until == Task(lit, make, twice, dt=0.1).until == 1.0
    for target in (data, twice):
        with pytest.raises(tf.InputError, match=r"until = 2.0 .*1 h, when the target was observed"):
            Task(lit, make, target, until=2.0, dt=0.1)

"""Data of several conditions that end at different times, readings that are missing, and ranges."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

import torchfilm as tf
from design import (
    Conditions,
    Measured,
    Observed,
    ObservedCourse,
    OnFraction,
    Parameter,
    Search,
    Task,
    infer,
)
from design.scene_family import _free_growth
from design.targets.observed_course import ending_at

ONE = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
SPACE = [Parameter("start", 0.1, 100.0, log=True), Parameter("loss", 0.01, 5.0, log=True)]


def washout(start=1.0, loss=0.5, dose=1.0) -> tf.Scene:
    """A level that falls as start · exp(−loss · t), whatever the dose."""
    rates = lambda u, s, p, cell: {"gfp": 0.0 * p.dose - p.loss * u.gfp}
    circuit = tf.Circuit(rates, species="gfp", initial={"gfp": start}, loss=loss, dose=dose)
    return tf.Scene(circuit, dim=2, dt=0.1, founders=ONE)


def gfp(state: tf.State) -> torch.Tensor:
    return state.groups.sum(state.gfp)


def course(times, values, spread=0.1) -> ObservedCourse:
    return ObservedCourse.of_measures(
        {"gfp": gfp}, times=times, values={"gfp": values}, spread={"gfp": spread}, smooth=True
    )


def fitted(conditions: Conditions) -> dict[str, float]:
    search = Search(washout, SPACE, conditions, replicates=1, dtype=torch.float64)
    return search.run(colonies=300, progress=False).values


def level(time: float) -> float:
    return 3.0 * math.exp(-0.9 * time)


def test_each_condition_is_compared_at_its_own_times():
    """A reading that was missing at the end of one dose made all data unusable."""
    early = course((0.5, 1.0, 2.0), (level(0.5), level(1.0), math.nan))
    late = course((1.0, 3.0), (level(1.0), level(3.0)))
    once = Measured({"gfp": gfp}, {"gfp": level(0.8)}, {"gfp": 0.1}, smooth=True, time=0.8)
    both = Conditions([({"dose": 1.0}, early), ({"dose": 2.0}, late), ({"dose": 3.0}, once)])
    task = Task(washout, SPACE, both, replicates=1)
    assert task.until == 3.0 and set(task.target.times) == {0.5, 1.0, 3.0, 0.8}
    found = fitted(both)
    assert found["start"] == pytest.approx(3.0, rel=1e-3)
    assert found["loss"] == pytest.approx(0.9, rel=1e-3)


def test_the_loss_of_data_that_end_early_is_theirs_alone():
    """Also as a part of a course that goes on; and the statistics bear their times."""
    early, late = course((0.5, 1.0), (1.0, 2.0)), course((0.5, 2.0), (1.0, 2.0))
    both = Conditions([({"dose": 1.0}, early), ({"dose": 2.0}, late)])
    scene = washout(2.0, 0.7, torch.tensor([1.0, 2.0]))
    model = scene.bind(2, dtype=torch.float64)
    state, notes = model.start(), []
    alone = None
    for step in range(20):
        state = model.step(state)
        notes.append(both.note(state))
        if step == 9:
            alone = early.loss(
                state, torch.stack([n[:, : early.note(state).shape[1]] for n in notes])
            )
    loss = both.loss(state, torch.stack(notes))
    expected = [
        np.mean([((2 * math.exp(-0.7 * t) - x) / 0.1) ** 2 for t, x in pairs])
        for pairs in (((0.5, 1.0), (1.0, 2.0)), ((0.5, 1.0), (2.0, 2.0)))
    ]
    assert loss.tolist() == pytest.approx(expected, rel=1e-3)
    assert float(alone[0]) == pytest.approx(float(loss[0]), rel=1e-12)
    assert both.unfit(state) == ["", ""]
    names = both.measures(state, torch.stack(notes))
    assert {"gfp at 1 h (dose = 1)", "gfp at 2 h (dose = 2)"} <= set(names)


def test_readings_weigh_alike_whatever_the_condition():
    """One reading under one dose weighed as much as twenty under the other."""
    draws = np.random.default_rng(0)
    times = np.arange(1, 11) * 0.2
    many = 3 * np.exp(-0.9 * times) + 0.1 * draws.normal(size=10)
    few = np.array([3.6, 0.9])
    conditions = Conditions(
        [({"dose": 1.0}, course(times, many)), ({"dose": 2.0}, course((0.2, 2.0), few))]
    )
    every = np.concatenate([times, [0.2, 2.0]])
    off = lambda q: (q[0] * np.exp(-q[1] * every) - np.concatenate([many, few])) / 0.1
    best = least_squares(off, [2.0, 1.0]).x
    found = fitted(conditions)
    assert [found["start"], found["loss"]] == pytest.approx(best.tolist(), rel=2e-3)


@pytest.mark.filterwarnings("ignore:The estimator has learnt less:UserWarning")
def test_infer_takes_data_that_end_apart():
    early = course((0.5, 1.0), (level(0.5), level(1.0)))
    late = course((1.0, 2.0), (level(1.0), level(2.0)))
    both = Conditions([({"dose": 1.0}, early), ({"dose": 2.0}, late)])
    found = infer(washout, SPACE, both, simulations=50, epochs=1, flows=1, progress=False)
    assert "gfp at 1 h (dose = 1)" in found.observed.plan.names and found.observed.time == 2.0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_other_targets_end_where_the_data_do():
    aged = Observed.from_state(washout().bind(1).start().replace(step=1, time=0.5))
    late = course((1.0, 2.0), (1.0, 2.0))
    assert Conditions([({"dose": 1.0}, aged), ({"dose": 2.0}, late)]).parts[0].time == 2.0


def test_a_course_of_ranges():
    """A wanted course, such as a pulse: below 1 until 1 h, then above 2."""
    frames = [
        Measured({"gfp": gfp}, {"gfp": wanted}, {"gfp": 0.1}, smooth=True, time=time)
        for time, wanted in ((0.5, (1.0, 2.0)), (1.0, (0.5, 0.9)), (2.0, 0.4))
    ]
    target = ObservedCourse(frames)
    assert set(target.evidence) == {"gfp at 2 h"}
    assert target.bounds == {"gfp at 0.5 h": "1 to 2", "gfp at 1 h": "0.5 to 0.9"}
    assert target.misses({"gfp at 0.5 h": 2.5, "gfp at 1 h": 0.5}) == pytest.approx(
        {"gfp at 0.5 h": 5.0, "gfp at 1 h": 0.0}
    )
    best = Search(washout, SPACE, target, replicates=1, dtype=torch.float64).run(
        colonies=200, progress=False
    )
    assert best.loss < 1e-6
    start, loss = best.values["start"], best.values["loss"]
    assert 0.999 <= start * math.exp(-loss / 2) <= 2.0 and 0.5 <= start * math.exp(-loss) <= 0.9
    with pytest.raises(tf.InputError, match=r"gfp at 0\.5 h.*must be one number, as data have one"):
        infer(washout, SPACE, target, simulations=50)


def test_a_range_and_data_of_another_time():
    early = Measured({"gfp": gfp}, {"gfp": (1.0, 2.0)}, {"gfp": 0.1}, time=0.5)
    late = Measured({"gfp": gfp}, {"gfp": 0.3}, {"gfp": 0.1}, time=2.0)
    both = Conditions([({"dose": 1.0}, early), ({"dose": 2.0}, late)])
    assert both.parts[0].time == 2.0 and both.parts[0].times == (0.5,)


@pytest.mark.parametrize(
    ("times", "hint"),
    [
        (np.arange(1, 7) / 6, "dt = 0.0833333333 would do"),
        (np.round(np.arange(1, 7) / 6, 2), "dt = 0.01 would do"),
        ([1.0, 1.0 + 1e-4 * math.pi], "No step does that all these times are multiples of"),
    ],
)
def test_times_that_are_no_steps_name_a_step_that_does(times, hint):
    data = course(times, np.ones(len(times)))
    with pytest.raises(tf.InputError, match=rf"(dt|until) = .* is not allowed.*{hint}"):
        Task(washout, SPACE, data, replicates=1)


def test_readings_at_the_start():
    with pytest.raises(tf.InputError, match=r"times = \[0\.0, 1\.0\].*Leave such readings out"):
        course((0.0, 1.0), (1.0, 2.0))


@pytest.mark.parametrize("more", [(), (tf.Removal(high=(20.0, 20.0)),)], ids=["free", "held"])
def test_minutes_for_hours(more):
    """A colony of 10^42 cells was grown until memory was gone."""

    def growing(start=1.0) -> tf.Scene:
        rates = lambda u, s, p, cell: {"gfp": p.start - u.gfp}
        circuit = tf.Circuit(rates, species="gfp", start=start)
        return tf.Scene(tf.Growth(rate=0.8), tf.Division(length=4.0), circuit, *more, dim=2, dt=0.1)

    def make(last):
        return Task(growing, SPACE[:1], course((last / 2, last), (1.0, 2.0)), replicates=1)

    if more:
        make(120.0)
        return
    with pytest.raises(tf.InputError, match=r"until = 120 h.*10\^42-fold.*Are times in hours"):
        make(120.0)
    with pytest.warns(UserWarning, match=r"until = 40 h.*10\^14-fold.*Are times in hours") as seen:
        make(40.0)
    assert seen[0].filename == __file__
    make(20.0)


def test_a_check_grows_data_to_no_other_size():
    """Half and twice the hours had losses of a failed colony."""
    search = Search(washout, SPACE, course((1.0, 2.0), (level(1.0), level(2.0))), replicates=1)
    best = search.run(colonies=12, progress=False)
    found = best.check(seeds=1, progress=False)
    assert found.sizes == () and len(found.losses) == 1
    with pytest.raises(tf.InputError, match=r"sizes = \(0\.5,\).*data were observed at 2 h"):
        best.check(seeds=1, sizes=(0.5,), progress=False)
    with pytest.raises(tf.InputError, match=r"sizes = 2\.0 .*data were observed at 2 h"):
        best.check(seeds=1, sizes=2.0, progress=False)
    assert best.check(seeds=1, sizes=[], change=0.3, progress=False).sizes == ()


def test_within_a_range_there_is_no_slope():
    """It was 1, so that readings within their ranges pulled at descents: after 150 colonies the
    loss was 3, not 1e-11. An infinite measure is within an open range."""
    frames = [
        Measured({"gfp": gfp}, {"gfp": (0.1, 50.0)}, {"gfp": 0.01}, smooth=True, time=time)
        for time in (0.2, 0.4, 0.6)
    ]
    exact = [
        Measured({"gfp": gfp}, {"gfp": level(t)}, {"gfp": 0.01}, smooth=True, time=t)
        for t in (1.0, 2.0)
    ]
    target = ObservedCourse([*frames, *exact])
    found = torch.tensor([[1.0, 0.05, 60.0, level(1.0), level(2.0)]], dtype=torch.float64)
    apart = target.apart(found.requires_grad_())
    (slope,) = torch.autograd.grad(apart.sum(), found)
    assert slope[0].tolist() == pytest.approx([0.0, 100.0, 100.0, 100.0, 100.0])
    search = Search(washout, SPACE, target, replicates=1, dtype=torch.float64)
    assert search.run(colonies=60, progress=False).loss < 1e-4
    endless = ObservedCourse([
        Measured({"gfp": gfp}, {"gfp": (2.0, math.inf)}, {"gfp": 0.1}, time=t, smooth=True)
        for t in (1.0, 2.0)
    ])  # fmt: skip
    assert endless.apart(torch.tensor([[math.inf, 1.0]])).tolist() == [[0.0, -10.0]]
    assert endless.misses({"gfp at 1 h": 1.5, "gfp at 2 h": 9.0}) == pytest.approx(
        {"gfp at 1 h": 5.0, "gfp at 2 h": 0.0}
    )
    assert endless.evidence == {} and set(endless.bounds) == {"gfp at 1 h", "gfp at 2 h"}


def test_weights_leave_failed_losses_and_other_targets_alone():
    long, short = course(np.arange(1, 31) / 10, np.ones(30)), course((1.0, 3.0), (1.0, 1.0))
    data = Conditions([({"dose": 1.0}, long), *(({"dose": d}, short) for d in range(2, 12))])
    assert data._weights[0] == pytest.approx(30 * 11 / 50)
    assert sum(data._weights) == pytest.approx(11)
    model = washout(1e12, 0.5, torch.arange(1.0, 12.0)).bind(11, dtype=torch.float64)
    state, notes = model.start(), []
    for _ in range(30):
        state = model.step(state)
        notes.append(data.note(state))
    far = data.loss(state, torch.stack(notes))
    assert bool((far < data.failed).all()) and float(far[0]) > 1e8
    gone = state.remove(torch.ones(11, dtype=torch.bool), "removed")
    failed = data.loss(gone, torch.stack(notes))
    assert failed.tolist() == [data.failed] * 11
    lit = OnFraction("gfp", 0.5, level=1.0)
    some = Conditions([({"dose": 1.0}, long), ({"dose": 2.0}, lit)])
    assert some._weights == (1.0, 1.0)


def test_a_first_look_waits_for_the_first_reading_of_every_condition():
    """One that ended before had a loss of 0."""
    early, late = course((0.5, 3.0), (1.0, 1.0)), course((2.0, 3.0), (1.0, 1.0))
    both = Conditions([({"dose": 1.0}, early), ({"dose": 2.0}, late)])
    task = Task(washout, SPACE, both, replicates=1)
    assert both.first_time == 2.0 and task.end(0.25)[1] == 2.0 and task.end(1.0)[1] == 3.0


def test_ends_are_kept_and_said():
    seen = [Observed.from_state(tf.rollout(washout().bind(1), until=t)) for t in (1.0, 2.0)]
    frames = [replace(x, time=t) for x, t in zip(seen, (1.0, 2.0), strict=True)]
    aged = ObservedCourse(frames)
    later = ending_at(aged, 4.0)
    assert later.time == 4.0 and later.times == (1.0, 2.0)
    assert later.without("length").time == 4.0 and later.without("length").times == (1.0, 2.0)
    state = washout().bind(1).start()
    at = lambda time: state.replace(step=1, time=time)
    assert later.unfit(at(4.0)) == [""] and "observed at 4 h" in later.unfit(at(2.0))[0]


def test_a_study_of_other_losses_does_not_go_on(tmp_path, monkeypatch):
    """It would hold losses that do not compare."""
    path, data = tmp_path / "study.h5", course((1.0, 2.0), (level(1.0), level(2.0)))
    Search(washout, SPACE, data, replicates=1).run(colonies=12, progress=False, study=path)
    monkeypatch.setattr("design.task.OF_DATA", "of a later version")
    with pytest.raises(tf.InputError, match="losses"):
        Search(washout, SPACE, data, replicates=1).run(colonies=24, progress=False, study=path)


class Grows(tf.Effect):
    title, stage = "grows", 15

    def step(self, state, dt, values):
        return state


SLOW = tf.Circuit(lambda u, s, p, cell: {"slow": -u.slow}, species="slow", initial={"slow": 1.0})


@pytest.mark.parametrize(
    ("effects", "free"),
    [
        ((tf.Growth(rate=0.8),), 0.8),
        (
            (
                tf.Growth(rate=0.8, factor="slow"),
                tf.Rules(lambda cells: None, variables={"slow": 1.0}),
            ),
            0.0,
        ),
        ((tf.Growth(rate=0.8, law="linear"),), 0.0),
        ((tf.Growth(rate=0.8), tf.Mechanics([tf.Plane(x=9.0, facing="-x")], dim=2)), 0.0),
        ((tf.Growth(rate=0.8), tf.Mechanics(dim=2)), 0.8),
        ((tf.Growth(rate=0.8), tf.Lysis(rate=0.1)), 0.0),
        ((tf.Growth(rate=0.8), dataclass(frozen=True)(Grows)()), 0.0),
    ],
)
def test_what_may_hold_a_colony_down(effects, free):
    scene = tf.Scene(*effects, tf.Division(length=4.0), dim=2)
    assert _free_growth(scene, scene.bind().start()) == pytest.approx(free)
    never = tf.Scene(*effects, dim=2)
    assert _free_growth(never, never.bind().start()) == 0.0

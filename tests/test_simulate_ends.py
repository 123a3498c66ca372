"""Where a run ends, and what is refused before anything runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from running import alone, scene_of

import torchfilm as tf


def test_until_a_time():
    scene = alone()
    states = list(tf.simulate(scene, scene.bind().start(), until=1.0))
    assert [s.step for s in states] == list(range(1, 11))
    assert states[-1].time == pytest.approx(1.0, rel=1e-12)


def test_dt_of_its_own():
    scene = alone()
    states = list(tf.simulate(scene, scene.bind().start(), until=1.0, dt=0.25))
    assert [s.time for s in states] == [0.25, 0.5, 0.75, 1.0]


def test_until_every_colony_has_so_many_cells():
    scene = scene_of()
    states = list(tf.simulate(scene, scene.bind(3).start(), cells=8))
    assert (states[-1].counts >= 8).all()
    assert not (states[-2].counts >= 8).all(), "it should have stopped before"


@pytest.mark.parametrize(("until", "cells", "by_time"), [(0.5, 1000, True), (50.0, 4, False)])
def test_the_first_end_reached_ends_the_run(until, cells, by_time):
    scene = scene_of()
    last = list(tf.simulate(scene, scene.bind(2).start(), until=until, cells=cells))[-1]
    assert (last.time == pytest.approx(until, rel=1e-12)) == by_time
    assert bool((last.counts >= cells).all()) != by_time


def test_a_run_that_is_at_its_end_does_nothing():
    scene = alone()
    last = list(tf.simulate(scene, scene.bind().start(), until=0.5))[-1]
    assert list(tf.simulate(scene, last, until=0.5)) == []
    assert list(tf.simulate(scene, scene.bind().start(), cells=1)) == []


@pytest.mark.parametrize(
    ("dt", "until"), [(0.025, 0.5), (0.05, 3.0), (0.1, 0.8), (0.01, 1.0), (0.3, 2.7)]
)
def test_an_end_that_has_been_reached_is_not_in_the_past(dt, until):
    """Whatever rounding the time has gathered, a run to 0.5 h has reached 0.5 h."""
    scene = alone()
    last = list(tf.simulate(scene, scene.bind().start(), until=until, dt=dt))[-1]
    assert list(tf.simulate(scene, last, until=until, dt=dt)) == []


def test_many_steps_end_on_time():
    """0.1 is not exact in binary: 1000 of them must still be 1000 steps."""
    scene = tf.Scene(tf.Growth(rate=0.0))
    last = list(tf.simulate(scene, scene.bind().start(), until=100.0, dt=0.1))[-1]
    assert last.step == 1000 and last.time == pytest.approx(100.0, rel=1e-12)
    assert len(list(tf.simulate(scene, last, until=100.3, dt=0.1))) == 3


@pytest.mark.parametrize("until", [0.55, 1.01, 0.05])
def test_an_end_between_two_steps_is_refused(until):
    scene = alone()
    with pytest.raises(tf.InputError, match=r"until.*integer number of steps.*0\.1.*Nearest"):
        tf.simulate(scene, scene.bind().start(), until=until)


def test_an_end_in_the_past_is_refused():
    scene = alone()
    last = list(tf.simulate(scene, scene.bind().start(), until=1.0))[-1]
    with pytest.raises(tf.InputError, match=r"until.*at least"):
        tf.simulate(scene, last, until=0.5)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({}, "end"),
        ({"until": math.nan}, "until"),
        ({"until": math.inf}, "until"),
        ({"until": "long"}, "until"),
        ({"cells": 0}, "cells"),
        ({"cells": 2.5}, "cells"),
        ({"cells": True}, "cells"),
        ({"until": 1.0, "dt": 0.0}, "dt"),
        ({"until": 1.0, "dt": -0.1}, "dt"),
        ({"until": 1.0, "on_failure": "ignore"}, "on_failure"),
        ({"until": 1.0, "record": 3}, "record = 3"),
        ({"until": 1.0, "observers": [print, 3]}, "observers"),
        ({"until": 1.0, "observers": [tf.LivePlot]}, r"observers.*LivePlot\(\) with its brackets"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(options, word):
    scene = alone()
    with pytest.raises(tf.InputError, match=word):
        tf.simulate(scene, scene.bind().start(), **options)


def test_scene_and_state_the_wrong_way_round_are_reported():
    scene = alone()
    for run in (tf.simulate, tf.rollout):
        with pytest.raises(
            tf.InputError, match=r"\(State, Scene, …\) is not allowed: first comes a Scene"
        ):
            run(scene.bind().start(), scene, until=1.0)


def test_a_number_of_cells_that_no_growth_leads_to_is_refused():
    """Colony 2 of rate 0 would keep the run going for ever; with as many cells as are wanted, or
    until a time, it may stand still."""
    scene = tf.Scene(tf.Growth(rate=[1.0, 0.5, 0.0]), tf.Division(length=3.0))
    with pytest.raises(
        tf.InputError,
        match=(
            r"growth_rate', which is 0 in 1 of 3 colonies, first in colony 2 .*come to 4"
            r" cells.*until="
        ),
    ):
        tf.simulate(scene, scene.bind(3).start(), cells=4)
    assert not list(tf.simulate(scene, scene.bind(3).start(), cells=1))
    assert len(list(tf.simulate(scene, scene.bind(3).start(), until=0.1))) == 4
    with pytest.raises(tf.InputError, match=r"growth_rate', which is 0 and which nothing"):
        tf.simulate(
            tf.Scene(tf.Growth(rate=0.0)), tf.Scene(tf.Growth(rate=0.0)).bind(2).start(), cells=4
        )


def test_a_number_of_cells_that_no_division_leads_to_is_refused():
    """Nothing adds cells without Division; where cells are removed, a run may end with none."""
    body = (tf.Growth(rate=1.0), tf.Mechanics(dim=2))
    scene = tf.Scene(*body)
    with pytest.raises(tf.InputError, match=r"cells = 4 .*divides cells.*has 1\..*tf\.Division"):
        tf.simulate(scene, cells=4)
    assert not list(tf.simulate(scene, cells=1))
    assert len(list(tf.simulate(scene, cells=4, until=0.1))) == 4
    with pytest.warns(UserWarning, match=r"cells = 4 is never reached.*loses all cells"):
        tf.simulate(tf.Scene(*body, tf.Removal((-9, -9), (9, 9))), cells=4)


def test_cells_that_divide_or_lengthen_in_a_way_of_their_own_are_no_mistake():
    flagged = tf.Scene(tf.Growth(rate=0.0), tf.Division())
    state = flagged.bind(2).start().with_fields(divide_flag=torch.ones(2, dtype=torch.bool))
    *_, end = tf.simulate(flagged, state, cells=2)
    assert end.counts.tolist() == [2, 2]

    @dataclass(frozen=True)
    class Stretch(tf.Effect):
        stage, title = 35, "stretch"

        def writes(self):
            return ("length",)

        def step(self, state, dt, values):
            return state.replace(length=state.length * 1.1)

    scene = tf.Scene(tf.Growth(rate=0.0), Stretch(), tf.Division(length=3.0))
    *_, end = tf.simulate(scene, scene.bind(1).start(), cells=4)
    assert end.cells >= 4


def test_observers_may_come_one_by_one():
    scene, seen = alone(), []
    for _ in tf.simulate(
        scene,
        scene.bind().start(),
        until=0.1,
        observers=(o for o in [lambda s: seen.append(s.step)]),
    ):
        pass
    assert len(seen) > 1


def test_a_state_of_another_scene_is_refused_before_anything_runs():
    state = alone().bind(cells=tf.Cells.single(3)).start()
    with pytest.raises(tf.InputError, match="2-D"):
        tf.simulate(scene_of(), state, until=1.0)
    with pytest.raises(tf.InputError, match=r"divide_flag|division_threshold"):
        tf.simulate(tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0)), state, until=1.0)
    with pytest.raises(tf.InputError, match="displacement"):
        tf.simulate(tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=3)), state, until=1.0)


def test_colonies_that_stand_still_are_named_after_others_have_left():
    """A colony that a caller takes out leaves what is known of the others as it was."""
    hardly = tf.Scene(tf.Growth(rate=1e-9), tf.Division(length=4.0), dim=2, dt=0.01)
    states = tf.simulate(hardly, cells=2, colonies=3)
    with pytest.warns(RuntimeWarning, match="colony 0, 2: larger by less than a hundredth"):
        for state in states:
            if state.step == 150:
                states.send(state.select([0, 2]))
            if state.step == 1100:
                break


FREE = tf.Growth(rate=1.5), tf.Division(length=4.0)
HOURS = r"until = 60 h: at 1\.5/h, volumes grow 10\^39-fold by then\. Are times in hours"


@pytest.mark.parametrize("more", [(), (tf.Mechanics(dim=2),)], ids=["alone", "contacts"])
def test_a_time_in_minutes_is_warned_of(more):
    with pytest.warns(UserWarning, match=HOURS):
        next(tf.simulate(tf.Scene(*FREE, *more, dim=2, dt=0.05), until=60.0))


@pytest.mark.parametrize(
    ("more", "end"),
    [
        ((), {"until": 60.0, "cells": 50}),
        ((), {"until": 13.0}),
        ((tf.Lysis(rate=1.0),), {"until": 60.0}),
        ((tf.Rules(lambda cells: None),), {"until": 60.0}),
        ((tf.Mechanics(dim=2, length_drag=10.0),), {"until": 60.0}),
        ((tf.Mechanics(dim=2, walls=[tf.Plane(y=-9.0, facing="+y")]),), {"until": 60.0}),
    ],
    ids=["cells", "hours", "lysis", "rules", "pressure", "walls"],
)
def test_long_runs_of_what_may_stay_small_are_not_warned_of(more, end):
    next(tf.simulate(tf.Scene(*FREE, *more, dim=2, dt=0.05), **end))


def test_a_state_near_its_end_is_not_warned_of():
    scene = tf.Scene(*FREE, dim=2, dt=0.05)
    late = scene.bind().start().replace(time=50.0, step=1000)
    next(tf.simulate(scene, late, until=60.0))

"""Contacts whose softness is stated, and first cells that walls leave no room."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from helpers import step

import torchfilm as tf

TWO = tf.Cells([[-1.4, 0.0], [1.4, 0.0]], [[1.0, 0.0]] * 2, length=2.0)


def soft(dt: float = 0.01, **given) -> tf.Scene:
    return tf.Scene(tf.Mechanics(dim=2, **given), founders=TWO, dt=dt)


@pytest.mark.parametrize("backend", [None, "torch"])
@pytest.mark.parametrize(
    ("given", "wanted"),
    [({"stiffness": 500.0}, 0.2), ({"stiffness": [5.0, 50.0]}, [20.0, 2.0]), ({"alpha": 0.1}, 0.1)],
)
def test_the_state_holds_the_softness_that_is_stated(backend, given, wanted):
    """α = 1/(stiffness Δt): the force of a contact is its overlap / (α Δt)."""
    scene = soft(backend=backend, **given)
    state = step(scene, scene.bind(2).start(), 0.01)
    each = torch.as_tensor(wanted).expand(2).repeat_interleave(2)
    torch.testing.assert_close(state.contact_alpha, each.to(state.dtype))


def test_softness_of_sub_steps():
    """A step with sub-steps holds theirs."""
    grows = tf.Growth(rate=4.0)
    scene = tf.Scene(grows, tf.Mechanics(dim=2, stiffness=500.0), founders=TWO)
    state = step(scene, scene.bind().start(), 0.1)
    number = int(state.reports["mechanics"].substeps)
    assert number > 1
    assert state.contact_alpha.tolist() == pytest.approx([number / 50.0] * 2)


@pytest.mark.parametrize("given", [{"stiffness": 1e12}, {"alpha": 1e-30}])
def test_contacts_too_hard_for_the_numbers_of_a_state(given):
    """In float32 drag would be lost, and cells turn at random; float64 takes stiffness of 1e12."""
    (name,) = given
    with pytest.raises(tf.InputError, match=rf"Mechanics\.{name} = .* with float32: drag"):
        [*tf.simulate(soft(**given), until=0.02)]
    if name == "stiffness":
        assert [*tf.simulate(soft(**given), until=0.02, dtype=torch.float64)]


@pytest.mark.parametrize(
    ("wall", "room"),
    [
        (tf.Sphere((0.0, 0.0), 0.3), "1 µm"),
        (tf.Sphere((0.0, 0.0), 1.4), "2.8 µm"),
        (tf.Box((-1.0, -1.0), (1.0, 1.0)), "2.41 µm"),  # corner to corner
        (tf.Channel(2.0, low_end=-1.0, high_end=1.0), "2.41 µm"),
    ],
)
def test_first_cells_that_fit_between_no_walls(wall, room):
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[wall]))
    with pytest.warns(RuntimeWarning, match=rf"is 3 µm long, and there is room for {room}"):
        scene.bind()


@pytest.mark.parametrize(
    "wall",
    [
        tf.Sphere((0.0, 0.0), 1.5),
        tf.Sphere((0.0, 0.0), 0.3, stiffness=100.0),
        tf.Sphere((0.0, 9.0), 0.3, inside=False),
        tf.Box((-1.6, -1.6), (1.6, 1.6)),
        tf.Box((-1.0, -1.0), (1.0, 1.0), stiffness=100.0),
        tf.Channel(2.0, low_end=-1.0),
        tf.Plane(x=-0.5, facing="+x"),
    ],
)
def test_first_cells_that_fit(wall):
    """Also those that lie in a wall: the first steps move them out."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tf.Scene(tf.Mechanics(dim=2, walls=[wall])).bind()


def test_numbers_beyond_those_of_float32():
    """They would be infinite in the state. In float64 they are numbers."""
    box = {"box": ((-16, -16), (16, 16)), "spacing": 4.0}
    for initial in (1e300, lambda at: 1e300 + 0 * at[:, 0]):
        scene = tf.Scene(tf.Medium(a=tf.Signal(10.0, initial=initial), **box), dim=2)
        with pytest.raises(tf.InputError, match=r"at most 3\.4e\+38 with float32"):
            scene.bind().start()
        assert bool(torch.isfinite(scene.bind(dtype=torch.float64).start().signals["a"]).all())
    later = tf.Schedule({0: 1.0, 1: 1e300})
    scene = tf.Scene(tf.Medium(a=tf.Signal(10.0, source=later), **box), dim=2)
    with pytest.raises(tf.InputError, match=r"source of the signal 'a' = 1e\+300 .*3\.4e\+38"):
        scene.bind().start()


@pytest.mark.parametrize(
    "make", [lambda d: tf.Scene(tf.Growth(1.0), dim=d), lambda d: tf.Mechanics(dim=d)]
)
@pytest.mark.parametrize("dim", [2.0, True, "2"])
def test_a_dimension_is_a_whole_number(make, dim):
    with pytest.raises(tf.InputError, match="one of 2, 3"):
        make(dim)


def across(tilt: float, length: float = 2.0) -> tf.Scene:
    """A cell across a channel of 1.2 µm."""
    founders = tf.Cells([[2.0, 0.0]], [[tilt, 1.0]], length=[length])
    mechanics = tf.Mechanics(dim=2, walls=[tf.Channel(1.2, low_end=0.0)])
    return tf.Scene(tf.Growth(rate=1.0), mechanics, founders=founders, dt=0.05)


def test_a_first_cell_straight_across_a_channel():
    """Nothing turns it. One that leans a little, or that fits, is silent."""
    words = r"Channel: cell 0 of colony 0, which is 3 µm long, starts straight across the 1\.2 µm"
    with pytest.warns(RuntimeWarning, match=words):
        across(0.0).bind()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        across(1e-4).bind()
        across(0.0, length=0.19).bind()
    for box in (tf.Box((-1.3, -1.3), (1.3, 1.3)), tf.Box((-1.0, -9.0), (1.0, math.inf))):
        with pytest.warns(RuntimeWarning, match=r"^Box: cell 0 .* starts straight across the 2"):
            tf.Scene(tf.Mechanics(dim=2, walls=[box])).bind()
    *_, last = tf.simulate(across(1e-4), until=1.0)
    assert float(last.axis[0, 0].abs()) > 0.9, "it lies along the channel"


def test_each_colony_has_the_room_of_its_own_wall():
    """A cell of 3 µm, in a ball that is wide in the first colony and not in the second."""
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[tf.Sphere((0.0, 0.0), [9.0, 1.4])]))
    with pytest.warns(RuntimeWarning, match=r"of colony 1 is 3 µm long.* room for 2\.8 µm"):
        scene.bind(2)


def test_a_cell_wider_than_a_channel_gets_one_warning():
    """It also lies across, which does not matter then."""
    founders = tf.Cells([[2.0, 0.0]], [[0.0, 1.0]], length=2.0, radius=0.7)
    mechanics = tf.Mechanics(dim=2, walls=[tf.Channel(1.2, low_end=0.0)])
    with pytest.warns(Warning) as told:
        tf.Scene(tf.Growth(rate=1.0), mechanics, founders=founders, dt=0.05).bind()
    assert ["too narrow" in str(w.message) for w in told] == [True]


@pytest.mark.parametrize(("apart", "words"), [(0.3, "deep in one another"), (1e-5, "deep in one"),
                                              (1e-8, "at the same place")])  # fmt: skip
def test_a_small_cell_in_a_large_one_is_noticed(apart, words):
    """It overlaps by more than its own radius of 0.2 µm, and by less than the other's of 0.6."""
    founders = tf.Cells([[0.0, 0.0], [0.0, apart]], [1.0, 0.0], 0.0, radius=[0.6, 0.2])
    with pytest.warns(RuntimeWarning, match=words):
        tf.Scene(tf.Mechanics(dim=2), founders=founders).bind()


SOFT = {
    "cells": (TWO, {"stiffness": 50.0}),
    "walls": (tf.Cells.single(2), {"walls": [tf.Box((-1.7, -9.0), (1.7, 9.0), stiffness=50.0)]}),
}


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("soft", SOFT)
def test_what_is_soft_yields_in_sub_steps_as_in_short_steps(soft, backend):
    """Sub-steps are steps of a part of the time. Growth by the same length in each, and tight
    solves: what is left is rounding, 1e-16, times what the solve amplifies."""
    founders, given = SOFT[soft]
    scene = tf.Scene(
        tf.Growth(rate=2.0, law="linear"),
        tf.Mechanics(dim=2, length_drag=10.0, tolerance=1e-9, backend=backend, **given),
        founders=founders,
    )
    model = scene.bind(dtype=torch.float64)
    start = model.start()
    once = model.step(start, 0.4)
    parts = int(once.reports["mechanics"].substeps)
    assert parts == 4
    state = start
    for _ in range(parts):
        state = model.step(state, 0.1)
        assert int(state.reports["mechanics"].substeps) == 1
    for field in ("position", "length"):
        torch.testing.assert_close(
            getattr(once, field), getattr(state, field), rtol=0, atol=1e-7, msg=field
        )
    assert float((once.length - start.length).max()) < 0.79, "something presses them"

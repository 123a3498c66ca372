"""Every physical parameter of a scene may be one number, or one per colony."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from founded import cells_in, crowd
from helpers import step

import torchfilm as tf
from torchfilm.tools.checks import InputError


def two_designs(make, colonies: int = 2) -> list[tf.State]:
    """Each colony of a batch with a parameter per colony, and the same colony in a scene with its
    one number."""
    batch = make(torch.tensor([1.0, 2.0], dtype=torch.float64))
    return [run_a_little(batch, colonies)] + [run_a_little(make(v), colonies) for v in (1.0, 2.0)]


def run_a_little(scene: tf.Scene, colonies: int) -> tf.State:
    state = scene.bind(colonies, dtype=torch.float64).start()
    for _ in range(6):
        state = step(scene, state, 0.1)
    return state


PUSH = tf.Growth(rate=0.5)
PER_COLONY = {
    "Growth.rate": lambda v: tf.Scene(tf.Growth(rate=v), founders=crowd()),
    "Growth.rate drawn": lambda v: tf.Scene(tf.Growth(rate=tf.Uniform(0.1, v)), founders=crowd()),
    "Division.length": lambda v: tf.Scene(PUSH, tf.Division(length=v + 1.5), founders=crowd()),
    "Division.volume": lambda v: tf.Scene(PUSH, tf.Division(volume=v + 1.5), founders=crowd()),
    "Division.added": lambda v: tf.Scene(PUSH, tf.Division(added=v * 0.4), founders=crowd()),
    "Division.fraction": lambda v: tf.Scene(
        PUSH, tf.Division(length=2.5, fraction=v * 0.3), founders=crowd()
    ),
    "Division.axis_noise": lambda v: tf.Scene(
        PUSH, tf.Division(length=2.5, axis_noise=v * 0.01), founders=crowd()
    ),
    "Mechanics.viscosity": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, viscosity=v), founders=crowd()
    ),
    "Mechanics.length_drag": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, length_drag=v), founders=crowd()
    ),
    "Mechanics.alpha": lambda v: tf.Scene(PUSH, tf.Mechanics(dim=2, alpha=v), founders=crowd()),
    "Mechanics.stiffness": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, stiffness=v * 10), founders=crowd()
    ),
    "Plane.y": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Plane(y=v + 1.8, facing="-y")]), founders=crowd()
    ),
    "Plane.stiffness": lambda v: tf.Scene(
        PUSH,
        tf.Mechanics(dim=2, walls=[tf.Plane(y=2.5, facing="-y", stiffness=v)]),
        founders=crowd(),
    ),
    "Plane.weight": lambda v: tf.Scene(
        PUSH,
        tf.Mechanics(dim=2, walls=[tf.Plane(y=2.5, facing="-y", weight=v / 2)]),
        founders=crowd(),
    ),
    "Sphere.radius": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Sphere((0.0, 1.2), v + 1.0)]), founders=crowd()
    ),
    "Channel.width": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Channel(v + 4.0)]), founders=crowd()
    ),
    "Box.high": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Box((-9.0, -9.0), (9.0, v + 1.5))]), founders=crowd()
    ),
    "Removal.high": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2), tf.Removal((-9.0, -9.0), (9.0, v + 1.5)), founders=crowd()
    ),
}


@pytest.mark.parametrize("name", list(PER_COLONY))
def test_every_physical_parameter_may_differ_from_colony_to_colony(name):
    """A colony of a batch with many designs is, bit for bit, that colony in a batch of its own
    design."""
    batch, *each = two_designs(PER_COLONY[name])
    first, second = (state.select([0]) for state in each)
    assert any(
        not torch.equal(getattr(first, part), getattr(second, part))
        for part in ("position", "axis", "length")
    )
    for k in range(2):
        mine, alone = batch.select([k]), each[k].select([k])
        for part in ("uid", "position", "axis", "length"):
            assert torch.equal(getattr(mine, part), getattr(alone, part)), part


SHORT = {
    "Growth.rate": lambda v: (tf.Growth(rate=v),),
    "Uniform.low": lambda v: (tf.Growth(rate=tf.Uniform(v, 3.0)),),
    "Division.length": lambda v: (tf.Division(length=v + 3),),
    "Division.fraction": lambda v: (tf.Division(fraction=v / 4),),
    "Mechanics.viscosity": lambda v: (tf.Mechanics(dim=2, viscosity=v),),
    "Mechanics.alpha": lambda v: (tf.Mechanics(dim=2, alpha=v),),
    "Plane.y": lambda v: (tf.Mechanics(dim=2, walls=[tf.Plane(y=v + 5, facing="-y")]),),
    "Plane.stiffness": lambda v: (
        tf.Mechanics(dim=2, walls=[tf.Plane(y=5.0, facing="-y", stiffness=v)]),
    ),
    "Sphere.radius": lambda v: (tf.Mechanics(dim=2, walls=[tf.Sphere((0.0, 0.0), v + 9)]),),
}


@pytest.mark.parametrize("name", list(SHORT))
def test_too_few_values_are_refused_by_name(name):
    scene = tf.Scene(*SHORT[name](torch.tensor([1.0, 2.0])), founders=cells_in(2))
    with pytest.raises(tf.InputError, match=name.split(".")[1]):
        scene.bind(3).start()


@pytest.mark.parametrize("name", list(SHORT))
def test_too_many_values_are_refused_by_name(name):
    """Four designs for three colonies: one would never be looked at, which can only be a
    mistake."""
    scene = tf.Scene(*SHORT[name](torch.tensor([1.0, 2.0, 1.0, 2.0])), founders=cells_in(2))
    with pytest.raises(tf.InputError, match=name.split(".")[1]):
        scene.bind(3).start()


STATED = tf.PerColony([5.0, 6.0])


@pytest.mark.parametrize(
    "make",
    [
        lambda: tf.Mechanics([tf.Sphere(centre=(0.0, 0.0), radius=STATED)], dim=2),
        lambda: tf.Mechanics([tf.Plane(y=STATED, facing="-y")], dim=2),
        lambda: tf.Mechanics([tf.Box((-5.0, -5.0), (STATED, 9.0))], dim=2),
        lambda: tf.Removal(low=(-9.0, -9.0), high=(STATED, 9.0)),
    ],
)  # fmt: skip
def test_what_is_stated_per_colony_stands_where_a_list_may(make):
    scene = tf.Scene(tf.Growth(rate=1.0), make(), dim=2)
    ((_, values),) = scene.per_colony()
    assert values.tolist() == [5.0, 6.0] and scene.bind(2).start().colonies == 2


class Column:
    """A column of a data frame whose rows have other numbers: it has `values`, and no place 0."""

    def __init__(self, values):
        self.values = np.array(values)

    def __array__(self, dtype=None, copy=None):
        return self.values if dtype is None else self.values.astype(dtype)

    def __len__(self):
        return len(self.values)

    def __getitem__(self, name):
        raise KeyError(name)


@pytest.mark.parametrize("kind", [np.int8, np.uint16, np.int64, np.float32, np.float64])
def test_columns_of_data_frames_are_one_number_per_colony(kind):
    rates = Column(np.array([1, 2, 3], dtype=kind))
    bind = lambda rate: tf.Scene(tf.Growth(rate=rate), tf.Division(length=4.0), dim=2).bind(3)
    for given in (rates, tf.PerColony(rates), {0: rates}):
        assert bind(given).start().growth_rate.tolist() == [1.0, 2.0, 3.0]
    wall = tf.Plane(y=-1.0, facing="+y", stiffness=rates)
    assert wall.stiffness.tolist() == [1.0, 2.0, 3.0]
    scene = bind(rates)
    rates.values[:] = 9
    assert scene.start().growth_rate.tolist() == [1.0, 2.0, 3.0]


def test_columns_of_texts_are_no_numbers():
    for given in (Column(["a", "b"]), Column(np.array([1, None], dtype=object)), np.array(["a"])):
        with pytest.raises(InputError, match=r"Growth\.rate = .*must be a number, or numbers"):
            tf.Growth(rate=given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.array([True, False]), r"Growth\.rate is bool of shape \(2,\)"),
        (torch.tensor([True, False]), r"Growth\.rate is bool of shape \(2,\)"),
        (np.array([1j, 2.0]), r"Growth\.rate is complex128 of shape \(2,\)"),
        (np.ones((2, 3)), r"is float64 of shape \(2, 3\): it must be one number, or a dense 1-D"),
        (torch.ones(2).to_sparse(), r"Growth\.rate is float32 of shape \(2,\): .* dense"),
        ([True, False], r"Growth\.rate = \[True, False\] is not allowed"),
        ([torch.tensor(True), 0.5], r"Growth\.rate = \[tensor\(True\), 0\.5\] is not allowed"),
        ([0.5, True], r"Growth\.rate = \[0\.5, True\] is not allowed"),
    ],
    ids=str,
)
def test_entries_that_are_no_real_numbers_are_refused_with_their_type(given, words):
    with pytest.raises(InputError, match=words):
        tf.Growth(rate=given)

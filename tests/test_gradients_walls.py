"""Gradients through contacts with walls: growth between them, their places, stiffness and size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from differences import F64, between_walls, check, growing, outcome, run, seeded

import torchfilm as tf


@pytest.mark.parametrize(
    "soft", [{}, {"stiffness": 3.0}, {"weight": 0.5}], ids=["hard", "soft", "weighted"]
)
@pytest.mark.parametrize("dim", [2, 3])
def test_growth_rate_between_walls(dim, soft):
    def experiment(rate):
        scene = growing(dim, rate, walls=between_walls(dim, **soft))
        return run(scene, seeded(scene))

    check(experiment, 0.8)


@pytest.mark.parametrize("dim", [2, 3])
def test_growth_rate_between_walls_that_only_push(dim):
    def experiment(rate):
        scene = growing(dim, rate, walls=between_walls(dim), contacts="one-sided")
        return run(scene, seeded(scene))

    check(experiment, 0.8)


@pytest.mark.parametrize("soft", [{}, {"stiffness": 3.0}], ids=["hard", "soft"])
def test_place_of_a_wall(soft):
    def experiment(y):
        scene = growing(2, torch.tensor(0.5, dtype=F64), walls=[tf.Plane(y=y, facing="+y", **soft)])
        return run(scene, seeded(scene))

    check(experiment, -0.55)


def test_place_of_a_wall_for_each_colony():
    def experiment(y):
        scene = growing(2, torch.tensor(0.5, dtype=F64), walls=[tf.Plane(y=y, facing="+y")])
        return run(scene, seeded(scene, colonies=2))

    check(experiment, [-0.55, -0.6])


def test_stiffness_of_a_wall():
    def experiment(stiffness):
        scene = growing(
            2,
            torch.tensor(0.5, dtype=F64),
            walls=[tf.Plane(y=-0.5, facing="+y", stiffness=stiffness)],
        )
        return run(scene, seeded(scene))

    check(experiment, 3.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_radius_of_a_sphere_around(dim):
    def experiment(radius):
        centre = (0.0, 1.8, 0.0)[:dim]
        scene = growing(dim, torch.tensor(0.5, dtype=F64), walls=[tf.Sphere(centre, radius)])
        return run(scene, seeded(scene))

    check(experiment, 2.6)


def test_place_of_a_wall_that_cuts_a_move():
    """A heap of discs of radius 0.05 to 2 µm above a floor. In the second step, of one pass, one
    comes to lie its radius deep in the floor, where its move ends: it follows the floor.
    """
    rng = np.random.default_rng(10)
    places, axis = rng.uniform(-1, 1, (25, 2)), rng.normal(size=(25, 2))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    radius = np.exp(rng.uniform(*np.log([0.05, 2.0]), 25))
    cells = tf.Cells(places, axis, np.zeros(25), radius=radius)

    def stepped(floor, state=None):
        contacts = tf.Mechanics(
            [tf.Plane(y=floor, facing="+y")], dim=2, passes=1, length_drag=1.0, tolerance=1e-10,
            max_iterations=50_000, backend="torch",
        )  # fmt: skip
        model = tf.Scene(contacts, founders=cells, dt=0.01).bind(dtype=F64)
        return model.step(model.start() if state is None else state)

    with pytest.warns(RuntimeWarning, match="deep in one another"):
        first = stepped(-1.0)
    floor = torch.tensor(-1.0, dtype=F64, requires_grad=True)
    height = stepped(floor, first).position[:, 1]
    above = (height.detach() + 1.0).abs()
    cut = int(above.argmin())
    assert float(above[cut]) < 1e-9, "its centre is on the floor"
    slopes = torch.stack([torch.autograd.grad(y, floor, retain_graph=True)[0] for y in height])
    with torch.no_grad():
        up, down = (stepped(torch.tensor(-1.0 + d, dtype=F64), first) for d in (1e-6, -1e-6))
    found = (up.position[:, 1] - down.position[:, 1]) / 2e-6
    assert float(slopes[cut]) == pytest.approx(1.0, abs=1e-6)
    assert torch.allclose(slopes, found, atol=1e-5)


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
def test_where_a_turn_is_cut_short(contacts):
    """Cells across one another turn by more than the 0.5 rad of a pass."""
    rng, cut = np.random.default_rng(11), []
    where, way = rng.uniform(-0.6, 0.6, (3, 2)), rng.normal(size=(3, 2))
    cells = tf.Cells(where, way, rng.uniform(0.3, 2.0, 3), 0.5)

    def experiment(alpha):
        effect = tf.Mechanics(
            dim=2, contacts=contacts, tolerance=1e-10, passes=1, alpha=alpha.reshape(1)
        )
        scene = tf.Scene(tf.Growth(rate=1.0), effect, founders=cells)
        state = run(scene, scene.bind(dtype=torch.float64).start(), steps=1, dt=0.025)
        cut.append(int(state.reports["mechanics"].clipped))
        return state

    check(experiment, 0.05)
    assert min(cut) > 0


def test_colonies_that_do_not_grow_have_gradients():
    """What bounds α from below is the force that stops growth: 0 here, in one of two colonies."""
    rate = torch.tensor([0.0, 0.5], dtype=F64, requires_grad=True)
    where, way = [[0.0, 0.0], [0.4, 0.8]], [[1.0, 0.0], [0.9553364, 0.29552]]
    scene = tf.Scene(
        tf.Growth(rate=tf.PerColony(rate), law="length"), tf.Mechanics(dim=2, tolerance=1e-9),
        founders=tf.Cells(where, way, [2.0, 2.2], [0.5, 0.5]),
    )  # fmt: skip
    state = run(scene, scene.bind(2, dtype=F64).start(), steps=3, dt=0.01)
    (found,) = torch.autograd.grad(outcome(state), rate)
    assert bool(torch.isfinite(found).all()) and bool((found != 0).all())

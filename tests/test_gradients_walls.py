"""Gradients through contacts with walls: growth between them, their places, stiffness and size."""

from __future__ import annotations

import pytest
import torch
from differences import F64, between_walls, check, growing, run, seeded

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

"""Walls whose place and direction are tensors: one per colony, gradients, changes in place."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rods import Rods

import torchfilm as tf

CENTERS = [[0.2, 0.0, 0.1], [-0.3, 0.4, 0.0], [0.1, -0.2, 0.3]]
NORMALS = [[1.0, 2.0, -0.5], [0.3, -1.0, 0.2], [-3.0, 0.5, 0.1]]


# a wall from a given vector, one or one per colony
MOVED = {
    "inside a sphere": lambda v: tf.Sphere(centre=v, radius=2.5),
    "outside a sphere": lambda v: tf.Sphere(centre=v, radius=1.5, inside=False),
    "point of a plane": lambda v: tf.Plane(point=v, normal=(1.0, 2.0, -0.5)[: np.shape(v)[-1]]),
    "normal of a plane": lambda v: tf.Plane(point=(0.1, 0.0, -0.2)[: np.shape(v)[-1]], normal=v),
}


def vectors(kind: str, dim: int) -> torch.Tensor:
    return torch.tensor(NORMALS if "normal" in kind else CENTERS, dtype=torch.float64)[:, :dim]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", list(MOVED))
@pytest.mark.parametrize(
    "give",
    [lambda v: v, lambda v: v.numpy(), lambda v: v.tolist()],
    ids=["tensor", "array", "list"],
)
def test_a_vector_for_each_colony_is_each_colonys_own(dtype, device, dim, kind, give):
    """Each colony's rows equal, bit for bit, those at a wall made from its own vector alone.

    This holds for every form of the vector.
    """
    rods, given = Rods(dim, 90, dtype, device), vectors(kind, dim)
    rods.colony = torch.arange(90, device=device) // 30
    together = rods.rows(MOVED[kind](give(given)))
    for k in range(3):
        alone = rods.rows(MOVED[kind](give(given)[k]))
        mine, own = (
            torch.nonzero(rods.colony.index_select(0, x.cell) == k).squeeze(1)
            for x in (together, alone)
        )
        assert own.numel() > 5
        for name in ("cell", "gap", "row", "surface"):
            assert torch.equal(
                getattr(together.take(mine), name), getattr(alone.take(own), name)
            ), name


@pytest.mark.parametrize("kind", list(MOVED))
@pytest.mark.parametrize("each", [True, False], ids=["per colony", "one"])
def test_gradients_to_a_walls_vector(kind, each):
    """Gradients of gaps and rows against central differences in float64.

    h = 1e-6 gives errors of 1e-9 by rounding and curvature; no rod crosses a switch within h.
    """
    rods = Rods(3, 90)
    rods.colony = torch.arange(90) // 30 if each else torch.zeros(90, dtype=torch.int64)
    mix = torch.linspace(0.5, 1.5, 7, dtype=torch.float64)

    def total(v):
        found = rods.rows(MOVED[kind](v))
        return (found.gap**2).sum() + ((found.row @ mix) * torch.cos(found.cell.double())).sum()

    given = vectors(kind, 3) if each else vectors(kind, 3)[0]
    given = given.clone().requires_grad_()
    for _ in range(2):  # a wall is used in many backward passes
        (slope,) = torch.autograd.grad(total(given), given)
    for k in range(given.numel()):
        step = torch.zeros_like(given).reshape(-1)
        step[k] = 1e-6
        step = step.reshape(given.shape)
        with torch.no_grad():
            by_hand = float(total(given + step) - total(given - step)) / 2e-6
        assert abs(by_hand) > 1e-3
        assert float(slope.reshape(-1)[k]) == pytest.approx(by_hand, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("kind", list(MOVED))
def test_a_vector_changed_in_place_moves_the_wall(kind):
    """An in-place change, as by an optimiser, with or without a gradient."""
    rods = Rods(3, 90)
    rods.colony = torch.arange(90) // 30
    for asked in (False, True):
        given = vectors(kind, 3).clone().requires_grad_(asked)
        wall = MOVED[kind](given)
        before = rods.rows(wall)
        with torch.no_grad():
            given += 0.05
        found, fresh = rods.rows(wall), rods.rows(MOVED[kind](given.detach().clone()))
        assert torch.equal(found.gap, fresh.gap) and not torch.equal(found.gap[:5], before.gap[:5])
        if asked:
            (slope,) = torch.autograd.grad(found.gap.sum(), given)
            assert (slope != 0).any(1).all()


def test_a_scene_counts_a_walls_vectors():
    """Vectors for two colonies in a batch of three, or of one, raise an error with the name at
    once.
    """
    scene = tf.Scene(tf.Mechanics(walls=[tf.Sphere(centre=[[0.0, 0, 0], [0.1, 0, 0]], radius=5.0)]))
    assert scene.bind(2).start().colonies == 2
    for count in (1, 3):
        with pytest.raises(tf.InputError, match=r"centre.*2 values"):
            scene.bind(count).start()
    one = tf.Scene(tf.Mechanics(walls=[tf.Sphere(centre=torch.zeros(3), radius=5.0)]))
    assert one.bind(2).start().colonies == 2, "one vector serves any number of colonies"

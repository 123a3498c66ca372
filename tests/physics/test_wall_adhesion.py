"""Cells that stick to walls: what holds an end of a cell, with how much, and which walls do."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    array,
    check_always,
    check_same_bits_alone,
    crowd,
    growth,
    mechanics,
    run,
    seeded,
    step,
)

import torchfilm as tf
from torchfilm.tools.checks import InputError

BACKENDS = pytest.mark.parametrize("backend", ["compiled", "torch"])
DIMS = pytest.mark.parametrize("dim", [2, 3])


def floor(dim: int = 2, **given) -> tf.Plane:
    """Its cells are above 0 on the last axis."""
    return tf.Plane(**{"xyz"[dim - 1]: 0.0}, facing="+" + "xyz"[dim - 1], **given)


def above(gap: float, dim: int = 2, stands: bool = False, **given) -> tf.Cells:
    """A cell 3 µm long in all, and 1 µm wide, at this gap above the floor."""
    place = np.zeros((1, dim))
    place[0, -1] = 0.5 + gap + (1.0 if stands else 0.0)
    return tf.Cells(place, np.eye(dim)[[-1 if stands else 0]], 2.0, **given)


def at_walls(
    cells: tf.Cells, *kinds: tf.Adhesion, walls: list, dt: float = 0.02, **given
) -> tf.Scene:
    """Tight solves: contacts alone."""
    dim = len(cells.position[0])
    parts = {"dim": dim, "walls": walls, "adhesion": kinds, "tolerance": 1e-6} | given
    return tf.Scene(tf.Mechanics(**parts), founders=cells, dt=dt)


def height(state: tf.State, stands: bool = False) -> float:
    return float(state.position[0, -1]) - (1.5 if stands else 0.5)


@BACKENDS
@DIMS
@pytest.mark.parametrize("stands", [False, True])
def test_an_end_closes_as_the_implicit_step_says(backend, dim, stands):
    """A cell of drag μL = 3, held by a stiffness of 50 at each end that is near: a cell that lies
    on the floor at both, one that stands on it at one."""
    scene = at_walls(
        above(0.08, dim, stands), tf.Adhesion(5.0, to="walls"), walls=[floor(dim)], backend=backend
    )
    state, gap = scene.bind(dtype=torch.float64).start(), 0.08
    for _ in range(4):
        state, gap = step(scene, state, 0.02), gap / (1 + (1 if stands else 2) * 50 * 0.02 / 3)
        assert height(state, stands) == pytest.approx(gap, rel=1e-5)
    assert float((state.axis - torch.tensor(np.eye(dim)[-1 if stands else 0])).abs().max()) < 1e-9


@BACKENDS
def test_beyond_its_reach_an_end_is_free(backend):
    for gap, moves in ((0.0999, True), (0.1001, False), (2.4, False)):
        scene = at_walls(above(gap), tf.Adhesion(5.0, to="walls"), walls=[floor()], backend=backend)
        state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
        assert (height(state) < gap - 0.01) == moves
        assert moves or height(state) == pytest.approx(gap, abs=1e-9)
    for reach in (0.1, 0.3, 0.7):
        for side in (-1e-9, 1e-9):
            kind = tf.Adhesion(5.0, reach, to="walls")
            scene = at_walls(above(reach + side), kind, walls=[floor()], backend=backend)
            state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
            assert (height(state) < reach - 0.001) == (side < 0), (reach, side)
    far = at_walls(above(2.4), tf.Adhesion(12.5, 2.5, to=0), walls=[floor()], backend=backend)
    state = step(far, far.bind(dtype=torch.float64).start(), 0.02)
    assert height(state) == pytest.approx(2.4 / (1 + 2 * 5 * 0.02 / 3), rel=1e-5)


@BACKENDS
@pytest.mark.parametrize(
    ("to", "moves"),
    [("walls", (True, True)), (0, (True, False)), (1, (False, True)), ("cells", (False, False))],
)
def test_only_the_walls_that_are_named_hold(backend, to, moves):
    """The first is a chamber, whose four surfaces are one wall: a cell is near one of them. The
    other cell is near an obstacle in it."""
    cells = tf.Cells([[0.0, 0.55], [20.0, 5.55]], [[1, 0]] * 2, 2.0)
    walls = [tf.Box((-20.0, 0.0), (40.0, 20.0)), tf.Sphere((20.0, 3.0), 2.0, inside=False)]
    scene = at_walls(cells, tf.Adhesion(5.0, to=to), walls=walls, backend=backend)
    state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
    assert tuple(array(state.position)[:, 1] < [0.54, 5.54]) == moves


@BACKENDS
@DIMS
@pytest.mark.parametrize("parts", [1, 3])
def test_an_obstacle_and_a_soft_wall_hold(backend, dim, parts):
    """A cell sinks onto an obstacle, and into no wall; a soft one holds as a hard one does."""
    centre = [0.0] * dim
    centre[-1] = -4.0
    cells = above(0.08, dim)
    for walls in ([tf.Sphere(centre, 4.0, inside=False)], [floor(dim, stiffness=20.0)]):
        given = {"walls": walls, "backend": backend, "max_elongation": 1.0 / parts}
        scene = at_walls(cells, tf.Adhesion(5.0, to="walls"), **given)
        state = run(scene, scene.bind(dtype=torch.float64).start(), 12, 0.02)
        assert -1e-3 < height(state) < 0.01
        free = at_walls(cells, **given)
        state = run(free, free.bind(dtype=torch.float64).start(), 12, 0.02)
        assert height(state) == pytest.approx(0.08)


@BACKENDS
@pytest.mark.parametrize(("strength", "holds"), [(40.0, True), (20.0, False)])
def test_a_cell_leaves_a_wall_that_it_pulls_hard_enough(backend, strength, holds):
    """A motile cell of drag 3 that stands on the floor swims away with 3·10: a strength of 40 holds
    it, stretched to ¾ of its reach; one of 20 does not. The force on the wall is that."""
    cells = above(0.0, stands=True, extra={"heading": [1.0]})
    scene = tf.Scene(
        tf.Motility(10.0, reversals=0.0),
        tf.Mechanics(
            dim=2, walls=[floor()], tolerance=1e-6, backend=backend,
            adhesion=[tf.Adhesion(strength, reach=0.2, to="walls")],
        ),
        founders=cells, dt=0.01,
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=1.0, dtype=torch.float64)
    if not holds:
        assert height(state, stands=True) > 5.0
        return
    assert height(state, stands=True) == pytest.approx(0.15, rel=1e-3)
    assert tf.measure.wall_forces(state, scene).force.tolist() == [[pytest.approx(-30.0, rel=1e-3)]]
    assert tf.measure.wall_forces(state, [floor()]).force.tolist() == [[0.0]]
    # −30 at the end of a cell, over twice its area from above
    pressure = -30.0 * (1.5 + 0.15) / (2 * (2.0 + np.pi / 4))
    assert tf.measure.pressure(state, scene).tolist() == [pytest.approx(pressure, rel=1e-3)]


@BACKENDS
def test_levels_and_strengths_of_types_decide(backend):
    """Of four cells apart: by its level of an adhesin, times the strength of its type."""
    cells = tf.Cells(
        [[8.0 * k, 0.55] for k in range(4)], [[1, 0]] * 4, 2.0,
        cell_type=[0, 0, 1, 1], extra={"a": [1.0, 0.0, 1.0, 2.0]},
    )  # fmt: skip
    kind = tf.Adhesion({0: 5.0, 1: 10.0}, adhesin="a", to="walls")
    scene = at_walls(cells, kind, walls=[floor()], backend=backend)
    state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
    for k, strength in enumerate((5.0, 0.0, 10.0, 20.0)):
        wanted = 0.05 / (1 + 2 * strength / 0.1 * 0.02 / 3)
        assert float(state.position[k, 1]) - 0.5 == pytest.approx(wanted, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize(("dim", "parts"), [(2, 1), (3, 1), (2, 3), (3, 3)])
def test_compiled_and_torch_agree(dim, parts):
    """A growing, motile crowd that sticks to the floor and to itself, to the tolerance of the
    solves, before decisions by last bits; also in three sub-steps."""
    ends, cells = [], crowd(np.random.default_rng(8), 50, dim)
    low = (cells.position[:, -1] - 0.5 * np.abs(cells.axis[:, -1]) * cells.length).min() - 0.55
    cells.position[:, -1] -= low
    for backend in ("compiled", "torch"):
        scene = tf.Scene(
            growth(),
            tf.Motility(5.0, reversals=1.0, turning=0.05),
            mechanics(
                dim=dim, contacts="one-sided", tolerance=1e-8, backend=backend,
                adhesion=[tf.Adhesion(100.0, 0.2), tf.Adhesion(50.0, 0.3, to="walls")],
                walls=[floor(dim)], max_elongation=0.25 if parts == 1 else 0.01,
            ),
        )  # fmt: skip
        start = seeded(scene, cells, "cpu", torch.float64)
        ends.append(run(scene, start, 3, 0.01))
    assert int(ends[0].reports["mechanics"].substeps.max()) == parts
    assert array((ends[0].position - ends[1].position).abs()).max() <= 1e-9
    with_pull, pushes = (
        float(tf.measure.wall_forces(ends[0], given).force) for given in (scene, [floor(dim)])
    )
    assert with_pull < pushes - 0.1, "the wall holds some of them"


@BACKENDS
def test_same_bits_alone_and_in_a_batch(backend):
    scene = tf.Scene(
        growth(),
        tf.Mechanics(
            dim=2, backend=backend, walls=[tf.Sphere((0.0, 0.0), 9.0)],
            adhesion=[tf.Adhesion(100.0, reach=0.2, to="walls")],
        ),
        tf.Division(length=3.0),
        founders=crowd(np.random.default_rng(8), 12, 2), dt=0.02,
    )  # fmt: skip
    check_same_bits_alone(scene, until=0.4, seed=4)


@pytest.mark.parametrize("strength", [100.0, 5e4])
def test_a_colony_on_a_sticky_floor_spreads_along_it(strength):
    """From 1 to 60 cells and more in 3-D, at a usual strength and at one near the most that is
    allowed: contacts stay clean, and more of the cells lie on the floor than without."""
    low = []
    for kinds in ([], [tf.Adhesion(strength, to="walls")]):
        scene = tf.Scene(
            tf.Growth(1.0),
            tf.Mechanics(dim=3, walls=[floor(3)], adhesion=kinds),
            tf.Division(length=tf.Uniform(3.0, 4.0)),
            founders=above(0.0, 3), dt=0.05,
        )  # fmt: skip
        overlaps = []
        for state in tf.simulate(scene, cells=60, colonies=6, seed=2):
            check_always(state)
            found = tf.measure.overlaps(state, [floor(3)])
            overlaps.append(float(found.mean.max()))
            assert float(found.walls.max()) <= 0.1
        assert np.mean(overlaps) <= 0.01
        low.append(float((state.position[:, 2] < 0.6).double().mean()))
    assert low[1] > low[0] + 0.1


def test_gradients_pass_through_strength_and_level():
    """Against central differences, in float64."""

    def loss(strength: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
        cells = above(0.05, extra={"a": [1.0]})
        kind = tf.Adhesion(strength, adhesin="a", to=0)
        scene = at_walls(cells, kind, walls=[floor()], backend="torch")
        state = scene.bind(dtype=torch.float64).start()
        state = state.with_fields(a=state.a * level)
        for _ in range(2):
            state = step(scene, state, 0.02)
        return state.position[0, 1]

    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (8.0, 1.0)]
    found = torch.autograd.grad(loss(*given), given)
    h = 1e-4
    for k, slope in enumerate(found):
        sides = [
            float(loss(*(x.detach() * (1 + s * h * (j == k)) for j, x in enumerate(given))))
            for s in (1, -1)
        ]
        by_hand = (sides[0] - sides[1]) / (2 * h * float(given[k].detach()))
        assert float(slope) == pytest.approx(by_hand, rel=1e-3) and abs(by_hand) > 1e-4


@pytest.mark.parametrize(
    ("given", "walls", "words"),
    [
        ({"to": "wall"}, 1, 'Adhesion.to = \'wall\'.*from 0.*else "cells" or "walls"'),
        ({"to": -1}, 1, "Adhesion.to = -1"),
        ({"to": 1.5}, 1, "Adhesion.to = 1.5"),
        ({"to": 1}, 1, "Adhesion.to = 1.*below 1, the number of walls.*from 0"),
        ({"to": "walls"}, 0, "there are no walls"),
        ({"to": "walls", "adhesin": "a", "partner": "b"}, 1, "partner.*a wall has no species"),
    ],
)
def test_bad_input(given, walls, words):
    with pytest.raises(InputError, match=words):
        tf.Mechanics(dim=2, walls=[floor()] * walls, adhesion=[tf.Adhesion(1.0, **given)])


def test_it_is_explained():
    kinds = [tf.Adhesion(5.0, to="walls"), tf.Adhesion(7.0, to=0, adhesin="a")]
    scene = at_walls(above(0.0, extra={"a": [1.0]}), *kinds, walls=[floor()])
    text = tf.explain(scene)
    assert "adhesion of each end to walls: a pull of up to 5 μ·µm²/h at a gap of 0.1 µm" in text
    assert "adhesion to wall 0: a pull of up to 7 μ·µm²/h" in text
    assert "in proportion to a" in text and "of both cells" not in text

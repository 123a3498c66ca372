"""Moves after a solve: no cell turns too far or passes a wall; solves with fixed lengths
converge.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass
from unittest import mock

import numpy as np
import pytest
import torch
from helpers import crowd, run, seeded, step

import torchfilm as tf
from torchfilm.physics.capsule import rotate
from torchfilm.physics.one_sided import _OneStep
from torchfilm.physics.problem import CONVERGED
from torchfilm.physics.wall_contacts import share_to_wall

X, Y = [1.0, 0.0], [0.0, 1.0]


def share(
    wall: tf.Wall, position, axis, length: float, way, turn: float = 0.0, radius: float = 0.5,
    gives: bool = False,
) -> float:  # fmt: skip
    """The share of its move that one cell in the plane makes."""
    t = lambda x: torch.tensor([x], dtype=torch.float64)
    at = lambda s: (
        t(position) + s * t(way),
        rotate(t(axis), s * t([turn])),
        torch.tensor([0.5 * length], dtype=torch.float64),
    )
    (surface,) = wall.surfaces(2)
    return float(
        share_to_wall(
            surface,
            at,
            torch.tensor([radius], dtype=torch.float64),
            torch.zeros(1, dtype=torch.int64),
            torch.tensor([math.hypot(*way) + 0.5 * length * turn], dtype=torch.float64),
            gives,
        )
    )


def test_a_move_ends_a_radius_behind_a_wall():
    """From 2 µm above a floor, 5 µm down: the cell's underside stops 0.5 µm behind the floor, after
    1.5 µm to the floor.

    A cell that began 0.2 µm deep moves 0.3 µm further, one that began 0.7 µm deep no deeper.
    """
    floor = tf.Plane(y=0.0, facing="+y")
    assert share(floor, [0.0, 2.0], X, 2.0, [0.0, -5.0]) == pytest.approx(2.0 / 5.0)
    assert share(floor, [0.0, 0.3], X, 2.0, [0.0, -5.0]) == pytest.approx(0.3 / 5.0)
    assert share(floor, [0.0, -0.2], X, 2.0, [0.0, -5.0]) == 0.0
    assert share(floor, [0.0, -0.2], X, 2.0, [1.0, 0.1]) == 1.0
    assert share(floor, [0.0, 2.0], X, 2.0, [7.0, -1.9]) == 1.0
    # a wall that gives way lets it a radius deeper
    assert share(floor, [0.0, -0.2], X, 2.0, [0.0, -5.0], gives=True) == pytest.approx(0.1)
    assert share(floor, [0.0, 2.0], X, 2.0, [0.0, 5.0]) == 1.0


def test_a_move_that_turns_an_end_through_a_wall():
    """A rod of 6 µm just above a floor turns by 0.49 rad about its centre.

    Its end would be 3 sin 0.49 lower, 0.91 µm deeper than a radius behind the floor.
    """
    floor = tf.Plane(y=0.0, facing="+y")
    part = share(floor, [0.0, 0.55], X, 6.0, [0.0, 0.0], turn=0.49)
    assert part == pytest.approx(0.55 / (3 * math.sin(0.49)))
    assert 0.55 - 3 * math.sin(part * 0.49) > -0.05


def test_a_move_does_not_jump_over_a_ball():
    """A cell would cross a ball of 1 µm; it stops at most a radius behind the ball's surface."""
    post = tf.Sphere((0.0, 0.0), 1.0, inside=False)
    part = share(post, [-1.6, 0.0], Y, 0.0, [3.4, 0.0])
    assert -1.6 + 3.4 * part == pytest.approx(-1.0, abs=3.4 / 8)
    assert share(post, [-1.6, 3.0], Y, 0.0, [3.4, 0.0]) == 1.0


def test_a_cell_that_is_thrown_at_a_wall_stays(device, dtype):
    """Two rods at one position, one with ten thousand times the drag of the other.

    The light one makes the whole move, and there is a wall in its way.
    """
    cells = tf.Cells([[0.0, 0.0], [0.0, 0.02]], [X, X], [4.0, 4.0], extra={"drag": [1e4, 1.0]})
    wall = [tf.Plane(y=0.55, facing="-y")]
    scene = tf.Scene(tf.Mechanics(wall, dim=2, alpha=1e-4, length_drag=10.0, contacts="bilateral"))
    state = run(scene, seeded(scene, cells, device, dtype), 1, dt=0.01)
    assert float(state.displacement[1, 1]) > 0.9 and float(state.position[1, 1]) <= 0.55 + 1e-5
    assert state.reports["mechanics"].clipped.tolist() == [1]
    # one-sided contacts bound the moves of a pass, and see the wall from farther away
    scene = tf.Scene(tf.Mechanics(wall, dim=2))
    state = run(scene, seeded(scene, cells, device, dtype), 1, dt=0.01)
    assert float(state.displacement[1, 1]) <= 0.3 + 1e-6
    assert float(state.position[1, 1]) <= 0.55 - 0.5 + 0.1


def heap(walls, dim: int = 2, seed: int = 2, **settings):
    """A scene of one-sided contacts and no growth, and its first state: 40 cells of radius 0.05 to
    2 µm at nearly one place, a third of them discs or balls."""
    rng = np.random.default_rng(seed)
    places, radius = rng.uniform(-1, 1, (40, dim)), np.exp(rng.uniform(*np.log([0.05, 2.0]), 40))
    axis = rng.normal(size=(40, dim))
    length = np.where(rng.random(40) < 1 / 3, 0.0, rng.uniform(0, 2, 40))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    cells = tf.Cells(places, axis, length, radius=radius)
    contacts = tf.Mechanics(walls, dim=dim, length_drag=1.0, **settings)
    scene = tf.Scene(contacts, founders=cells, dim=dim, dt=0.01)
    with pytest.warns(RuntimeWarning, match="deep in one another"):
        model = scene.bind(dtype=torch.float64)
    return model, model.start()


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_heap_drives_no_cell_through_a_wall(backend, contacts):
    """A heap above a floor, and one pass a step. A pass moves cells by up to 0.6 mean radii, which
    is many radii of the small ones.

    No cell comes deeper than its radius: its centreline stays above the floor.
    """
    floor, cut = [tf.Plane(y=-1.6, facing="+y")], 0
    settings = {"passes": 1} if contacts == "one-sided" else {"contacts": contacts}
    model, state = heap(floor, backend=backend, **settings)
    lowest = lambda s: s.position[:, 1] - 0.5 * s.length * s.axis[:, 1].abs() + 1.6
    for _ in range(6):
        before, state = lowest(state), model.step(state)
        cut += int(state.reports["mechanics"].clipped.sum())
        # as deep as before at most, where that was deeper; rods that turn come a little deeper
        assert bool((lowest(state) >= before.clamp(max=0.0) - 0.02).all())
    assert cut > 20, "the heap parts fast"


@pytest.mark.filterwarnings("ignore:.*there is room for")
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    "wall",
    [
        tf.Plane(y=-1.0, facing="+y"),
        tf.Sphere((1.5, 0.0, 0.0), 0.5, inside=False),
        tf.Sphere((0.0, 0.0, 0.0), 1.8, inside=True),
    ],
    ids=["floor", "post", "chamber"],
)
def test_both_paths_cut_the_same_moves_at_walls(dim, wall):
    """Two steps of heaps at walls, of one pass each: two heaps, and more until a move is cut."""
    if isinstance(wall, tf.Sphere):
        wall = tf.Sphere(wall.centre[:dim], wall.radius, inside=wall.inside)
    no_limit = lambda self, at, made: torch.ones_like(self.given.radius)
    none = (
        nullcontext(),
        nullcontext(),
        mock.patch.object(_OneStep, "_share_to_hard_walls", no_limit),
    )
    farther = 0.0
    for number, seed in enumerate((1, 4, 5, 3)):
        ends = []
        for backend, limit in zip(("compiled", "torch", "torch"), none, strict=True):
            model, state = heap([wall], dim, seed, passes=1, tolerance=1e-6, backend=backend)
            with limit:
                ends.append(model.step(model.step(state)))
        one, other, without = ends
        assert float((one.position - other.position).abs().max()) < 1e-5
        clipped = [s.reports["mechanics"].clipped.item() for s in ends]
        assert clipped[0] == clipped[1] > 0
        farther = max(farther, float((without.position - other.position).abs().max()))
        if number and farther > 0.01:
            break
    assert farther > 0.01, "no move was cut"


@pytest.mark.parametrize(
    "alpha, viscosity, length_drag", [(1e-7, 0.1, 10.0), (1e-6, 0.01, 1.0), (1e-8, 1.0, 100.0)]
)
def test_rods_end_to_end_in_a_full_channel(device, alpha, viscosity, length_drag):
    """Contacts so hard that float32 rounding alone would make some cells' blocks indefinite.

    Every solve converges.
    """
    rng = np.random.default_rng(0)
    centre = np.stack([1.45 + 2.9 * np.arange(12), 0.02 * rng.normal(size=12)], 1)
    axis = np.stack([np.ones(12), 0.02 * rng.normal(size=12)], 1)
    cells = tf.Cells(centre, axis / np.linalg.norm(axis, axis=1, keepdims=True), 1.95)
    walls = [tf.Channel(width=1.1, low_end=0.0, high_end=34.8)]
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(
            dim=2,
            walls=walls,
            alpha=alpha,
            viscosity=viscosity,
            length_drag=length_drag,
            max_iterations=500,
        ),
    )
    state = seeded(scene, cells, device, torch.float32)
    for _ in range(4):
        state = run(scene, state, 1, dt=0.025, check=False)
        assert int(state.reports["mechanics"].status.max()) == CONVERGED, state.reports["mechanics"]
        assert bool(torch.isfinite(state.position).all())


@pytest.mark.parametrize("dim", [2, 3])
def test_contacts_do_not_draw_out_a_cell_that_does_not_grow(device, dtype, dim):
    """In an overlapping crowd bilateral contacts pull on some cells.

    They may lengthen cells that grow, but a cell with growth rate 0 keeps its length to the bit.
    """
    cells = crowd(np.random.default_rng(0), 60, dim)
    scene = tf.Scene(tf.Growth(rate=[0.0, 0.1]), tf.Mechanics(dim=dim))
    state = scene.bind(2, cells=cells, device=device, dtype=dtype).start()
    still, first = state.colony == 0, state.length
    for _ in range(4):
        before, state = state, step(scene, state, 0.025)
        assert torch.equal(state.length[still], first[still]) and bool(
            (state.elongation[still] == 0).all()
        )
        slack = 1 - 4 * torch.finfo(dtype).eps  # the growth of a step is added and then subtracted
        assert bool((state.length[~still] >= slack * before.length[~still]).all())
    assert float((state.position - before.position).abs().max()) > 0


@dataclass(frozen=True, eq=False)
class Thickening(tf.Effect):
    """Sets the drag of all cells to 2, and that of the first cell of colony 1 to `bad`."""

    bad: float

    stage = 15
    title = "thickening"

    def declares(self, dim):
        return [tf.Field("drag", "relative viscosity")]

    def writes(self):
        return ["drag"]

    def step(self, state, dt, values):
        bad = (state.own_colony_id == 1) & (state.uid == 0)
        return state.with_fields(drag=torch.where(bad, self.bad, 2.0))


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
@pytest.mark.parametrize("bad", [0.0, -1.0, math.inf, math.nan])
def test_a_drag_that_is_not_above_zero_fails_its_colony(contacts, bad):
    """A rule's values are checked as it sets them, and an effect's here: a cell has no place at a
    drag of 0. The message names the field; the other colony goes on as if alone."""

    def end(bad, **given):
        scene = tf.Scene(
            Thickening(bad),
            tf.Growth(rate=1.0),
            tf.Mechanics(dim=2, contacts=contacts),
            founders=tf.Cells([[0.0, 0.0], [2.2, 0.1]], [[1.0, 0.0]] * 2),
        )
        *_, last = tf.simulate(scene, colonies=2, until=0.1, dt=0.025, **given)
        return last

    words = r"(?s)in 1 of 2.*drag is not above 0 and finite.*Check the effect or rule that sets"
    with pytest.raises(tf.SimulationError, match=words) as e:
        end(bad)
    assert e.value.colonies == (1,)
    dropped, sound = end(bad, on_failure="drop"), end(2.0)
    assert dropped.counts.tolist() == [2, 0]
    assert torch.equal(dropped.position, sound.position[sound.colony == 0])


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_cells_sink_into_soft_walls_as_deep_as_pressure_takes_them(backend):
    """Bilateral contacts cut moves at hard walls alone. A cell in agarose may come deeper than its
    radius; where it could not, pressed cells came to lie in one another."""
    film = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]
    mechanics = tf.Mechanics(film, dim=3, length_drag=10.0, contacts="bilateral", backend=backend)
    divides = tf.Division(length=tf.Uniform(3.5, 4.5))
    scene = tf.Scene(tf.Growth(rate=1.0), divides, mechanics, dim=3, dt=0.025)
    worst, deepest = 0.0, 0.0
    until = {"compiled": 6.5, "torch": 5.0}[backend]
    for state in tf.simulate(scene, colonies=2, until=until, seed=0):
        found = tf.measure.overlaps(state, film)
        worst, deepest = (
            max(worst, float(found.worst.max())),
            max(deepest, float(found.walls.max())),
        )
    assert worst <= 0.2
    assert backend == "torch" or deepest > 0.5, "some cell lies deeper than its radius in agarose"


@pytest.mark.parametrize("backend", ("compiled", "torch"))
def test_a_cell_deep_in_a_hard_wall_comes_out_in_one_step(backend):
    """A pass moves it by 0.3 µm at most; no pair of cells asks for another pass, the wall does."""
    cells = tf.Cells([[0.0, 0.02], [30.0, 3.0]], [X, X], length=2.0)
    walls = [tf.Plane(y=0.0, facing="+y")]
    scene = tf.Scene(tf.Mechanics(dim=2, walls=walls, backend=backend), founders=cells, dt=0.01)
    model = scene.bind(dtype=torch.float64)
    height = model.step(model.start()).position[:, 1].tolist()
    assert 0.49 < height[0] <= 0.5 and height[1] == 3.0

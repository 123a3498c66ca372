"""Walls: which side cells are on, how far from the wall, and the rows by which that changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array, growth, mechanics, run, seeded, unit

import torchfilm as tf
from torchfilm.physics import capsule
from torchfilm.physics.walls import find_wall_contacts

INF = math.inf
WALLS_3D = {
    "plane": tf.Plane(x=0.3, facing="+x"),
    "plane facing down": tf.Plane(z=0.2, facing="-z"),
    "tilted plane": tf.Plane(point=(0.1, 0.0, -0.2), normal=(1.0, 2.0, -0.5)),
    "inside a sphere": tf.Sphere(center=(0.2, 0.0, 0.1), radius=2.5),
    "outside a sphere": tf.Sphere(center=(0.2, 0.0, 0.1), radius=1.5, inside=False),
    "box": tf.Box(low=(-1, -2, -INF), high=(1.5, 2, 1)),
    "channel": tf.Channel(width=2.0, height=3.0, low_end=-2.0, high_end=None),
}
WALLS_2D = {
    "plane": tf.Plane(y=0.3, facing="+y"),
    "inside a circle": tf.Sphere(center=(0.2, 0.0), radius=2.5),
    "outside a circle": tf.Sphere(center=(0.2, 0.0), radius=1.5, inside=False),
    "channel": tf.Channel(width=2.0, high_end=2.0),
}
ALL = [pytest.param(3, w, id=f"3-D {n}") for n, w in WALLS_3D.items()] + [pytest.param(2, w, id=f"2-D {n}") for n, w in WALLS_2D.items()]


def distance(wall: tf.Plane, p: np.ndarray) -> np.ndarray:
    """Signed distance (..., surfaces) of points (..., d) to each surface of the wall, written out from what the wall says of itself."""
    if isinstance(wall, tf.Sphere):
        away = np.linalg.norm(p - np.array(wall.center), axis=-1)
        return (wall.radius - away if wall.inside else away - wall.radius)[..., None]
    if isinstance(wall, tf.Plane):
        if wall.point is not None:
            n = np.array(wall.normal) / np.linalg.norm(wall.normal)
            return ((p - np.array(wall.point)) @ n)[..., None]
        k = "xyz".index(wall.facing[1])
        return ((p[..., k] - getattr(wall, wall.facing[1])) * (1 if wall.facing[0] == "+" else -1))[..., None]
    if isinstance(wall, tf.Box):
        low, high = np.array(wall.low), np.array(wall.high)
    else:
        half = [wall.width / 2] + ([] if wall.height is None else [wall.height / 2])
        low = np.array([-INF if wall.low_end is None else wall.low_end, *[-h for h in half]])
        high = np.array([INF if wall.high_end is None else wall.high_end, *half])
    both = np.stack([p - low, high - p], -1).reshape(*p.shape[:-1], -1)
    return both[..., np.isfinite(np.stack([low, high], -1).reshape(-1))]


class Rods:
    """Rods at random about the origin, and the rows that a wall gives them."""

    def __init__(self, dim: int, count: int = 300, dtype=torch.float64, device="cpu", seed: int = 1):
        rng = np.random.default_rng(seed)
        t = lambda x, kind: torch.as_tensor(x, dtype=kind, device=device)  # noqa: E731
        self.position = t(rng.uniform(-2, 2, (count, dim)), torch.float64)
        self.axis, self.length = t(unit(rng, count, dim), dtype), t(rng.uniform(0.5, 3, count), dtype)
        self.radius = torch.full_like(self.length, 0.5)
        self.colony = torch.zeros(count, dtype=torch.int64, device=device)

    def rows(self, wall):
        return find_wall_contacts(wall.surfaces(self.position.shape[1]), self.position, self.axis, self.length, self.radius, self.colony)


@pytest.mark.parametrize("dim, wall", ALL)
def test_every_overlapping_end_has_a_row(dtype, device, dim, wall):
    """Gaps of both ends with every surface against the plain formula; rows exactly for those under zero. float32: places of 4 µm to 1e-6."""
    rods = Rods(dim, dtype=dtype, device=device)
    found = rods.rows(wall)
    half = (0.5 * array(rods.length))[:, None] * array(rods.axis)
    tips = np.stack([array(rods.position) + half, array(rods.position) - half])
    gap = distance(wall, tips) - 0.5
    expected = {(i, k, round(g, 4)) for e in range(2) for i, k in zip(*np.nonzero(gap[e] < 0), strict=True) for g in [gap[e, i, k]]}
    ends = array(found.row[:, -1]) != 0
    got = list(zip(array(found.cell)[ends].tolist(), array(found.surface)[ends].tolist(), array(found.gap)[ends].tolist(), strict=True))
    assert len(got) == len(expected) and len(got) > 20
    assert bool((found.gap < 0).all())
    for i, k, g in got:
        assert min(abs(g - gap[e, i, k]) for e in range(2)) <= 2e-6


def marked_gaps(rods: Rods, wall, dof: int, by: float, cell, surface, s, end) -> np.ndarray:
    """Gap of one marked point of each row's cell (at s from the centre, riding along with an end as the cell grows), after a small move."""
    dim, turns = rods.position.shape[1], 1 if rods.position.shape[1] == 2 else 3
    c, a = rods.position[cell].clone(), rods.axis[cell].clone()
    if dof < dim:
        c[:, dof] += by
    elif dof < dim + turns:
        turn = torch.zeros(len(cell), turns, dtype=a.dtype)
        turn[:, dof - dim] = by
        a = capsule.rotate(a, turn)
    at = s + (0.5 * by * end if dof == dim + turns else 0.0)
    return distance(wall, array(c) + at[:, None] * array(a))[np.arange(len(cell)), surface] - 0.5


@pytest.mark.parametrize("dim, wall", ALL)
def test_rows_are_the_derivative_of_the_gap(dim, wall):
    """Gap after a small move x: gap − row · x. Central differences in float64, h = 1e-6: rounding 1e-10, curvature 1e-12."""
    rods, h = Rods(dim), 1e-6
    found = rods.rows(wall)
    cell, surface, row = array(found.cell), array(found.surface), array(found.row)
    c, a, half = array(rods.position)[cell], array(rods.axis)[cell], 0.5 * array(rods.length)[cell]
    # which point of the cell a row is about, told from its gap
    places = np.stack([half, -half])
    ends = np.array([1.0, -1.0])
    if isinstance(wall, tf.Sphere) and not wall.inside:
        nearest = np.clip(((np.array(wall.center) - c) * a).sum(1), -half, half)
        places, ends = np.concatenate([places, nearest[None]]), np.array([1.0, -1.0, 0.0])
    gaps = np.stack([distance(wall, c + s[:, None] * a)[np.arange(len(cell)), surface] - 0.5 for s in places])
    pick = np.abs(gaps - array(found.gap)).argmin(0)
    s, end = places[pick, np.arange(len(cell))], ends[pick]
    assert np.abs(gaps[pick, np.arange(len(cell))] - array(found.gap)).max() <= 1e-12
    for dof in range(row.shape[1]):
        up, down = (marked_gaps(rods, wall, dof, x, cell, surface, s, end) for x in (h, -h))
        assert np.abs(row[:, dof] + (up - down) / (2 * h)).max() <= 1e-7


@pytest.mark.parametrize("dim", [2, 3])
def test_a_ball_in_the_way_is_met_between_the_ends(dtype, device, dim):
    """A rod lying on a small ball: neither end touches, the middle does, and is pushed straight away without a torque to speak of."""
    center = (0.1, -0.9, 0.0)[:dim]
    rods = Rods(dim, 1, dtype, device)
    rods.position[:] = 0.0
    rods.axis[:] = torch.eye(dim)[0]
    rods.length[:] = 4.0
    found = rods.rows(tf.Sphere(center=center, radius=0.5, inside=False))
    assert found.cell.tolist() == [0]
    assert float(found.gap[0]) == pytest.approx(0.9 - 0.5 - 0.5, abs=1e-6)
    row = array(found.row)[0]
    # the row is the way to the wall; its lever is 0.1 µm along x
    assert row[:dim] == pytest.approx(np.array([0.0, -1.0, 0.0])[:dim], abs=1e-6)
    assert np.abs(row[dim:-1]).max() == pytest.approx(0.1, abs=1e-6)
    assert row[-1] == 0


def test_a_box_is_its_planes(dtype, device):
    rods = Rods(3, dtype=dtype, device=device)
    box = rods.rows(tf.Box(low=(-1, -2, -INF), high=(1, INF, INF)))
    planes = [rods.rows(p) for p in (tf.Plane(x=-1.0, facing="+x"), tf.Plane(x=1.0, facing="-x"), tf.Plane(y=-2.0, facing="+y"))]
    assert torch.equal(box.cell, torch.cat([p.cell for p in planes]))
    assert torch.equal(box.gap, torch.cat([p.gap for p in planes]))
    assert torch.equal(box.row, torch.cat([p.row for p in planes]))


def test_a_wall_may_stand_elsewhere_in_each_colony(dtype, device):
    rods = Rods(3, 2, dtype, device)
    rods.position[:], rods.axis[:] = 0.0, torch.tensor([0.0, 0.0, 1.0])
    rods.colony = torch.tensor([0, 1], device=device)
    found = rods.rows(tf.Plane(x=torch.tensor([-0.3, -0.7]), facing="+x"))
    assert found.cell.tolist() == [0, 0]
    assert array(found.gap) == pytest.approx(np.array([-0.2, -0.2]), abs=1e-6)
    found = rods.rows(tf.Sphere(center=(0, 0, 0), radius=torch.tensor([9.0, 1.0])))
    assert set(found.cell.tolist()) == {1}


@pytest.mark.parametrize("dim, wall", ALL)
def test_no_row_where_there_is_room(dim, wall):
    rods = Rods(dim)
    half = (0.5 * array(rods.length))[:, None] * array(rods.axis)
    steps = np.linspace(-1, 1, 41)[:, None, None]
    room = (distance(wall, array(rods.position) + steps * half) - 0.5).min((0, 2))
    touched = np.zeros(len(room), dtype=bool)
    touched[array(rods.rows(wall).cell)] = True
    # sampled every 0.08 µm: a ball met between two samples may be 2e-3 nearer than it looks
    assert not touched[room > 2e-3].any()
    assert touched[room < 0].all()


@pytest.mark.parametrize(
    "wall, start",
    [
        (tf.Sphere(center=(0, 0, 0), radius=3.0), [0.0, 0.5, 0.0]),
        (tf.Box(low=(-3, -1, -1), high=(3, 1, 1)), [0.0, 0.2, 0.0]),
        (tf.Channel(width=2.0, height=2.0, low_end=-3.0, high_end=3.0), [0.0, 0.2, 0.0]),
    ],
    ids=["sphere", "box", "channel"],
)
@pytest.mark.slow
def test_a_growing_cell_stays_inside(dtype, device, wall, start):
    """One cell of 2 µm grows to fill 6 µm of room and stops; hard walls give way by αγ e, which is e = 0.05 µm at l = 5, over a cosine."""
    scene = tf.Scene(growth(), mechanics(walls=[wall]))
    state = run(scene, seeded(scene, tf.Cells([start], [[1.0, 0.05, 0.0]], 2.0), device, dtype), 150)
    assert 4.5 < float(state.length) < 5.3
    half = 0.5 * array(state.length)[:, None] * array(state.axis)
    room = distance(wall, array(state.position) + np.array([-1, 1])[:, None, None] * half) - 0.5
    assert room.min() >= -0.1


@pytest.mark.parametrize(
    "make",
    [
        lambda: tf.Plane(x=0.0),
        lambda: tf.Plane(x=0.0, facing="+y"),
        lambda: tf.Plane(x=0.0, y=0.0, facing="+x"),
        lambda: tf.Plane(point=(0, 0)),
        lambda: tf.Plane(point=(0, 0), normal=(0, 0)),
        lambda: tf.Plane(x=0.0, facing="+x", weight=0.0),
        lambda: tf.Plane(x=0.0, facing="+x", weight=1.5),
        lambda: tf.Plane(x=0.0, facing="+x", weight=0.5, stiffness=1.0),
        lambda: tf.Sphere(center=(0, 0), radius=0.0),
        lambda: tf.Box(low=(0, 0), high=(1, 0)),
        lambda: tf.Box(low=(0, 0), high=(1, 1, 1)),
        lambda: tf.Channel(width=-1.0),
        lambda: tf.Channel(width=1.0, low_end=1.0, high_end=0.0),
        lambda: tf.Channel(width=1.0, height=1.0).surfaces(2),
        lambda: tf.Plane(z=0.0, facing="+z").surfaces(2),
        lambda: tf.Sphere(center=(0, 0), radius=1.0).surfaces(3),
    ],
)
def test_walls_that_make_no_sense_are_refused(make):
    with pytest.raises(tf.InputError):
        make()


def test_cells_behind_a_wall_are_refused_before_the_first_step():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(walls=[tf.Plane(x=1.0, facing="+x")]))
    with pytest.raises(tf.InputError, match="inside out"):
        scene.seed(2)

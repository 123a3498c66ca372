"""Walls: the side of the cells, the distance to the wall, and the rows of the contact problem."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import array, growth, mechanics, run, seeded
from rods import Rods

import torchfilm as tf
from torchfilm.physics import capsule

INF = math.inf
WALLS_3D = {
    "plane": tf.Plane(x=0.3, facing="+x"),
    "plane facing down": tf.Plane(z=0.2, facing="-z"),
    "tilted plane": tf.Plane(point=(0.1, 0.0, -0.2), normal=(1.0, 2.0, -0.5)),
    "inside a sphere": tf.Sphere(centre=(0.2, 0.0, 0.1), radius=2.5),
    "outside a sphere": tf.Sphere(centre=(0.2, 0.0, 0.1), radius=1.5, inside=False),
    "box": tf.Box(low=(-1, -2, -INF), high=(1.5, 2, 1)),
    "channel": tf.Channel(width=2.0, height=3.0, low_end=-2.0, high_end=None),
}
WALLS_2D = {
    "plane": tf.Plane(y=0.3, facing="+y"),
    "inside a circle": tf.Sphere(centre=(0.2, 0.0), radius=2.5),
    "outside a circle": tf.Sphere(centre=(0.2, 0.0), radius=1.5, inside=False),
    "channel": tf.Channel(width=2.0, high_end=2.0),
}
ALL = [pytest.param(3, w, id=f"3-D {n}") for n, w in WALLS_3D.items()] + [
    pytest.param(2, w, id=f"2-D {n}") for n, w in WALLS_2D.items()
]


def distance(wall: tf.Plane, p: np.ndarray) -> np.ndarray:
    """Signed distance (..., surfaces) of points (..., d) to each surface, from the wall's
    arguments.
    """
    if isinstance(wall, tf.Sphere):
        away = np.linalg.norm(p - np.array(wall.centre), axis=-1)
        return (wall.radius - away if wall.inside else away - wall.radius)[..., None]
    if isinstance(wall, tf.Plane):
        if wall.point is not None:
            n = np.array(wall.normal) / np.linalg.norm(wall.normal)
            return ((p - np.array(wall.point)) @ n)[..., None]
        k = "xyz".index(wall.facing[1])
        return ((p[..., k] - getattr(wall, wall.facing[1])) * (1 if wall.facing[0] == "+" else -1))[
            ..., None
        ]
    if isinstance(wall, tf.Box):
        low, high = np.array(wall.low), np.array(wall.high)
    else:
        half = [wall.width / 2] + ([] if wall.height is None else [wall.height / 2])
        low = np.array([-INF if wall.low_end is None else wall.low_end, *[-h for h in half]])
        high = np.array([INF if wall.high_end is None else wall.high_end, *half])
    both = np.stack([p - low, high - p], -1).reshape(*p.shape[:-1], -1)
    return both[..., np.isfinite(np.stack([low, high], -1).reshape(-1))]


def foot(wall: tf.Sphere, rods: Rods) -> np.ndarray:
    """The position along each rod, −1 … +1, that is nearest to the ball's centre."""
    along = ((np.array(wall.centre) - array(rods.position)) * array(rods.axis)).sum(1)
    return np.clip(along / (0.5 * array(rods.length)), -1, 1)


def roots(wall, rods: Rods) -> np.ndarray:
    """The root of the share of each end's row, (2, N).

    It is 1, except at a ball met from outside. There the nearest point has a row of its own, and an
    end's share is half of its relative distance from the nearest point; 1 where the end is that
    point.
    """
    if not isinstance(wall, tf.Sphere) or wall.inside:
        return np.ones((2, len(rods.length)))
    at = foot(wall, rods)
    return np.stack(
        [np.where(at == 1, 1, np.sqrt((1 - at) / 2)), np.where(at == -1, 1, np.sqrt((1 + at) / 2))]
    )


@pytest.mark.parametrize("dim, wall", ALL)
def test_every_overlapping_end_has_a_row(dtype, device, dim, wall):
    """The gaps of both ends to every surface against the plain formula; rows exactly where gap < 0.

    float32: positions of 4 µm to 1e-6.
    """
    rods = Rods(dim, dtype=dtype, device=device)
    found = rods.rows(wall)
    half = (0.5 * array(rods.length))[:, None] * array(rods.axis)
    tips = np.stack([array(rods.position) + half, array(rods.position) - half])
    gap = (distance(wall, tips) - 0.5) * roots(wall, rods)[..., None]
    expected = {
        (i, k, round(g, 4))
        for e in range(2)
        for i, k in zip(*np.nonzero(gap[e] < 0), strict=True)
        for g in [gap[e, i, k]]
    }
    ends = array(found.row[:, -1]) != 0
    got = list(
        zip(
            array(found.cell)[ends].tolist(),
            array(found.surface)[ends].tolist(),
            array(found.gap)[ends].tolist(),
            strict=True,
        )
    )
    assert len(got) == len(expected) and len(got) > 20
    assert bool((found.gap < 0).all())
    for i, k, g in got:
        assert min(abs(g - gap[e, i, k]) for e in range(2)) <= 2e-6


def marked_gaps(rods: Rods, wall, dof: int, by: float, cell, surface, s, end) -> np.ndarray:
    """The gap of a marked point of each row's cell after a small move.

    The point is at s from the centre and moves with an end as the cell grows.
    """
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
    """The gap after a small move x is gap − row · x.

    Central differences in float64, h = 1e-6: rounding 1e-10, curvature 1e-12.
    """
    rods, h = Rods(dim), 1e-6
    found = rods.rows(wall)
    cell, surface, row = array(found.cell), array(found.surface), array(found.row)
    c, a, half = array(rods.position)[cell], array(rods.axis)[cell], 0.5 * array(rods.length)[cell]
    # the point of the cell that a row belongs to, found from its gap
    places = np.stack([half, -half])
    ends = np.array([1.0, -1.0])
    shares = roots(wall, rods)[:, cell]
    if isinstance(wall, tf.Sphere) and not wall.inside:
        nearest = foot(wall, rods)[cell] * half
        places, ends = np.concatenate([places, nearest[None]]), np.array([1.0, -1.0, 0.0])
        shares = np.concatenate([shares, np.ones((1, len(cell)))])
    gaps = (
        np.stack(
            [
                distance(wall, c + s[:, None] * a)[np.arange(len(cell)), surface] - 0.5
                for s in places
            ]
        )
        * shares
    )
    pick = np.abs(gaps - array(found.gap)).argmin(0)
    s, end, root = (
        places[pick, np.arange(len(cell))],
        ends[pick],
        shares[pick, np.arange(len(cell))],
    )
    assert np.abs(gaps[pick, np.arange(len(cell))] - array(found.gap)).max() <= 1e-12
    for dof in range(row.shape[1]):
        up, down = (marked_gaps(rods, wall, dof, x, cell, surface, s, end) for x in (h, -h))
        assert np.abs(row[:, dof] + root * (up - down) / (2 * h)).max() <= 1e-7


@pytest.mark.parametrize("dim", [2, 3])
def test_a_ball_in_the_way_is_met_between_the_ends(dtype, device, dim):
    """A rod on a small ball: its middle touches, its ends do not, and it is pushed without a
    torque.
    """
    centre = (0.1, -0.9, 0.0)[:dim]
    rods = Rods(dim, 1, dtype, device)
    rods.position[:] = 0.0
    rods.axis[:] = torch.eye(dim)[0]
    rods.length[:] = 4.0
    found = rods.rows(tf.Sphere(centre=centre, radius=0.5, inside=False))
    assert found.cell.tolist() == [0]
    assert float(found.gap[0]) == pytest.approx(0.9 - 0.5 - 0.5, abs=1e-6)
    row = array(found.row)[0]
    # the row is the direction to the wall; its lever is 0.1 µm along x
    assert row[:dim] == pytest.approx(np.array([0.0, -1.0, 0.0])[:dim], abs=1e-6)
    assert np.abs(row[dim:-1]).max() == pytest.approx(0.1, abs=1e-6)
    assert row[-1] == 0


def force(rods: Rods, wall) -> torch.Tensor:
    """The force of the wall's rows on each rod at rest: the sum of gap times row, (N, D)."""
    found = rods.rows(wall)
    total = torch.zeros(
        len(rods.length), found.row.shape[1], dtype=found.row.dtype, device=found.row.device
    )
    return total.index_add(0, found.cell, found.gap.unsqueeze(1) * found.row)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("radius", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("way", ["shift", "turn"])
def test_the_force_of_a_ball_never_jumps(dtype, device, dim, radius, way):
    """Force, torque and elongation at a ball change by at most 1e-3 between neighbouring positions.

    A rod of 2 µm, 0.3 µm deep, is shifted past a ball along its whole length, or turned with its
    end near the ball until the end is nearest, in 8,001 positions (as in hard case 3). The path
    itself causes half of that change: 7.5e-4 µm at slopes up to 0.5 (0.3 µm over the ball's
    radius), or 1e-4 rad at slopes up to 5 µm² (two ends, levers and depths of 1 µm).
    """
    count, t = 8001, torch.linspace(-1, 1, 8001, dtype=torch.float64, device=device)
    rods = Rods(dim, count, dtype, device)
    rods.length[:] = 2.0
    rods.position[:], rods.axis[:] = 0.0, torch.eye(dim, dtype=dtype, device=device)[0]
    if way == "shift":
        rods.position[:, 0] = 3.0 * t
    else:
        rods.position[:, 0] = 0.8
        rods.axis[:, 0], rods.axis[:, 1] = (
            torch.cos(0.4 * t).to(dtype),
            torch.sin(0.4 * t).to(dtype),
        )
    ball = tf.Sphere(centre=(0.0, -0.2 - radius, 0.0)[:dim], radius=radius, inside=False)
    found = force(rods, ball)
    at = foot(ball, rods)
    assert at.min() == -1 and np.abs(at).min() < 0.9, (
        "the nearest point should come from between the ends to an end"
    )
    assert float(found[count // 2, :dim].norm()) >= 0.3 - 1e-6, (
        "the nearest point alone pushes with its overlap"
    )
    assert float((found[1:] - found[:-1]).abs().max()) <= 1e-3


@pytest.mark.parametrize("length", [0.0, 2.0])
def test_a_very_large_ball_is_a_plane_to_a_rod_that_stands_askew(dtype, device, length):
    """Both ends overlap and one is nearest: rows as at a plane.

    A ball of 1e5 µm differs from a plane by 1e-5 over 1 µm, and its distances by float64's 1e-11.
    """
    rods = Rods(3, 1, dtype, device)
    rods.position[:], rods.length[:] = 0.0, length
    rods.axis[:] = torch.tensor([math.cos(0.1), 0.0, math.sin(0.1)])
    on_ball = force(rods, tf.Sphere(centre=(0, 0, -1e5 - 0.1), radius=1e5, inside=False))
    on_plane = force(rods, tf.Plane(z=-0.1, facing="+z"))
    assert float(on_plane.abs().max()) > 0.1
    assert float((on_ball - on_plane).abs().max()) <= 2e-5


def test_a_box_is_its_planes(dtype, device):
    rods = Rods(3, dtype=dtype, device=device)
    box = rods.rows(tf.Box(low=(-1, -2, -INF), high=(1, INF, INF)))
    planes = [
        rods.rows(p)
        for p in (
            tf.Plane(x=-1.0, facing="+x"),
            tf.Plane(x=1.0, facing="-x"),
            tf.Plane(y=-2.0, facing="+y"),
        )
    ]
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
    found = rods.rows(tf.Sphere(centre=(0, 0, 0), radius=torch.tensor([9.0, 1.0])))
    assert set(found.cell.tolist()) == {1}


@pytest.mark.parametrize("dim, wall", ALL)
def test_deepest_is_the_least_distance_along_the_cell(dim, wall):
    """Against 2,001 points along each rod of up to 3 µm.

    A sample lies within 7.5e-4 µm, and a distance changes no faster than its point moves.
    """
    rods = Rods(dim)
    half = 0.5 * rods.length
    samples = array(rods.position) + np.linspace(-1, 1, 2001)[:, None, None] * array(half)[
        :, None
    ] * array(rods.axis)
    for number, surface in enumerate(wall.surfaces(dim)):
        s = surface.deepest(rods.position, rods.axis, half, rods.colony)
        assert bool((s.abs() <= half).all())
        found, _ = surface.gap_of_points(rods.position + s.unsqueeze(1) * rods.axis, rods.colony)
        least = distance(wall, samples)[..., number].min(0)
        assert (array(found) <= least + 1e-12).all() and (array(found) >= least - 7.5e-4).all()


@pytest.mark.parametrize("dim, wall", ALL)
def test_no_row_where_there_is_room(dim, wall):
    rods = Rods(dim)
    half = (0.5 * array(rods.length))[:, None] * array(rods.axis)
    steps = np.linspace(-1, 1, 41)[:, None, None]
    room = (distance(wall, array(rods.position) + steps * half) - 0.5).min((0, 2))
    touched = np.zeros(len(room), dtype=bool)
    touched[array(rods.rows(wall).cell)] = True
    # sampled every 0.08 µm: a ball met between two samples may be 2e-3 nearer than the samples
    assert not touched[room > 2e-3].any()
    assert touched[room < 0].all()


@pytest.mark.parametrize(
    "wall, start",
    [
        (tf.Sphere(centre=(0, 0, 0), radius=3.0), [0.0, 0.5, 0.0]),
        (tf.Box(low=(-3, -1, -1), high=(3, 1, 1)), [0.0, 0.2, 0.0]),
        (tf.Channel(width=2.0, height=2.0, low_end=-3.0, high_end=3.0), [0.0, 0.2, 0.0]),
    ],
    ids=["sphere", "box", "channel"],
)
@pytest.mark.slow
def test_a_growing_cell_stays_inside(dtype, device, wall, start):
    """One cell of 2 µm grows to fill 6 µm of room and stops.

    Hard walls yield by αγ e, which is e = 0.05 µm at l = 5, over a cosine.
    """
    scene = tf.Scene(growth(), mechanics(walls=[wall]))
    state = run(
        scene, seeded(scene, tf.Cells([start], [[1.0, 0.05, 0.0]], 2.0), device, dtype), 150
    )
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
        lambda: tf.Sphere(centre=(0, 0), radius=0.0),
        lambda: tf.Box(low=(0, 0), high=(1, 0)),
        lambda: tf.Box(low=(0, 0), high=(1, 1, 1)),
        lambda: tf.Channel(width=-1.0),
        lambda: tf.Channel(width=1.0, low_end=1.0, high_end=0.0),
        lambda: tf.Channel(width=1.0, height=1.0).surfaces(2),
        lambda: tf.Plane(z=0.0, facing="+z").surfaces(2),
        lambda: tf.Sphere(centre=(0, 0), radius=1.0).surfaces(3),
        lambda: tf.Sphere(centre=torch.zeros(4, 2), radius=1.0).surfaces(3),
        lambda: tf.Sphere(centre=torch.zeros(2, 2, 2), radius=1.0),
        lambda: tf.Sphere(centre=torch.zeros(0, 2), radius=1.0),
        lambda: tf.Sphere(centre=[[0.0, 0.0], [0.0]], radius=1.0),
        lambda: tf.Sphere(centre=torch.tensor([[0.0, INF], [0.0, 0.0]]), radius=1.0),
        lambda: tf.Sphere(centre=(torch.zeros(2), torch.zeros(3)), radius=1.0),
        lambda: tf.Sphere(centre="here", radius=1.0),
        lambda: tf.Sphere(centre=1.0, radius=1.0),
        lambda: tf.Plane(point=(0, 0), normal=torch.tensor([[0.0, 1.0], [0.0, 0.0]])),
        lambda: tf.Plane(point=torch.zeros(2, 2), normal=torch.ones(3, 2)),
        lambda: tf.Plane(point=torch.zeros(2, 2), normal=(0, 0, 1)),
    ],
)
def test_walls_that_make_no_sense_are_refused(make):
    with pytest.raises(tf.InputError):
        make()


def test_a_wall_yields_where_it_does_so_in_one_colony():
    made = lambda **options: tf.Plane(y=0, facing="+y", **options).yields
    assert made(weight=[1.0, 0.5]) and made(weight=0.5) and made(stiffness=10.0)
    assert not made() and not made(weight=1.0) and not made(weight=[1.0, 1.0])


@pytest.mark.parametrize("where", [4.0, [4.0, 5.0]])
def test_a_tensor_that_turns_a_wall_inside_out_is_refused_in_the_next_step(where):
    """As an optimiser may, which changes tensors in place."""
    width, high = (torch.tensor(where, dtype=torch.float64) for _ in range(2))
    channel, box = tf.Channel(width=width), tf.Box((0.0, 0.0), (high, 9.0))
    assert len(channel.surfaces(2)) == 2 and len(box.surfaces(2)) == 4
    width.mul_(-1.0)
    high.mul_(-1.0)
    for wall, axis in ((channel, "y"), (box, "x")):
        with pytest.raises(tf.InputError, match=rf"walls of \w+ along {axis}.*inside out"):
            wall.surfaces(2)


def test_cells_behind_a_wall_are_refused_before_the_first_step():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(walls=[tf.Plane(x=1.0, facing="+x")]))
    with pytest.raises(tf.InputError, match="inside out"):
        scene.bind(2).start()


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [100, 1000])
def test_a_soft_wall_yields_as_the_documentation_says(stiffness):
    """The table of docs/mechanics.md, in its set-up, by one colony where it has four."""
    page = (Path(__file__).parents[2] / "docs" / "mechanics.md").read_text()
    said = float(re.search(rf"^\| {stiffness} \| ([\d.]+) \(", page, re.M).group(1))
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics([tf.Box((-6, -6), (6, 6), stiffness=stiffness)], dim=2, length_drag=10.0),
        dt=0.025,
    )
    depths = []
    for state in tf.simulate(scene, until=6.0):
        if state.step >= 200 and state.step % 4 == 0:
            half = 0.5 * state.length.double().unsqueeze(1) * state.axis.double()
            ends = torch.stack([state.position - half, state.position + half])
            depth = (ends.abs().amax(2) - 6.0 + state.radius).amax(0)
            depths.append(depth[depth > 0])
    # one colony has some ten cells at a wall, and the four differ by about a tenth
    assert float(torch.cat(depths).mean()) == pytest.approx(said, rel=0.3)

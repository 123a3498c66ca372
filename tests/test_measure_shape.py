"""Shape of colonies, and quantities between neighbours."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

import torchfilm as tf


def state_of(position, axis=(1.0, 0.0), **columns) -> tf.State:
    cells = tf.Cells(position, axis, **columns)
    return (
        tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=cells.dim)
        .bind(dtype=torch.float64)
        .start()
    )


def pixels(state: tf.State, size: float) -> np.ndarray:
    """The places, (M, 2), of the pixels that lie in cells, so wide."""
    half = 0.5 * state.length[:, None] * state.axis
    low, high = state.position.min() - 4.0, state.position.max() + 4.0
    line = torch.arange(float(low), float(high), size, dtype=torch.float64)
    grid = torch.cartesian_prod(line, line)
    covered = torch.zeros(len(grid), dtype=torch.bool)
    for place, arm, radius in zip(state.position, half, state.radius, strict=True):
        apart = grid - place
        along = ((apart @ arm) / (arm @ arm).clamp(min=1e-30)).clamp(-1.0, 1.0)
        covered |= (apart - along[:, None] * arm).norm(dim=1) <= radius
    return grid[covered].numpy()


ROD = [[0.0, 0.0]]
THREE = [[0.0, 0.0], [5.0, 1.0], [2.0, 4.0]]
AXES = [[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]


@pytest.mark.parametrize(
    ("position", "axis", "length"),
    [(ROD, (0.6, 0.8), 3.0), (THREE, AXES, [2.0, 3.0, 1.0]), ([[1.0, 1.0]], (1.0, 0.0), 0.0)],
)
def test_aspect_ratio_and_hull_are_those_of_an_image(position, axis, length):
    state = state_of(position, axis, length=length)
    seen = pixels(state, 0.02)
    variances = np.linalg.eigvalsh(np.cov(seen.T))
    expected = math.sqrt(variances[1] / variances[0])
    assert float(tf.measure.aspect_ratio(state)) == pytest.approx(expected, rel=5e-3)
    # the outermost pixels' middles lie up to a pixel within
    hull, found = ConvexHull(seen), tf.measure.hull(state)
    missing = 0.02 * hull.area
    assert hull.volume <= float(found.area) <= hull.volume + 1.1 * missing
    assert hull.area <= float(found.perimeter) <= hull.area + 1.1 * 2 * math.pi * 0.02
    solid = len(seen) * 0.02**2 / float(found.area)
    assert float(found.solidity) == pytest.approx(solid, abs=missing / hull.volume)
    circular = 4 * math.pi * float(found.area) / float(found.perimeter) ** 2
    assert float(found.circularity) == pytest.approx(circular, rel=1e-9)


def test_a_rod_has_the_hull_of_a_stadium():
    found = tf.measure.hull(state_of([[3.0, -2.0]], (0.6, 0.8), length=3.0, radius=0.5))
    assert float(found.area) == pytest.approx(3.0 + math.pi / 4, rel=1e-12)
    assert float(found.perimeter) == pytest.approx(6.0 + math.pi, rel=1e-12)
    assert float(found.solidity) == pytest.approx(1.0, rel=1e-12)


def test_cells_of_different_width_have_the_hull_of_their_discs():
    """Two discs of radius 1 and 2, 6 µm apart: a belt around two pulleys."""
    state = state_of([[0.0, 0.0], [6.0, 0.0]], length=0.0, radius=[1.0, 2.0])
    angle = math.asin(1.0 / 6.0)
    straight = 6.0 * math.cos(angle)
    found = tf.measure.hull(state)
    belt = 2 * straight + 2.0 * (math.pi + 2 * angle) + (math.pi - 2 * angle)
    area = straight * (1.0 + 2.0) + 2.0 * (math.pi + 2 * angle) + 0.5 * (math.pi - 2 * angle)
    assert float(found.perimeter) == pytest.approx(belt, rel=1e-3)
    assert float(found.area) == pytest.approx(area, rel=1e-3)


def test_colonies_stand_for_themselves_and_empty_ones_are_nan():
    cells = tf.Cells(
        [*THREE, [0.0, 0.0]], [*AXES, [1.0, 0.0]], [2.0, 3.0, 1.0, 2.0], colony=[0, 0, 0, 2]
    )
    scene = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=2)
    state = scene.bind(dtype=torch.float64).start()
    alone = state_of(THREE, AXES, length=[2.0, 3.0, 1.0])
    aspect, hull = tf.measure.aspect_ratio(state), tf.measure.hull(state)
    assert aspect[0] == tf.measure.aspect_ratio(alone)[0] and aspect[1].isnan()
    assert hull.area[0] == tf.measure.hull(alone).area[0] and hull.circularity[1].isnan()
    assert float(aspect[2]) > 2.0 and float(hull.solidity[2]) == pytest.approx(1.0)


def test_in_space_it_is_what_is_seen_from_above():
    flat = state_of([[0.0, 0.0]], (0.6, 0.8), length=1.5)
    tilted = state_of([[0.0, 0.0, 4.0]], (0.36, 0.48, 0.8), length=2.5)
    upright = state_of([[0.0, 0.0, 4.0]], (0.0, 0.0, 1.0), length=2.5)
    for measure in (tf.measure.aspect_ratio, lambda s: tf.measure.hull(s).area):
        assert float(measure(tilted)) == pytest.approx(float(measure(flat)), rel=1e-9)
    assert float(tf.measure.aspect_ratio(upright)) == pytest.approx(1.0)
    assert float(tf.measure.hull(upright).circularity) == pytest.approx(1.0)


def test_aspect_ratios_pass_derivatives():
    state = state_of(THREE, AXES, length=[2.0, 3.0, 1.0])

    def ratio(x):
        return tf.measure.aspect_ratio(state.replace(position=x))

    place = state.position.clone().requires_grad_()
    assert torch.autograd.gradcheck(ratio, place)


def test_morans_index():
    """A line of six touching cells: pairs of neighbours (0, 1), …, (4, 5)."""
    place = [[3.0 * k, 0.0] for k in range(6)]
    value = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    state = state_of(place, length=2.0, extra={"lit": value})
    apart = value - value.mean()
    expected = (apart[:-1] * apart[1:]).mean() / apart.var()
    assert float(tf.measure.moran(state, "lit", 0.1)) == pytest.approx(expected)
    checker = torch.tensor([1.0, -1.0] * 3, dtype=torch.float64)
    assert float(tf.measure.moran(state, checker, 0.1)) == pytest.approx(-1.0)
    assert tf.measure.moran(state, torch.ones(6), 0.1).isnan()
    many = state_of([[3.0 * (k % 50), 3.0 * (k // 50)] for k in range(200)])
    assert tf.measure.moran(many, torch.full((200,), 0.1, dtype=torch.float64), 0.5).isnan()
    assert tf.measure.moran(state_of([[0.0, 0.0], [30.0, 0.0]]), "length", 0.1).isnan()
    with pytest.raises(tf.InputError, match=r"moran\(name\) = 'dark'"):
        tf.measure.moran(state, "dark", 0.1)


def test_morans_index_of_shuffled_cells_is_about_zero():
    cells = tf.inoculum(300, 30.0, seed=1)
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=2).bind().start()
    drawn = torch.from_numpy(np.random.default_rng(0).normal(size=(40, 300)))
    found = torch.stack([tf.measure.moran(state, x, 1.0)[0] for x in drawn])
    assert abs(float(found.mean()) + 1 / 299) < 4 * float(found.std()) / 40**0.5


def test_a_periodic_space_has_no_hull():
    faces = {"x": (-20.0, 20.0)}
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, periodic=faces))
    for name in ("hull", "aspect_ratio"):
        with pytest.raises(tf.InputError, match=f"{name} goes by places"):
            getattr(tf.measure, name)(scene.bind().start())


def test_the_radius_of_a_colony_counts_cells_by_their_volume():
    """So does its centre: of a large cell and a small one both are near the large one."""
    state = state_of([[0.0, 0.0], [6.0, 0.0]], length=[5.0, 0.0], radius=[1.0, 0.5])
    volume = np.array([math.pi * 5.0 + 4 / 3 * math.pi, math.pi / 6])
    centre = 6.0 * volume[1] / volume.sum()
    square = (volume * (np.array([0.0, 6.0]) - centre) ** 2).sum() / volume.sum()
    found = tf.measure.colony_radius(state)
    assert found.tolist() == pytest.approx([math.sqrt(2 * square)], rel=1e-12)


def disc(radius, count, seed=0):
    """Cells of all directions, evenly in a disc."""
    random = np.random.default_rng(seed)
    r, way = radius * np.sqrt(random.random(count)), 2 * np.pi * random.random((2, count))
    places = np.stack([3.0 + r * np.cos(way[0]), r * np.sin(way[0]) - 2.0], 1)
    axes = np.stack([np.cos(way[1]), np.sin(way[1])], 1)
    return tf.Scene(tf.Mechanics(dim=2), founders=tf.Cells(places, axes, 2.0)).bind().start()


@pytest.mark.filterwarnings("ignore:.*deep in one another")
def test_the_edge_of_a_disc_is_its_circle():
    """The moments of rods reach a little beyond the disc in which their centres lie."""
    state = disc(20.0, 4000)
    found = tf.measure.outline(state)
    assert found.centre[0].tolist() == pytest.approx([3.0, -2.0], abs=0.5)
    assert found.half_axes[0].tolist() == pytest.approx([20.0, 20.0], rel=0.03)
    away = (state.position - found.centre).norm(dim=1)
    radius = found.half_axes.mean()
    assert torch.allclose(tf.measure.below_edge(state), radius - away, atol=0.4)
    edges = [0.0, 5.0, 10.0, 15.0]
    depth = tf.measure.profile(state, tf.measure.below_edge(state), edges, along="edge")
    assert depth[0].tolist() == pytest.approx([2.4, 7.3, 12.2], abs=0.3)


def test_an_edge_in_a_periodic_space_is_refused():
    scene = tf.Scene(tf.Mechanics(dim=2, periodic={"x": (0.0, 40.0)}))
    for measure in (tf.measure.outline, tf.measure.below_edge):
        with pytest.raises(tf.InputError, match=f"{measure.__name__} .*periodic along x or y"):
            measure(scene.bind().start())


def test_the_depth_of_a_colony_is_from_its_lowest_end_to_its_highest():
    """The ends may be those of different cells, of which the upper one stands upright."""
    state = state_of(
        [[0.0, 0.0, 0.0], [0.0, 0.0, 5.0], [9.0, 0.0, 7.0]],
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.6, 0.8]],
        length=[2.0, 4.0, 1.0], radius=0.5, colony=[0, 0, 1],
    )  # fmt: skip
    assert tf.measure.depth(state).tolist() == pytest.approx([8.0, 1.8])


@pytest.mark.parametrize("length", [0.0, 0.7, 2.0])
def test_the_outline_of_one_cell_has_the_second_moments_of_a_capsule(length):
    """By quadrature over discs across the cell; a ball has a circle."""
    r = 0.5
    x = (np.arange(200_000) + 0.5) / 200_000 * (length + 2 * r) - length / 2 - r
    disc = r * r - np.clip(np.abs(x) - length / 2, 0, None) ** 2  # of squared radius, at x
    along, across = np.average(x * x, weights=disc), np.average(disc / 4, weights=disc)
    cells = tf.Cells([[3.0, 1.0]], [[0.6, 0.8]], length=length, radius=r)
    found = tf.measure.outline(tf.Scene(tf.Growth(rate=1.0), dim=2).bind(cells=cells).start())
    assert found.half_axes[0].tolist() == pytest.approx([2 * along**0.5, 2 * across**0.5], rel=1e-6)

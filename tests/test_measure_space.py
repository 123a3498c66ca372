"""Profiles along a coordinate and correlations by distance, against fields that are known."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

import torchfilm as tf

EDGES = [0.0, 2.0, 4.0, 6.0, 8.0]


def lawn(values, place, periodic=None, colony=None) -> tf.State:
    place = np.asarray(place, dtype=float)
    cells = tf.Cells(place, np.eye(place.shape[1])[0], 0.0, 0.5, colony=colony, extra={"y": values})
    scene = tf.Scene(tf.Mechanics(dim=place.shape[1], periodic=periodic or {}))
    return scene.bind(cells.colonies, cells=cells, dtype=torch.float64).start()


def lattice(size=20):
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(*[np.arange(size)] * 2, indexing="ij"))
    return np.stack([x, y], 1).astype(float)


def test_a_profile_is_the_mean_of_each_bin():
    place = lattice(8)
    state = lawn(place[:, 0] * 10 + place[:, 1], place)
    along_x = tf.measure.profile(state, "y", EDGES)
    assert along_x[0].tolist() == pytest.approx([10 * m + 4.0 for m in (1, 3, 5, 7)])
    along_y = tf.measure.profile(state, "y", [0, 4, 8, 12], along="y")
    assert along_y[0, :2].tolist() == pytest.approx([42.0, 46.0]) and bool(along_y[0, 2].isnan())
    own = tf.measure.profile(state, state.position[:, 1], EDGES, along=8.0 - state.position[:, 0])
    assert own[0].tolist() == pytest.approx([4.0] * 4)
    radius = np.hypot(*(place - 4.0).T)
    ring = tf.measure.profile(state, torch.as_tensor(radius), [0, 2, 9], along="radius")
    assert ring[0].tolist() == pytest.approx(
        [radius[radius < 2].mean(), radius[radius >= 2].mean()]
    )
    film = lawn(place[:, 1], place, {"x": (0.0, 8.0)})
    below = tf.measure.profile(film, "y", EDGES, along="top")
    assert below[0].tolist() == pytest.approx([7.0, 5.0, 3.0, 1.0])


@pytest.mark.parametrize("name", ["length", "radius", "volume"])
def test_sizes_of_cells_have_profiles(name):
    rods = tf.Cells(lattice(8), np.array([1.0, 0.0]), np.linspace(1.0, 3.0, 64), 0.4)
    state = tf.Scene(tf.Growth(rate=1.0), dim=2).bind(cells=rods, dtype=torch.float64).start()
    found = tf.measure.profile(state, name, EDGES)
    assert found[0].tolist() == pytest.approx(getattr(state, name).view(4, 16).mean(1).tolist())


def test_signals_at_cells_have_profiles():
    scene = tf.Scene(
        tf.Medium(
            m=tf.Signal(0.0, initial=lambda p: p[:, 0].clamp(min=0)), box=((0, 0), (8, 8)),
            spacing=1.0,
        ),
        dim=2, founders=tf.Cells(lattice(8), np.array([1.0, 0.0]), 0.0),
    )  # fmt: skip
    found = tf.measure.profile(scene.bind(dtype=torch.float64).start(), "out.m", EDGES)
    assert found[0].tolist() == pytest.approx([1.0, 3.0, 5.0, 7.0])


def test_the_correlation_of_a_wave_has_its_wavelength():
    """y = cos(2πx/10) on a periodic lattice: pairs at (a, b) have cos(2πa/10), exactly."""
    place = lattice()
    state = lawn(np.cos(2 * math.pi * place[:, 0] / 10), place, {"x": (0, 20), "y": (0, 20)})
    edges = np.arange(0.75, 9.0, 0.5)
    found = tf.measure.correlation(state, "y", edges)[0]
    a, b = (v.ravel() for v in np.meshgrid(*[np.arange(-9, 11)] * 2))
    r = np.hypot(a, b)
    for low, high, value in zip(edges, edges[1:], found.tolist(), strict=False):
        wave = np.cos(2 * math.pi * a[(r >= low) & (r < high)] / 10)
        wanted = wave.mean() if len(wave) else math.nan
        assert value == pytest.approx(wanted, abs=1e-9, nan_ok=True), low


def test_noise_has_no_correlation_and_equal_pairs_have_one():
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 40, (1500, 2))
    noise = tf.measure.correlation(lawn(rng.normal(size=1500), place), "y", [0, 2, 5, 10])[0]
    pairs = [np.pi * (b * b - a * a) * 1500**2 / 1600 / 2 for a, b in ((0, 2), (2, 5), (5, 10))]
    # −1/N on average, as the mean of all is taken off
    assert all(abs(v) < 4 / math.sqrt(n) + 1e-3 for v, n in zip(noise.tolist(), pairs, strict=True))
    twins = np.repeat(place[:100], 2, 0) + np.tile([[0.0, 0.0], [0.01, 0.0]], (100, 1))
    same = lawn(np.repeat(rng.normal(size=100), 2), twins)
    assert float(tf.measure.correlation(same, "y", [0, 0.1])) == pytest.approx(1.0)


@pytest.mark.parametrize("periodic", [None, {"x": (-3.0, 17.0)}])
@pytest.mark.parametrize("edges", [[0.0, 1.0, 3.0, 30.0], [0.5, 2.0, 4.0]])
def test_the_correlation_is_the_sum_over_all_pairs(periodic, edges):
    """Also of cells at one place, at the edge of a bin, and beyond a face."""
    rng = np.random.default_rng(3)
    place = np.r_[rng.uniform(-2, 16, (60, 2)), [[1.0, 1.0]] * 3, [[2.0, 1.0], [3.0, 3.0]]]
    y = rng.normal(size=len(place))
    x = place[:, None] - place
    if periodic is not None:
        x[..., 0] -= 20.0 * np.round(x[..., 0] / 20.0)
    r, product = np.hypot(*x.transpose(2, 0, 1)), np.multiply.outer(y - y.mean(), y - y.mean())
    others = ~np.eye(len(y), dtype=bool)
    wanted = [
        product[(r >= low) & (r < high) & others].mean() / y.var()
        for low, high in itertools.pairwise(edges)
    ]
    found = tf.measure.correlation(lawn(y, place, periodic), "y", torch.tensor(edges))
    assert found[0].tolist() == pytest.approx(wanted, rel=1e-9)


def test_a_bin_without_pairs_is_none():
    place = np.stack([np.arange(200.0), np.zeros(200)], 1)
    y = np.random.default_rng(0).normal(size=200)
    found = tf.measure.correlation(lawn(y, place), "y", [0.0, 0.5, 1.5])[0]
    assert bool(found[0].isnan()) and bool(found[1].isfinite())


def test_a_cell_just_below_a_face_is_within():
    below = np.nextafter(1.7, -np.inf)
    place = np.array([[below, 0.0], [-3.2, 0.0], [0.0, 0.0]])
    found = tf.measure.correlation(
        lawn(np.array([1.0, 2.0, -3.0]), place, {"x": (-3.3, 1.7)}), "y", [0.0, 0.2]
    )
    assert float(found) == pytest.approx(2.0 / (14 / 3))


def test_colonies_do_not_see_one_another():
    rng = np.random.default_rng(1)
    place, owner = rng.uniform(0, 10, (90, 2)), np.repeat([0, 1, 2], 30)
    state = lawn(rng.normal(size=90), place, colony=owner)
    both = [m(state, "y", EDGES) for m in (tf.measure.profile, tf.measure.correlation)]
    alone = state.select([1])
    for whole, m in zip(both, (tf.measure.profile, tf.measure.correlation), strict=True):
        assert torch.equal(m(alone, "y", EDGES)[0], whole[1])
    flat = lawn(np.ones(5), rng.uniform(0, 5, (5, 2)))
    assert bool(tf.measure.correlation(flat, "y", EDGES).isnan().all())


@pytest.mark.parametrize("count", [7, 5000])
@pytest.mark.parametrize("level", [0.1, 0.7, 1.1])
def test_equal_numbers_have_no_correlation(level, count):
    """Also where their mean is rounded, so that each is off it by as much, the more cells the more:
    that is no pattern."""
    place = np.random.default_rng(2).uniform(0, 5 * (count / 7) ** 0.5, (count, 2))
    flat = lawn(np.full(count, level), place)
    assert bool(tf.measure.correlation(flat, "y", EDGES).isnan().all())
    assert bool(tf.measure.moran(flat, "y", 3.0).isnan().all())


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: tf.measure.profile(s, "gfp", EDGES), r"profile\(name\) = 'gfp'.*one of 'y'"),
        (lambda s: tf.measure.profile(s, torch.ones(2), EDGES), r"profile\(name\) = \(2,\)"),
        (lambda s: tf.measure.profile(s, "y", [3.0]), r"profile\(edges\) = \[3.0\].*two or more"),
        (lambda s: tf.measure.profile(s, "y", [3, 1]), r"profile\(edges\) .*ascending"),
        (lambda s: tf.measure.profile(s, "y", EDGES, along="z"), r"profile\(along\) = 'z'.*'top'"),
        (lambda s: tf.measure.correlation(s, "y", [-1, 1]), r"correlation\(edges\) = -1"),
        (lambda s: tf.measure.correlation(s, "out.a", EDGES), r"correlation\(name\) = 'out.a'"),
    ],
)
def test_what_has_no_place_is_refused(call, words):
    with pytest.raises(tf.InputError, match=words):
        call(lawn(np.ones(4), lattice(2)))

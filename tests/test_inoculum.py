"""Founders at random places."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import torchfilm as tf


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_are_scattered_evenly_and_none_overlap(dim):
    cells = tf.inoculum(60, radius=20.0, colonies=10, dim=dim, seed=3)
    distance = np.linalg.norm(cells.position, axis=1)
    assert cells.overlaps() == [] and distance.max() <= 20.0
    assert np.allclose(np.linalg.norm(cells.axis, axis=1), 1.0)
    # evenly in the disc or ball: (r/R)^d is uniform; five standard errors of 600 numbers
    share = (distance / 20.0) ** dim
    assert share.mean() == pytest.approx(0.5, abs=5 / np.sqrt(12 * 600))
    assert np.abs(cells.axis.mean(0)).max() < 5 / np.sqrt(dim * 600)


@pytest.mark.parametrize(("dim", "count", "radius"), [(2, 100, 15.0), (3, 120, 6.5)])
def test_dense_cells_find_room(dim, count, radius):
    """Two fifths of a disc, a quarter of a ball: cells that have a place keep it."""
    cells = tf.inoculum(count, radius=radius, dim=dim)
    assert cells.overlaps() == []
    assert np.linalg.norm(cells.position, axis=1).max() <= radius


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_are_scattered_evenly_in_a_box(dim):
    low, high = np.array([10.0, -3.0, 0.0][:dim]), np.array([50.0, 3.0, 20.0][:dim])
    cells = tf.inoculum(30, box=(low, high), colonies=20, dim=dim, seed=2)
    share = (cells.position - low) / (high - low)
    assert cells.overlaps() == [] and share.min() >= 0.0 and share.max() <= 1.0
    # five standard errors of 600 even numbers, and of their spread
    assert np.abs(share.mean(0) - 0.5).max() < 5 / np.sqrt(12 * 600)
    assert share.std(0) == pytest.approx([1 / np.sqrt(12)] * dim, rel=0.1)
    assert np.abs(cells.axis.mean(0)).max() < 5 / np.sqrt(dim * 600)


def test_a_disc_may_lie_elsewhere():
    here, there = (tf.inoculum(20, 9.0, centre=at, seed=1) for at in (None, (30.0, -4.0)))
    assert np.allclose(there.position, here.position + np.array([30.0, -4.0]))
    assert np.array_equal(there.axis, here.axis)
    flat = tf.inoculum(20, box=((0, 0), (30, 8)), dim=3, floor=0.0)
    assert (flat.position[:, 2] == 0.5).all() and flat.position[:, 1].max() <= 8.0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, r"radius = None .* given, or box="),
        ({"radius": 5.0, "box": ((0, 0), (9, 9))}, "radius = 5.0 .* left out with a box"),
        ({"box": ((0, 0), (9, 9)), "centre": (1, 1)}, "centre = .* left out with a box"),
        ({"box": ((0, 9), (9, 0))}, "box = .* the lower corner first"),
        ({"box": ((0, 0, 0), (9, 9, 9))}, r"box\[0\]"),
        ({"box": 7.0}, "box = 7.0 .* the lower and the upper corner"),
        ({"radius": 5.0, "centre": (1, 2, 3)}, "centre"),
        ({"box": ((0, 0), (9, 2))}, "box = .* wide enough .* give a greater box"),
    ],
)
def test_places_that_cannot_be_are_refused(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.inoculum(40, **given)


def test_cells_lie_on_a_floor():
    cells = tf.inoculum(40, radius=12.0, dim=3, floor=-1.0, cell_radius=0.4, colonies=2, seed=5)
    flat = tf.inoculum(40, radius=12.0, cell_radius=0.4, colonies=2, seed=5)
    assert (cells.position[:, 2] == -0.6).all() and (cells.axis[:, 2] == 0.0).all()
    assert np.array_equal(cells.position[:, :2], flat.position) and cells.overlaps() == []
    wall = tf.Plane(z=-1.0, facing="+z")
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=3, walls=[wall]), founders=cells)
    assert float(tf.measure.overlaps(scene.bind(2).start(), [wall]).walls.max()) < 1e-6


def test_lengths_are_drawn_or_given():
    """Cells of all lengths do not divide all at once. Places of one length stay what they were."""
    spread = tf.inoculum(500, 60.0, length=tf.Uniform(1.0, 3.0), colonies=2)
    lengths = np.asarray(spread.length).reshape(2, 500)
    assert lengths.min() >= 1.0 and lengths.max() <= 3.0 and (lengths[0] != lengths[1]).any()
    np.testing.assert_allclose(lengths.mean(1), 2.0, atol=5 * 2 / np.sqrt(12 * 500))
    assert spread.overlaps() == []
    first = tf.inoculum(500, 60.0, length=tf.Uniform(1.0, 3.0))
    assert np.array_equal(np.asarray(first.length), lengths[0])
    given = tf.inoculum(3, 20.0, length=[1.0, 2.0, 3.0], colonies=2)
    assert np.asarray(given.length).tolist() == [1.0, 2.0, 3.0] * 2
    one, other = tf.inoculum(30, 15.0), tf.inoculum(30, 15.0, length=[2.0] * 30)
    assert np.array_equal(np.asarray(one.position), np.asarray(other.position))


def test_shares_of_types():
    cells = tf.inoculum(31, radius=30.0, types={0: 0.9, 2: 0.1}, colonies=5, seed=1)
    kinds = cells.cell_type.reshape(5, 31)
    assert [(k == 2).sum() for k in kinds] == [3] * 5 and set(kinds.ravel()) == {0, 2}
    assert len({tuple(k) for k in kinds}) == 5, "who is of which type is drawn"
    assert np.bincount(tf.inoculum(3, 30.0, types={0: 0.5, 1: 0.5}).cell_type).sum() == 3


@pytest.mark.parametrize(("dim", "floor"), [(2, None), (3, 1.0)])
def test_sizes_of_types(dim, floor):
    """Round cells of 2 µm beside rods; none overlap, and on a floor each lies on it."""
    founders = tf.inoculum(
        20, 20.0, types={0: 0.8, 1: 0.2}, cell_radius={0: 0.5, 1: 2.0},
        length={0: tf.Uniform(2, 4), 1: 0.0}, colonies=2, dim=dim, floor=floor, seed=3,
    )  # fmt: skip
    large = founders.cell_type == 1
    assert int(large.sum()) == 8 and set(founders.radius[large].tolist()) == {2.0}
    assert set(founders.radius[~large].tolist()) == {0.5}
    rods = founders.length[~large]
    assert bool((founders.length[large] == 0).all()) and len(set(rods.tolist())) == 32
    assert 2 <= float(rods.min()) < float(rods.max()) <= 4
    assert len(founders.overlaps()) == 0
    if floor is not None:
        assert np.allclose(founders.position[:, 2], floor + founders.radius)


def test_a_colony_is_the_same_among_others():
    one = tf.inoculum(12, radius=12.0, types={0: 0.5, 1: 0.5}, seed=4)
    many = tf.inoculum(12, radius=12.0, types={0: 0.5, 1: 0.5}, colonies=3, seed=4)
    assert np.array_equal(one.position, many.position[:12]) and one.colony is None
    assert np.array_equal(one.cell_type, many.cell_type[:12])
    assert not np.array_equal(many.position[:12], many.position[12:24])
    other = tf.inoculum(12, radius=12.0, seed=5)
    assert not np.array_equal(one.position, other.position)


def test_colonies_grow_from_it():
    founders = tf.inoculum(5, radius=8.0, types={0: 0.4, 1: 0.6}, colonies=2)
    scene = tf.Scene(
        tf.Growth(rate={0: 1.0, 1: 1.2}), tf.Division(length=4.0), tf.Mechanics(dim=2),
        founders=founders,
    )  # fmt: skip
    *_, state = tf.simulate(scene, cells=20)
    assert state.colonies == 2 and int(state.counts.min()) >= 20


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"types": {0: 0.5, 1: 0.4}}, "sum to 1. Their sum is 0.9"),
        ({"types": {0: 1.5}}, r"types\[0\] = 1.5"),
        ({"types": {-1: 1.0}}, "types = -1"),
        ({"types": [0, 1]}, "a share for each cell type"),
        ({"radius": 2.0}, "30 cells of length 2 and radius 0.5 µm would fill 426% of it, and"),
        ({"count": 0}, "count = 0"),
        ({"dim": 4}, "dim = 4"),
        ({"floor": 0.0}, "floor = 0.0 .*left out with dim=2"),
        ({"dim": 3, "floor": np.inf}, "floor = inf"),
        ({"colonies": 0}, "colonies = 0"),
        ({"length": -1.0}, "length = -1"),
        ({"length": tf.Uniform(-1.0, 2.0)}, "length.low = -1.0 is not allowed"),
        ({"length": tf.Uniform([1.0, 2.0], 3.0)}, "length.low"),
        ({"length": tf.Normal(2.0, 0.1)}, "length = Normal.*one length for each of the 30 cells"),
        ({"length": [1.0, 2.0]}, "one length for each of the 30 cells, each finite"),
        ({"length": ["a"] * 30}, "one length for each of the 30 cells"),
        ({"length": [[1.0], [1.0, 2.0]]}, "one length for each of the 30 cells"),
        ({"length": "2"}, "length = '2' is not allowed"),
        ({"fractions": {0: 1.0}}, "no parameter 'fractions'"),
        ({"length": {0: 1.0}}, r"length = \{0: 1.0\}.*one number where there are no types.*types="),
        ({"length": {0: 1.0}, "types": {0: 0.5, 1: 0.5}}, "a value for each of the types 0, 1"),
        ({"cell_radius": {0: 1.0, 1: 0.0}, "types": {0: 0.5, 1: 0.5}}, r"cell_radius\[1\] = 0"),
        ({"length": {0: 1.0, 1: -1.0}, "types": {0: 0.5, 1: 0.5}}, r"length\[1\] = -1"),
        ({"length": {0: tf.Uniform(-1, 1)}, "types": {0: 1.0}}, r"length\[0\].low = -1"),
    ],
)
def test_what_is_no_inoculum(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.inoculum(**{"count": 30, "radius": 15.0, **given})


# --- numbers of each type, and variables ----------------------------------------------------------


def test_types_may_be_numbers_of_cells():
    founders = tf.inoculum(30, 15.0, types={0: 3, 1: 27}, colonies=2)
    kinds = founders.cell_type.reshape(2, 30)
    assert (kinds == 0).sum(1).tolist() == [3, 3]
    same = tf.inoculum(30, 15.0, types={0: 0.1, 1: 0.9}, colonies=2)
    assert np.array_equal(founders.cell_type, same.cell_type)
    assert np.bincount(tf.inoculum(2, 9.0, types={0: 1, 1: 1}).cell_type).tolist() == [1, 1]
    assert set(tf.inoculum(5, 9.0, types={0: 1, 1: 0}).cell_type) == {0}  # shares
    with pytest.raises(tf.InputError, match=r"sum to the count, 30, .*Their sum is 29"):
        tf.inoculum(30, 15.0, types={0: 3, 1: 26})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tf.inoculum(300, 60.0, types={0: np.uint8(250), 1: np.uint8(50)})
    with pytest.raises(tf.InputError, match=r"types\[0\] = -3"):
        tf.inoculum(30, 15.0, types={0: -3, 1: 33})


def test_a_share_of_which_no_cell_comes_is_warned_of():
    with pytest.warns(UserWarning, match=r"types\[0\] is so small a share of the cells"):
        founders = tf.inoculum(30, 15.0, types={0: 0.01, 1: 0.99})
    assert set(founders.cell_type) == {1}
    tf.inoculum(30, 15.0, types={0: 0.0, 1: 1.0})  # none is wanted


def test_variables_may_differ_by_type():
    given = {"plasmids": {0: 4, 1: 0}, "age": 1.5}
    founders = tf.inoculum(6, 9.0, types={0: 2, 1: 4}, colonies=2, extra=given)
    state = tf.Scene(tf.Growth(), founders=founders, dim=2).bind(2).start()
    assert torch.equal(state.plasmids, 4.0 * (state.cell_type == 0))
    assert (state.age == 1.5).all()
    with pytest.raises(
        tf.InputError, match=r"extra\['plasmids'\] = .*a value for each of the types"
    ):
        tf.inoculum(6, 9.0, types={0: 2, 1: 4}, extra={"plasmids": {0: 4}})
    with pytest.raises(tf.InputError, match=r"extra\['plasmids'\]\[1\] = 'few'"):
        tf.inoculum(6, 9.0, types={0: 2, 1: 4}, extra={"plasmids": {0: 4, 1: "few"}})
    with pytest.raises(tf.InputError, match=r"extra = 3 .*names"):
        tf.inoculum(6, 9.0, extra={3: 1.0})
    with pytest.raises(tf.InputError, match=r"extra = 4 .*numbers by name"):
        tf.inoculum(6, 9.0, extra=4)

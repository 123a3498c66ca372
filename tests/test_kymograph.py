"""Kymographs: the means that are drawn, where and when, and what cannot be drawn."""

from __future__ import annotations

import numpy as np
import pytest

import torchfilm as tf

PLACES = [[-1.5, 0.0], [-1.25, 0.0], [2.5, 0.0], [0.5, 4.5]]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two colonies of four cells at rest, whose level is 2x + t, and a signal that is y."""
    path = tmp_path_factory.mktemp("kymograph") / "run.h5"

    def rise(cells):
        cells.level = 2.0 * cells.position[:, 0] + cells.time

    scene = tf.Scene(
        tf.Rules(update=rise, variables={"level": 0.0}),
        tf.Medium(
            m=tf.Signal(0.0, initial=lambda p: p[:, 1].clamp(min=0)), box=((-6, -6), (6, 6)),
            spacing=1.0,
        ),
        founders=tf.Cells(PLACES * 2, [1.0, 0.0], 0.0, colony=[0] * 4 + [1] * 4), dim=2, dt=0.1,
    )  # fmt: skip
    for _ in tf.simulate(scene, until=0.4, record=tf.Recorder(path, scene, every=2)):
        pass
    return path


def mesh(picture):
    return picture.figure.axes[0].collections[0]


def test_means_by_place_and_time(run):
    drawn = mesh(tf.pictures.kymograph(run, "level", edges=[-2, 0, 1, 2, 3]))
    values = drawn.get_array().filled(np.nan)
    at = np.array([-2.75, 1.0, np.nan, 5.0])  # of the cells in each bin, but for the time
    late = np.array([[0.1], [0.3]])  # rules of a step have the time of its beginning
    np.testing.assert_allclose(values[1:], at + late, atol=1e-6)
    np.testing.assert_allclose(drawn.get_coordinates()[:, 0, 1], [0.0, 0.1, 0.3, 0.4], atol=1e-9)
    np.testing.assert_allclose(drawn.get_coordinates()[0, :, 0], [-2, 0, 1, 2, 3])


def test_bins_are_those_where_cells_are_and_signals_and_radii(run, tmp_path):
    drawn = mesh(tf.pictures.kymograph(run, "out.m", along="y", colony=1, out=tmp_path / "k.png"))
    np.testing.assert_allclose(drawn.get_coordinates()[0, :, 0], np.arange(0, 6))
    np.testing.assert_allclose(drawn.get_array().filled(np.nan)[-1], [0.25, *[np.nan] * 3, 4.5])
    assert (tmp_path / "k.png").stat().st_size > 1000
    place = np.array(PLACES)
    radius = np.hypot(*(place - place.mean(0)).T)
    ring = mesh(tf.pictures.kymograph(run, "radius", along="radius"))
    assert ring.get_coordinates()[0, -1, 0] == np.floor(radius.max()) + 1
    there = np.flatnonzero(np.isfinite(ring.get_array().filled(np.nan)[0]))
    assert {*there + np.floor(radius.min())} == {*np.floor(radius)}


def test_the_words_and_the_range(run):
    picture = tf.pictures.kymograph(run, "level", limits=(-1.0, 1.0))
    axes = picture.figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (µm)", "time (h)")
    assert axes.get_title() == "level, colony 0" and axes.yaxis_inverted()
    assert mesh(picture).get_clim() == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"quantity": "gfp"}, "quantity = 'gfp'.*one of .*level.*out.m"),
        ({"along": "z"}, "along = 'z'.*'radius'"),
        ({"colony": 5}, "colony = 5.*one of 0, 1"),
        ({"edges": [2.0, 1.0]}, r"kymograph\(edges\) .*ascending"),
        ({"limits": 3.0}, "limits = 3.0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(run, given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.pictures.kymograph(run, **{"quantity": "level", **given})


def test_a_run_without_cells_has_none(tmp_path):
    none = tf.Scene(tf.Growth(rate=1.0), dim=2, founders=tf.Cells(np.zeros((0, 2)), [1.0, 0.0]))
    list(tf.simulate(none, until=0.1, record=tmp_path / "b.h5"))
    with pytest.raises(tf.InputError, match="no cell in any frame"):
        tf.pictures.kymograph(tmp_path / "b.h5", "length")


def still(path, select=None, place=((-3.0, 0.0), (3.0, 0.0)), length=(0.0, 4.0)):
    """Two colonies at rest, of these cells and of two as long as 1 µm, in this order."""
    cells = tf.Cells([*place] * 2, [1.0, 0.0], [*length, 1.0, 1.0], colony=[0, 0, 1, 1])
    scene = tf.Scene(tf.Growth(rate=0.0), founders=cells, dim=2, dt=0.1)
    state = scene.bind().start()
    state = state if select is None else state.select(select)
    tf.simulate(scene, state, until=0.3, record=tf.Recorder(path, scene, every=1)).last()
    return path


def drawn(picture) -> np.ndarray:
    return mesh(picture).get_array().filled(np.nan)


def test_a_colony_goes_by_its_id(tmp_path):
    path = still(tmp_path / "swapped.h5", select=[1, 0])
    for colony, wanted in ((0, {0.0, 4.0}), (1, {1.0}), (None, {1.0})):
        given = {} if colony is None else {"colony": colony}
        last = drawn(tf.pictures.kymograph(path, "length", **given))[-1]
        assert {*last[np.isfinite(last)]} == wanted
    alone = still(tmp_path / "alone.h5", select=[1])
    assert len(drawn(tf.pictures.kymograph(alone, "length", colony=1))) == 4


def test_the_centre_is_that_of_the_volume(tmp_path):
    path = still(tmp_path / "run.h5")
    edges = mesh(tf.pictures.kymograph(path, "length", along="radius")).get_coordinates()[0, :, 0]
    volume = np.pi * 0.25 * np.array([0.0, 4.0]) + 4 / 3 * np.pi * 0.125
    x = np.array([-3.0, 3.0])
    far = abs(x - (volume * x).sum() / volume.sum())
    assert edges[0] == np.floor(far.min()) and edges[-1] == np.floor(far.max()) + 1


@pytest.mark.parametrize("edges", [[-20.0, -10.0], [10.0, 20.0]])
def test_a_range_without_cells_is_refused(tmp_path, edges):
    path = still(tmp_path / "run.h5")
    with pytest.raises(tf.InputError, match="a range with cells"):
        tf.pictures.kymograph(path, "length", edges=edges)


def test_edges_are_several_and_names_as_they_are_written(tmp_path):
    path = still(tmp_path / "run.h5")
    with pytest.raises(tf.InputError, match=r"edges\) = 10.*two or more, µm, ascending. Such as"):
        tf.pictures.kymograph(path, "length", edges=10)
    with pytest.raises(tf.InputError, match="Did you mean 'length'"):
        tf.pictures.kymograph(path, "LENGTH")


def test_a_frame_without_cells_is_empty(tmp_path):
    path = tmp_path / "gone.h5"
    scene = tf.Scene(tf.Growth(rate=0.0), founders=tf.Cells(PLACES, [1.0, 0.0]), dim=2, dt=0.1)
    run = tf.simulate(scene, until=0.4, record=tf.Recorder(path, scene, every=1))
    state = next(run)
    run.send(state.remove(state.length >= 0.0, "removed"))
    run.last()
    found = drawn(tf.pictures.kymograph(path, "length", along="radius"))
    assert np.isfinite(found[0]).any() and np.isnan(found[-1]).all()

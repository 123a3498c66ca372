"""Cells over their micrograph, overlaps at the start, and how they are pushed apart."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from rasterised import rasterised

import torchfilm as tf
from torchfilm.pictures.micrograph import OVERLAP, PLAIN

pytest.importorskip("matplotlib")

SHAPE = (60, 80)
TABLE = {
    "cx": [20.0, 22.0, 60.0], "cy": [20.0, 27.0, 40.0], "a": [0.0, 0.1, 1.2], "L": [20.0] * 3,
    "id": [11, 12, 13],
}  # fmt: skip


def cells(**options) -> tf.Cells:
    names = {"x": "cx", "y": "cy", "angle": "a", "length": "L", "label": "id"}
    given = {"pixel_size": 0.1, "columns": names, "y": "down", "radius": 0.5, **options}
    given["angle_unit"] = "radians"
    return tf.Cells.from_table(TABLE, **given)


def pixels(path) -> np.ndarray:
    from matplotlib.image import imread

    return imread(path)[..., :3]


def coloured(path, colour: str) -> np.ndarray:
    """(n, 2) where a picture is near a colour, as shares of its height and width."""
    from matplotlib.colors import to_rgb

    picture = pixels(path)
    return np.argwhere(np.abs(picture - to_rgb(colour)).max(-1) < 0.15) / picture.shape[:2]


def test_outlines_lie_over_the_cells_of_the_image(tmp_path):
    """Apart from the image, cells of an upright micrograph are where its bright pixels are."""
    mask = rasterised([15, 60], [12, 45], [0.5, 0.5], [14, 14], [5, 5], SHAPE)
    pytest.importorskip("skimage")
    found = tf.Cells.from_masks(mask, pixel_size=0.1)
    path = tf.pictures.overlay(found, mask, tmp_path / "check.png").path
    assert path == tmp_path / "check.png" and not len(coloured(path, OVERLAP))
    outline = coloured(path, PLAIN)
    upper, lower = outline[outline[:, 1] < 0.5], outline[outline[:, 1] >= 0.5]
    # the upper left cell is at row 12 of 60, column 15 of 80; the lower one at row 45, column 60
    assert 0.1 < upper[:, 0].mean() < 0.35 and upper[:, 1].mean() == pytest.approx(
        15 / 80, abs=0.03
    )
    assert 0.6 < lower[:, 0].mean() < 0.8 and lower[:, 1].mean() == pytest.approx(60 / 80, abs=0.03)


def test_outlines_and_names_are_at_the_pixels_of_the_cells():
    """Also where cells lie askew: an outline holds the pixels of its cell, and no other ones."""
    from matplotlib.path import Path

    mask = rasterised([20, 55], [20, 40], [0.6, -1.0], [24, 20], [6, 6], SHAPE)
    mask = np.where(mask == 1, 7, np.where(mask == 2, 4, 0))
    pytest.importorskip("skimage")
    found = tf.Cells.from_masks(mask, pixel_size=0.1)
    ax = tf.pictures.overlay(found, mask, labels=True).figure.axes[0]
    assert ax.images[0].get_extent() == pytest.approx((-0.05, 7.95, 5.95, -0.05))
    rows, columns = np.indices(SHAPE)
    places = 0.1 * np.stack([columns, rows], -1).reshape(-1, 2)
    named = {}
    for text in ax.texts[: found.count]:
        column, row = np.round(np.array(text.get_position()) / 0.1).astype(int)
        named[int(text.get_text())] = int(mask[row, column])
    assert named == {7: 7, 4: 4}
    for outline in ax.collections[0].get_paths():
        inside = Path(outline.vertices).contains_points(places).reshape(SHAPE)
        (label,) = set(np.unique(mask[inside])) - {0}
        both = (inside & (mask == label)).sum()
        assert both > 0.9 * inside.sum() and both > 0.9 * (mask == label).sum()


def test_overlapping_cells_are_red(tmp_path):
    """The two at the left overlap by 0.4 µm, the one at the right is by itself."""
    found = cells()
    assert [{i, j} for i, j, _ in found.overlaps()] == [{0, 1}]
    tf.pictures.overlay(found, np.zeros(SHAPE), tmp_path / "check.png")
    assert coloured(tmp_path / "check.png", OVERLAP)[:, 1].max() < 0.5
    assert coloured(tmp_path / "check.png", PLAIN)[:, 1].min() > 0.5
    tf.pictures.overlay(found, np.zeros(SHAPE), tmp_path / "all.png", depth=0.5, labels=True)
    assert not len(coloured(tmp_path / "all.png", OVERLAP))


def test_centred_cells_lie_where_they_were(tmp_path):
    image = np.random.default_rng(0).normal(size=SHAPE)
    one, other = (
        tf.pictures.overlay(cells(centre=c), image, tmp_path / f"{c}.png").path
        for c in (False, True)
    )
    assert np.array_equal(pixels(one), pixels(other))


def test_y_up_counts_rows_from_the_bottom(tmp_path):
    tf.pictures.overlay(cells(y="up"), np.zeros(SHAPE), tmp_path / "up.png", depth=1.0)
    found = coloured(tmp_path / "up.png", PLAIN)
    left = found[found[:, 1] < 0.5]
    assert left[:, 0].mean() > 0.55


@pytest.mark.parametrize(
    "make, over, options, message",
    [
        (lambda: tf.Cells.single(2), np.zeros(SHAPE), {}, r"no pixel size.*Cells\.from_masks"),
        (lambda: 7, np.zeros(SHAPE), {}, r"overlay\(cells\) = 'int'"),
        (cells, np.zeros((30, 50)), {}, r"2 of 3|1 of 3 cells lie outside.*label 13 at row 40"),
        (cells, np.full(SHAPE, np.nan), {}, r"no finite number"),
        (lambda: tf.Cells.single(3), np.zeros(SHAPE), {}, r"cells in the plane"),
        (cells, np.zeros(9), {}, r"shape \(9,\)"),
        (cells, "none.tif", {}, r"none\.tif cannot be read"),
        (cells, np.zeros(SHAPE), {"depth": -1.0}, r"depth = -1"),
        (cells, np.zeros((2, *SHAPE)), {}, r"2 frames"),
    ],
)
def test_bad_overlays_are_refused(tmp_path, make, over, options, message):
    with pytest.raises(tf.InputError, match=message):
        tf.pictures.overlay(make(), over, tmp_path / "check.png", **options)


def test_another_image_than_that_of_the_masks_is_refused(tmp_path):
    pytest.importorskip("skimage")
    mask = rasterised([15, 60], [12, 45], [0.5, 0.5], [14, 14], [5, 5], SHAPE)
    with pytest.raises(tf.InputError, match=r"60 × 90 pixels.*60 × 80"):
        tf.pictures.overlay(
            tf.Cells.from_masks(mask, pixel_size=0.1), np.zeros((60, 90)), tmp_path / "check.png"
        )


# --- overlaps -------------------------------------------------------------------------------------


def test_relaxed_cells_do_not_overlap():
    before = cells()
    after = before.relaxed()
    assert before.overlaps(0.25) and not after.overlaps(0.01)
    assert np.array_equal(after.length, before.length)
    assert np.array_equal(after.radius, before.radius)
    moved = np.linalg.norm(after.position - before.position, axis=1)
    assert np.allclose(moved, after.micrograph.moved) and moved[2] < 1e-9
    # contacts push both cells, by equal forces: about half of the overlap each
    assert 0.1 < moved[0] < 0.5 and np.allclose(
        after.position[:2].mean(0), before.position[:2].mean(0), atol=0.05
    )
    assert "label 11 by" in after.summary() or "label 12 by" in after.summary()
    assert after.relaxed() is after


def test_relaxing_keeps_the_order_of_cells_in_several_colonies():
    position = [[0.0, 0.0], [30.0, 0.0], [0.0, 0.6], [30.0, 0.7]]
    before = tf.Cells(
        position, [1.0, 0.0], colony=[1, 0, 1, 0], extra={"gfp": [1.0, 2.0, 3.0, 4.0]}
    )
    after = before.relaxed()
    assert not after.overlaps(0.01) and after.extra["gfp"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert np.abs(after.position - before.position).max() < 0.5
    assert after.colony.tolist() == [1, 0, 1, 0]


def test_relaxed_cells_start_without_a_warning():
    deep = tf.Cells([[0.0, 0.0], [0.2, 0.3]], [1.0, 0.0])
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2))
    with pytest.warns(RuntimeWarning, match=r"deep in one another.*Cells\.relaxed"):
        scene.bind(cells=deep).start()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        state = scene.bind(cells=deep.relaxed()).start()
    assert state.position.dtype == torch.float64


@pytest.mark.parametrize("stiffness", [None, 1.0])
def test_relaxed_cells_lie_in_no_wall(stiffness):
    """Two that overlap between two walls, and one that lies in a wall and overlaps no cell."""
    walls = [
        tf.Plane(y=-1.0, facing="+y", stiffness=stiffness),
        tf.Plane(y=1.0, facing="-y", stiffness=stiffness),
    ]
    before = tf.Cells([[0.0, 0.0], [0.0, 0.3], [20.0, 0.7]], [1.0, 0.0], length=2.0, radius=0.5)
    after = before.relaxed(walls=walls)
    assert not after.overlaps(0.01) and abs(float(after.position[2, 0]) - 20.0) < 1e-6
    reach = np.abs(after.position[:, 1]) + np.abs(after.axis[:, 1]) * after.length / 2 + 0.5
    assert reach.max() < 1.01
    alone = before.relaxed()
    assert np.abs(alone.position[2] - before.position[2]).max() == 0.0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*between two hard sides")
        with pytest.raises(tf.SimulationError, match=r"still overlap.*cell and a wall by"):
            tf.Cells([[0.0, 0.0]], [1.0, 0.0], radius=1.2).relaxed(walls=walls)
    with pytest.raises(tf.InputError, match=r"Mechanics\.walls"):
        before.relaxed(walls=["floor"])


def test_a_depth_that_is_none_is_refused():
    with pytest.raises(tf.InputError, match="depth = 0"):
        cells().relaxed(0.0)


def test_a_summary_shows_sizes_and_overlaps():
    text = cells().summary()
    assert "3 cells from the table, 0.1 µm a pixel" in text
    assert "centres: x 2 to 6, y -4 to -2 µm" in text
    assert "length without caps: 2 to 2 µm" in text and "width: 1 to 1 µm" in text
    assert "1 pair, the deepest 0.4 µm (label 1" in text

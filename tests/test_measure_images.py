"""Images of colonies in memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf

WINDOW = ((-8.0, -6.0), (8.0, 6.0))
PLACES = [[0.0, 0.0], [4.0, 2.0], [-5.0, -3.0]]
AXES = [[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]


def colony(dim: int = 2, **options) -> tf.State:
    pad = lambda rows: np.pad(np.array(rows), ((0, 0), (0, dim - 2)))
    cells = tf.Cells(pad(PLACES), pad(AXES), [2.0, 3.0, 1.0], extra={"gfp": [1.0, 2.0, 5.0]})
    scene = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=dim)
    return scene.bind(**{"colonies": 1, **options}).start()


def test_an_image_holds_what_cells_hold():
    state = colony(2)
    ones = torch.ones(3)
    found = tf.measure.image(state, ["gfp", ones], pixel_size=0.05, window=WINDOW)
    assert found.shape == (1, 2, 240, 320) and found.dtype == torch.float64
    totals = found.sum((0, 2, 3)) * 0.05**2
    assert float(totals[0]) == pytest.approx(float((state.gfp * state.volume).sum()), rel=5e-3)
    assert float(totals[1]) == pytest.approx(float(state.volume.sum()), rel=5e-3)
    flat = tf.measure.image(state, "gfp", pixel_size=0.05, window=WINDOW, profile="flat")
    # the cells do not overlap
    assert set(flat.unique().tolist()) == {0.0, 1.0, 2.0, 5.0}
    area = (2.0 * 0.5 * state.length + torch.pi * 0.25)[2]
    assert float((flat == 5.0).sum()) * 0.05**2 == pytest.approx(float(area), rel=1e-2)


def test_the_first_row_lies_at_the_greatest_y():
    found = tf.measure.labels(colony(), pixel_size=0.1, window=WINDOW)[0]
    assert found.shape == (120, 160) and set(found.unique().tolist()) == {0, 1, 2, 3}
    row, column = (int((6.0 - 2.0) / 0.1), int((4.0 + 8.0) / 0.1))
    assert found[row, column] == 2 and found[60, 80] == 1 and found[0, 0] == 0


def test_masks_are_read_back_as_the_cells_that_they_show():
    state = colony()
    mask = tf.measure.labels(state, pixel_size=0.05, window=WINDOW)[0].numpy()
    back = tf.Cells.from_masks(mask, pixel_size=0.05)
    corner = np.array([-8.0 + 0.025, 6.0 - 0.025])  # the centre of the first pixel
    assert back.position + corner == pytest.approx(state.position.numpy(), abs=0.02)
    assert back.length == pytest.approx(state.length.numpy(), abs=0.04)


def test_files_show_the_same(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2), dt=0.1)
    *_, last = tf.simulate(scene, until=2.5, colonies=2, record=tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        given = {"pixel_size": 0.1, "window": WINDOW, "colony": 1, "frames": [-1]}
        seen = results.to_labels(tmp_path / "masks.tif", **given)
        light = results.to_ome_tiff(
            tmp_path / "light.tif", channels={"volume": 2.0}, offset=0.0, **given
        )
    mask = tf.measure.labels(last, pixel_size=0.1, window=WINDOW)
    assert mask[1].numpy().tolist() == tifffile.imread(seen).tolist()
    image = tf.measure.image(last, 2.0 * last.volume, pixel_size=0.1, window=WINDOW)
    np.testing.assert_allclose(image[1, 0].numpy(), tifffile.imread(light), rtol=1e-5, atol=1e-5)


def test_each_colony_has_its_own_and_empty_ones_are_dark():
    state = colony(colonies=3)
    some = state.remove((state.colony == 1) | (state.uid == 0), "removed")
    found = tf.measure.image(some, "gfp", pixel_size=0.25, window=WINDOW)
    assert not found[1].any() and torch.equal(found[0], found[2]) and found[0].any()
    alone = tf.measure.image(some.select([2]), "gfp", pixel_size=0.25, window=WINDOW)
    assert torch.equal(alone[0], found[2])
    masks = tf.measure.labels(some, pixel_size=0.25, window=WINDOW)
    assert set(masks[0].unique().tolist()) == {0, 2, 3} and not masks[1].any()


def test_in_space_light_adds_up_and_masks_are_sections():
    cells = tf.Cells([[0, 0, 1.0], [0, 0, 4.0]], [1.0, 0.0, 0.0], 2.0)
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=3).bind().start()
    found = tf.measure.image(state, torch.ones(2), pixel_size=0.5, window=WINDOW)
    assert float(found.max()) == pytest.approx(2.0, rel=0.2)  # both diameters
    at = lambda z: set(
        tf.measure.labels(state, pixel_size=0.25, window=WINDOW, z=z).unique().tolist()
    )
    assert (at(1.0), at(4.0), at(2.5)) == ({0, 1}, {0, 2}, {0})


def test_cells_across_the_faces_are_seen_at_both():
    cells = tf.Cells([[7.8, 0.0]], [1.0, 0.0], 2.0)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, periodic={"x": (-8.0, 8.0)}), founders=cells
    )
    found = tf.measure.labels(scene.bind().start(), pixel_size=0.1, window=WINDOW)[0]
    assert found[60, 0] == 1 and found[60, -1] == 1


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda s: tf.measure.image(s, "yfp", pixel_size=0.1, window=WINDOW), "'yfp'"),
        (lambda s: tf.measure.image(s, [], pixel_size=0.1, window=WINDOW), "one or more"),
        (lambda s: tf.measure.image(s, "gfp", pixel_size=0.0, window=WINDOW), "pixel_size"),
        (lambda s: tf.measure.image(s, "gfp", pixel_size=1e-5, window=WINDOW), "at most"),
        (lambda s: tf.measure.image(s, "gfp", pixel_size=1.0, window=((1, 1), (0, 2))), "window"),
        (
            lambda s: tf.measure.image(s, "gfp", pixel_size=1.0, window=WINDOW, profile="thin"),
            "profile",
        ),
        (lambda s: tf.measure.labels(s, pixel_size=1.0, window=WINDOW, z=1.0), "left out in the"),
    ],
)
def test_what_is_refused(make, said):
    with pytest.raises(tf.InputError, match=said):
        make(colony())


def test_sections_need_a_height():
    with pytest.raises(tf.InputError, match="the height of the section"):
        tf.measure.labels(colony(3), pixel_size=1.0, window=WINDOW)

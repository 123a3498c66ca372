"""Fluorescence of cells from images beside their label image."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from rasterised import rasterised

import torchfilm as tf

tifffile = pytest.importorskip("tifffile")
pytest.importorskip("skimage")

SHAPE = (60, 80)
DARK, LIGHT = 100.0, {1: 40.0, 2: 7.0, 3: 300.0}


def masked() -> np.ndarray:
    return rasterised(
        [25.0, 55.0, 25.0], [15.0, 35.0, 45.0], [0.4, -0.9, 0.0], [18.0, 12.0, 10.0], [5.0] * 3,
        SHAPE,
    )  # fmt: skip


def shone(mask: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """The background, and in each region its light; noise: of the pixels, of mean 0."""
    image = DARK + sum(light * (mask == k) for k, light in LIGHT.items())
    return image + noise * np.random.default_rng(0).normal(size=mask.shape)


def read(mask, images, **options) -> tf.Cells:
    return tf.Cells.from_masks(
        mask, pixel_size=0.1, fluorescence={"gfp": images}, **{"drop": "border", **options}
    )


def test_a_cell_has_the_mean_of_its_pixels_less_the_background():
    mask = masked()
    image = shone(mask, noise=4.0)
    cells = read(mask, image)
    for k, found in zip((1, 2, 3), cells.extra["gfp"], strict=True):
        wanted = image[mask == k].mean() - np.median(image[mask == 0])
        assert found == pytest.approx(wanted, rel=1e-12)
        # some 250 pixels a cell, and the median of some 4,000: 5 standard errors
        assert found == pytest.approx(LIGHT[k], abs=5 * 4.0 / np.sqrt((mask == k).sum()))
    assert cells.micrograph.background["gfp"] == np.median(image[mask == 0])


@pytest.mark.parametrize("counts", [0, 90.0])
def test_the_background_may_be_given(counts):
    mask = masked()
    cells = read(mask, shone(mask), background=counts)
    assert cells.extra["gfp"] == pytest.approx([DARK + x - counts for x in LIGHT.values()])


def test_fluorescence_reaches_the_state_the_table_and_the_summary():
    mask = masked()
    cells = tf.Cells.from_masks(
        mask, pixel_size=0.1, fluorescence={"gfp": shone(mask), "rfp": 3.0 * shone(mask)}
    )
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells).bind().start()
    assert state.gfp.tolist() == pytest.approx(list(LIGHT.values()))
    assert cells.table()["rfp"] == pytest.approx([3 * x for x in LIGHT.values()])
    assert (
        "gfp: 7 to 300, median 40 (mean of the pixels, less 100 of background)" in cells.summary()
    )
    assert "less 300" in cells.relaxed().summary()


def test_regions_that_are_left_out_are_no_background():
    mask = masked()
    mask[:, 70:] = 9  # a great bright region at the border
    image = shone(mask) + 5000.0 * (mask == 9)
    cells = read(mask, image)
    assert cells.extra["gfp"] == pytest.approx(list(LIGHT.values()))
    assert cells.micrograph.label.tolist() == ["1", "2", "3"]


def test_numbers_of_cells_may_have_gaps():
    mask = masked()
    apart = np.array([0, 7, 2**40, 9])[mask]
    cells = read(apart, shone(mask))
    of = dict(zip(cells.micrograph.label.tolist(), cells.extra["gfp"], strict=True))
    assert of == pytest.approx({"7": 40.0, "9": 300.0, str(2**40): 7.0})


def test_a_frame_is_picked_from_both(tmp_path):
    mask = masked()
    other = np.roll(mask, 3, axis=1)
    tifffile.imwrite(tmp_path / "masks.tif", np.stack([mask, other]))
    images = np.stack([shone(mask), 2.0 * shone(other)]).astype(np.float32)
    tifffile.imwrite(tmp_path / "gfp.tif", images)
    for frame, factor in ((0, 1.0), (1, 2.0), (-1, 2.0)):
        cells = read(tmp_path / "masks.tif", tmp_path / "gfp.tif", frame=frame)
        assert cells.extra["gfp"] == pytest.approx([factor * x for x in LIGHT.values()])
    with pytest.raises(tf.InputError, match=r"fluorescence\['gfp'\] has 1 frame"):
        read(tmp_path / "masks.tif", images[0], frame=1)
    with pytest.raises(tf.InputError, match=r"gfp\.tif has 2 frames: say which one by frame"):
        read(mask, tmp_path / "gfp.tif")


def test_stacks_of_unlike_lengths_are_not_paired():
    """Frame 1 of three and frame 1 of two were probably not taken at one time."""
    mask = masked()
    images = np.stack([shone(mask)] * 2)
    with pytest.raises(tf.InputError, match=r"one of 2 frame\(s\), and .*mask.* one of 3"):
        read(np.stack([mask] * 3), images, frame=1)


def test_an_image_beside_results_of_delta(tmp_path):
    """Its labels end with its last region of interest; its frames have numbers of its own."""
    mask = masked()
    with h5py.File(tmp_path / "Position000001.nc", "w") as file:
        group = file.create_group("roi00")
        group["frame"], group["label_stack"] = [7], mask[None]
        group.attrs["box"] = str({"xtl": 0, "ytl": 0, "xbr": SHAPE[1], "ybr": SHAPE[0]})
    image = np.pad(shone(mask), ((0, 20), (0, 10)))
    cells = read(tmp_path / "Position000001.nc", image, frame=7)
    assert cells.extra["gfp"] == pytest.approx(list(LIGHT.values()))
    with pytest.raises(tf.InputError, match=r"has 2 frames.*the image of its frame alone"):
        read(tmp_path / "Position000001.nc", np.stack([image] * 2), frame=7)
    with pytest.raises(tf.InputError, match="from this file labels are read"):
        read(mask, tmp_path / "Position000001.nc")


BAD = {
    "another shape": ({"gfp": np.ones((30, 40))}, {}, r"30 × 40 pixels, .*mask has 60 × 80"),
    "colours": ({"gfp": np.ones((*SHAPE, 3))}, {}, r"fluorescence\['gfp'\] has 3 colours"),
    "nan": ({"gfp": np.full(SHAPE, np.nan)}, {}, r"4800 pixels that are not finite.*row 0, column"),
    "text": ({"gfp": [["a"]]}, {}, r"fluorescence\['gfp'\] = .*an array of numbers"),
    "JPEG": ({"gfp": "gfp.jpg"}, {}, "JPEG changes numbers"),
    "no file": ({"gfp": "gfp.tif"}, {}, r"gfp\.tif cannot be read"),
    "no name": ({"green light": np.ones(SHAPE)}, {}, r"fluorescence = 'green light'"),
    "a name of the state": ({"length": np.ones(SHAPE)}, {}, r"fluorescence = 'length'"),
    "cell_type": ({"cell_type": np.ones(SHAPE)}, {}, r"fluorescence = 'cell_type'"),
    "a number as name": ({1: np.ones(SHAPE)}, {}, r"fluorescence = 1"),
    "no names": (np.ones(SHAPE), {}, "images by field"),
    "background": ({"gfp": np.ones(SHAPE)}, {"background": "mode"}, r"'mode'.*\"median\" or"),
    "no background": ({"gfp": np.ones(SHAPE)}, {"background": None}, r"background = None"),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_fluorescence_is_refused(kind):
    images, options, message = BAD[kind]
    with pytest.raises(tf.InputError, match=message):
        tf.Cells.from_masks(masked(), pixel_size=0.1, fluorescence=images, **options)


@pytest.mark.parametrize(
    "axes, shape, words",
    [
        ("CYX", (2, *SHAPE), r"2 channels \(axes CYX\)"),
        ("TCYX", (3, 2, *SHAPE), r"2 channels \(axes TCYX\)"),
        ("ZYX", (4, *SHAPE), r"4 planes \(axes ZYX\)"),
    ],
)
def test_channels_and_planes_are_not_taken_for_frames(axes, shape, words, tmp_path):
    """Some programs call frames so; then one that is asked for is taken, with a warning."""
    path = tmp_path / "two.ome.tif"
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    tifffile.imwrite(path, values, photometric="minisblack", metadata={"axes": axes})
    read = lambda masks, **options: tf.Cells.from_masks(
        masks, pixel_size=0.1, fluorescence={"gfp": path}, **options
    )
    with pytest.raises(tf.InputError, match=words):
        read(masked())
    movie = np.stack([masked()] * len(values))
    if axes == "TCYX":
        with pytest.raises(tf.InputError, match=words):
            read(movie, frame=1)
    else:
        with pytest.warns(UserWarning, match=words + r"; frame=1 takes one of these"):
            assert len(read(movie, frame=1).extra["gfp"]) == 3

"""Cells from label images: how exact the capsules are, and invalid images."""

from __future__ import annotations

import math

import h5py
import numpy as np
import pytest
from rasterised import bent, rasterised

import torchfilm as tf
from torchfilm.micrographs.capsule_fit import (
    capsule_of_area,
    capsule_of_moments,
    moments_of_capsule,
)

tifffile = pytest.importorskip("tifffile")
pytest.importorskip("skimage")

SHAPE = (60, 80)


def masked(**changes) -> np.ndarray:
    """Two cells in a small image."""
    given = {
        "x": [25.0, 55.0], "y": [20.0, 35.0], "angle": [0.4, -0.9], "length": [18.0, 12.0],
        "radius": [5.0, 5.0], **changes,
    }  # fmt: skip
    return rasterised(**given, shape=SHAPE)


def read(image, **options) -> tf.Cells:
    return tf.Cells.from_masks(image, **{"pixel_size": 0.1, **options})


# --- the fit --------------------------------------------------------------------------------------


def test_moments_of_a_capsule_are_those_of_its_area():
    """By midpoints of a fine grid: exact to the square of its spacing, but for the boundary."""
    h = 0.005
    x, y = np.meshgrid(np.arange(-3 + h / 2, 3, h), np.arange(-1.5 + h / 2, 1.5, h))
    inside = np.hypot(np.maximum(np.abs(x) - 1.25, 0), y) <= 0.75
    area, along, across = moments_of_capsule(np.array([2.5]), np.array([0.75]))
    assert inside.sum() * h**2 == pytest.approx(area[0], rel=1e-4)
    assert x[inside].var() == pytest.approx(along[0], rel=1e-4)
    assert y[inside].var() == pytest.approx(across[0], rel=1e-4)


def test_a_capsule_is_found_from_its_moments():
    length = np.array([0.0, 1e-6, 0.01, 0.5, 2.0, 7.0, 60.0, 1e3])
    radius = np.array([0.5, 0.5, 3.0, 0.2, 0.5, 0.4, 0.5, 1.0])
    area, along, across = moments_of_capsule(length, radius)
    for found in (capsule_of_moments(along, across), capsule_of_area(area, along)):
        # 1e-6 of a radius changes the ratio by 1e-6: ten digits of it are left
        assert np.allclose(found[0], length, rtol=1e-12, atol=1e-9)
        assert np.allclose(found[1], radius, rtol=1e-9)


def test_a_region_rounder_than_a_disc_has_no_length():
    """Pixels may have a moment a little below that of a disc of their area."""
    length, radius = capsule_of_area(np.array([math.pi]), np.array([0.24]))
    assert length[0] < 1e-12 and radius[0] == pytest.approx(1.0)


def test_a_curved_cell_keeps_its_width():
    """Bent by 0.8 radians: within 5 % of the radius, where the moment across adds 8 %."""
    mask = bent((80, 80), (40, 30), 0.8, 30.0, 6.0)
    with pytest.warns(RuntimeWarning, match="not shaped like"):
        assert read(mask, pixel_size=0.1).radius[0] == pytest.approx(0.6, rel=0.05)


@pytest.mark.parametrize(
    "radius, place, angle, length, width",
    [(4.0, 0.15, 1.5, 0.35, 0.1), (8.0, 0.1, 0.5, 0.25, 0.06)],
)
def test_the_error_on_rasterised_capsules(radius, place, angle, length, width):
    """Root mean squares over 40 capsules: pixels, degrees, pixels, pixels. The bounds are 1.5 to 2
    times what the documentation states, which is from more capsules."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(40):
        size, a = rng.uniform(2, 8) * radius, rng.uniform(0, math.pi)
        side = int(size + 2 * radius + 8)
        x, y = side / 2 + rng.uniform(-0.5, 0.5, 2)
        mask = rasterised([x], [y], [a], [size], [radius], (side, side))
        found = read(mask, pixel_size=0.1)
        turn = np.cross(np.append(found.axis[0], 0), (math.cos(a), -math.sin(a), 0))[2]
        errors.append(
            (math.hypot(found.position[0, 0] / 0.1 - x, found.position[0, 1] / 0.1 + y),
             math.degrees(math.asin(min(abs(turn), 1.0))),
             found.length[0] / 0.1 - size, found.radius[0] / 0.1 - radius)
        )  # fmt: skip
    rms = np.sqrt((np.array(errors) ** 2).mean(0))
    assert (rms < (place, angle, length, width)).all(), rms


@pytest.mark.parametrize("pixel_size", [65.0, 0.001])
def test_widths_that_no_bacteria_have_give_a_warning(pixel_size):
    with pytest.warns(UserWarning, match=rf"µm wide.*Is pixel_size = {pixel_size:g} µm right"):
        read(masked(), pixel_size=pixel_size)
    with pytest.warns(UserWarning, match="Are the columns in µm"):
        columns = {"x_um": [0.0, 40.0], "y_um": [0.0, 0.0], "angle_rad": [0.0, 0.0]}
        tf.Cells.from_table(columns | {"length_um": [30.0, 31.0], "width_um": [9.0, 9.5]})


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["masks.tif", "masks.png", "masks.npy", "array", "float array"])
def test_kinds_of_images(tmp_path, name):
    mask = masked()
    path = tmp_path / name
    if name == "masks.tif":
        tifffile.imwrite(path, mask)
    elif name == "masks.png":
        from PIL import Image

        Image.fromarray(mask).save(path)
    elif name == "masks.npy":
        np.save(path, mask)
    image = path if "." in name else mask.astype(float) if name == "float array" else mask
    cells = read(image)
    assert cells.count == 2 and cells.micrograph.label.tolist() == ["1", "2"]
    assert np.allclose(cells.position, [[2.5, -2.0], [5.5, -3.5]], atol=0.04)
    assert (cells.position[:, 1] < 0).all() and np.allclose(cells.radius, 0.5, atol=0.02)
    # from +x towards the rows, so downwards
    assert np.allclose(np.abs(cells.axis[0] @ (math.cos(0.4), -math.sin(0.4))), 1.0, atol=1e-3)


def test_a_table_of_the_mask_gives_the_same_cells():
    from skimage.measure import regionprops_table

    names = ("label", "centroid", "orientation", "axis_major_length", "axis_minor_length", "area")
    table = regionprops_table(masked(), properties=names)
    one, other = read(masked()), tf.Cells.from_table(table, pixel_size=0.1, columns="skimage")
    for name in ("position", "axis", "length", "radius"):
        assert np.allclose(getattr(one, name), getattr(other, name), rtol=1e-9)
    del table["area"]  # then by the moment across
    other = tf.Cells.from_table(table, pixel_size=0.1, columns="skimage")
    assert np.allclose(one.length, other.length, atol=0.03)
    assert np.allclose(one.radius, other.radius, atol=0.01)


def test_pages_that_were_written_one_by_one_are_frames(tmp_path):
    pages = [masked(), masked(x=[30.0, 55.0]), masked(x=[30.0, 58.0])]
    with tifffile.TiffWriter(tmp_path / "pages.tif") as file:
        for page in pages:
            file.write(page)
    with pytest.raises(tf.InputError, match=r"pages\.tif has 3 frames.*from 0 to 2"):
        read(tmp_path / "pages.tif")
    for frame in (0, 1, 2, -1):
        found = read(tmp_path / "pages.tif", frame=frame).position
        assert np.array_equal(found, read(np.stack(pages), frame=frame).position)


def test_images_of_unlike_shapes_in_one_file_are_named(tmp_path):
    with tifffile.TiffWriter(tmp_path / "two.tif") as file:
        file.write(masked())
        file.write(np.zeros((8, 9), np.uint8))
    with pytest.warns(UserWarning, match=r"two\.tif holds 2 series.*\(8, 9\); the first is taken"):
        found = read(tmp_path / "two.tif")
    assert np.array_equal(found.position, read(masked()).position)


def test_a_frame_of_a_stack(tmp_path):
    stack = np.stack([masked(), masked(x=[30.0, 55.0])])
    tifffile.imwrite(tmp_path / "stack.tif", stack)
    assert read(tmp_path / "stack.tif", frame=1).position[0, 0] == pytest.approx(3.0, abs=0.02)
    with pytest.raises(tf.InputError, match=r"stack\.tif has 2 frames.*from 0 to 1"):
        read(tmp_path / "stack.tif")
    last = read(tmp_path / "stack.tif", frame=-1)
    assert np.array_equal(last.position, read(tmp_path / "stack.tif", frame=1).position)
    first = read(stack, frame=-2).position
    assert np.array_equal(first, read(stack, frame=0).position)
    assert not np.array_equal(first, last.position)
    with pytest.raises(tf.InputError, match=r"frame = -3 .*from -2 to 1: .* has 2 frames"):
        read(tmp_path / "stack.tif", frame=-3)
    with pytest.raises(tf.InputError, match=r"frame = 2 .*from -2 to 1: .* has 2 frames"):
        read(tmp_path / "stack.tif", frame=2)
    with pytest.raises(tf.InputError, match=r"frame = 'a'.*whole number"):
        read(stack, frame="a")


def test_labels_may_be_great():
    cells = read(np.where(masked() == 2, 2**40, masked().astype(np.int64)))
    assert cells.micrograph.label.tolist() == ["1", str(2**40)]


def test_centre_moves_the_mean_to_the_origin():
    assert np.allclose(read(masked(), centre=True).position.mean(0), 0.0)


def results_of_delta(path, first: int = 0) -> None:
    """As DeLTA writes them: a group for each region, with its box in the image."""
    with h5py.File(path, "w") as file:
        for k, (top, left) in enumerate([(0, 0), (10, 90)]):
            group = file.create_group(f"roi{k:02}")
            group["frame"] = np.arange(first, first + 2)
            group["label_stack"] = np.stack([masked(), masked(x=[30.0, 55.0])])
            box = {"xtl": left, "ytl": top, "xbr": left + 80, "ybr": top + 60}
            group.attrs["box"] = str(box)


def test_results_of_delta(tmp_path):
    results_of_delta(tmp_path / "Position000001.nc", first=1)
    cells = read(tmp_path / "Position000001.nc", frame=2)
    assert cells.count == 4 and len(set(cells.micrograph.label)) == 4
    assert np.allclose(cells.position[2:] - cells.position[:2], [[9.0, -1.0]] * 2)
    with pytest.raises(tf.InputError, match=r"frame = None.*one of 1 to 2"):
        read(tmp_path / "Position000001.nc")


# --- regions that need a look ---------------------------------------------------------------------


def with_problems() -> np.ndarray:
    mask = masked()
    mask[0:12, 60:70] = 7  # at the border
    mask[50:53, 10:13] = 8  # 9 pixels
    mask[45:50, 30:40], mask[54:58, 30:40] = 9, 9  # two pieces
    mask[20:60, 0:0] = 0
    return mask


def test_regions_are_reported_by_label():
    mask = with_problems()
    with pytest.raises(tf.InputError, match=r"1 of 5 regions are smaller than 30.*label 8\..*tiny"):
        read(mask)
    with pytest.raises(tf.InputError, match=r"1 of 4 .*in several pieces: label 9\..*drop='piec"):
        read(mask, drop="tiny")
    with pytest.warns(RuntimeWarning, match=r"1 of 3 .*at the border.*label 7\..*drop='border'"):
        assert read(mask, drop=("tiny", "pieces")).count == 3
    cells = read(mask, drop=("tiny", "pieces", "border"))
    assert cells.count == 2
    assert cells.micrograph.left_out == {"tiny": ["8"], "pieces": ["9"], "border": ["7"]}
    assert "left out, border: 1, label 7" in cells.summary()


def test_a_curved_cell_is_reported():
    with pytest.warns(RuntimeWarning, match=r"1 of 1 .*not shaped like a straight.*label 1"):
        read(bent((60, 80), (40, 25), 1.2, 30.0, 5.0))
    read(bent((60, 80), (40, 30), 0.2, 30.0, 5.0))  # nearly straight: any warning is an error
    with pytest.raises(tf.InputError, match=r"no cell is left"):
        read(bent((60, 80), (40, 25), 1.2, 30.0, 5.0), drop="misfit")


def test_two_cells_in_one_region_are_reported():
    mask = masked(x=[25.0, 27.0], y=[20.0, 30.0])
    with pytest.warns(RuntimeWarning, match=r"several cells in one") as found:
        tf.Cells.from_masks((mask > 0).astype(int), pixel_size=0.1)
    assert found[0].filename == __file__


# --- bad images -----------------------------------------------------------------------------------

BAD = {
    "one colour for all cells": (
        lambda: np.where(masked() > 0, 255, 0),
        {},
        r"1 of 1 regions are in several pieces.*skimage\.measure\.label",
    ),
    "few colours": (
        lambda: (lambda mask: np.where(mask > 0, mask % 3 + 1, 0))(
            rasterised([15, 40, 65] * 2, [15] * 3 + [45] * 3, [0] * 6, [10] * 6, [5] * 6, SHAPE)
        ),
        {},
        r"3 of 3 regions are in several pieces.*few numbers",
    ),
    "all background": (lambda: np.zeros(SHAPE, int), {}, r"no cell: all its pixels are 0"),
    "all one label": (lambda: np.ones(SHAPE, int), {}, r"no background.*all are 1"),
    "a micrograph": (lambda: masked() + 90, {}, r"no background: no.*\(labels 90 to 92\)"),
    "a probability": (lambda: masked() * 0.3, {}, r"0\.3 as a label"),
    "nan": (lambda: np.where(masked() > 1, np.nan, masked()), {}, r"nan as a label"),
    "negative": (lambda: masked().astype(int) - 1, {}, r"labels from -1 to 1"),
    "colours": (lambda: np.stack([masked()] * 3, -1), {}, r"3 colours a pixel"),
    "text": (lambda: np.array([["a", "b"]]), {}, r"an array of numbers"),
    "empty": (lambda: np.zeros((0, 0)), {}, r"not empty"),
    "a row": (lambda: np.arange(9), {}, r"shape \(9,\)"),
    "a line of pixels": (lambda: np.eye(40, dtype=int)[:1].repeat(40, 0), {}, r"smaller than 30"),
    "no number": (lambda: object(), {}, r"mask = .*array of"),
    "pixel size": (masked, {"pixel_size": 0.0}, r"pixel_size = 0\.0"),
    "pixel size text": (masked, {"pixel_size": "65 nm"}, r"pixel_size = '65 nm'"),
    "drop": (masked, {"drop": "edge"}, r"drop = 'edge'.*'border'"),
    "no drop": (masked, {"drop": None}, r"drop = None"),
    "centre": (masked, {"centre": 1.5}, r"centre = 1\.5"),
    "an argument that is none": (masked, {"pixel": 1}, r"no parameter 'pixel'.*pixel_size"),
    "least area": (masked, {"least_area": 0}, r"least_area = 0"),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_masks_are_refused(kind):
    make, options, message = BAD[kind]
    with pytest.raises(tf.InputError, match=message):
        read(make(), **options)


@pytest.mark.parametrize("suffix", [".tif", ".png", ".npy", ".nc"])
@pytest.mark.parametrize("fault", ["truncated", "empty", "text", "missing"])
def test_broken_files_are_reported(tmp_path, suffix, fault):
    path = tmp_path / f"masks{suffix}"
    if suffix == ".nc":
        results_of_delta(path)
    elif suffix == ".npy":
        np.save(path, masked())
    elif suffix == ".tif":
        tifffile.imwrite(path, masked())
    else:
        from PIL import Image

        Image.fromarray(masked()).save(path)
    whole = path.read_bytes()
    if fault == "missing":
        path.unlink()
    else:
        path.write_bytes({"truncated": whole[:90], "empty": b"", "text": b"x,y\n1,2\n"}[fault])
    with pytest.raises(tf.InputError, match=rf"masks\{suffix}"):
        read(path, frame=0)


def test_files_with_objects_are_not_loaded(tmp_path):
    np.save(tmp_path / "cells_seg.npy", {"masks": masked()}, allow_pickle=True)
    with pytest.raises(tf.InputError, match=r"not loaded since they can execute code"):
        read(tmp_path / "cells_seg.npy")


@pytest.mark.parametrize(
    "name, message",
    [
        ("a.csv", "Cells.from_table"),
        ("a.jpg", "JPEG changes numbers"),
        ("a.mat", "regs_label"),
        ("a.xyz", r"\.tif, \.png"),
        ("other.nc", "not a results file of DeLTA"),
    ],
)
def test_files_of_other_kinds_are_reported(tmp_path, name, message):
    with h5py.File(tmp_path / "other.nc", "w") as file:
        file["x"] = [0.0]
    with pytest.raises(tf.InputError, match=message):
        read(tmp_path / name, frame=0)


def test_the_extra_is_named_where_it_is_missing(monkeypatch, tmp_path):
    tifffile.imwrite(tmp_path / "masks.tif", masked())
    monkeypatch.setitem(__import__("sys").modules, "tifffile", None)
    with pytest.raises(tf.InputError, match=r'pip install -e "\.\[images\]"'):
        read(tmp_path / "masks.tif")
    monkeypatch.setitem(__import__("sys").modules, "skimage.measure", None)
    with pytest.raises(tf.InputError, match=r'pip install -e "\.\[images\]"'):
        read(masked())

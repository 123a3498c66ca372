"""Results as microscope images: masks that are measured again, light that is conserved, noise as
stated, and what other programs read of the files."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from exported import recorded, signalling
from recorded import record

import torchfilm as tf
from torchfilm.io.raster import Raster, Rods, label_image, thickness_image

tifffile = pytest.importorskip("tifffile", reason="the extra images")
PIXEL = 0.05


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return recorded(signalling(), tmp_path_factory.mktemp("images") / "run.h5", 3.0)


def apart(count: int = 12, dim: int = 2) -> Rods:
    """Cells that do not overlap, turned every way."""
    turn = np.linspace(0.1, 3.0, count)
    rise = np.linspace(-1.2, 1.5, count) if dim == 3 else np.zeros(count)
    axis = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], 1)
    centre = np.stack([5.0 * np.arange(count), 0.3 * turn, 0.1 * rise], 1)
    return Rods(centre, axis, np.linspace(0.0, 1.6, count), np.linspace(0.4, 0.6, count))


def raster(rods: Rods) -> Raster:
    low, high = rods.centre.min(0) - 3, rods.centre.max(0) + 3
    shape = tuple(np.ceil((high - low)[[1, 0]] / PIXEL).astype(int).tolist())
    return Raster(PIXEL, float(low[0]), float(high[1]), shape)


# --- the raster -----------------------------------------------------------------------------------


def test_areas_of_masks_are_those_of_capsules():
    rods = apart()
    labels = np.arange(1, 13, dtype=np.uint16)
    image = label_image(rods, labels, raster(rods), 0.0)
    found = np.bincount(image.reshape(-1), minlength=13)[1:] * PIXEL**2
    area = 4 * rods.half * rods.radius + math.pi * rods.radius**2
    # counting pixel centres is wrong by some of those on the rim: about their number to the 1/3
    assert np.allclose(found, area, rtol=0.02) and abs(found.sum() / area.sum() - 1) < 2e-3


@pytest.mark.parametrize("dim", [2, 3])
def test_thickness_adds_up_to_the_volume(dim):
    rods = apart(dim=dim)
    image = thickness_image(rods, np.ones((1, 12)), raster(rods), False)[0]
    volume = math.pi * rods.radius**2 * (2 * rods.half + 4 / 3 * rods.radius)
    assert image.sum() * PIXEL**2 == pytest.approx(volume.sum(), rel=1e-3)
    if dim == 2:
        assert image.max() <= 2 * rods.radius.max() + 1e-12
        flat = thickness_image(rods, np.ones((1, 12)), raster(rods), True)[0]
        assert np.array_equal(flat > 0, image > 0) and set(np.unique(flat)) == {0.0, 1.0}


def test_cells_that_stand_upright_or_are_spheres():
    axis = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    rods = Rods(
        np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), axis, np.array([1.0, 0.0]), np.full(2, 0.5)
    )
    one = Raster(0.1, -0.05, 0.05, (1, 1))
    assert thickness_image(rods, np.ones((1, 2)), one, False)[0, 0, 0] == pytest.approx(3.0)
    other = Raster(0.1, 2.95, 0.05, (1, 1))
    assert thickness_image(rods, np.ones((1, 2)), other, False)[0, 0, 0] == pytest.approx(1.0)


def test_where_two_cells_overlap_the_nearer_axis_wins():
    axis = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    centre = np.array([[0.0, 0.3, 0.0], [0.0, -0.3, 0.0]])
    rods = Rods(centre, axis, np.ones(2), np.full(2, 0.5))
    image = label_image(rods, np.array([5, 9], np.uint16), Raster(0.1, -2.0, 1.0, (20, 40)), 0.0)
    middle = image[:, 20]
    assert middle.tolist() == [0] * 2 + [5] * 8 + [9] * 8 + [0] * 2, "greatest y comes first"
    again = label_image(rods, np.array([9, 5], np.uint16), Raster(0.1, -2.0, 1.0, (20, 40)), 0.0)
    assert np.array_equal(again == 9, image == 5), "whatever the order of the cells"


def test_a_section_in_space_cuts_spheres_into_discs():
    rods = Rods(np.zeros((1, 3)), np.eye(3)[:1], np.zeros(1), np.ones(1))
    part = Raster(0.02, -2.0, 2.0, (200, 200))
    for z in (0.0, 0.6, 1.1):
        area = (label_image(rods, np.ones(1, np.uint8), part, z) > 0).sum() * 0.02**2
        assert area == pytest.approx(math.pi * max(0.0, 1 - z * z), rel=0.01, abs=1e-9)


# --- masks ----------------------------------------------------------------------------------------


def test_masks_map_back_to_the_table(run, tmp_path):
    path = run.to_labels(tmp_path / "masks.tif", pixel_size=PIXEL, colony=1)
    masks = tifffile.imread(path)
    assert masks.dtype == np.uint16 and masks.shape[0] == len(run)
    with tifffile.TiffFile(path) as file:
        text = file.ome_metadata
        assert file.pages[0].tags["ResolutionUnit"].value == 3  # per cm
        per_cm = file.pages[0].tags["XResolution"].value
    assert per_cm[0] / per_cm[1] == pytest.approx(1e4 / PIXEL)
    left, top = (float(re.search(rf'Position{n}="([-\d.e]+)"', text)[1]) for n in "XY")
    for k in range(len(run)):
        table = run.table(k)
        mine = table["colony"] == 1
        assert set(np.unique(masks[k])) - {0} == set((table["cell"][mine] + 1).tolist())
        for cell, x, y in zip(*(table[n][mine] for n in ("cell", "x", "y")), strict=True):
            row, column = np.nonzero(masks[k] == cell + 1)
            # cells that overlap hide a part of each other
            assert left + column.mean() * PIXEL == pytest.approx(x, abs=0.1)
            assert top - row.mean() * PIXEL == pytest.approx(y, abs=0.1)


def test_masks_of_all_cells_have_their_area(run, tmp_path):
    masks = tifffile.imread(run.to_labels(tmp_path / "m.tif", pixel_size=PIXEL, colony=0))
    table = run.table(0)
    one = {n: float(table[n][table["colony"] == 0][0]) for n in ("length", "radius")}
    area = 2 * one["length"] * one["radius"] + math.pi * one["radius"] ** 2
    assert (masks[0] > 0).sum() * PIXEL**2 == pytest.approx(area, rel=0.02)


def test_masks_are_read_back_as_the_cells(run, tmp_path):
    """What `Cells.from_masks` finds in a mask are the cells that were drawn."""
    pytest.importorskip("skimage", reason="the extra images")
    path = run.to_labels(tmp_path / "m.tif", pixel_size=PIXEL, colony=1, frames=[-1])
    with tifffile.TiffFile(path) as file:
        text = file.ome_metadata
    first = [float(re.search(rf'Position{n}="([-\d.e]+)"', text)[1]) for n in "XY"]
    cells, table = tf.Cells.from_masks(path, pixel_size=PIXEL), run.table(-1)
    rows = np.flatnonzero(table["colony"] == 1)
    rows = rows[np.argsort(table["cell"][rows])]  # in the order of the labels
    assert cells.count == len(rows) > 20
    # cells that overlap hide a part of each other
    assert np.allclose(cells.radius, table["radius"][rows], atol=0.03)
    assert np.allclose(cells.length, table["length"][rows], atol=0.15)
    places = np.stack([table["x"][rows], table["y"][rows]], 1)
    assert np.allclose(cells.position + first, places, atol=0.05)
    axis = np.stack([np.cos(table["angle"][rows]), np.sin(table["angle"][rows])], 1)
    assert (np.abs((cells.axis * axis).sum(1)) > math.cos(0.05)).all()


def test_masks_with_many_cells_have_32_bits(tmp_path):
    """uids above 65534, as in a long run."""

    def update(cells):
        cells.divide_flag = cells.uid == cells.uid
        cells.remove_flag = (cells.uid > 0) & (cells.uid % 2 == 0)

    growth = tf.Growth(law="linear", rate=300.0)
    scene = tf.Scene(tf.Rules(update), growth, tf.Division(), dim=2, dt=0.01)
    state = scene.bind().start()
    record(scene, state.replace(next_uid=state.next_uid + 70001), tmp_path / "run.h5", until=0.05)
    with tf.Results(tmp_path / "run.h5") as results:
        path = results.to_labels(
            tmp_path / "m.tif", pixel_size=0.5, frames=[-1], window=((-9, -9), (9, 9))
        )
        cells = results.table(-1)["cell"]
    masks = tifffile.imread(path)
    assert cells.min() > 70000 and masks.dtype == np.uint32
    assert set(np.unique(masks)) - {0} == set((cells + 1).tolist())


def test_runs_in_space_need_a_section(tmp_path):
    results = recorded(signalling(3), tmp_path / "run.h5", 1.0)
    with pytest.raises(tf.InputError, match=r"z = None.*height of the section"):
        results.to_labels(tmp_path / "m.tif", pixel_size=0.1, colony=0)
    with pytest.raises(tf.InputError, match=r"z = 50.*where the colony's cells are"):
        results.to_labels(tmp_path / "m.tif", pixel_size=0.1, colony=0, z=50.0)
    path = results.to_labels(tmp_path / "m.tif", pixel_size=0.1, colony=0, z=0.0)
    assert (tifffile.imread(path)[-1] > 0).any()
    light = results.to_ome_tiff(
        tmp_path / "l.ome.tif", pixel_size=0.1, colony=0, channels={"growth_rate": 1.0}, offset=0.0
    )
    table = results.table(-1)
    mine = table["colony"] == 0
    amount = (table["growth_rate"] * table["volume"])[mine].sum()
    assert tifffile.imread(light)[-1].sum() * 0.01 == pytest.approx(amount, rel=0.01)


# --- fluorescence ---------------------------------------------------------------------------------


def test_light_is_the_amount_in_the_cells(run, tmp_path):
    """Concentration times volume times gain, whatever the blur."""
    table = run.table(-1)
    mine = table["colony"] == 1
    amount = 7.0 * float((table["gfp"] * table["volume"])[mine].sum())
    for blur in (0.0, 0.2):
        path = run.to_ome_tiff(
            tmp_path / f"{blur}.ome.tif", pixel_size=PIXEL, colony=1, channels={"gfp": 7.0},
            blur=blur, frames=[-1], offset=0.0, background=0.0,
        )  # fmt: skip
        image = tifffile.imread(path)
        assert image.dtype == np.float32
        assert image.sum() * PIXEL**2 == pytest.approx(amount, rel=5e-3)


def test_light_from_beyond_a_window_is_blurred_into_it(run, tmp_path):
    """A window through the colony is the same part of a larger image."""
    options = {"pixel_size": 0.1, "colony": 1, "channels": {"gfp": 100.0}, "blur": 0.3}
    parts = []
    for side in (8.0, 1.0):
        path = tmp_path / f"{side}.ome.tif"
        window = ((-side, -side), (side, side))
        parts.append(
            tifffile.imread(run.to_ome_tiff(path, frames=[-1], window=window, **options)).squeeze()
        )
    whole, part = parts
    assert part.shape == (20, 20) and part[0].max() > 101.0, "cells should reach the edge"
    assert np.allclose(part, whole[70:90, 70:90], rtol=1e-5)


def test_noise_is_that_of_photons_and_camera(run, tmp_path):
    """Far from cells, mean background + offset and variance background + noise²."""
    options = {
        "pixel_size": 0.2, "colony": 0, "channels": {"gfp": 1.0}, "frames": [0], "noise": 5.0,
        "background": 50.0, "offset": 200.0, "window": ((50.0, 50.0), (90.0, 90.0)),
    }  # fmt: skip
    image = tifffile.imread(run.to_ome_tiff(tmp_path / "a.ome.tif", **options))
    assert image.dtype == np.uint16 and image.size == 40000
    # of 40,000 pixels: five standard errors, and 1/12 for rounding
    assert image.mean() == pytest.approx(250.0, abs=5 * math.sqrt(75 / 40000))
    assert image.var() == pytest.approx(75.0 + 1 / 12, rel=5 * math.sqrt(2 / 40000))
    other = tifffile.imread(run.to_ome_tiff(tmp_path / "b.ome.tif", **{**options, "seed": 1}))
    assert not np.array_equal(image, other)


def test_each_channel_has_noise_of_its_own(run, tmp_path):
    """Far from cells, where both have the same light: of 40,000 pixels that are independent the
    correlation is 0 to five standard errors."""
    image = tifffile.imread(
        run.to_ome_tiff(
            tmp_path / "a.ome.tif", pixel_size=0.2, colony=0, channels={"gfp": 1.0, "out.ahl": 1.0},
            frames=[0], noise=5.0, background=50.0, window=((50.0, 50.0), (90.0, 90.0)),
        )
    )  # fmt: skip
    first, second = image.reshape(2, -1).astype(float)
    assert first.size == 40000 and abs(np.corrcoef(first, second)[0, 1]) < 5 / 200


def test_frames_and_colonies_have_noise_of_their_own(run, tmp_path):
    """Far from cells, as above."""
    given = {"pixel_size": 0.2, "channels": {"gfp": 1.0}, "frames": [0, -1], "noise": 5.0}
    given |= {"background": 50.0, "window": ((50.0, 50.0), (90.0, 90.0))}
    images = [
        tifffile.imread(run.to_ome_tiff(tmp_path / f"{colony}.tif", colony=colony, **given))
        for colony in (0, 1)
    ]
    alike = np.corrcoef(np.concatenate(images).reshape(4, -1).astype(float))
    assert abs(alike[np.triu_indices(4, 1)]).max() < 5 / 200


def test_noise_does_not_depend_on_what_else_is_written(run, tmp_path):
    common = {"pixel_size": 0.2, "colony": 1, "noise": 3.0, "window": ((-9, -9), (9, 9))}
    all_of_it = tifffile.imread(
        run.to_ome_tiff(tmp_path / "a.ome.tif", channels={"out.ahl": 9.0, "gfp": 50.0}, **common)
    )
    one = tifffile.imread(
        run.to_ome_tiff(tmp_path / "b.ome.tif", channels={"gfp": 50.0}, frames=[-1], **common)
    )
    assert all_of_it.shape[:2] == (len(run), 2) and np.array_equal(all_of_it[-1, 1], one)


def test_what_other_programs_read(run, tmp_path):
    path = run.to_ome_tiff(
        tmp_path / "a.ome.tif", pixel_size=0.1, colony=1, channels={"gfp": 5.0, "out.ahl": 1.0}
    )
    with tifffile.TiffFile(path) as file:
        assert file.is_ome and len(file.series) == 1 and file.series[0].axes == "TCYX"
        assert len(file.pages) == 2 * len(run)
        text = file.ome_metadata
    for part in ('PhysicalSizeX="0.1"', 'PhysicalSizeYUnit="µm"', 'Name="gfp"', 'Name="out.ahl"'):
        assert part in text, part
    times = [float(t) for t in re.findall(r'DeltaT="([\d.e-]+)" DeltaTUnit="h"', text)]
    assert np.allclose(times, np.repeat(run.times, 2))
    assert ('TimeIncrement="' in text) == bool(np.allclose(np.diff(run.times), run.times[1]))


def test_what_is_written_of_a_window_is_where_it_lies(run, tmp_path):
    path = run.to_labels(
        tmp_path / "a.ome.tif", pixel_size=0.5, colony=1, window=((-3.0, -2.0), (5.0, 4.0))
    )
    with tifffile.TiffFile(path) as file:
        text, tags = file.ome_metadata, file.pages[0].tags
        resolution, unit = tags["XResolution"].value, tags["ResolutionUnit"].value
    places = {axis: set(re.findall(f'Position{axis}="([^"]*)"', text)) for axis in "XY"}
    # of the centre of the first pixel, at the left of the top row
    assert {axis: set(map(float, found)) for axis, found in places.items()} == {
        "X": {-2.75}, "Y": {3.75},
    }  # fmt: skip
    assert unit == 3 and resolution[0] / resolution[1] == 20_000  # pixels per cm
    assert 'Name="run, colony 1"' in text


def test_bad_input_is_named(run, tmp_path):
    def light(**options):
        return run.to_ome_tiff(
            tmp_path / "a.ome.tif",
            **{"pixel_size": 0.1, "colony": 0, "channels": {"gfp": 1.0}, **options},
        )

    def masks(**options):
        given = {"path": tmp_path / "a.tif", "pixel_size": 0.1, "colony": 0, **options}
        return run.to_labels(**given)

    for ask, options, message in (
        (masks, {"path": "a.png"}, r"path = 'a.png'.*\.tif or \.tiff"),
        (masks, {"pixel_size": 0.0}, "pixel_size = 0.0.*above 0"),
        (masks, {"pixel_size": 1e-5}, "pixel_size = 1e-05.*pixels.*smaller window"),
        (masks, {"colony": None}, "has the colonies 0, 1: say which"),
        (masks, {"colony": 5}, "colony = 5.*0, 1"),
        (masks, {"z": 1.0}, "z = 1.0.*left out"),
        (masks, {"window": (0, 1)}, r"window\[0\] = 0.*sequence"),
        (masks, {"window": ((0, 0), (1, -1))}, "window.*lower left corner first"),
        (masks, {"window": ((0, 0), (1, math.inf))}, r"window\[1\].*finite"),
        (light, {"channels": {"gpf": 1.0}}, "channels = 'gpf'.*Did you mean gfp.*growth_rate"),
        (light, {"channels": {}}, r"channels = \{\}.*'gfp': 100"),
        (light, {"channels": {"gfp": -1.0}}, r"channels\['gfp'\] = -1.0.*above 0"),
        (light, {"channels": {"parent": 1.0}}, "channels = 'parent'.*at least 0"),
        (light, {"channels": {"cell": 1e9}, "noise": 1.0, "frames": [-1]}, "65535.*Lower the gain"),
        (light, {"blur": -1.0}, "blur = -1.0"),
        (light, {"noise": math.nan}, "noise = nan"),
        (light, {"seed": -1}, "seed = -1"),
        (light, {"profile": "round"}, "profile = 'round'"),
    ):
        with pytest.raises(tf.InputError, match=message):
            ask(**options)
    assert list(tmp_path.iterdir()) == [], "nothing is left of what failed"
    masks()
    with pytest.raises(tf.InputError, match=r"no file yet.*overwrite"):
        masks()
    masks(overwrite=True)


def test_an_empty_colony_needs_a_window(tmp_path):
    cells = tf.Cells([[0.0, 0.0]], [1.0, 0.0], colony=[1])
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=cells, dt=0.1)
    results = recorded(scene, tmp_path / "run.h5", 0.3)
    with pytest.raises(tf.InputError, match=r"colony 0 has no cell.*window"):
        results.to_labels(tmp_path / "m.tif", pixel_size=0.1, colony=0)
    window = ((-1, -1), (1, 1))
    path = results.to_labels(tmp_path / "m.tif", pixel_size=0.1, colony=0, window=window)
    assert not tifffile.imread(path).any()
    light = results.to_ome_tiff(
        tmp_path / "l.tif", pixel_size=0.1, colony=0, window=window, channels={"growth_rate": 1.0}
    )
    assert (tifffile.imread(light) == 100).all()

"""The size of a pixel that an image file states."""

import numpy as np
import pytest

import torchfilm as tf
from tests.micrographs.rasterised import rasterised
from torchfilm.micrographs.pixel_sizes import pixel_size_of

tifffile = pytest.importorskip("tifffile")
MASK = rasterised([25.0], [20.0], [0.4], [18.0], [5.0], shape=(40, 60)).astype(np.uint16)


def ome(path, across, down, unit=None):
    sizes = {"PhysicalSizeX": across, "PhysicalSizeY": down}
    units = {} if unit is None else {"PhysicalSizeXUnit": unit, "PhysicalSizeYUnit": unit}
    tifffile.imwrite(path, MASK, ome=True, metadata={"axes": "YX", **sizes, **units})
    return path


def imagej(path, size, unit):
    tifffile.imwrite(path, MASK, imagej=True, resolution=(1 / size,) * 2, metadata={"unit": unit})
    return path


@pytest.mark.parametrize(
    ("size", "unit"),
    [(0.065, None), (0.065, "µm"), (0.065, "\u03bcm"), (65.0, "nm"), (6.5e-5, "mm")],
)
def test_an_ome_tiff_states_its_pixels(tmp_path, size, unit):
    path = ome(tmp_path / "a.ome.tif", size, size, unit)
    assert pixel_size_of(path, None) == pytest.approx(0.065)
    found, right = (tf.Cells.from_masks(path), tf.Cells.from_masks(MASK, pixel_size=0.065))
    assert found.table()["length_um"] == pytest.approx(right.table()["length_um"])


@pytest.mark.parametrize("unit", ["micron", "um", "\\u00B5m"])
def test_a_tiff_of_imagej_states_its_pixels(tmp_path, unit):
    found = pixel_size_of(imagej(tmp_path / "a.tif", 0.065, unit), None)
    assert found == pytest.approx(0.065, rel=1e-6)


def test_what_a_run_draws_states_its_pixels(tmp_path):
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=tf.inoculum(3, radius=5.0))
    for _ in tf.simulate(scene, until=0.1, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        path = tmp_path / "run.ome.tif"
        results.to_ome_tiff(path, pixel_size=0.13, channels={"growth_rate": 100.0})
    assert pixel_size_of(path, None) == pytest.approx(0.13)


def test_a_size_that_differs_gives_a_warning(tmp_path):
    path = ome(tmp_path / "a.ome.tif", 0.065, 0.065)
    with pytest.warns(UserWarning, match=r"pixel_size = 0.13 µm, but .* states 0.065 µm a pixel"):
        assert pixel_size_of(path, 0.13) == 0.13
    assert pixel_size_of(path, 0.0655) == 0.0655


def test_no_size_has_an_error(tmp_path):
    plain = tmp_path / "plain.tif"
    tifffile.imwrite(plain, MASK)
    dots = tmp_path / "dots.tif"  # a resolution for print says nothing of the microscope
    tifffile.imwrite(dots, MASK, resolution=(72, 72), resolutionunit="INCH")
    pixels = imagej(tmp_path / "pixels.tif", 1.0, "pixel")
    for image in (MASK, plain, dots, pixels, ome(tmp_path / "b.ome.tif", 1.0, 1.0, "pixel")):
        with pytest.raises(tf.InputError, match=r"does not state .* give pixel_size=…"):
            tf.Cells.from_masks(image)
    with pytest.raises(tf.InputError, match=r"states pixels of 0.1 × 0.2 µm"):
        tf.Cells.from_masks(ome(tmp_path / "c.ome.tif", 0.1, 0.2))


def test_a_broken_file_has_the_error_of_reading(tmp_path):
    path = tmp_path / "broken.tif"
    path.write_bytes(b"II*\x00" + b"\xff" * 30)
    with pytest.raises(tf.InputError, match="cannot be read as TIF"):
        tf.Cells.from_masks(path, pixel_size=0.1)
    with pytest.raises(tf.InputError, match="does not state"):
        tf.Cells.from_masks(path)

"""Cells from tables: units, directions, frames, labels, and invalid tables."""

from __future__ import annotations

import math
import warnings

import h5py
import numpy as np
import pytest
import torch
from rasterised import rasterised

import torchfilm as tf
from design import Observed

SKIMAGE = ("label", "centroid", "orientation", "axis_major_length", "axis_minor_length", "area")


def table(**columns) -> dict:
    """Columns x, y, angle and length, in µm and radians."""
    given = {"x": [0.0, 5.0], "y": [0.0, 0.0], "angle": [0.0, 1.0], "length": [2.0, 2.0], **columns}
    units = {"x": "um", "y": "um", "length": "um", "angle": "rad"}
    return {f"{n}_{units[n]}" if n in units else n: values for n, values in given.items()}


IN_PIXELS = {"x_px": [0.0, 5.0], "y_px": [0.0] * 2, "angle_rad": [0.0] * 2, "length_px": [2.0] * 2}
PIXELS = {"cx": [10.0, 40.0], "cy": [20.0, 50.0], "theta": [0.0, 30.0], "L": [40.0, 60.0]}
NAMES = {"x": "cx", "y": "cy", "length": "L", "angle": "theta"}


def read(table=PIXELS, **options) -> tf.Cells:
    given = {"pixel_size": 0.1, "columns": NAMES, "angle_unit": "degrees", **options}
    return tf.Cells.from_table(table, **given)


# --- units and directions -------------------------------------------------------------------------


def test_pixels_degrees_and_y_down():
    cells = read(y="down", length_with_caps=True, radius=0.5)
    assert np.allclose(cells.position, [[1.0, -2.0], [4.0, -5.0]])
    assert np.allclose(cells.length, [3.0, 5.0]) and cells.radius.tolist() == [0.5, 0.5]
    # 30° from +x towards the table's +y, which is down
    assert np.allclose(cells.axis[1], [math.sqrt(3) / 2, -0.5])
    assert cells.extra == {}


@pytest.mark.parametrize(
    "options, sign",
    [
        ({}, 1),
        ({"y": "up"}, 1),
        ({"y": "down"}, -1),
        ({"y": "down", "angle_turns": "counterclockwise"}, 1),
        ({"angle_turns": "clockwise"}, -1),
    ],
)
def test_the_sense_of_angles(options, sign):
    assert np.allclose(read(**options).axis[1], [math.sqrt(3) / 2, 0.5 * sign])


def test_long_labels_have_all_their_digits():
    long = [2**60, 2**60 + 1]  # which are one float
    found = tf.Cells.from_table({**IN_PIXELS, "label": long}, pixel_size=0.1, fields=[])
    assert found.micrograph.label.tolist() == [str(n) for n in long]


def test_masked_values_are_missing():
    masked = np.ma.array([0.0, 5.0], mask=[False, True])
    with pytest.raises(tf.InputError, match="row 2, column 'x_um': 'nan' is not a number"):
        tf.Cells.from_table(table(x=masked))


def test_axes_are_mirrored_with_y():
    columns = {"x": [0.0], "y": [3.0], "axis_x": [0.6], "axis_y": [0.8], "length": [2.0]}
    cells = tf.Cells.from_table(columns, length_unit="um", y="down")
    assert np.allclose(cells.axis, [[0.6, -0.8]]) and cells.position.tolist() == [[0.0, -3.0]]


def test_units_in_the_names_of_columns():
    """Only columns in pixels are scaled."""
    columns = {"x_px": [10.0], "y_um": [2.0], "angle_deg": [90.0], "length_px": [30.0]}
    cells = tf.Cells.from_table({**columns, "width_um": [0.8]}, pixel_size=0.1)
    assert np.allclose(cells.position, [[1.0, 2.0]]) and np.allclose(cells.axis, [[0.0, 1.0]])
    assert np.allclose([cells.length, cells.radius], [[3.0], [0.4]])


def test_centre_moves_each_colony_to_the_origin():
    cells = tf.Cells.from_table(table(x=[4.0, 6.0], y=[1.0, 3.0]), centre=True)
    assert cells.position.tolist() == [[-1.0, -1.0], [1.0, 1.0]]
    apart = tf.Cells.from_table(table(x=[4.0, 6.0], y=[1.0, 3.0], colony=[0, 1]), centre=True)
    assert apart.position.tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_a_data_frame_and_a_csv_file_give_the_same_cells(tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({**PIXELS, "t": [3, 3], "name": ["a", "b"]})
    frame.to_csv(tmp_path / "cells.csv")  # the first column has no name: the numbers of the rows
    columns = {**NAMES, "frame": "t", "label": "name"}
    one, other = (
        read(given, columns=columns, frame=3) for given in (frame, tmp_path / "cells.csv")
    )
    assert np.array_equal(one.position, other.position) and np.array_equal(one.axis, other.axis)
    assert one.micrograph.label.tolist() == other.micrograph.label.tolist() == ["a", "b"]
    frame.rename(columns={v: k for k, v in NAMES.items()}).drop(columns="name").to_csv(
        tmp_path / "own.csv"
    )
    own = tf.Cells.from_table(tmp_path / "own.csv", length_unit="um", angle_unit="degrees")
    assert set(own.extra) == {"t"}


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_are_the_same_after_a_table(dim):
    rng = np.random.default_rng(0)
    cells = tf.Cells(
        rng.normal(size=(5, dim)), rng.normal(size=(5, dim)), rng.uniform(1, 2, 5), 0.4,
        cell_type=[0, 1, 0, 1, 2], colony=[0, 0, 1, 1, 1], extra={"gfp": rng.uniform(size=5)},
    )  # fmt: skip
    again = tf.Cells.from_table(cells.table())
    for name in ("position", "axis", "length", "radius", "cell_type", "colony"):
        assert np.allclose(getattr(again, name), getattr(cells, name), rtol=0, atol=1e-12)
    assert np.array_equal(again.extra["gfp"], cells.extra["gfp"])


# --- degrees and radians --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["table", "csv", "hdf5"])
def test_degrees_are_noticed(tmp_path, kind):
    columns = table(angle=[0.5, -87.5])
    said = r"'angle_rad' reaches 87\.5.*radians.*1 of 2.*degrees"
    with pytest.warns(RuntimeWarning, match=said) as found:
        if kind == "table":
            tf.Cells.from_table(columns)
        elif kind == "csv":
            rows = zip(*columns.values(), strict=True)
            lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
            (tmp_path / "cells.csv").write_text("\n".join(lines))
            tf.Cells.from_table(tmp_path / "cells.csv")
        else:
            with h5py.File(tmp_path / "cells.h5", "w") as file:
                for name, values in columns.items():
                    file[name] = values
            tf.Cells.from_hdf5(tmp_path / "cells.h5")
    assert found[0].filename == __file__


def test_a_full_turn_in_radians_is_no_degrees():
    """Any warning would be an error here."""
    tf.Cells.from_table(table(angle=[2 * math.pi, -2 * math.pi]))


@pytest.mark.parametrize("angle", ["angle_deg", "angle_degrees"])
@pytest.mark.parametrize("micro", ["um", "µm", "\u03bcm"])
def test_units_are_known_as_people_write_them(micro, angle):
    names = {f"{n}_{micro}": [2.0] for n in ("x", "y", "length")}
    cells = tf.Cells.from_table({**names, angle: [90.0]})
    assert cells.length.tolist() == [2.0] and cells.extra == {}
    assert cells.axis.tolist()[0] == pytest.approx([0.0, 1.0], abs=1e-15)
    plain = {"x": [2.0], "y": [2.0], "length": [2.0], "angle": [90.0]}
    same = tf.Cells.from_table(plain, length_unit=micro, angle_unit="deg")
    assert same.axis.tolist() == cells.axis.tolist() and same.length.tolist() == [2.0]


def test_units_are_never_guessed():
    """`Cells` and `design.Observed` read their tables by the same rules."""
    plain = {"x": [0.0], "y": [0.0], "length": [2.0], "angle": [0.0]}
    for read in (tf.Cells.from_table, Observed.from_table):
        with pytest.raises(tf.InputError, match=r"'x' has no unit.*length_unit=\"um\".*\"x_um\""):
            read(plain, angle_unit="radians")
        with pytest.raises(tf.InputError, match=r"'angle' has no unit.*angle_unit.*\"angle_deg\""):
            read(plain, length_unit="um")
        read(plain, length_unit="um", angle_unit="radians")


def test_radians_taken_for_degrees_are_noticed():
    many = {"x_um": np.arange(9.0), "y_um": np.zeros(9), "length_um": np.ones(9)}
    with pytest.warns(RuntimeWarning, match=r"all 9 values.*within ±1\.5.*radians") as told:
        tf.Cells.from_table({**many, "angle": np.linspace(-1, 1.5, 9)}, angle_unit="degrees")
    assert [w.filename for w in told] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tf.Cells.from_table({**many, "angle": np.zeros(9)}, angle_unit="degrees")


# --- the tables of programs -----------------------------------------------------------------------

X, Y = np.array([40.0, 90.0, 60.3]), np.array([30.0, 41.5, 100.0])
ANGLE = np.array([0.3, -1.0, 2.2])  # from +x towards the rows, downwards
LENGTH, RADIUS = np.array([30.0, 20.0, 45.0]), np.array([7.0, 6.0, 6.5])


def regionprops(separator: str = "-") -> dict:
    measure = pytest.importorskip("skimage.measure")
    mask = rasterised(X, Y, ANGLE, LENGTH, RADIUS, (140, 130))
    return measure.regionprops_table(mask, properties=SKIMAGE, separator=separator)


def close_to_truth(cells: tf.Cells, size: float) -> None:
    assert np.allclose(cells.position / size, np.stack([X, -Y], 1), atol=0.3)
    assert np.allclose(cells.length / size, LENGTH, atol=0.6)
    assert np.allclose(cells.radius / size, RADIUS, atol=0.2)
    true = np.stack([np.cos(ANGLE), -np.sin(ANGLE)], 1)
    assert (np.abs((cells.axis * true).sum(1)) > np.cos(np.deg2rad(2.0))).all()


@pytest.mark.parametrize("separator", ["-", "_"])
def test_the_table_of_scikit_image(separator):
    cells = tf.Cells.from_table(regionprops(separator), pixel_size=0.065, columns="skimage")
    close_to_truth(cells, 0.065)
    assert cells.extra == {} and cells.micrograph.label.tolist() == ["1", "2", "3"]


def test_the_table_of_scikit_image_in_degrees_with_frames():
    columns = regionprops()
    columns["orientation"] = np.rad2deg(columns["orientation"])
    both = {n: np.concatenate([v, v + 1]) for n, v in columns.items()} | {
        "frame": [0] * 3 + [1] * 3
    }
    read = lambda **options: tf.Cells.from_table(
        both, pixel_size=0.065, columns="skimage", **options
    )
    close_to_truth(read(angle_unit="degrees", frame=0), 0.065)
    with pytest.raises(tf.InputError, match=r"2 frames: 0, 1\..*frame="):
        read(angle_unit="degrees")
    with pytest.warns(RuntimeWarning, match=r"'orientation' reaches.*over 1\.571"):
        read(frame=0)


def test_the_table_of_matlab():
    """Its measures, computed as its source does: centres from 1, angles as seen, and 1/12 for the
    area of a pixel."""
    mask = rasterised(X, Y, ANGLE, LENGTH, RADIUS, (140, 130))
    rows = []
    for k in (1, 2, 3):
        r, c = np.nonzero(mask == k)
        x, y = c + 1.0, -(r + 1.0)
        uxx, uyy, uxy = x.var() + 1 / 12, y.var() + 1 / 12, np.cov(x, y, bias=True)[0, 1]
        common = math.hypot(uxx - uyy, 2 * uxy)
        angle = 0.5 * math.degrees(math.atan2(2 * uxy, uxx - uyy))
        major, minor = (math.sqrt(8 * (uxx + uyy + s * common)) for s in (1, -1))
        rows.append((x.mean(), -y.mean(), major, minor, angle))
    names = ("Centroid_1", "Centroid_2", "MajorAxisLength", "MinorAxisLength", "Orientation")
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    cells = tf.Cells.from_table(columns, pixel_size=0.065, columns="matlab")
    close_to_truth(cells, 0.065)
    table = regionprops()
    del table["area"]
    same = tf.Cells.from_table(table, pixel_size=0.065, columns="skimage")
    assert np.allclose(cells.length, same.length) and np.allclose(cells.position, same.position)


def test_fields_are_named():
    columns = {**regionprops(), "intensity_mean": [0.1, 0.2, 0.3]}
    read = lambda **options: tf.Cells.from_table(
        columns, pixel_size=0.065, columns="skimage", **options
    )
    assert read(fields={"gfp": "intensity_mean"}).extra["gfp"].tolist() == [0.1, 0.2, 0.3]
    for fields in ("intensity_mean", ["intensity_mean"]):
        assert set(read(fields=fields).extra) == {"intensity_mean"}
    with pytest.raises(tf.InputError, match="'area' is not allowed"):
        read(fields="area")  # the state has one
    with pytest.raises(tf.InputError, match="lacks the column 'intensity'"):
        read(fields=["intensity"])


# --- frames and labels ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["label", "Label", "frame", "track_id", "index"])
def test_columns_that_number_cells_are_no_fields(name):
    numbers = [1.0, 1.0] if name == "frame" else [1.0, 2.0]
    assert set(tf.Cells.from_table(table(**{name: numbers, "gfp": [0.5, 1.5]})).extra) == {"gfp"}


def test_one_frame_of_several():
    columns = {**IN_PIXELS, "label": [7.0, 7.0], "frame": [0.0, 12.0]}
    cells = tf.Cells.from_table(columns, frame=12, pixel_size=0.1)
    assert cells.count == 1 and cells.position.tolist() == [[0.5, 0.0]]
    assert cells.micrograph.label.tolist() == ["7"]
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells).bind().start()
    assert "label" not in state.fields and "frame" not in state.fields


# --- bad input ------------------------------------------------------------------------------------

ONE = {"x_um": [0.0], "y_um": [0.0], "angle_rad": [0.0], "length_um": [1.0]}
ELLIPSES = {
    "label": [4, 9],
    "centroid-0": [5.0, 20.0],
    "centroid-1": [5.0, 20.0],
    "orientation": [0.0, 1.0],
    "axis_major_length": [20.0, 30.0],
    "axis_minor_length": [8.0, 9.0],
}
SET = {"columns": "skimage", "pixel_size": 0.1}

BAD = {
    "several frames": (table(frame=[0, 1]), {}, r"2 frames: 0, 1\. .*frame="),
    "a length unit of a program": (
        ELLIPSES,
        {**SET, "length_unit": "um"},
        r"length_unit = 'um'.*columns='skimage', which settles",
    ),
    "no such frame": (table(frame=[0, 1]), {"frame": 3}, r"frame = 3 .*one of the frames.*: 0, 1"),
    "frame without a column": (table(), {"frame": 3}, r"lacks the column 'frame'"),
    "one label twice": (table(label=[4, 4]), {}, r"row 2, label 4.*row 1 has this label, too"),
    "one place twice": (
        table(x=[1, 1], label=[4, 5]),
        {},
        r"row 1, label 4: 2 cells have the same",
    ),
    "a NaN": (table(y=[0.0, math.nan]), {}, r"row 2, column 'y_um': 'nan' is not a number"),
    "text": (table(length=["2", "long"]), {}, r"row 2, column 'length_um': 'long' is not"),
    "nothing in pixels": (ONE, {"pixel_size": 0.1}, r"pixel_size = 0\.1.*no column is in pixels"),
    "pixels without a size": ({**ONE, "width_px": [9.0]}, {}, r"'width_px' is in pixels"),
    "pixel size 0": (ONE, {"pixel_size": 0.0}, r"pixel_size = 0\.0"),
    "pixel size nan": (ONE, {"pixel_size": math.nan}, r"pixel_size = nan"),
    "two units": ({**ONE, "x": [0.0]}, {}, r"'x' and 'x_um': keep one"),
    "angle unit": (ONE, {"angle_unit": "turns"}, r"angle_unit = 'turns'.*'degrees', 'radians'"),
    "angle unit without angles": (
        {"x_um": [0.0], "y_um": [0.0], "axis_x": [1.0], "axis_y": [0.0], "length_um": [1.0]},
        {"angle_unit": "degrees"},
        r"angle_unit = 'degrees'.*left out",
    ),
    "turns without angles": (
        {"x_um": [0.0], "y_um": [0.0], "axis_x": [1.0], "axis_y": [0.0], "length_um": [1.0]},
        {"angle_turns": "clockwise"},
        r"angle_turns.*no column 'angle'",
    ),
    "y": (ONE, {"y": "south"}, r"y = 'south'.*'up', 'down'"),
    "y down in space": ({**ONE, "z_um": [0.0]}, {"y": "down"}, r"\"up\" for cells in space"),
    "caps without radius": (ONE, {"length_with_caps": True}, r"requires the radius"),
    "caps longer than cells": (
        table(label=[3, 8], length=[2.0, 0.7]),
        {"length_with_caps": True, "radius": 0.5},
        r"row 2, label 8 is 0\.7 µm long with caps.*width, 1 µm \(such cells: 1\)",
    ),
    "two radii": ({**ONE, "width_um": [1.0]}, {"radius": 0.5}, r"width and radius= both"),
    "negative radius": (ONE, {"radius": -0.5}, r"radius = -0\.5"),
    "a name that the table lacks": (ONE, {"columns": {"x": "cx"}}, r"lacks the column 'cx'"),
    "of ImageJ": (
        {n: [1.0] for n in ("X", "Y", "Angle", "Major", "Minor")},
        {},
        r"lacks the column 'x'.*case count: rename X, Y, Angle to x, y, angle, or give columns="
        r"\{'x': 'X', 'y': 'Y', 'angle': 'Angle'\}\.",
    ),
    "an angle in capitals": (
        {"x_um": [0.0], "y_um": [0.0], "length_um": [1.0], "ANGLE_RAD": [0.0]},
        {},
        r"direction: .*rename ANGLE_RAD to angle_rad\.$",
    ),
    "a name in capitals beside the same with a unit": (
        {"X": [0.0], "Y": [0.0], "Angle": [0.0], "length_um": [1.0], "angle_rad": [0.0]},
        {},
        r"lacks the column 'x'.*rename X, Y to x, y, or give columns=\{'x': 'X', 'y': 'Y'\}\.$",
    ),
    "a field in capitals": (
        {**ONE, "GFP": [1.0]},
        {"fields": ["gfp"]},
        r"lacks the column 'gfp'.*Did you mean 'GFP'\? Upper and lower case count",
    ),
    "a quantity that is none": (ONE, {"columns": {"xx": "x"}}, r"columns = 'xx'.*'x'"),
    "a program that is none": (ONE, {"columns": "delta"}, r"columns = 'delta'.*'skimage'"),
    "columns of another kind": (ONE, {"columns": ["x"]}, r"names of columns by quantity"),
    "of skimage, not said": (ELLIPSES, {}, r"lacks the column 'x'.*columns='skimage'"),
    "own, said to be skimage": (ONE, SET, r"lacks the column 'centroid-1'.*scikit-image"),
    "skimage, said to be matlab": (
        ELLIPSES,
        {"columns": "matlab", "pixel_size": 0.1},
        r"lacks the column 'Centroid_1'.*look like columns='skimage'",
    ),
    "a program's pixels without a size": (ELLIPSES, {"columns": "skimage"}, r"pixel_size = None"),
    "y of a program": (ELLIPSES, {**SET, "y": "up"}, r"y = 'up'.*columns='skimage', which settles"),
    "two names of one measure": (
        {**ELLIPSES, "major_axis_length": [1, 2]},
        SET,
        r"'axis_major_length' and 'major_axis_length': keep one",
    ),
    "no width": (
        {**ELLIPSES, "axis_minor_length": [8.0, 0.0]},
        SET,
        r"row 2, label 9 has axes of 30 and 0 pixels",
    ),
    "no area": ({**ELLIPSES, "area": [9.0, 0.0]}, SET, r"label 9 has an area of 0 pixels"),
    "axes exchanged": ({**ELLIPSES, "axis_minor_length": [8.0, 31.0]}, SET, r"label 9.*30 and 31"),
    "nan in a program's row": (
        {**ELLIPSES, "orientation": [math.nan, math.nan]},
        SET,
        r"row 1, column 'orientation': 'nan' is not a number \(in 2 of 2 rows\)",
    ),
    "complex numbers": (table(x=[1.0, 2.0j]), {}, r"column 'x_um': '\(1\+0j\)' is not a number"),
    "one column for two": (
        ONE,
        {"columns": {"x": "length", "length": "length"}},
        r"columns\['x'\] = 'length'.*used once",
    ),
    "a column that is no name": (ONE, {"columns": {"x": 3}}, r"columns\['x'\] = 3"),
    "fields": (ONE, {"fields": 3}, r"fields = 3.*names of columns"),
    "a required column of text": (
        table(length=["abc", "abc"]),
        {},
        r"column 'length_um': 'abc' is not a number \(in 2 of 2 rows\)\. This column is needed",
    ),
    "a radius of text": (table(radius_um=["abc", "abc"]), {}, r"'radius_um'.*Leave the column out"),
    "a cell without a length": (table(length=[1.0, math.nan]), {}, r"'length_um'.*such cells out"),
    "a field of text": (table(strain=["a", "b"]), {}, r"'strain'.*Leave the column out"),
    "caps": (ONE, {"length_with_caps": "yes"}, r"length_with_caps = 'yes'.*True, False"),
    "centre": (ONE, {"centre": "x"}, r"centre = 'x'"),
    "an argument that is none": (ONE, {"pixelsize": 0.1}, r"'pixelsize'.*Did you mean pixel_size"),
    "no table": (7, {}, r"table = 'int'.*the path of a CSV file"),
    "a nested column": ({**ONE, "x": [[0.0, 1.0]]}, {}, r"column 'x'.*not a list of numbers"),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_tables_are_refused(kind):
    columns, options, message = BAD[kind]
    with pytest.raises(tf.InputError, match=message):
        tf.Cells.from_table(columns, **options)


@pytest.mark.parametrize(
    "data, message",
    [
        ("x,y\n1,2\n".encode("utf-16"), r"UTF-8"),
        ("x,y,länge\n1,2,3\n".encode("latin-1"), r"UTF-8"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", r"UTF-8|CSV"),
        (b"x_um,y_um,angle_rad,length_um\n1,2,0,3\n4,5,0", r"line 3, column 'length_um': no value"),
        (b"", r"empty"),
    ],
    ids=["UTF-16", "Latin-1", "a picture", "truncated", "empty"],
)
def test_files_that_are_no_tables_are_reported(tmp_path, data, message):
    path = tmp_path / "cells.csv"
    path.write_bytes(data)
    with pytest.raises(tf.InputError, match=message) as caught:
        tf.Cells.from_table(path)
    assert "cells.csv" in str(caught.value)


def test_cells_of_a_table_start_a_run():
    """The first lines that a user types, from the table of a frame to a colony."""
    cells = tf.Cells.from_table(
        {**PIXELS, "t": [3, 3]},
        pixel_size=0.065,
        columns={**NAMES, "frame": "t"},
        angle_unit="degrees",
        y="down",
        length_with_caps=True,
        radius=0.4,
        frame=3,
    )
    scene = tf.Scene(
        tf.Growth(rate=1.2), tf.Division(length=5.0), tf.Mechanics(dim=2), founders=cells
    )
    *_, state = tf.simulate(scene, until=0.2, dt=0.05)
    assert state.cells == 2 and torch.isfinite(state.position).all()


def test_lengths_that_no_bacteria_have_are_noticed():
    """As with a pixel size in nm, where no column says how wide the cells are."""
    columns = {"x_px": [10.0, 90.0], "y_px": [0.0, 0.0], "length_px": [40.0, 50.0],
               "angle_rad": [0.0, 1.0]}  # fmt: skip
    with pytest.warns(UserWarning, match=r"2\.93e\+03 µm long with their caps.* = 65 µm right"):
        tf.Cells.from_table(columns, pixel_size=65.0, y="up")
    assert tf.Cells.from_table(columns, pixel_size=0.065, y="up").count == 2

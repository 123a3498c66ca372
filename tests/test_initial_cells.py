"""Initial cells: arrays, CSV, HDF5, overlaps, and invalid input."""

from __future__ import annotations

import math
import warnings

import h5py
import numpy as np
import pytest
import torch
from helpers import step

import torchfilm as tf


def seed(cells: tf.Cells, colonies: int = 1, **options) -> tf.State:
    return tf.Scene(tf.Growth(), founders=cells).bind(colonies, **options).start()


# --- arrays ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [list, np.asarray, torch.as_tensor])
def test_from_lists_arrays_or_tensors(kind):
    cells = tf.Cells(
        kind([[0.0, 1.0], [2.0, 3.0]]),
        kind([[3.0, 4.0], [0.0, -2.0]]),
        kind([1.0, 2.5]),
        kind([0.5, 0.25]),
    )
    assert (cells.count, cells.dim) == (2, 2)
    state = seed(cells, dtype=torch.float64)
    assert state.position.tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert state.axis.tolist() == [[pytest.approx(0.6), pytest.approx(0.8)], [0.0, -1.0]], (
        "axes of any length are made unit"
    )
    assert state.length.tolist() == [1.0, 2.5] and state.radius.tolist() == [0.5, 0.25]


def test_one_number_serves_all_cells():
    state = seed(tf.Cells([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [0.0, 0.0, 2.0], 1.5, 0.25))
    assert state.length.tolist() == [1.5, 1.5] and state.radius.tolist() == [0.25, 0.25]
    assert state.axis.tolist() == [[0.0, 0.0, 1.0]] * 2


def test_axes_are_unit_in_float32():
    rng = np.random.default_rng(0)
    state = seed(tf.Cells(np.zeros((500, 3)), rng.normal(size=(500, 3))))
    # one rounding of each component and one of the norm
    assert float((state.axis.double().norm(dim=1) - 1).abs().max()) < 2 * 2.0**-23


def test_a_copy_for_each_colony():
    state = seed(tf.Cells([[0.0, 0.0], [5.0, 0.0]], [[1.0, 0.0]] * 2, [1.0, 2.0]), 3)
    assert state.counts.tolist() == [2, 2, 2] and state.length.tolist() == [1.0, 2.0] * 3
    assert state.uid.tolist() == [0, 1] * 3 and state.next_uid.tolist() == [2, 2, 2]


@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
def test_a_colony_for_each_cell():
    cells = tf.Cells(
        [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]], [1.0, 0.0], colony=[2, 0, 2, 0]
    )
    state = seed(cells)
    assert state.colonies == 3 and state.counts.tolist() == [2, 0, 2]
    assert state.position[:, 0].tolist() == [1.0, 3.0, 0.0, 2.0], (
        "in their own order within a colony"
    )
    assert state.uid.tolist() == [0, 1, 0, 1]
    assert seed(cells, 5).counts.tolist() == [2, 0, 2, 0, 0]
    with pytest.raises(tf.InputError, match="at least 3"):
        seed(cells, 2)


def test_types_and_extra_columns_become_fields():
    cells = tf.Cells(
        [[0.0, 0.0], [5.0, 0.0]], [1.0, 0.0], cell_type=[0, 3], extra={"gfp": [0.5, 1.5]}
    )
    state = seed(cells)
    assert state.cell_type.tolist() == [0, 3] and state.cell_type.dtype == torch.int64
    assert state.gfp.tolist() == [0.5, 1.5]


def test_arrays_given_are_not_shared():
    """A state is frozen: a later change of the array has no effect on it."""
    position = np.zeros((1, 2))
    state = seed(tf.Cells(position, [1.0, 0.0]))
    position[0, 0] = 9.0
    assert state.position.tolist() == [[0.0, 0.0]]


def test_cells_given_at_seeding_replace_the_founders():
    scene = tf.Scene(tf.Growth(rate=1.0), founders=tf.Cells.single(2))
    assert scene.bind(cells=tf.Cells([[7.0, 0.0]], [1.0, 0.0])).start().position.tolist() == [
        [7.0, 0.0]
    ]


@pytest.mark.parametrize("dim", [2, 3])
def test_single(dim):
    cell = tf.Cells.single(dim)
    assert cell.position.tolist() == [[0.0] * dim] and cell.axis.tolist() == [
        [1.0] + [0.0] * (dim - 1)
    ]


# --- overlaps -------------------------------------------------------------------------------------


def test_overlaps_are_reported_deepest_first():
    """For parallel rods in a row the overlap is 1 − distance."""
    cells = tf.Cells([[0.0, 0.0], [0.0, 0.9], [0.0, 1.5], [0.0, 9.0]], [1.0, 0.0])
    found = cells.overlaps()
    assert [(sorted(f[:2]), pytest.approx(f[2], abs=1e-12)) for f in found] == [
        ([1, 2], 0.4),
        ([0, 1], 0.1),
    ]
    assert [sorted(f[:2]) for f in cells.overlaps(0.2)] == [[1, 2]]


def test_cells_of_different_colonies_do_not_overlap():
    assert tf.Cells([[0.0, 0.0], [0.0, 0.5]], [1.0, 0.0], colony=[0, 1]).overlaps() == []
    assert len(tf.Cells([[0.0, 0.0], [0.0, 0.5]], [1.0, 0.0], colony=[1, 1]).overlaps()) == 1


def test_no_cell_no_overlap():
    assert tf.Cells(np.zeros((0, 2)), np.zeros((0, 2))).overlaps() == []


# --- CSV and HDF5 ---------------------------------------------------------------------------------

CSV = """\
x_um,y_um,angle_rad,length_um,radius_um,cell_type,colony,gfp
0,1,0,2.0,0.5,1,0,0.25
10,1,1.5707963267948966,3.0,0.4,0,1,0.75
"""


def test_csv(tmp_path):
    path = tmp_path / "cells.csv"
    path.write_text(CSV)
    cells = tf.Cells.from_table(path)
    assert cells.position.tolist() == [[0.0, 1.0], [10.0, 1.0]]
    assert np.allclose(cells.axis, [[1.0, 0.0], [0.0, 1.0]], rtol=0, atol=1e-15)
    assert cells.length.tolist() == [2.0, 3.0] and cells.radius.tolist() == [0.5, 0.4]
    assert (
        cells.cell_type.tolist() == [1, 0]
        and cells.colony.tolist() == [0, 1]
        and cells.extra["gfp"].tolist() == [0.25, 0.75]
    )
    assert seed(cells).counts.tolist() == [1, 1]


def test_csv_in_space_with_axes(tmp_path):
    path = tmp_path / "cells.csv"
    path.write_text("x_um,y_um,z_um,axis_x,axis_y,axis_z,length_um\n1,2,3,0,0,2,2.5\n")
    cells = tf.Cells.from_table(path)
    assert cells.position.tolist() == [[1.0, 2.0, 3.0]] and cells.axis.tolist() == [[0.0, 0.0, 1.0]]
    assert cells.length.tolist() == [2.5] and cells.radius.tolist() == [0.5]


@pytest.mark.parametrize("group", ["/", "/frame/7"])
def test_hdf5(tmp_path, group):
    path = tmp_path / "cells.h5"
    with h5py.File(path, "w") as file:
        for name, values in {
            "x_um": [0.0, 5.0],
            "y_um": [1.0, 1.0],
            "angle_rad": [0.0, 0.0],
            "length_um": [2.0, 3.0],
            "cell_type": [0, 2],
        }.items():
            file[f"{group}/{name}"] = values
    cells = tf.Cells.from_hdf5(path, group) if group != "/" else tf.Cells.from_hdf5(path)
    assert cells.position.tolist() == [[0.0, 1.0], [5.0, 1.0]] and cells.cell_type.tolist() == [
        0,
        2,
    ]


def test_table():
    cells = tf.Cells.from_table(
        {"x_um": [0.0], "y_um": [0.0], "angle_rad": [math.pi / 6], "length_um": [2.0]}
    )
    assert np.allclose(cells.axis, [[math.sqrt(3) / 2, 0.5]], rtol=0, atol=1e-15)


def test_a_run_from_a_csv_file(tmp_path):
    path = tmp_path / "cells.csv"
    path.write_text("x_um,y_um,angle_rad,length_um\n0,0,0,2\n0,1.1,0.1,2.5\n")
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Mechanics(dim=2))
    state = scene.bind(2, cells=tf.Cells.from_table(path)).start()
    for _ in range(10):
        state = step(scene, state, 0.1)
    assert state.counts.tolist()[0] > 2


# --- bad input ------------------------------------------------------------------------------------

P, A = [[0.0, 0.0], [3.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]]

BAD = {
    "position nan": (
        lambda: tf.Cells([[0.0, math.nan]], [[1.0, 0.0]]),
        r"position\[0, 1\].*nan.*finite",
    ),
    "position infinite": (
        lambda: tf.Cells([[math.inf, 0.0]], [[1.0, 0.0]]),
        r"position\[0, 0\].*inf",
    ),
    "position flat": (lambda: tf.Cells([0.0, 0.0], [1.0, 0.0]), r"position.*\(2,\).*\(N, 2\)"),
    "position 4-D": (lambda: tf.Cells([[0.0] * 4], [[1.0] * 4]), r"position.*\(N, 2\)"),
    "position text": (lambda: tf.Cells([["a", "b"]], [[1.0, 0.0]]), r"position.*numbers"),
    "position ragged": (lambda: tf.Cells([[0.0, 0.0], [1.0]], A), r"position.*numbers"),
    "axis nan": (lambda: tf.Cells(P, [[1.0, 0.0], [math.nan, 0.0]]), r"axis\[1, 0\].*finite"),
    "axis zero": (lambda: tf.Cells(P, [[1.0, 0.0], [0.0, 0.0]]), r"axis\[1\].*not zero"),
    "axis shape": (lambda: tf.Cells(P, [[1.0, 0.0]] * 3), r"axis.*\(3, 2\).*\(2, 2\)"),
    "axis angles": (lambda: tf.Cells(P, [0, 90]), r"for two cells.*Write axis=\[\[cos"),
    "axis 3-D": (lambda: tf.Cells(P, [[1.0, 0.0, 0.0]] * 2), r"axis"),
    "length negative": (lambda: tf.Cells(P, A, [2.0, -0.1]), r"length\[1\].*-0\.1.*at least 0"),
    "length nan": (lambda: tf.Cells(P, A, [2.0, math.nan]), r"length\[1\].*finite"),
    "length of all nan": (lambda: tf.Cells(P, A, math.nan), r"length"),
    "length of all negative": (lambda: tf.Cells(P, A, -1.0), r"length.*at least 0"),
    "length shape": (lambda: tf.Cells(P, A, [2.0, 2.0, 2.0]), r"length.*\(3,\).*\(2,\)"),
    "length text": (lambda: tf.Cells(P, A, "long"), r"length.*numbers"),
    "radius zero": (lambda: tf.Cells(P, A, 2.0, [0.5, 0.0]), r"radius\[1\].*above 0"),
    "radius negative": (lambda: tf.Cells(P, A, 2.0, -0.5), r"radius.*above 0"),
    "radius infinite": (lambda: tf.Cells(P, A, 2.0, [0.5, math.inf]), r"radius\[1\].*finite"),
    "type fraction": (lambda: tf.Cells(P, A, cell_type=[0, 1.5]), r"cell_type\[1\].*whole"),
    "type negative": (lambda: tf.Cells(P, A, cell_type=[0, -1]), r"cell_type\[1\].*whole"),
    "type shape": (lambda: tf.Cells(P, A, cell_type=[0]), r"cell_type.*\(1,\).*\(2,\)"),
    "colony fraction": (lambda: tf.Cells(P, A, colony=[0, 0.5]), r"colony\[1\].*whole"),
    "colony negative": (lambda: tf.Cells(P, A, colony=[0, -1]), r"colony\[1\].*whole"),
    "extra shape": (lambda: tf.Cells(P, A, extra={"gfp": [1.0]}), r"gfp.*\(1,\)"),
    "extra nan": (lambda: tf.Cells(P, A, extra={"gfp": [1.0, math.nan]}), r"gfp\[1\].*finite"),
    "extra reserved": (lambda: tf.Cells(P, A, extra={"volume": [1.0, 2.0]}), r"volume"),
    "extra no name": (lambda: tf.Cells(P, A, extra={"mean gfp": [1.0, 2.0]}), r"mean gfp"),
    "table without x": (
        lambda: tf.Cells.from_table({"y_um": [0.0], "length_um": [1.0], "angle_rad": [0.0]}),
        r"lacks the column 'x'.*y_um, length_um",
    ),
    "table without length": (
        lambda: tf.Cells.from_table({"x_um": [0.0], "y_um": [0.0], "angle_rad": [0.0]}),
        r"lacks the column 'length'",
    ),
    "table without direction": (
        lambda: tf.Cells.from_table({"x_um": [0.0], "y_um": [0.0], "length_um": [1.0]}),
        r"'angle'.*axis_x, axis_y",
    ),
    "table unequal": (
        lambda: tf.Cells.from_table(
            {"x_um": [0.0, 1.0], "y_um": [0.0], "angle_rad": [0.0, 0.0], "length_um": [2.0, 2.0]}
        ),
        r"\by_um\b",
    ),
    "table axis unequal": (
        lambda: tf.Cells.from_table(
            {"x_um": [0.0, 1.0], "y_um": [0.0, 1.0], "angle_rad": [0.0], "length_um": [2.0, 2.0]}
        ),
        r"angle|axis",
    ),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_cells_are_refused_by_name(kind):
    make, message = BAD[kind]
    with pytest.raises(tf.InputError, match=message):
        make()


BAD_CSV = {
    "text": (
        "x_um,y_um,angle_rad,length_um\n0,0,0,2\n1,zero,0,2\n",
        r"line 3, column 'y_um'.*'zero'",
    ),
    "blank": ("x_um,y_um,angle_rad,length_um\n0,0,0,2\n1,,0,2\n", r"line 3, column 'y_um'"),
    "short row": (
        "x_um,y_um,angle_rad,length_um\n0,0,0,2\n1,0,0,2\n1,0,0\n",
        r"line 4, column 'length_um'.*3 values.*4 columns",
    ),
    "one word": (
        "x_um,y_um,angle_rad,length_um\n0,0,0,2\nend\n",
        r"line 3, column 'y_um'.*1 value .*4 columns",
    ),
    "long row": ("x_um,y_um,angle_rad,length_um\n0,0,0,2\n1,0,0,2,9\n", r"line 3"),
    "decimal commas": ("x_um,y_um,angle_rad,length_um\n0,0,0,2\n1,5,0,0,2,0\n", r"line 3"),
    "empty file": ("", r"cells\.csv.*empty.*header.*x_um,y_um,angle_rad,length_um"),
    "blank lines only": ("\n\n", r"cells\.csv.*empty"),
    "header only": ("x_um,y_um,angle_rad,length_um\n", r"cells\.csv.*no cell.*header"),
    "semicolons": (
        "x_um;y_um;angle_rad;length_um\n0;0;0;2\n",
        r"cells\.csv, line 1.*semicolon.*comma",
    ),
    "semicolons and decimal commas": (
        "x_um;y_um;angle_rad;length_um\n0,5;0;0;2,0\n",
        r"cells\.csv, line 1.*semicolon.*comma.*decimal point",
    ),
    "tabs": ("x_um\ty_um\tangle_rad\tlength_um\n0\t0\t0\t2\n", r"cells\.csv, line 1.*tab.*comma"),
    "angle and axis": (
        "x_um,y_um,angle_rad,axis_x,axis_y,length_um\n0,0,0,1,0,2\n",
        r"cells\.csv.*'angle'.*'axis_x'.*one of the two",
    ),
    "angle and half an axis": (
        "x_um,y_um,angle_rad,axis_y,length_um\n0,0,0,1,2\n",
        r"'angle'.*'axis_y'.*one of the two",
    ),
    "a name twice": (
        "x_um,y_um,angle_rad,length_um,x_um\n0,0,0,2,1\n",
        r"cells\.csv, line 1.*'x_um' twice",
    ),
    "no header": ("0,0,0,2\n1,0,0,2\n", r"line 1: numbers instead of a header"),
    "nan": (
        "x_um,y_um,angle_rad,length_um\n0,0,0,2\nnan,0,0,2\n",
        r"line 3, column 'x_um': 'nan' is not a number",
    ),
    "negative": ("x_um,y_um,angle_rad,length_um\n0,0,0,-2\n", r"length\[0\]"),
    "zero axis": ("x_um,y_um,axis_x,axis_y,length_um\n0,0,0,0,2\n", r"axis\[0\]"),
}


@pytest.mark.parametrize("kind", list(BAD_CSV))
def test_bad_csv_files_are_refused_with_the_place(tmp_path, kind):
    text, message = BAD_CSV[kind]
    path = tmp_path / "cells.csv"
    path.write_text(text)
    with pytest.raises(tf.InputError, match=message) as caught:
        tf.Cells.from_table(path)
    if "line" in message or "lacks" in message:
        assert "cells.csv" in str(caught.value)


@pytest.mark.parametrize(
    "data",
    [
        b"x_um,y_um,angle_rad,length_um\n0,0,0,\xff\xfe\n",
        b"x_um,y_um,angle_rad,length_um\n0,0,\x00,2\n",
    ],
    ids=["not UTF-8", "a zero byte"],
)
def test_a_csv_file_that_is_no_text_is_reported(tmp_path, data):
    path = tmp_path / "cells.csv"
    path.write_bytes(data)
    with pytest.raises(tf.InputError, match=r"cells\.csv"):
        tf.Cells.from_table(path)


def test_a_table_without_cells_is_reported():
    with pytest.raises(tf.InputError, match=r"table.*no cell"):
        tf.Cells.from_table({"x_um": [], "y_um": [], "angle_rad": [], "length_um": []})


def test_csv_lines_are_counted_as_an_editor_does(tmp_path):
    """Blank lines count: the bad number is in the fifth line of the file."""
    path = tmp_path / "cells.csv"
    path.write_text("x_um,y_um,angle_rad,length_um\n0,0,0,2\n\n\n1,zero,0,2\n")
    with pytest.raises(tf.InputError, match="line 5"):
        tf.Cells.from_table(path)


@pytest.mark.parametrize("read", [tf.Cells.from_table, tf.Cells.from_hdf5])
def test_a_missing_file_is_reported_with_its_name(tmp_path, read):
    with pytest.raises((tf.InputError, FileNotFoundError), match=r"no_such_file"):
        read(tmp_path / "no_such_file.xx")


def test_a_file_that_is_no_hdf5_is_reported(tmp_path):
    path = tmp_path / "cells.h5"
    path.write_text("x,y\n0,0\n")
    with pytest.raises(tf.InputError, match=r"cells\.h5"):
        tf.Cells.from_hdf5(path)


def test_a_missing_group_is_reported(tmp_path):
    path = tmp_path / "cells.h5"
    with h5py.File(path, "w") as file:
        file["x_um"] = [0.0]
    with pytest.raises(tf.InputError, match="frame"):
        tf.Cells.from_hdf5(path, "/frame")


def test_a_data_set_of_text_is_reported(tmp_path):
    path = tmp_path / "cells.h5"
    with h5py.File(path, "w") as file:
        file["x_um"], file["y_um"], file["angle_rad"], file["length_um"] = (
            [0.0],
            [0.0],
            [0.0],
            [2.0],
        )
        file["strain"] = ["K12"]
    with pytest.raises(tf.InputError, match="strain"):
        tf.Cells.from_hdf5(path)


# --- cells in one another -------------------------------------------------------------------------


def on_a_plane(*places, **options) -> tf.State:
    cells = tf.Cells([list(p) for p in places], [1.0, 0.0], **options)
    return tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=cells).bind().start()


def test_two_cells_at_one_place_are_noticed():
    """They can be separated (tests/laws), but one is likely to be listed twice."""
    with pytest.warns(
        RuntimeWarning,
        match=r"cells 0 and 2 of colony 0 start at the same place, \[1\.5, 0\.0\] \(.*pairs: 1\)",
    ) as told:
        on_a_plane((1.5, 0.0), (9.0, 0.0), (1.5, 0.0), (9.0, 5.0))
    assert [w.filename for w in told] == [__file__]


def test_two_cells_at_one_place_in_a_table_are_refused():
    columns = {
        "x_um": [4.0, 1.0, 4.0],
        "y_um": [0.0] * 3,
        "angle_rad": [0.0, 0.0, 1.0],
        "length_um": [2.0] * 3,
    }
    with pytest.raises(
        tf.InputError, match=r"row 1: 2 cells.*\[4\.0, 0\.0\].*positions: 1.*listed twice"
    ):
        tf.Cells.from_table(columns)
    assert tf.Cells.from_table({**columns, "colony": [0, 0, 1]}).count == 3


def test_cells_deep_in_one_another_are_noticed():
    """Parallel rods of radius 0.5 µm, 0.4 µm apart: they overlap by 0.6 µm."""
    with pytest.warns(
        RuntimeWarning, match=r"cells 1 and 2 of colony 0 start 0\.6 µm deep.*a radius: 1\)"
    ):
        on_a_plane((9.0, 9.0), (0.0, 0.0), (0.0, 0.4))


def test_less_than_a_radius_or_other_colonies_are_no_matter():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        on_a_plane((0.0, 0.0), (0.0, 0.6))
        on_a_plane((0.0, 0.0), (0.0, 0.0), colony=[0, 1])


def test_without_mechanics_cells_may_be_anywhere():
    assert seed(tf.Cells([[0.0, 0.0]] * 3, [1.0, 0.0])).cells == 3


# --- lengths in pixels ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "division, length, pixels",
    [({"length": 4.2}, 39.6, True), ({"volume": 3.0}, 39.6, True), ({"length": 4.2}, 4.5, False)],
)
def test_lengths_in_pixels_are_noticed(division, length, pixels):
    scene = tf.Scene(tf.Division(**division), founders=tf.Cells([[0.0, 0.0]], [1.0, 0.0], length))
    with pytest.raises(
        tf.InputError, match=r"cell .* begins with a (length|volume) of .* threshold is .* at most"
    ) as caught:
        scene.bind().start()
    said = str(caught.value)
    assert ("look like pixels" in said) == pixels and "Raise the threshold" in said
    if pixels:
        assert "length 39.6" in said and "multiply" in said


def test_a_table_of_results_is_read_back_as_cells(tmp_path):
    """What it has of the run, of other columns and of the medium is no field of the cells."""
    scene = tf.scenes.quorum_sensing()
    *_, state = tf.simulate(scene, cells=6, record=tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        results.to_pandas(frame=-1).to_csv(tmp_path / "last.csv", index=False)
    given = {"length_unit": "um", "angle_unit": "radians"}
    cells = tf.Cells.from_table(tmp_path / "last.csv", **given)
    assert set(cells.extra) == {"ahl", "division_threshold", "growth_rate", "luxi"}
    again = scene.bind(cells=cells).start()
    assert torch.allclose(again.fields["luxi"], state.fields["luxi"])
    assert torch.allclose(again.length, state.length)


# --- numbers of colonies --------------------------------------------------------------------------


def test_numbers_that_leave_colonies_empty_are_warned_of():
    table = {"x_um": [0.0, 0.0], "y_um": [0.0, 3.0], "length_um": [2.0, 2.0],
             "angle_rad": [0.0, 0.0], "colony": [1, 3]}  # fmt: skip
    with pytest.warns(UserWarning, match="colonies 0, 2 of 4 stay empty.*of colonies 1, 3 only"):
        cells = tf.Cells.from_table(table)
    assert seed(cells).counts.tolist() == [0, 1, 0, 1]  # and no second word


def test_names_are_no_numbers_of_colonies():
    with pytest.raises(tf.InputError, match=r"colony = 20250131.*below 100000.*np|numpy\.unique"):
        tf.Cells([[0.0, 0.0], [0.0, 3.0]], [1.0, 0.0], colony=[0, 20250131])
    number = 9 * np.arange(12_000)  # gaps, but not so many
    assert tf.Cells(np.zeros((12_000, 2)), [1.0, 0.0], colony=number).colonies == 107_992

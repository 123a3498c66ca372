"""What commands print and write is what the run and the library say."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

import torchfilm as tf
from torchfilm.cli.export import Export
from torchfilm.cli.inspect import Info
from torchfilm.cli.report import _size, summary_table
from torchfilm.cli.start_cells import StartCells
from torchfilm.tools.timing import Timings


def test_info_counts_cells_of_the_last_frame_and_keeps_the_order_of_values(tmp_path, capsys):
    scene = tf.Scene(tf.Growth(rate=[1.5, 0.7]), tf.Division(length=3.0), dim=2, dt=0.1)
    *_, state = tf.simulate(scene, until=2.0, record=tmp_path / "run.h5")
    many, few = state.counts.tolist()
    assert 1 < few < many
    Info(str(tmp_path / "run.h5"))()
    text = capsys.readouterr().out
    assert f"cells in the last frame: {few + many} ({few} to {many} a colony)" in text
    assert "Growth.rate = 1.5, 0.7" in text


def test_the_mean_overlap_of_a_run_is_that_of_all_its_pairs():
    """One pair by 0.4 µm in the first colony, and two by 0.1 µm in the second."""
    places = [[0.0, 0.0], [0.0, 0.6], [0.0, 0.0], [0.0, 0.9], [0.0, 1.8]]
    cells = tf.Cells(places, [[1.0, 0.0]] * 5, 2.0, radius=0.5, colony=[0, 0, 1, 1, 1])
    scene = tf.Scene(tf.Mechanics(dim=2), founders=cells)
    said = summary_table(scene, scene.bind().start(), Timings(), 1.0)
    assert "mean 0.2000 µm, worst 0.400 µm" in said and "(2 to 3 a colony)" in said


def test_the_thickness_of_a_film_counts_from_its_floor():
    cells = tf.Cells([[5.0, 2.5], [12.0, 2.5]], [[1.0, 0.0]] * 2, 2.0, radius=0.5)
    floor = tf.Plane(y=2.0, facing="+y")
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[floor], periodic={"x": (0, 20)}), founders=cells)
    state = scene.bind().start()
    thick = float(tf.measure.film(state, floor=2.0).thickness)
    what, size = _size(scene, state)
    assert what == "film" and size.startswith(f"{thick:.1f} µm thick") and 0 < thick < 1


def test_masks_of_a_section_and_a_window_are_those_of_the_library(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="the extra images")
    cells = tf.Cells([[1.0, 0.0, -1.0], [3.0, 2.0, 1.0]], [[1.0, 0.0, 0.0]] * 2, 2.0)
    scene = tf.Scene(tf.Growth(rate=0.1), founders=cells, dt=0.1)
    path = tmp_path / "run.h5"
    tf.simulate(scene, until=0.1, record=path).last()
    given = {"pixel_size": 0.25, "z": -1.0}
    Export(path, tmp_path / "a.tif", window=[-2.0, -1.0, 6.0, 4.0], **given)()
    with tf.Results(path) as results:
        results.to_labels(tmp_path / "b.tif", window=((-2.0, -1.0), (6.0, 4.0)), **given)
    ours, wanted = (tifffile.imread(tmp_path / name) for name in ("a.tif", "b.tif"))
    assert ours.shape[-2:] == (20, 32) and np.array_equal(ours, wanted)
    assert set(np.unique(ours)) == {0, 1}


def test_rods_may_be_written_as_lines(tmp_path):
    path = tmp_path / "run.h5"
    cells = tf.Cells([[0.0, 0.0], [5.0, 0.0]], [[1.0, 0.0]] * 2, 2.0)
    tf.simulate(tf.Scene(tf.Growth(rate=0.1), founders=cells), until=0.1, record=path).last()
    Export(path, tmp_path / "a.vtkhdf", rods="lines", frames=["0"])()
    with h5py.File(tmp_path / "a.vtkhdf") as file:
        assert file["VTKHDF/Lines/NumberOfCells"][...].tolist() == [2]
        assert file["VTKHDF/Polygons/NumberOfCells"][...].tolist() == [0]


def test_units_of_a_table_in_hdf5_are_those_of_the_options(tmp_path):
    with h5py.File(tmp_path / "cells.h5", "w") as file:
        columns = {"x": [1.0, 5.0], "y": [0.0, 3.0], "angle": [0.0, 90.0], "length": [2.0, 3.0]}
        for name, values in columns.items():
            file[name] = np.array(values)
    options = {"pixel_size": 0.5, "angle_unit": "degrees"}
    cells = StartCells(tmp_path / "cells.h5", **options).read()
    wanted = tf.Cells.from_hdf5(tmp_path / "cells.h5", **options)
    assert np.array_equal(cells.position, wanted.position)
    assert np.asarray(cells.length).tolist() == pytest.approx([1.0, 1.5])
    assert np.asarray(cells.axis)[1].tolist() == pytest.approx([0.0, 1.0], abs=1e-6)

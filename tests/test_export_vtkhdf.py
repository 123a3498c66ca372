"""Results for ParaView and pyvista: the files are what the VTKHDF specification says, and VTK opens
them where it is installed."""

from __future__ import annotations

from itertools import pairwise

import h5py
import numpy as np
import pytest
from exported import polydata, recorded, signalling

import torchfilm as tf
from torchfilm.io.capsule_mesh import capsule


@pytest.fixture(scope="module", params=[2, 3])
def run(request, tmp_path_factory):
    """Results of two colonies whose grids grow, in the plane and in space; and their exports."""
    folder = tmp_path_factory.mktemp("vtk")
    results = recorded(
        signalling(request.param), folder / "run.h5", 3.0 if request.param == 2 else 2
    )
    return results, *results.to_vtkhdf(folder / "run.vtkhdf")


def volume(points, polygons) -> float:
    """The volume that a closed surface encloses, positive if its polygons face outwards."""
    total = 0.0
    for polygon in polygons:
        first, *others = points[polygon].astype(float)
        for a, b in pairwise(others):
            total += float(np.dot(first, np.cross(a, b))) / 6
    return total


def test_the_headers_are_those_of_the_specification(run):
    _, cells, signals = run
    for path, kind in ((cells, b"PolyData"), (signals, b"ImageData")):
        with h5py.File(path) as file:
            root = file["VTKHDF"]
            assert root.attrs["Version"].tolist() == [2, 0] and root.attrs["Type"] == kind
            kind_of_type = root.attrs.get_id("Type").get_type()
            assert not kind_of_type.is_variable_str(), "readers want a string of a fixed length"
            assert root["Steps"].attrs["NSteps"] == len(root["Steps/Values"])
    with h5py.File(cells) as file:
        steps = file["VTKHDF/Steps"]
        assert (
            steps["CellOffsets"].shape
            == steps["ConnectivityIdOffsets"].shape
            == (len(steps["Values"]), 4)
        )


def test_each_step_has_the_cells_of_its_frame(run):
    results, path, _ = run
    ids = results.colony_id
    with h5py.File(path) as file:
        shift = file["torchfilm/shift"][...]
    assert not shift[0].any() and shift[1].any()
    for k in range(len(results)):
        found, table, frame = polydata(path, k), results.table(k), results.frame(k)
        count = len(table["cell"])
        assert found["time"] == results.times[k]
        assert len(found["points"]) == 50 * count and len(found["Polygons"]) == 60 * count
        assert not found["Vertices"] and not found["Lines"] and not found["Strips"]
        for name in ("cell", "colony", "gfp", "k", "out.ahl", "length", "age"):
            column = found["data"][name].reshape(count, 60)
            assert np.allclose(column, np.asarray(table[name])[:, None], rtol=1e-6), name
        centre = found["points"].reshape(count, 50, 3).mean(1) - shift[frame["colony"]]
        dim = frame["position"].shape[1]
        assert np.allclose(centre[:, :dim], frame["position"], atol=1e-4)
    assert set(ids) == set(found["data"]["colony"])


def test_surfaces_enclose_the_cells_and_face_outwards(run):
    results, path, _ = run
    found, table = polydata(path, -1), results.table(-1)
    for cell in (0, len(table["cell"]) - 1):
        own = found["Polygons"][60 * cell : 60 * (cell + 1)]
        assert set(np.concatenate(own)) == set(range(50 * cell, 50 * (cell + 1)))
        # a polyhedron inside the capsule: 12 sides have 0.955 of a circle's area
        assert 0.9 < volume(found["points"], own) / table["volume"][cell] < 0.96


def test_colonies_do_not_touch(run):
    results, path, _ = run
    found = polydata(path, -1)
    colony = results.table(-1)["colony"]
    points = found["points"].reshape(len(colony), -1, 3)
    apart = [points[colony == c].reshape(-1, 3) for c in (0, 1)]
    assert any(apart[0][:, k].max() < apart[1][:, k].min() for k in (0, 1))


def test_signals_lie_where_the_cells_are(run):
    """One lattice covers growing grids, NaN elsewhere; its values are those of the results."""
    results, _, path = run
    with h5py.File(path) as file:
        root, shift = file["VTKHDF"], file["torchfilm/shift"][...]
        extent = root.attrs["WholeExtent"].reshape(3, 2)
        origin, spacing = root.attrs["Origin"], root.attrs["Spacing"]
        values = root["PointData/ahl"]
        shape = tuple(extent[::-1, 1] + 1)
        flat = shape[1:] if shape[0] == 1 else shape
        assert values.shape == (len(results), *flat)
        assert root["Steps/PointDataOffsets/ahl"][...].tolist() == list(range(len(results)))
        known = [int(np.isfinite(values[k]).sum()) for k in range(len(results))]
        for k in (0, len(results) - 1):
            at, sizes, _ = results.grid(k)
            assert known[k] == sizes.prod(1).sum()
            for c in (0, 1):
                first = np.round((at[c] + shift[c] + spacing / 2 - origin) / spacing).astype(int)
                x, y, z = (slice(a, a + n) for a, n in zip(first, sizes[c], strict=True))
                mine = values[k].reshape(shape)[z, y, x].transpose(2, 1, 0)
                assert np.allclose(mine, results.signal("ahl", k)[c], rtol=1e-6)
                corner = origin + first * spacing - spacing / 2
                assert np.allclose(corner, at[c] + shift[c]), "voxels lie where they are"
    assert known[-1] > known[0], "these grids grow"


def test_colonies_are_moved_by_whole_voxels(tmp_path):
    """Also where a cell beyond the box makes a colony as wide as no number of voxels."""
    cells = tf.Cells([[0.0, 0.0], [17.3, 8.7]], [[1.0, 0.0]] * 2)
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=10.0, initial=1.0), spacing=2.0, box=((-4, -4), (4, 4)),
        outside="reservoir",
    )  # fmt: skip
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), medium, founders=cells, dt=0.1)
    results = recorded(scene, tmp_path / "run.h5", 0.2, colonies=3, every=1)
    _, signals = results.to_vtkhdf(tmp_path / "a.vtkhdf")
    with h5py.File(signals) as file:
        voxels = file["torchfilm/shift"][...] / file["VTKHDF"].attrs["Spacing"]
    assert np.allclose(voxels, np.round(voxels), atol=1e-6) and (abs(voxels[1:]).max(1) > 5).all()


def test_some_colonies_and_frames_as_lines(run, tmp_path):
    results = run[0]
    path, _ = results.to_vtkhdf(tmp_path / "a.vtkhdf", colonies=[1], frames=[0, -1], rods="lines")
    found, table = polydata(path, 1), results.table(-1)
    mine = table["colony"] == 1
    assert len(found["Lines"]) == mine.sum() == len(found["points"]) / 2 and not found["Polygons"]
    ends = found["points"].reshape(-1, 2, 3)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert np.allclose(lengths, table["length"][mine], rtol=1e-4)
    assert np.allclose(ends.mean(1)[:, 0], table["x"][mine], atol=1e-4)
    with pytest.raises(IndexError):
        polydata(path, 2)


def test_colonies_in_an_order_of_ones_own_lie_in_the_plane_of_their_medium(tmp_path):
    """Ids are no places here: colonies 2, 0 and 1 are in the places 0, 1 and 2."""
    cells = tf.Cells(
        [[0.0, 0.0], [3.0, 0.0], [0.0, 3.0], [-3.0, 1.0]], [[1.0, 0.0]] * 4, 2.0,
        colony=[0, 1, 1, 2],
    )  # fmt: skip
    medium = tf.Medium(m=tf.Signal(0.0), box=((-6, -6), (6, 6)), spacing=2.0, depth=2.0, height=5.0)
    scene = tf.Scene(tf.Growth(rate=0.1), medium, founders=cells, dt=0.1)
    path = tmp_path / "run.h5"
    tf.simulate(scene, scene.bind().start().select([2, 0, 1]), until=0.1, record=path).last()
    with tf.Results(path) as results:
        shapes, _ = results.to_vtkhdf(tmp_path / "a.vtkhdf", colonies=[1, 2], rods="lines")
        table = results.table(0)
    with h5py.File(shapes) as file:
        ids = file["torchfilm/colony"][...].tolist()
        shifts = dict(zip(ids, file["torchfilm/shift"][...], strict=True))
    found = polydata(shapes, 0)
    middle = found["points"].reshape(-1, 2, 3).mean(1)
    assert ids == [1, 2] and found["data"]["colony"].tolist() == [2, 1, 1]
    assert not shifts[1].any() and shifts[2].any()
    rows = [int(np.flatnonzero(table["colony"] == 2)[0]), *np.flatnonzero(table["colony"] == 1)]
    for k, row in enumerate(rows):
        place = np.array([table["x"][row], table["y"][row], 5.0])
        assert middle[k] == pytest.approx(place + shifts[int(table["colony"][row])], abs=1e-5)


def dying(tmp_path) -> tf.Results:
    """Colonies of which one is empty from the start, and the other in the middle: it is refilled by
    no one. The first frame has cells, later ones none."""

    def update(cells):
        cells.remove_flag = cells.time > 0.45

    cells = tf.Cells([[0.0, 0.0]], [1.0, 0.0], colony=[1])
    scene = tf.Scene(
        tf.Rules(update), tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=cells, dt=0.1
    )
    return recorded(scene, tmp_path / "dying.h5", 0.8, colonies=2, every=1)


def test_frames_and_colonies_without_cells(tmp_path):
    results = dying(tmp_path)
    counts = results.counts.sum(1)
    assert counts[0] == 1 and counts[-1] == 0
    (path,) = results.to_vtkhdf(tmp_path / "a.vtkhdf")
    assert [len(polydata(path, k)["Polygons"]) for k in range(len(results))] == (
        60 * counts
    ).tolist()
    (path,) = results.to_vtkhdf(tmp_path / "b.vtkhdf", colonies=[0])
    assert all(len(polydata(path, k)["points"]) == 0 for k in range(len(results)))


def test_vtk_opens_the_files(run, tmp_path):
    hdf = pytest.importorskip("vtkmodules.vtkIOHDF", reason="vtk is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    def read(path, step):
        reader = hdf.vtkHDFReader()
        assert reader.CanReadFile(str(path))
        reader.SetFileName(str(path))
        reader.UpdateInformation()
        reader.SetStep(step)
        reader.Update()
        return reader.GetOutput()

    results, cells, signals = run
    for k in (0, 1, len(results) - 1):
        wanted, found = polydata(cells, k), read(cells, k)
        assert found.GetNumberOfPolys() == len(wanted["Polygons"])
        assert np.allclose(vtk_to_numpy(found.GetPoints().GetData()), wanted["points"])
        for name, values in wanted["data"].items():
            assert np.allclose(vtk_to_numpy(found.GetCellData().GetArray(name)), values), name
        last = found.GetCell(found.GetNumberOfCells() - 1)
        ids = [last.GetPointId(j) for j in range(last.GetNumberOfPoints())]
        assert ids == wanted["Polygons"][-1]
        image = read(signals, k)
        with h5py.File(signals) as file:
            stored = file["VTKHDF/PointData/ahl"][k].reshape(-1)
        ahl = vtk_to_numpy(image.GetPointData().GetArray("ahl"))
        assert np.array_equal(ahl, stored, equal_nan=True)
    dead = dying(tmp_path)
    (path,) = dead.to_vtkhdf(tmp_path / "dead.vtkhdf")
    polys = [read(path, k).GetNumberOfPolys() for k in range(len(dead))]
    assert polys == (60 * dead.counts.sum(1)).tolist()


def test_the_mesh_is_closed():
    """Each edge belongs to two polygons, once in either direction."""
    mesh = capsule()
    edges = [
        (int(a), int(b))
        for start, end in pairwise(mesh.offsets)
        for a, b in zip(
            mesh.connectivity[start:end], np.roll(mesh.connectivity[start:end], -1), strict=True
        )
    ]
    assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)


def test_bad_input_is_named(run, tmp_path):
    results = run[0]
    ask = results.to_vtkhdf
    for options, message in (
        ({"path": tmp_path / "a.vtk"}, r"path = .*ends in \.vtkhdf"),
        ({"path": tmp_path / "no" / "a.vtkhdf"}, "a folder that exists"),
        ({"colonies": [7]}, r"colonies = \[7\].*0, 1"),
        ({"colonies": []}, r"colonies = \[\].*at least one"),
        ({"frames": [99]}, r"frames = \[99\].*frames"),
        ({"frames": [1, 0]}, "in the order of time"),
        ({"rods": "balls"}, "rods = 'balls'.*'capsules', 'lines'"),
    ):
        with pytest.raises(tf.InputError, match=message):
            ask(**{"path": tmp_path / "a.vtkhdf", **options})
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "b_signals.vtkhdf").write_text("mine")
    with pytest.raises(tf.InputError, match=r"b_signals.*no file yet.*overwrite"):
        ask(tmp_path / "b.vtkhdf")
    assert [p.name for p in tmp_path.iterdir()] == ["b_signals.vtkhdf"]
    ask(tmp_path / "b.vtkhdf", overwrite=True)
    assert polydata(tmp_path / "b.vtkhdf", 0)["Polygons"]


def test_pyvista_opens_the_files(run):
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed")
    results, cells, signals = run
    found = []
    for path in (cells, signals):
        reader = pyvista.get_reader(path)
        reader.reader.UpdateInformation()
        assert reader.reader.GetNumberOfSteps() == len(results)
        reader.reader.SetStep(len(results) - 1)
        found.append(reader.read())
    mesh, grid = found
    wanted = polydata(cells, -1)
    assert np.array_equal(mesh.points, wanted["points"]) and mesh.n_open_edges == 0
    assert np.array_equal(mesh.cell_data["gfp"], wanted["data"]["gfp"])
    with h5py.File(signals) as file:
        stored = file["VTKHDF/PointData/ahl"][-1].reshape(-1)
    assert np.array_equal(grid.point_data["ahl"], stored, equal_nan=True)
    low, high = np.array(grid.bounds)[::2], np.array(grid.bounds)[1::2]
    dim = results.attributes["dim"]
    inside = (mesh.points >= low - 1) & (mesh.points <= high + 1)
    assert inside[:, :dim].all(), "cells lie in their medium"

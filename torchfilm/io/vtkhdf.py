"""Results for ParaView and pyvista: VTKHDF files, written with h5py.

Cells are temporal PolyData, signals temporal ImageData, each in a file of its own. The layout is
that of the VTKHDF specification, version 2.0 (docs.vtk.org, VTKHDF file format), which readers of
VTK 9.3 and later know.

| specification      | here                                                                    |
|--------------------|-------------------------------------------------------------------------|
| parts              | one per frame: PartOffsets counts the frames                            |
| CellOffsets        | polygons (or lines) before the frame; the other topologies are empty    |
| Offsets            | one more per frame than polygons, but none for a frame without cells:   |
|                    | readers infer how many to skip from the polygons before                 |
| temporal ImageData | (time, z, y, x), or (time, y, x) for one layer of voxels; its extent    |
|                    | cannot change: one lattice covers all frames, NaN where no grid is      |
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from torchfilm.io.capsule_mesh import Mesh, capsule, centreline
from torchfilm.io.new_file import check_frames, check_new_file
from torchfilm.io.room import Room
from torchfilm.io.side_by_side import SideBySide, chosen_colonies, side_by_side
from torchfilm.io.table import Tables
from torchfilm.tools import checks
from torchfilm.tools.whole_files import written_whole

if TYPE_CHECKING:
    from torchfilm.io.results import Results

VERSION = (2, 0)
TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")  # in the order of CellOffsets
SUFFIX = ".vtkhdf"
MESHES = {"capsules": ("Polygons", capsule), "lines": ("Lines", centreline)}
# Columns of the table that are the geometry or the same for all cells of a frame.
LEFT_OUT = {"frame", "time", "x", "y", "z"}
CHUNK = 65536


def write_vtkhdf(
    results: Results,
    path: str | Path,
    colonies: Sequence[int] | None,
    frames: Sequence[int] | None,
    rods: str,
    overwrite: bool,
) -> list[Path]:
    """As `Results.to_vtkhdf`."""
    checks.choice("rods", rods, tuple(MESHES))
    places = chosen_colonies(results, colonies)
    chosen = check_frames(len(results), frames, results.path)
    cells = check_new_file(path, (SUFFIX,), overwrite, results.path)
    signals = cells.with_name(f"{cells.name[: -len(SUFFIX)]}_signals{SUFFIX}")
    if results.signal_names:
        check_new_file(signals, (SUFFIX,), overwrite, results.path)
    layout = side_by_side(results, places, chosen)
    with written_whole(cells) as beside, h5py.File(beside, "w") as file:
        _write_cells(file, Room(file, cells), results, layout, chosen, rods)
    if not results.signal_names:
        return [cells]
    with written_whole(signals) as beside, h5py.File(beside, "w") as file:
        _write_signals(file, Room(file, signals), results, layout, chosen)
    return [cells, signals]


def _root(file: h5py.File, kind: str, results: Results, layout: SideBySide, times: np.ndarray):
    """The groups VTKHDF and Steps; and beside them what only torchfilm knows."""
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = np.asarray(VERSION)
    root.attrs["Type"] = np.bytes_(kind)  # of a fixed length, as the readers want it
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = len(times)
    steps["Values"] = times
    about = file.create_group("torchfilm")
    about.attrs["scene"] = results.attributes["scene"]
    about["colony"] = results.colony_id[layout.places]
    about["shift"] = layout.shift
    return root, steps


def _growing(group: h5py.Group, name: str, dtype: Any, shape: tuple[int, ...] = ()) -> None:
    group.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=dtype,
        chunks=(CHUNK, *shape),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )


def _add(room: Room, dataset: h5py.Dataset, rows: np.ndarray) -> None:
    room.claim(rows.nbytes)
    start = len(dataset)
    dataset.resize(start + len(rows), axis=0)
    dataset[start:] = rows


# --- cells ----------------------------------------------------------------------------------------


def _write_cells(
    file: h5py.File, room: Room, results: Results, layout: SideBySide, frames: list[int], rods: str
) -> None:
    root, steps = _root(file, "PolyData", results, layout, results.times[frames])
    topology, mesh = MESHES[rods][0], MESHES[rods][1]()
    sizes = len(mesh.end), len(mesh.offsets) - 1, len(mesh.connectivity)
    _growing(root, "Points", "f4", (3,))
    _growing(root, f"{topology}/Connectivity", "i8")
    _growing(root, f"{topology}/Offsets", "i8")
    data = root.create_group("CellData")
    tables, counts = Tables(results, results.lineage(), internals=False), []
    ids = results.colony_id[layout.places]
    height = float(results.attributes.get("height", 0.0))
    for k in frames:
        columns = tables([k], lambda colony, _: np.isin(colony, ids))
        found = results.frame(k)
        mine = np.isin(found["colony"], layout.places)
        count = int(mine.sum())
        counts.append(count)
        _add(
            room,
            root["Points"],
            _points(mesh, layout, {n: x[mine] for n, x in found.items()}, height),
        )
        if count:
            before = np.arange(count)[:, None]
            _add(room, root[topology]["Connectivity"], _flat(mesh.connectivity + before * sizes[0]))
            ends = _flat(mesh.offsets[1:] + before * sizes[2])
            _add(room, root[topology]["Offsets"], np.concatenate([[0], ends]))
        for name, value in columns.items():
            if name not in LEFT_OUT and value.dtype.kind != "U":  # viewers colour by numbers
                column = _plain(value)
                if name not in data:
                    _growing(data, name, column.dtype)
                _add(room, data[name], np.repeat(column, sizes[1]))
    _add(room, root[topology]["Offsets"], np.zeros(1))  # for a last frame without cells
    _count(root, steps, topology, np.asarray(counts), sizes)


def _points(mesh: Mesh, layout: SideBySide, cells: dict, height: float) -> np.ndarray:
    centre, axis = (_in_space(cells[n]) for n in ("position", "axis"))
    if cells["position"].shape[1] == 2:
        centre[:, 2] = height
    order = np.argsort(layout.places)
    at = order[np.searchsorted(layout.places, cells["colony"], sorter=order)]
    made = mesh.points(centre + layout.shift[at], axis, cells["length"], cells["radius"])
    return made.reshape(-1, 3)


def _in_space(x: np.ndarray) -> np.ndarray:
    """Vectors (N, 2 or 3) as (N, 3) float64."""
    return np.pad(x.astype(np.float64), ((0, 0), (0, 3 - x.shape[1])))


def _flat(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1)


def _plain(value: np.ndarray) -> np.ndarray:
    """A column in a type that viewers know: float32, int64, or int8 for bools."""
    if value.dtype.kind == "f":
        return value.astype(np.float32)
    if value.dtype.kind == "b":
        return value.astype(np.int8)
    return value.astype(np.int64)


def _count(
    root: h5py.Group,
    steps: h5py.Group,
    topology: str,
    counts: np.ndarray,
    sizes: tuple[int, int, int],
) -> None:
    """What the specification counts: points, polygons and connectivity of each frame, and how many
    there are before it. sizes: of one cell."""
    frames = len(counts)
    before = np.concatenate([[0], np.cumsum(counts)[:-1]])
    column = np.arange(4) == TOPOLOGIES.index(topology)
    root["NumberOfPoints"] = counts * sizes[0]
    for name in TOPOLOGIES:
        own = counts if name == topology else np.zeros_like(counts)
        group = root.require_group(name)
        group["NumberOfCells"] = own * sizes[1]
        group["NumberOfConnectivityIds"] = own * sizes[2]
        if name != topology:
            group["Connectivity"] = np.zeros(0, np.int64)
            group["Offsets"] = np.zeros(frames, np.int64)  # one for each part, of no polygon
    steps["PartOffsets"] = np.arange(frames)
    steps["NumberOfParts"] = np.ones(frames, np.int64)
    steps["PointOffsets"] = before * sizes[0]
    steps["CellOffsets"] = (before * sizes[1])[:, None] * column
    steps["ConnectivityIdOffsets"] = (before * sizes[2])[:, None] * column
    for name in root["CellData"]:
        steps[f"CellDataOffsets/{name}"] = before * sizes[1]


# --- signals --------------------------------------------------------------------------------------


def _write_signals(
    file: h5py.File, room: Room, results: Results, layout: SideBySide, frames: list[int]
) -> None:
    root, steps = _root(file, "ImageData", results, layout, results.times[frames])
    assert layout.origin is not None and layout.low is not None and layout.high is not None
    size, spacing = layout.high - layout.low, results.grid(frames[0])[2]
    # values are those of the voxels' centres
    root.attrs["WholeExtent"] = np.stack([np.zeros(3, np.int64), size - 1], 1).reshape(-1)
    root.attrs["Origin"] = layout.origin + (layout.low + 0.5) * spacing
    root.attrs["Spacing"] = spacing
    root.attrs["Direction"] = np.eye(3).reshape(-1)
    data = root.create_group("PointData")
    data.attrs["Scalars"] = np.bytes_(results.signal_names[0])
    shape = tuple(size[::-1].tolist())
    flat = shape[1:] if shape[0] == 1 else shape  # as readers expect it of one layer
    for name in results.signal_names:
        dataset = data.create_dataset(
            name,
            shape=(len(frames), *flat),
            dtype="f4",
            chunks=(1, *(min(n, 128) for n in flat)),
            compression="gzip",
            compression_opts=1,
            shuffle=True,
        )
        steps[f"PointDataOffsets/{name}"] = np.arange(len(frames))
        for at, k in enumerate(frames):
            values = _covered(results, layout, name, k, shape).reshape(flat)
            room.claim(values.nbytes)
            dataset[at] = values


def _covered(
    results: Results, layout: SideBySide, name: str, k: int, shape: tuple[int, ...]
) -> np.ndarray:
    """A signal of all colonies on the covering lattice, (z, y, x); NaN outside their grids."""
    out = np.full(shape, np.nan, np.float32)
    origin, _, spacing = results.grid(k)
    values = results.signal(name, k)
    for place, shift in zip(layout.places, layout.shift, strict=True):
        corner = (origin[place] + shift - layout.origin) / spacing - layout.low
        starts = np.round(corner).astype(int).tolist()
        x, y, z = (slice(a, a + n) for a, n in zip(starts, values[place].shape, strict=True))
        out[z, y, x] = values[place].transpose(2, 1, 0)
    return out

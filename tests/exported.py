"""Shared by the tests of exports: runs that are exported, and a reader of VTKHDF files that goes by
the specification alone."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import h5py
import numpy as np
import torch
from recorded import DT, record

import torchfilm as tf

TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")


def signalling(dim: int = 2) -> tf.Scene:
    """Two colonies of cells that make a signal, at different rates; their grids grow."""

    def circuit(u, s, p, cell):
        return {"gfp": p.k - p.g * u.gfp}, {"ahl": 1.0 + 0.0 * u.gfp}

    box = (-4.0,) * dim, (4.0,) * dim
    return tf.Scene(
        tf.Growth(rate=torch.tensor([0.8, 1.4])),
        tf.Division(length=tf.Uniform(3.0, 4.0)),
        tf.Circuit(circuit, species=("gfp",), k=torch.tensor([1.0, 2.0]), g=0.1),
        tf.Medium(ahl=tf.Signal(diffusion=10.0), spacing=2.0, box=box, outside="grow"),
        tf.Mechanics(dim=dim),
        dt=DT,
    )


def recorded(scene: tf.Scene, path, until: float, colonies: int = 2, every: int = 20) -> tf.Results:
    record(scene, scene.bind(colonies, seed=3).start(), path, until=until, every=every)
    return tf.Results(path)


def polydata(path, step: int) -> dict[str, Any]:
    """Points, polygons or lines, and cell data of one step."""
    with h5py.File(path) as file:
        root, steps = file["VTKHDF"], file["VTKHDF/Steps"]
        part, count = int(steps["PartOffsets"][step]), int(steps["NumberOfParts"][step])
        assert count == 1
        start = int(steps["PointOffsets"][step])
        points = root["Points"][start : start + int(root["NumberOfPoints"][part])]
        assert len(points) == root["NumberOfPoints"][part]
        cells: dict[str, list[list[int]]] = {}
        for at, name in enumerate(TOPOLOGIES):
            group = root[name]
            number = int(group["NumberOfCells"][part])
            before = int(steps["CellOffsets"][step, at])
            # as readers do: one more offset for each part that has the polygons before
            passed = np.cumsum(group["NumberOfCells"][:part]) - group["NumberOfCells"][:part]
            first = before + int((passed < before).sum())
            ends = group["Offsets"][first : first + number + 1]
            ids = int(steps["ConnectivityIdOffsets"][step, at])
            used = group["Connectivity"][ids : ids + int(group["NumberOfConnectivityIds"][part])]
            assert len(ends) == number + 1 and ends[0] == 0 and ends[-1] == len(used)
            cells[name] = [used[a:b].tolist() for a, b in pairwise(ends)]
        size = sum(map(len, cells.values()))
        data = {}
        for name, values in root["CellData"].items():
            at = int(steps[f"CellDataOffsets/{name}"][step])
            data[name] = values[at : at + size]
            assert len(data[name]) == size
        return {"points": points, **cells, "data": data, "time": float(steps["Values"][step])}

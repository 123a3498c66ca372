"""The layout of a results file, and the arrays that a state contributes to it.

    /                     attributes: format, version, scene, recipe, seed, dim, dtype, versions
    /colony_id, /stream   (B,)
    /cells/NAME           one row per cell, frame after frame: colony, uid, parent, position, axis,
                          length, radius, fields per cell. Rows between frames are −1 or NaN
    /frames/NAME          one row per frame: first_row, counts (B), next_uid (B), births, ends,
                          time, step
    /frames/colony/NAME   one row per frame: fields per colony
    /frames/grid/NAME     one row per frame: origin, shape (B, 3), first_voxel
    /signals/NAME         scenes with a medium only: one row per voxel, all colonies of a frame
                          after one another, frames as in /cells
    /signals_at_cells/NAME  scenes with a medium only: one row per cell, as in /cells: the
                          concentration that the cell finds
    /obstacles            scenes with obstacles only: 1 in the voxels of the first frame in which no
                          signal can be, for pictures
    /parameters/PATH      (B,), parameters with one value per colony: see `torchfilm.io.parameters`
    /lineage/births       colony_id, uid, parent, step, length, time
    /lineage/ends         colony_id, uid, step, fate, length, time

A frame holds the whole state, so every frame is a checkpoint. `frames/step` is written last: a
frame without an entry there is incomplete and is ignored. Files contain data only; torchfilm
executes nothing from them.

A file that can be read while it is written keeps the old place of a compressed chunk when the chunk
is written again. So each chunk is written once: rows of cells and voxels are compressed, and a
frame begins with a chunk (`frames/first_row`, `frames/grid/first_voxel`). The small tables, to
which a frame adds a few rows, are not compressed: their chunks are written again in place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from torch import Tensor

from torchfilm.state import CELL, COLONY, PER_CELL, State
from torchfilm.tools.checks import SimulationError

FORMAT, VERSION = "torchfilm results", 3
AT_CELLS = "signals_at_cells"
OBSTACLES = "obstacles"
# Internal fields of files that do not name theirs, as earlier versions wrote them.
INTERNAL_BEFORE = (
    "collapsed_steps",
    "compression",
    "contact_alpha",
    "displacement",
    "divide_flag",
    "elongation",
)
INTERNAL_ENDING_BEFORE = "circuit_volume"
CHUNK_ROWS, CHUNK_VOXELS = 512, 32768  # at most so many voxels
CHUNK_BYTES = 1024  # of the tables that are not compressed
BLANK = {"f": np.nan, "i": -1}  # between frames, by the kind of dtype
LINEAGE = {
    "births": ("colony_id", "uid", "parent", "step", "length", "time"),
    "ends": ("colony_id", "uid", "step", "fate", "length", "time", "cell_type"),
}
LINEAGE_NUMBERS = ("length", "time")  # µm and h
LINEAGE_LATER = (*LINEAGE_NUMBERS, "cell_type")  # older files lack some
# step last: it commits the frame
FRAME_COLUMNS = ("first_row", "counts", "next_uid", "births", "ends", "time", "step")


def numpy_of(x: Tensor) -> np.ndarray:
    """A tensor as a NumPy array on the CPU, without its gradient."""
    return x.detach().cpu().numpy()


def cell_columns(state: State) -> dict[str, np.ndarray]:
    """The arrays per cell by name, each (N, …)."""
    columns = {name: numpy_of(getattr(state, name)) for name in PER_CELL}
    return columns | {
        n: numpy_of(v) for n, v in state.fields.items() if state.declared[n].scope == CELL
    }


def colony_columns(state: State) -> dict[str, np.ndarray]:
    """The fields per colony by name, each (B, …)."""
    return {n: numpy_of(v) for n, v in state.fields.items() if state.declared[n].scope == COLONY}


def voxel_columns(state: State) -> dict[str, np.ndarray]:
    """The concentrations of the signals by name, each one value per voxel of all colonies."""
    return {n: numpy_of(v) for n, v in state.signals.items()}


def found_columns(state: State) -> dict[str, np.ndarray]:
    """The concentration of each signal at the cells by name, each (N,)."""
    contact = state.contact()
    return {} if contact is None else {n: numpy_of(v) for n, v in contact.found.items()}


def grid_columns(state: State, first_voxel: int = 0) -> dict[str, np.ndarray]:
    """The grids of a frame: their origin (B, 3) µm, their shape (B, 3), and the row of their first
    voxel. Empty if the scene has no medium."""
    if state.layout is None:
        return {}
    grid = state.layout.grid
    return {
        "origin": numpy_of(grid.origin),
        "shape": numpy_of(grid.shape),
        "first_voxel": np.asarray(first_voxel, np.int64),
    }


def all_columns(state: State) -> dict[str, dict[str, np.ndarray]]:
    """The arrays of a frame by group and name."""
    return {
        "cells": cell_columns(state),
        "frames/colony": colony_columns(state),
        "signals": voxel_columns(state),
        "frames/grid": grid_columns(state),
    }


def frame_bytes(state: State) -> int:
    """The size of the arrays of a frame, told by their shapes: nothing is copied from a GPU."""
    of_colonies = [v for n, v in state.fields.items() if state.declared[n].scope == COLONY]
    grid = [] if state.layout is None else [state.layout.grid.origin, state.layout.grid.shape]
    columns = [*state.cell_columns().values(), *state.signals.values(), *of_colonies, *grid]
    at_cells = state.cells * len(state.signals) * state.length.element_size()
    return at_cells + sum(
        v.numel() * v.element_size() for v in (*columns, state.counts, state.next_uid)
    )


def create_framed(file: h5py.File, name: str, dtype: Any, shape: Sequence[int], chunk: int) -> None:
    """Create an empty dataset of rows of this shape, compressed, to which whole frames are
    added."""
    blank = BLANK.get(np.dtype(dtype).kind)
    packed = {"compression": "gzip", "compression_opts": 1, "fillvalue": blank}
    _create_empty(file, name, dtype, shape, chunk, **packed)


def create_table(file: h5py.File, name: str, dtype: Any, shape: Sequence[int]) -> None:
    """Create an empty dataset of rows of this shape, to which a few rows at a time are added."""
    row = max(1, np.dtype(dtype).itemsize * math.prod(shape))
    _create_empty(file, name, dtype, shape, max(1, CHUNK_BYTES // row))


def _create_empty(
    file: h5py.File, name: str, dtype: Any, shape: Sequence[int], chunk: int, **options: Any
) -> None:
    """A dataset without rows, which may grow. chunk: rows that are stored together."""
    file.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=dtype,
        chunks=(chunk, *(max(1, s) for s in shape)),
        **options,
    )


def voxels_per_chunk(voxels: int) -> int:
    """Chunks that hold a frame of so many voxels with little room left."""
    pieces = max(1, math.ceil(voxels / CHUNK_VOXELS))
    return max(1, math.ceil(voxels / pieces))


def write_rows(table: h5py.Dataset, at: int, value: np.ndarray) -> None:
    """Make these the last rows of a dataset, from `at` on. By HDF5's own functions: those of h5py
    take longer than the rows of a small frame."""
    value = np.ascontiguousarray(value)
    if value.shape[1:] != table.shape[1:]:  # HDF5 would cut off what is already there
        rule = f"has rows of the shape {table.shape[1:]}, not {value.shape[1:]}"
        raise ValueError(f"{table.name} {rule}")
    table.id.set_extent((at + len(value), *value.shape[1:]))
    if value.size:
        place = table.id.get_space()
        place.select_hyperslab((at,) + (0,) * (value.ndim - 1), value.shape)
        table.id.write(h5py.h5s.create_simple(value.shape), place, value)


def check_columns(
    path: Path, given: Mapping[str, Mapping[str, np.ndarray]], part_of_file: Callable[[str], Any]
) -> None:
    """Raise SimulationError unless the columns of a state, by group and name, are those of a file,
    which would else lack rows, round what it is given, or cut it off."""
    for group, columns in given.items():
        there = set(part_of_file(group) or ())
        if new := sorted(columns.keys() - there):
            raise SimulationError(
                f"{_noun(group)} {new[0]!r} appeared during the run, after {path} was laid out."
                " Begin the run with it: rules have Rules(…, variables=…), states"
                " state.declare(…)."
            )
        if gone := sorted(there - columns.keys()):
            raise SimulationError(
                f"{_noun(group)} {gone[0]!r} of {path} is gone from the state: all frames of a file"
                " have the same columns. Record what follows to a file of its own."
            )
        for name, value in columns.items():
            table = part_of_file(f"{group}/{name}")
            if value.dtype != table.dtype:
                raise SimulationError(
                    f"{_noun(group)} {name!r} is of {value.dtype} now, and of {table.dtype} in"
                    f" {path}: convert what you set it to, value.to(torch.{table.dtype})."
                )


def _noun(group: str) -> str:
    return {"signals": "the signal", "frames/grid": "the grid's"}.get(group, "the field")


def next_chunk(table: h5py.Dataset, rows: int) -> int:
    """The first row at or after `rows` at which a chunk begins."""
    return math.ceil(rows / table.chunks[0]) * table.chunks[0]


def create_tables(file: h5py.File, state: State) -> None:
    """Create all datasets of a results file for the fields and signals of this state."""
    file.create_dataset("colony_id", data=numpy_of(state.colony_id))
    file.create_dataset("stream", data=numpy_of(state.stream))
    for name, value in cell_columns(state).items():
        create_framed(file, f"cells/{name}", value.dtype, value.shape[1:], CHUNK_ROWS)
    colonies = (state.colonies,)
    shapes = {
        "counts": (colonies, np.int64),
        "next_uid": (colonies, np.int64),
        "time": ((), np.float64),
    }
    for name in FRAME_COLUMNS:
        shape, dtype = shapes.get(name, ((), np.int64))
        create_table(file, f"frames/{name}", dtype, shape)
    for name, value in colony_columns(state).items():
        create_table(file, f"frames/colony/{name}", value.dtype, value.shape)
    if state.layout is not None:
        file.attrs["spacing"] = state.layout.grid.spacing
        file.attrs["height"] = state.layout.height
        if state.layout.mask is not None:
            solid = numpy_of(~state.layout.mask).astype(np.int8)
            file.create_dataset(OBSTACLES, data=solid, compression="gzip")
        for name, value in voxel_columns(state).items():
            chunk = voxels_per_chunk(len(value))
            create_framed(file, f"signals/{name}", value.dtype, (), chunk)
            create_framed(file, f"{AT_CELLS}/{name}", value.dtype, (), CHUNK_ROWS)
        for name, value in grid_columns(state).items():
            create_table(file, f"frames/grid/{name}", value.dtype, value.shape)
    for table, columns in LINEAGE.items():
        for name in columns:
            dtype = np.float64 if name in LINEAGE_NUMBERS else np.int64
            create_table(file, f"lineage/{table}/{name}", dtype, ())

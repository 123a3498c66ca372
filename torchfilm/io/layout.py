"""The layout of a results file, and the arrays that a state contributes to it.

    /                     attributes: format, version, scene, recipe, seed, dim, dtype, versions
    /colony_id, /stream   (B,)
    /cells/NAME           one row per cell, all frames in sequence: colony, uid, parent, position,
                          axis, length, radius, fields per cell
    /frames/NAME          one row per frame: first_row, counts (B), next_uid (B), births, ends,
                          time, step
    /frames/colony/NAME   one row per frame: fields per colony
    /frames/grid/NAME     one row per frame: origin, shape (B, 3), first_voxel
    /signals/NAME         scenes with a medium only: one row per voxel, all colonies and frames in
                          sequence
    /signals_at_cells/NAME  scenes with a medium only: one row per cell, as in /cells: the
                          concentration that the cell finds
    /parameters/PATH      (B,), parameters with one value per colony: see `torchfilm.io.parameters`
    /lineage/births       colony_id, uid, parent, step
    /lineage/ends         colony_id, uid, step, fate

A frame holds the whole state, so every frame is a checkpoint. `frames/step` is written last: a
frame without an entry there is incomplete and is ignored. Files contain data only; torchfilm
executes nothing from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np
from torch import Tensor

from torchfilm.state import CELL, COLONY, PER_CELL, State

FORMAT, VERSION = "torchfilm results", 2
AT_CELLS = "signals_at_cells"
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
FATES = ("divided", "removed", "left", "failed")
CHUNK_ROWS, CHUNK_VOXELS, CHUNK_FRAMES = 8192, 32768, 64
LINEAGE = {
    "births": ("colony_id", "uid", "parent", "step"),
    "ends": ("colony_id", "uid", "step", "fate"),
}
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


def create_growing(
    file: h5py.File, name: str, dtype: Any, shape: Sequence[int], chunk: int
) -> None:
    """Create an empty dataset of rows of this shape, compressed, to which rows can be added."""
    file.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=dtype,
        chunks=(chunk, *(max(1, s) for s in shape)),
        compression="gzip",
        compression_opts=1,
    )


def create_tables(file: h5py.File, state: State) -> None:
    """Create all datasets of a results file for the fields and signals of this state."""
    file.create_dataset("colony_id", data=numpy_of(state.colony_id))
    file.create_dataset("stream", data=numpy_of(state.stream))
    for name, value in cell_columns(state).items():
        create_growing(file, f"cells/{name}", value.dtype, value.shape[1:], CHUNK_ROWS)
    colonies = (state.colonies,)
    shapes = {
        "counts": (colonies, np.int64),
        "next_uid": (colonies, np.int64),
        "time": ((), np.float64),
    }
    for name in FRAME_COLUMNS:
        shape, dtype = shapes.get(name, ((), np.int64))
        create_growing(file, f"frames/{name}", dtype, shape, CHUNK_FRAMES)
    for name, value in colony_columns(state).items():
        create_growing(file, f"frames/colony/{name}", value.dtype, value.shape, CHUNK_FRAMES)
    if state.layout is not None:
        file.attrs["spacing"] = state.layout.grid.spacing
        file.attrs["height"] = state.layout.height
        for name, value in voxel_columns(state).items():
            create_growing(file, f"signals/{name}", value.dtype, (), CHUNK_VOXELS)
            create_growing(file, f"{AT_CELLS}/{name}", value.dtype, (), CHUNK_ROWS)
        for name, value in grid_columns(state).items():
            create_growing(file, f"frames/grid/{name}", value.dtype, value.shape, CHUNK_FRAMES)
    for table, columns in LINEAGE.items():
        for name in columns:
            create_growing(file, f"lineage/{table}/{name}", np.int64, (), CHUNK_ROWS)

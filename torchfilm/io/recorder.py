"""Writing results: an observer that puts a run into one HDF5 file as it goes. The layout is told in
`torchfilm.io.results`."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from torchfilm.effects.mechanics import Mechanics
from torchfilm.io.results import (
    CHUNK_ROWS,
    CHUNK_VOXELS,
    FATES,
    FORMAT,
    FRAME_COLUMNS,
    LINEAGE,
    VERSION,
    Results,
    committed,
)
from torchfilm.physics.surfaces import as_data
from torchfilm.scene import Scene
from torchfilm.state import CELL, COLONY, PER_CELL, State
from torchfilm.tools import checks
from torchfilm.tools.checks import SimulationError
from torchfilm.version import __version__

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]

ROOM_TO_SPARE = 65536  # bytes that HDF5 may need beside a frame's own


class Recorder:
    """An observer that writes every `every`-th step (and the last one, on `close`) of a run to an
    HDF5 file.

    path: a new file, unless `overwrite` or `append` says otherwise; `append` goes on in a file
    whose last frame is the state that the run starts from, by the same scene, or, if `changed`, by
    one that has the same fields.
    """

    def __init__(
        self,
        path: str | Path,
        scene: Scene,
        *,
        every: int = 10,
        overwrite: bool = False,
        append: bool = False,
        changed: bool = False,
    ):
        if isinstance(every, bool) or not isinstance(every, int) or every < 1:
            raise checks.input_error("every", every, "a whole number of steps from 1")
        self.path, self.scene, self.every, self.append, self.changed = (
            Path(path),
            scene,
            every,
            append,
            changed,
        )
        if append and not self.path.exists():
            raise checks.input_error(
                "record", str(path), "an existing results file to append to", "No such file."
            )
        if self.path.is_dir():
            raise checks.input_error("record", str(path), "a file, not a folder")
        if self.path.exists() and not append and not overwrite:
            raise checks.input_error(
                "record",
                str(path),
                "a path where there is no file yet",
                "Choose another (--out), replace it (--overwrite; in Python tf.Recorder(path,"
                " scene, overwrite=True)), or resume from it.",
            )
        if self.path.exists() and not append and not _may_go(self.path):
            raise checks.input_error(
                "record",
                str(path),
                "a results file, where it replaces one",
                "This is another kind of file, such as a study. Choose another (--out).",
            )
        if not self.path.parent.is_dir():
            raise checks.input_error(
                "record", str(path), "in a folder that exists", f"Make {self.path.parent} first."
            )
        self.overwrite = overwrite
        self.file: h5py.File | None = None
        self.dt = scene.dt  # `simulate` sets the one that it uses
        self.tables: dict[str, h5py.Dataset] = {}
        self.births: list[tuple[np.ndarray, ...]] = []
        self.ends: list[tuple[np.ndarray, ...]] = []
        self.last: State | None = None
        self.written = -1

    def __call__(self, state: State) -> None:
        self.last = state
        if self.file is None:
            self._open(state)  # what happened before the first frame is not this run's
            return
        self._note_events(state)
        if (state.step - self.first_step) % self.every == 0:
            self._write(state)

    def close(self) -> None:
        """Write the last state, if it is not yet written, and close the file."""
        if self.file is None:
            return
        try:
            if self.last is not None and -1 < self.written != self.last.step:
                self._write(self.last)
        finally:
            self.tables.clear()
            self.file.close()
            self.file = None

    def _open(self, state: State) -> None:
        if self.append:
            rebuilt = self.path.with_name(self.path.name + ".resumed")
            _copy_committed(self.path, rebuilt)
            os.replace(rebuilt, self.path)
            mine = (
                state.seed,
                str(state.dtype)[6:],
                state.dim,
                state.colony_id.tolist(),
                state.stream.tolist(),
            )
            with Results(self.path) as kept:
                if not self.changed:
                    kept.check_alike(self.scene)
                about = kept.attributes
                there = (
                    int(about["seed"]),
                    str(about["dtype"]),
                    int(about["dim"]),
                    kept.colony_id.tolist(),
                    kept.stream.tolist(),
                )
            if mine != there:
                raise checks.input_error(
                    "state",
                    f"of (seed, dtype, dim, colonies, streams) {mine}",
                    f"of {there}, as {self.path} is",
                    "Record to a file of its own.",
                )
            self.file = h5py.File(self.path, "r+", libver="latest")
            last = int(self.file["frames/step"][-1])
            if last != state.step:
                self.file.close()
                self.file = None
                raise checks.input_error(
                    "state",
                    f"at step {state.step}",
                    f"the last frame of {self.path}, at step {last}",
                    "Start from its last frame.",
                )
            # of one that was changed on purpose
            for name, value in {**_about(self.scene), "dt": self.dt}.items():
                self.file.attrs[name] = value
            self.file.swmr_mode = True
            self.written, self.first_step = last, int(self.file["frames/step"][0])
            return
        self.first_step = state.step
        if self.path.exists() and not self.overwrite:
            raise checks.input_error(
                "record",
                str(self.path),
                "a path where there is no file yet",
                "A Recorder writes one run; make another for the next.",
            )
        self.file = h5py.File(self.path, "w", libver="latest")
        self._create(state)
        self.file.swmr_mode = True
        self._write(state)

    def _create(self, state: State) -> None:
        file, scene = self.file, self.scene
        assert file is not None
        attributes = {
            "format": FORMAT,
            "version": VERSION,
            "seed": state.seed,
            "dim": state.dim,
            "dtype": str(state.dtype)[6:],
            "device": str(state.device),
            "dt": self.dt,
            "every": self.every,
            **_about(scene),
            "torchfilm": __version__,
            "torch": str(torch.__version__),
            "declared": json.dumps(
                {
                    f.name: [f.meaning, f.unit, f.scope, list(f.shape), f.at_division]
                    for f in state.declared.values()
                }
            ),
        }
        for name, value in attributes.items():
            file.attrs[name] = value
        file.create_dataset("colony_id", data=_numpy(state.colony_id))
        file.create_dataset("stream", data=_numpy(state.stream))
        for name, value in _cell_columns(state).items():
            _growing(file, f"cells/{name}", value.dtype, value.shape[1:], CHUNK_ROWS)
        colonies = (state.colonies,)
        shapes = {
            "counts": (colonies, np.int64),
            "next_uid": (colonies, np.int64),
            "time": ((), np.float64),
        }
        for name in FRAME_COLUMNS:
            shape, dtype = shapes.get(name, ((), np.int64))
            _growing(file, f"frames/{name}", dtype, shape, 64)
        for name, value in _colony_columns(state).items():
            _growing(file, f"frames/colony/{name}", value.dtype, value.shape, 64)
        if state.layout is not None:
            file.attrs["spacing"], file.attrs["height"] = (
                state.layout.grid.spacing,
                state.layout.height,
            )
            for name, value in _voxels(state).items():
                _growing(file, f"signals/{name}", value.dtype, (), CHUNK_VOXELS)
            for name, value in _grid_columns(state).items():
                _growing(file, f"frames/grid/{name}", value.dtype, value.shape, 64)
        for table, columns in LINEAGE.items():
            for name in columns:
                _growing(file, f"lineage/{table}/{name}", np.int64, (), CHUNK_ROWS)

    def _note_events(self, state: State) -> None:
        for b in state.births:
            parents = torch.cat([b.parents.uid, b.parents.uid])
            ids = torch.cat([b.parents.own_colony_id, b.parents.own_colony_id])
            self.births.append(
                (_numpy(ids), _numpy(b.uid), _numpy(parents), np.full(parents.numel(), state.step))
            )
        for e in state.ended:
            self.ends.append(
                (
                    _numpy(e.colony_id),
                    _numpy(e.uid),
                    np.full(e.uid.numel(), state.step),
                    np.full(e.uid.numel(), FATES.index(e.fate)),
                )
            )

    def _write(self, state: State) -> None:
        assert self.file is not None
        self._check_room(state)
        try:
            self._write_frame(self.file, state)
        except (OSError, RuntimeError) as error:  # HDF5 reports a failed flush as a RuntimeError
            self.last = None  # nothing more is written: the file ends with the last whole frame
            raise SimulationError(
                f"could not write step {state.step} to {self.path}: {error}. Is the disk full?"
                f" Frames up to step {self.written} are safe; free some room and resume."
            ) from error
        self.written = state.step

    def _check_room(self, state: State) -> None:
        """Stop while the file is still whole: HDF5 does not survive a disk that fills under it."""
        columns = (*_cell_columns(state).values(), *_voxels(state).values())
        needed = (
            sum(v.nbytes for v in columns)
            + sum(c.nbytes for e in (*self.births, *self.ends) for c in e)
            + ROOM_TO_SPARE
        )
        room = shutil.disk_usage(self.path.parent).free
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0] if resource else -1
        if limit >= 0:
            room = min(room, limit - self.path.stat().st_size)
        if room < needed:
            self.last = None
            raise SimulationError(
                f"no room to write step {state.step} to {self.path}: {room} bytes are left, and a"
                f" frame may need {needed}. Frames up to step {self.written} are safe; free some"
                " room and resume."
            )

    def _append(self, name: str, value: np.ndarray, at: int) -> None:
        """Put rows at `at`, and see them to the disk: a handle dropped with rows in its cache would
        lose a failure to write them."""
        assert self.file is not None
        table = self.tables.setdefault(name, self.file[name])
        try:
            table.resize(at + len(value), axis=0)
            if len(value):
                table[at:] = value
            table.flush()
        except BaseException:
            table.resize(at, axis=0)  # no half row stays behind, whatever broke off
            raise

    def _write_frame(self, file: h5py.File, state: State) -> None:
        columns = _cell_columns(state)
        unknown = [n for n in columns if f"cells/{n}" not in file]
        if unknown:
            raise SimulationError(
                f"the field {unknown[0]!r} came up in mid-run, after {self.path} was laid out: give"
                " it a first value in Rules(…, variables=…) and start anew."
            )
        counted = committed(file)
        first_row, first_voxel = counted["rows"], counted["voxels"]
        for name, value in columns.items():
            self._append(f"cells/{name}", value, first_row)
        lineage = counted
        for table, events in (("births", self.births), ("ends", self.ends)):
            names = list(LINEAGE[table])
            merged = (
                [np.concatenate(c) for c in zip(*events, strict=True)]
                if events
                else [np.empty(0, np.int64)] * len(names)
            )
            for name, value in zip(names, merged, strict=True):
                self._append(f"lineage/{table}/{name}", value, lineage[table])
            lineage[table] += len(merged[0])
        frame = lineage["frames"]
        row = {
            "first_row": first_row,
            "counts": _numpy(state.counts),
            "next_uid": _numpy(state.next_uid),
            "births": lineage["births"],
            "ends": lineage["ends"],
            "time": state.time,
            "step": state.step,
        }
        for name, value in _colony_columns(state).items():
            self._append(f"frames/colony/{name}", value[None], frame)
        for name, value in _voxels(state).items():
            self._append(f"signals/{name}", value, first_voxel)
        for name, value in _grid_columns(state, first_voxel).items():
            self._append(f"frames/grid/{name}", value[None], frame)
        file.flush()
        for name in FRAME_COLUMNS:
            self._append(f"frames/{name}", np.asarray(row[name])[None], frame)
        file.flush()
        self.births, self.ends = [], []


def _about(scene: Scene) -> dict[str, str]:
    """What tells which scene a file is of, and from which it is built again."""
    walls = [
        as_data(s)
        for effect in scene.effects
        if isinstance(effect, Mechanics)
        for s in effect.surfaces()
    ]
    return {
        "scene": scene.explain(),
        "effects": json.dumps(scene.listing()),
        "code": json.dumps(scene.code),
        "walls": json.dumps(walls),
        "recipe": json.dumps(scene.recipe),
        "settings": json.dumps(scene.settings),
        "accuracy": json.dumps(scene.accuracy),
    }


def _may_go(path: Path) -> bool:
    """Whether a file may be replaced by results: not if it is HDF5 of another kind."""
    try:
        with h5py.File(path, "r") as file:
            return file.attrs.get("format", FORMAT) == FORMAT
    except OSError:
        return True


def _numpy(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy()


def _cell_columns(state: State) -> dict[str, np.ndarray]:
    columns = {name: _numpy(getattr(state, name)) for name in PER_CELL}
    return columns | {
        n: _numpy(v) for n, v in state.fields.items() if state.declared[n].scope == CELL
    }


def _colony_columns(state: State) -> dict[str, np.ndarray]:
    return {n: _numpy(v) for n, v in state.fields.items() if state.declared[n].scope == COLONY}


def _voxels(state: State) -> dict[str, np.ndarray]:
    return {n: _numpy(v) for n, v in state.signals.items()}


def _grid_columns(state: State, first_voxel: int = 0) -> dict[str, np.ndarray]:
    """What a frame says of its grids."""
    if state.layout is None:
        return {}
    grid = state.layout.grid
    return {
        "origin": _numpy(grid.origin),
        "shape": _numpy(grid.shape),
        "first_voxel": np.asarray(first_voxel, np.int64),
    }


def _growing(file: h5py.File, name: str, dtype: Any, shape: Sequence[int], chunk: int) -> None:
    file.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=dtype,
        chunks=(chunk, *(max(1, s) for s in shape)),
        compression="gzip",
        compression_opts=1,
    )


def _copy_committed(source: Path, target: Path) -> None:
    """A clean copy with only what was committed: free of the marks and half frames that a kill
    leaves."""
    with Results(source) as results, h5py.File(target, "w", libver="latest") as out:
        file = results.file
        keep = committed(file)
        for name, value in file.attrs.items():
            out.attrs[name] = value
        sizes = {
            "cells": keep["rows"],
            "signals": keep["voxels"],
            "frames": keep["frames"],
            "lineage/births": keep["births"],
            "lineage/ends": keep["ends"],
        }

        def copy(name: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset):
                return
            size = next((n for group, n in sizes.items() if name.startswith(group + "/")), None)
            if size is None:
                out.create_dataset(name, data=item[...])
                return
            _growing(out, name, item.dtype, item.shape[1:], item.chunks[0])
            out[name].resize(size, axis=0)
            for start in range(0, size, CHUNK_ROWS):
                stop = min(size, start + CHUNK_ROWS)
                out[name][start:stop] = item[start:stop]

        file.visititems(copy)
    shutil.copymode(source, target)

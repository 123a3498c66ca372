"""Writing results: an observer that records a run in one HDF5 file, frame by frame.
`torchfilm.io.layout` describes the file."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from torchfilm.io import events, replacing
from torchfilm.io.identity import earlier_runs, scene_attributes
from torchfilm.io.layout import (
    AT_CELLS,
    CHUNK_ROWS,
    FORMAT,
    FRAME_COLUMNS,
    LINEAGE,
    VERSION,
    all_columns,
    check_columns,
    create_framed,
    create_tables,
    found_columns,
    frame_bytes,
    grid_columns,
    next_chunk,
    numpy_of,
    write_rows,
)
from torchfilm.io.parameters import write_parameters
from torchfilm.io.reading import committed, inode_of_open
from torchfilm.io.results import Results
from torchfilm.io.room import SPARE_BYTES, check_room, free_bytes
from torchfilm.model import Model
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.checks import SimulationError
from torchfilm.tools.whole_files import why_not_written
from torchfilm.version import __version__

EVERY = 10  # steps from one frame to the next
# Suffixes of formats that a run might be thought to write: such a name would mislead.
OF_OTHERS = (".csv", ".tsv", ".json", ".txt", ".xml")


class Recorder(metaclass=checks.KnownKeywords):
    """An observer that writes every `every`-th step of a run to an HDF5 file, and on `close` the
    last one. every: by default 10; with `append` as the file has it.

    path: a new file. With `overwrite` it may exist: the new file is written beside it, as
    `path.new`, and replaces it when its first frame is on the disk. A run that fails earlier leaves
    the old file as it was. With `append` it must exist: the run resumes from its last frame. The
    scene must then be the recorded one; with `changed`, any scene with the same fields. Raises
    InputError if the path does not fit.
    """

    def __init__(
        self,
        path: str | Path,
        scene: Scene,
        *,
        every: int | None = None,
        overwrite: bool = False,
        append: bool = False,
        changed: bool = False,
    ):
        self.path, self.scene = checks.file_path("record", path), scene
        self.every = EVERY if every is None else checks.integer("every", every, least=1)
        self._as_before = every is None
        self.overwrite, self.append, self.changed = overwrite, append, changed
        self._check_path()
        # where a link leads; the path itself may be relative to a folder that the process leaves
        self.target = self.path.resolve()
        self.source = replacing.replacement_of(self.target)
        self.file: h5py.File | None = None
        self.dt = scene.dt
        self.model: Model | None = None
        self.first_step = 0
        self.tables: dict[str, h5py.Dataset] = {}
        self.sizes: dict[str, int] = {}  # as `committed` tells them
        # events since the last frame that is written
        self.births: list[events.Rows] = []
        self.ends: list[events.Rows] = []
        self.last: State | None = None
        self.written = -1

    def _check_path(self) -> None:
        shown = str(self.path)
        if self.append and not self.path.exists():
            raise checks.input_error(
                "record", shown, "an existing results file to append to", "No such file."
            )
        if self.path.is_dir():
            raise checks.input_error("record", shown, "a file, not a folder")
        if self.path.suffix.lower() in OF_OTHERS and not self.append:
            raise checks.input_error(
                "record", shown, "a name such as results.h5: results are HDF5",
                "Write tables and pictures of it later: torchfilm export, torchfilm show.",
            )  # fmt: skip
        if not self.path.parent.is_dir():
            raise checks.input_error(
                "record", shown, "in a folder that exists", f"Make {self.path.parent} first."
            )
        if not self.path.exists() or self.append:
            return
        if not self.overwrite:
            raise checks.input_error(
                "record", shown, "a path where there is no file yet",
                "Choose another path, replace the file with record=tf.Recorder(path, scene,"
                " overwrite=True), or continue its run with append=True instead.",
            )  # fmt: skip
        replacing.check_replaceable(self.path)

    def attach(self, model: Model, dt: float) -> None:
        """Take the model and the step of the run. Raises InputError for another scene's."""
        if model.scene is not self.scene and model.scene != self.scene:
            raise checks.InputError(
                "the Recorder was made for another scene than the one that runs: its file would"
                " describe the wrong one."
            )
        if self.written > -1 and not self.append:
            raise checks.InputError(
                f"this Recorder has written a run to {self.path}. A Recorder writes one run; make"
                " another for the next, or give Recorder(…, append=True) to go on in its file."
            )
        self.model, self.dt = model, dt

    def __call__(self, state: State) -> None:
        if self.file is not None and self.last is not None:
            events.check_course(self.last, state)  # the file ends with the last state before
        before, self.last = self.last, state
        if self.file is None:
            self._open(state)  # earlier events belong to no frame of this run
            return
        if before is not None:
            self.births += events.arrivals_of(events.arrived_since(before, state), state)
            self.ends += events.ends_of(before, events.removed_before(state, before))
        self.births += events.births_of(state)
        self.ends += events.ends_of(state, state.ended)
        if (state.step - self.first_step) % self.every == 0:
            self._write(state)

    def close(self) -> None:
        """Write the last state, unless it is already written, and close the file."""
        if self.file is None:
            return
        try:
            if self.last is not None and -1 < self.written != self.last.step:
                self._write(self.last)
        finally:
            self._drop()

    def _drop(self) -> None:
        """Close the file as it is."""
        self.tables.clear()
        if self.file is not None:
            self.file.close()
            self.file = None

    def _open(self, state: State) -> None:
        """Make the new file, complete with a frame, under another name; then put it in place."""
        self._check_still_free()
        self.sizes, self.births, self.ends = {}, [], []
        try:
            with ExitStack() as hold:
                if self.append:
                    self._resume(state, hold)
                else:
                    self._create(state, hold)
                assert self.file is not None
                self.file = replacing.put_in_place(self.file, self.source, self.target)
        except BaseException:
            mine = self.file is not None
            self._drop()
            if mine:  # and not another process's
                self.source.unlink(missing_ok=True)
            raise
        self.tables.clear()  # of the file as it was opened before, where it was opened again

    def _check_still_free(self) -> None:
        """Raise InputError where a file has come to the path, or another process writes it."""
        if self.append or not self.path.exists():
            return
        if not self.overwrite:
            raise checks.input_error(
                "record",
                str(self.path),
                "a path where there is no file yet",
                "A file has come there since this Recorder was made: of an earlier run of it, or of"
                " another process. Choose another path.",
            )
        replacing.check_replaceable(self.path)

    def _create(self, state: State, hold: ExitStack) -> None:
        """A new file with the first frame."""
        self.first_step = state.step
        self.file = replacing.create_file(self.source)
        # again: nobody else can put a file in place while this one is open beside it
        self._check_still_free()
        for name, value in self._attributes(state).items():
            self.file.attrs[name] = value
        create_tables(self.file, state)
        own = self.model is None or self.model.begin.given is None
        write_parameters(self.file, self.scene, state.colony_id, state.step, by_founders=own)
        self.file.swmr_mode = True
        hold.enter_context(replacing.held(self.source))
        self._write(state)

    def _attributes(self, state: State) -> dict[str, Any]:
        declared = {
            f.name: [f.meaning, f.unit, f.scope, list(f.shape), f.at_division]
            for f in state.declared.values()
        }
        return {
            "format": FORMAT,
            "version": VERSION,
            "seed": state.seed,
            "dim": state.dim,
            "dtype": str(state.dtype)[6:],
            "device": str(state.device),
            "dt": self.dt,
            "every": self.every,
            **scene_attributes(self.scene, self.model),
            "torchfilm": __version__,
            "torch": str(torch.__version__),
            "declared": json.dumps(declared),
            "internal": json.dumps([f.name for f in state.declared.values() if f.internal]),
        }

    def _resume(self, state: State, hold: ExitStack) -> None:
        """A copy of the file, which ends with this state."""
        with Results(self.path) as kept:
            self._check_resumed(kept, state)
            absent = events.absent_from(state, kept.frame(), kept.colony_id)
            self.ends += events.ends_of(state, absent)
            come = events.just_arrived(state, kept.next_uid())
            self.births += events.arrivals_of(come, state.replace(ended=()))
            self.written, self.first_step = int(kept.steps[-1]), int(kept.steps[0])
            frames = len(kept)
            self.every = int(kept.attributes["every"]) if self._as_before else self.every
        check_room(
            self.target, self.target.stat().st_size, f"to resume {self.path}, by a copy of it",
            "The file is whole. Free some space and resume.",
        )  # fmt: skip
        self.file = replacing.create_file(self.source)
        replacing.copy_committed(self.target, self.file)
        # with `changed`, the scene may be another one
        ours = {**scene_attributes(self.scene, self.model), "dt": self.dt, "every": self.every}
        ours["earlier"] = earlier_runs(self.file.attrs, ours, frames)
        for name, value in ours.items():
            self.file.attrs[name] = value
        about = self.scene, state.colony_id, state.step
        write_parameters(self.file, *about, changed=self.changed)
        self._add_found(self.file, state)
        self.file.swmr_mode = True
        hold.enter_context(replacing.held(self.source))

    @staticmethod
    def _add_found(file: h5py.File, state: State) -> None:
        """Add the datasets of signals at the cells, NaN so far, to a file of an earlier version."""
        rows = committed(file)["rows"]
        for name, value in found_columns(state).items():
            if f"{AT_CELLS}/{name}" not in file:
                create_framed(file, f"{AT_CELLS}/{name}", value.dtype, (), CHUNK_ROWS)
                file[f"{AT_CELLS}/{name}"].resize(rows, axis=0)

    def _check_resumed(self, kept: Results, state: State) -> None:
        """Raise InputError unless the file ends with this state, of this scene."""
        if not self.changed:
            kept.check_alike(self.scene)
        about = kept.attributes
        mine = (
            state.seed,
            str(state.dtype)[6:],
            state.dim,
            state.colony_id.tolist(),
            state.stream.tolist(),
        )
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
        keys = lambda ids, uid: {*zip(ids.tolist(), uid.tolist(), strict=True)}
        frame = kept.frame()
        known = keys(kept.colony_id[frame["colony"]], frame["uid"])
        come = events.just_arrived(state, kept.next_uid())
        known |= {key for a in come for key in keys(a.colony_id, a.uid)}
        same = np.array_equal(
            kept.next_uid(), numpy_of(state.next_uid - events.numbers_of(come, state))
        )
        if not same or not keys(state.own_colony_id, state.uid) <= known:
            raise checks.input_error(
                "state", "with other cells", f"of cells of the last frame of {self.path}",
                "Record to a file of its own.",
            )  # fmt: skip
        for scope, columns in all_columns(state).items():
            recorded, own = set(kept.file.get(scope, ())), set(columns)
            if other := sorted(recorded ^ own):
                has = "lacks" if other[0] in recorded else "has"
                raise checks.input_error(
                    "state",
                    f"one that {has} the field {other[0]!r}",
                    f"one with the fields of {self.path}",
                    "Start from its last frame, or record to a file of its own.",
                )
        last = int(kept.steps[-1])
        if last != state.step:
            raise checks.input_error(
                "state",
                f"at step {state.step}",
                f"the last frame of {self.path}, at step {last}",
                "Start from its last frame.",
            )

    def _write(self, state: State) -> None:
        assert self.file is not None
        self._check_in_place()
        self._check_free_bytes(state)
        try:
            self._write_frame(self.file, state)
        except SimulationError:
            self.last = None
            raise
        except (OSError, RuntimeError, MemoryError) as error:  # a failed flush is a RuntimeError
            self.last = None  # nothing more is written: the file ends with the last complete frame
            raise SimulationError(
                f"could not write step {state.step} to {self.path}: {error}."
                f" {why_not_written(error)} {self._safe}"
            ) from error
        self.written = state.step

    @property
    def _safe(self) -> str:
        if self.written < 0:
            return "No frame was written; free some space and run again."
        return f"Frames up to step {self.written} are safe; free some space and resume."

    def _check_in_place(self) -> None:
        """Stop if another run has replaced the file, or someone has deleted it: the frames would go
        to a file that no path leads to."""
        if self.written < 0:
            return
        assert self.file is not None
        if not self.target.exists() or self.target.stat().st_ino != inode_of_open(self.file):
            self.last = None
            raise SimulationError(
                f"{self.path} was deleted or replaced while this run was writing it. Frames up to"
                f" step {self.written} were in that file. Record each run to a file of its own."
            )

    def _check_free_bytes(self, state: State) -> None:
        """Stop while the file is still whole: a full disk damages an HDF5 file."""
        of_ends = sum(c.nbytes for e in (*self.births, *self.ends) for c in e)
        needed = frame_bytes(state) + of_ends + SPARE_BYTES
        path = self.target if self.written >= 0 else self.source
        free = free_bytes(self.target.parent, path.stat().st_size)
        if free < needed:
            self.last = None
            raise SimulationError(
                f"no room to write step {state.step} to {self.path}: {free} bytes are free, and a"
                f" frame may need {needed}. {self._safe}"
            )

    def _table(self, name: str) -> Any:
        """A dataset of the file; None where it has none of this name."""
        if name not in self.tables and self.file is not None:
            self.tables[name] = self.file.get(name)
        return self.tables[name]

    def _append(self, name: str, value: np.ndarray, at: int) -> None:
        """Write rows at `at` and flush them. A dataset closed with rows in its cache would hide a
        failure to write them."""
        table = self._table(name)
        try:
            write_rows(table, at, value)
            table.flush()
        except BaseException:
            table.resize(at, axis=0)  # no half-written row stays, whatever the failure
            raise

    def _write_frame(self, file: h5py.File, state: State) -> None:
        columns = all_columns(state)
        check_columns(self.path, columns, self._table)
        sizes = dict(self.sizes or committed(file))
        frame, first_voxel, voxels = sizes["frames"], 0, 0
        first_row = next_chunk(self._table("cells/uid"), sizes["rows"])
        for name, value in columns["cells"].items():
            self._append(f"cells/{name}", value, first_row)
        for name, value in found_columns(state).items():
            self._append(f"{AT_CELLS}/{name}", value, first_row)
        for table, found in (("births", self.births), ("ends", self.ends)):
            names, none = LINEAGE[table], np.empty(0, np.int64)
            merged = [np.concatenate(c) for c in zip(*found, strict=True)] or [none] * len(names)
            for name, value in zip(names, merged, strict=True):
                if self._table(f"lineage/{table}/{name}") is not None:  # older files lack some
                    self._append(f"lineage/{table}/{name}", value, sizes[table])
            sizes[table] += len(merged[0])
        for name, value in columns["frames/colony"].items():
            self._append(f"frames/colony/{name}", value[None], frame)
        for name, value in columns["signals"].items():
            first_voxel = next_chunk(self._table(f"signals/{name}"), sizes["voxels"])
            voxels = first_voxel + len(value)
            self._append(f"signals/{name}", value, first_voxel)
        for name, value in grid_columns(state, first_voxel).items():
            self._append(f"frames/grid/{name}", value[None], frame)
        file.flush()
        row = {
            "first_row": first_row,
            "counts": numpy_of(state.counts),
            "next_uid": numpy_of(state.next_uid),
            "births": sizes["births"],
            "ends": sizes["ends"],
            "time": state.time,
            "step": state.step,
        }
        for name in FRAME_COLUMNS:
            self._append(f"frames/{name}", np.asarray(row[name])[None], frame)
        file.flush()
        ends = {"frames": frame + 1, "rows": first_row + state.cells, "voxels": voxels}
        self.sizes, self.births, self.ends = sizes | ends, [], []

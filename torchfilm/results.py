"""Results: one HDF5 file of ragged frames, readable while it is written, from which a run resumes bit for bit.

    /                 attributes: format, version, scene, recipe, seed, dim, dtype, versions
    /colony_id        (B,)
    /cells/NAME       rows of all frames one after the other: colony, uid, parent, position, axis, length, radius, fields per cell
    /frames/NAME      a row a frame: first_row, counts (B), next_uid (B), births, ends, time, step; /frames/colony/NAME fields per colony
    /lineage/births   colony_id, uid, parent, step · /lineage/ends   colony_id, uid, step, fate

A frame holds the whole state, so every frame is a checkpoint. `frames/step` is written last: what is not counted there did
not happen. The file is written in HDF5's single-writer mode and flushed each frame, so that a kill costs at most the
frames since. Files are data only; nothing in them is executed.
"""

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

from torchfilm.scene import Scene
from torchfilm.state import CELL, PER_CELL, Field, State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.version import __version__

FORMAT, VERSION = "torchfilm results", 1
FATES = ("divided", "removed", "left", "failed")
CHUNK_ROWS = 8192
LINEAGE = {"births": ("colony_id", "uid", "parent", "step"), "ends": ("colony_id", "uid", "step", "fate")}
# step last: it commits the frame
FRAME_COLUMNS = ("first_row", "counts", "next_uid", "births", "ends", "time", "step")


class Recorder:
    """An observer that writes every `every`-th step (and the last one, on `close`) of a run to an HDF5 file.

    path: a new file, unless `overwrite` or `append` says otherwise; `append` goes on in a file whose last frame is the state that
    the run starts from.
    """

    def __init__(self, path: str | Path, scene: Scene, *, every: int = 10, overwrite: bool = False, append: bool = False):
        if isinstance(every, bool) or not isinstance(every, int) or every < 1:
            raise checks.refuse("every", every, "a whole number of steps from 1")
        self.path, self.scene, self.every, self.append = Path(path), scene, every, append
        if append and not self.path.exists():
            raise checks.refuse("record", str(path), "an existing results file to append to", "No such file.")
        if self.path.is_dir():
            raise checks.refuse("record", str(path), "a file, not a folder")
        if self.path.exists() and not append and not overwrite:
            raise checks.refuse("record", str(path), "a path where there is no file yet", "Choose another, or say overwrite, or resume from it.")
        if not self.path.parent.is_dir():
            raise checks.refuse("record", str(path), "in a folder that exists", f"Make {self.path.parent} first.")
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
            self.file = h5py.File(self.path, "r+", libver="latest")
            last = int(self.file["frames/step"][-1])
            if last != state.step:
                self.file.close()
                raise checks.refuse("state", f"at step {state.step}", f"the last frame of {self.path}, at step {last}", "Start from its last frame.")
            self.file.swmr_mode = True
            self.written, self.first_step = last, int(self.file["frames/step"][0])
            return
        self.first_step = state.step
        self.file = h5py.File(self.path, "w", libver="latest")
        self._create(state)
        self.file.swmr_mode = True
        self._write(state)

    def _create(self, state: State) -> None:
        file, scene = self.file, self.scene
        assert file is not None
        attributes = {
            "format": FORMAT, "version": VERSION, "seed": state.seed, "dim": state.dim, "dtype": str(state.dtype)[6:],
            "device": str(state.device), "dt": self.dt, "every": self.every,
            "scene": scene.explain(), "recipe": json.dumps(scene.recipe), "settings": json.dumps(scene.settings),
            "torchfilm": __version__, "torch": str(torch.__version__),
            "declared": json.dumps({f.name: [f.meaning, f.unit, f.scope, list(f.shape), f.at_division] for f in state.declared.values()}),
        }  # fmt: skip
        for name, value in attributes.items():
            file.attrs[name] = value
        file.create_dataset("colony_id", data=_numpy(state.colony_id))
        for name, value in _cell_columns(state).items():
            _growing(file, f"cells/{name}", value.dtype, value.shape[1:], CHUNK_ROWS)
        colonies = (state.colonies,)
        shapes = {"counts": (colonies, np.int64), "next_uid": (colonies, np.int64), "time": ((), np.float64)}
        for name in FRAME_COLUMNS:
            shape, dtype = shapes.get(name, ((), np.int64))
            _growing(file, f"frames/{name}", dtype, shape, 64)
        for name, value in _colony_columns(state).items():
            _growing(file, f"frames/colony/{name}", value.dtype, value.shape, 64)
        for table, columns in LINEAGE.items():
            for name in columns:
                _growing(file, f"lineage/{table}/{name}", np.int64, (), CHUNK_ROWS)

    def _note_events(self, state: State) -> None:
        for b in state.births:
            parents = torch.cat([b.parents.uid, b.parents.uid])
            ids = torch.cat([b.parents.own_colony_id, b.parents.own_colony_id])
            self.births.append((_numpy(ids), _numpy(b.uid), _numpy(parents), np.full(parents.numel(), state.step)))
        for e in state.ended:
            self.ends.append((_numpy(e.colony_id), _numpy(e.uid), np.full(e.uid.numel(), state.step), np.full(e.uid.numel(), FATES.index(e.fate))))

    def _write(self, state: State) -> None:
        assert self.file is not None
        try:
            self._write_frame(self.file, state)
        except (OSError, RuntimeError) as error:  # HDF5 reports a failed flush as a RuntimeError
            self.last = None  # nothing more is written: the file ends with the last whole frame
            raise SimulationError(
                f"could not write step {state.step} to {self.path}: {error}. Is the disk full? Frames up to step {self.written} are safe; "
                "free some room and resume."
            ) from error
        self.written = state.step

    def _append(self, name: str, value: np.ndarray, at: int) -> None:
        """Put rows at `at`, and see them to the disk: a handle dropped with rows in its cache would lose a failure to write them."""
        assert self.file is not None
        table = self.tables.setdefault(name, self.file[name])
        table.resize(at + len(value), axis=0)
        if len(value):
            table[at:] = value
        table.flush()

    def _write_frame(self, file: h5py.File, state: State) -> None:
        columns = _cell_columns(state)
        unknown = [n for n in columns if f"cells/{n}" not in file]
        if unknown:
            raise SimulationError(
                f"the field {unknown[0]!r} came up in mid-run, after {self.path} was laid out: give it a first value in Rules(…, variables=…) and start anew."
            )
        first_row = _committed(file)["rows"]
        for name, value in columns.items():
            self._append(f"cells/{name}", value, first_row)
        lineage = _committed(file)
        for table, events in (("births", self.births), ("ends", self.ends)):
            names = list(LINEAGE[table])
            merged = [np.concatenate(c) for c in zip(*events, strict=True)] if events else [np.empty(0, np.int64)] * len(names)
            for name, value in zip(names, merged, strict=True):
                self._append(f"lineage/{table}/{name}", value, lineage[table])
            lineage[table] += len(merged[0])
        frame = lineage["frames"]
        row = {
            "first_row": first_row, "counts": _numpy(state.counts), "next_uid": _numpy(state.next_uid), "births": lineage["births"],
            "ends": lineage["ends"], "time": state.time, "step": state.step,
        }  # fmt: skip
        for name, value in _colony_columns(state).items():
            self._append(f"frames/colony/{name}", value[None], frame)
        file.flush()
        for name in FRAME_COLUMNS:
            self._append(f"frames/{name}", np.asarray(row[name])[None], frame)
        file.flush()
        self.births, self.ends = [], []


def _numpy(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy()


def _cell_columns(state: State) -> dict[str, np.ndarray]:
    columns = {name: _numpy(getattr(state, name)) for name in PER_CELL}
    return columns | {n: _numpy(v) for n, v in state.fields.items() if state.declared[n].scope == CELL}


def _colony_columns(state: State) -> dict[str, np.ndarray]:
    return {n: _numpy(v) for n, v in state.fields.items() if state.declared[n].scope != CELL}


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


def _committed(file: h5py.File) -> dict[str, int]:
    """How much of the file counts: frames, rows, births, ends."""
    frames = file["frames/step"].shape[0]
    if frames == 0:
        return {"frames": 0, "rows": 0, "births": 0, "ends": 0}
    at = frames - 1
    rows = int(file["frames/first_row"][at]) + int(file["frames/counts"][at].sum())
    return {"frames": frames, "rows": rows, "births": int(file["frames/births"][at]), "ends": int(file["frames/ends"][at])}


def _open_to_read(path: Path) -> h5py.File:
    """Open a results file, finished, still growing, or left by a kill."""
    if not path.is_file():
        raise checks.refuse("results", str(path), "a results file", "No such file.")
    error: Exception | None = None
    with open(path, "rb") as raw:
        head = raw.read(36)
    # a single-writer open of a file that was cut would wait for the rest for ever: its superblock says how long it should be
    if head[:8] == b"\x89HDF\r\n\x1a\n" and head[8] >= 2 and int.from_bytes(head[28:36], "little") > path.stat().st_size:
        raise InputError(f"{path} is truncated: it has {path.stat().st_size} of {int.from_bytes(head[28:36], 'little')} bytes. Use a whole copy of it.")
    for options in ({"swmr": True, "libver": "latest"}, {}):
        try:
            return h5py.File(path, "r", **options)
        except OSError as found:
            error = found
    raise InputError(f"{path} cannot be read as HDF5: it is truncated or not a results file ({error}).") from error


def _copy_committed(source: Path, target: Path) -> None:
    """A clean copy with only what was committed: free of the marks and half frames that a kill leaves."""
    with Results(source) as results, h5py.File(target, "w", libver="latest") as out:
        file = results.file
        keep = _committed(file)
        for name, value in file.attrs.items():
            out.attrs[name] = value
        sizes = {"cells": keep["rows"], "frames": keep["frames"], "lineage/births": keep["births"], "lineage/ends": keep["ends"]}

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


class Results:
    """A results file to read: `len(results)` frames; `results.frame(k)`, `results.table(k)`, `results.lineage()`, `results.state(scene, k)`."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.file = _open_to_read(self.path)
        try:
            if self.file.attrs.get("format") != FORMAT or "frames/step" not in self.file:
                raise InputError(f"{path} is not a torchfilm results file (its format is {self.file.attrs.get('format')!r}).")
            if int(self.file.attrs["version"]) > VERSION:
                raise InputError(f"{path} has format version {self.file.attrs['version']}, newer than this torchfilm reads ({VERSION}). Update torchfilm.")
            if len(self) == 0:
                raise InputError(f"{path} holds no finished frame.")
        except InputError:
            self.file.close()
            raise

    def __enter__(self) -> Results:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def __len__(self) -> int:
        return self.file["frames/step"].shape[0]

    @property
    def times(self) -> np.ndarray:
        """(F,) h."""
        return self.file["frames/time"][: len(self)]

    @property
    def steps(self) -> np.ndarray:
        return self.file["frames/step"][: len(self)]

    @property
    def counts(self) -> np.ndarray:
        """(F, B) cells in each colony."""
        return self.file["frames/counts"][: len(self)]

    @property
    def colony_id(self) -> np.ndarray:
        return self.file["colony_id"][...]

    @property
    def attributes(self) -> dict[str, Any]:
        """Scene, recipe, seed, versions, …"""
        return dict(self.file.attrs)

    @property
    def recipe(self) -> tuple[str, dict[str, Any]] | None:
        """The ready-made scene and its parameters, if it was one."""
        found = json.loads(self.file.attrs["recipe"])
        return None if found is None else (found[0], found[1])

    @property
    def settings(self) -> dict[str, Any]:
        """The parameters that a scene of the user's own was made with."""
        return json.loads(self.file.attrs["settings"])

    def refresh(self) -> None:
        """See what a run has written since."""
        for item in ("step", *FRAME_COLUMNS):
            self.file[f"frames/{item}"].id.refresh()
        for dataset in (*self.file["cells"].values(), *self.file["lineage/births"].values(), *self.file["lineage/ends"].values()):
            dataset.id.refresh()

    def _index(self, frame: int) -> int:
        if not -len(self) <= frame < len(self):
            raise checks.refuse("frame", frame, f"from {-len(self)} to {len(self) - 1}: {self.path} has {len(self)} frames")
        return frame % len(self)

    def frame(self, frame: int = -1) -> dict[str, np.ndarray]:
        """Arrays of one frame by name: colony (place in the batch), uid, parent, position, axis, length, radius and the fields per cell."""
        k = self._index(frame)
        start = int(self.file["frames/first_row"][k])
        stop = start + int(self.file["frames/counts"][k].sum())
        return {name: dataset[start:stop] for name, dataset in self.file["cells"].items()}

    def table(self, frame: int | None = None) -> dict[str, np.ndarray]:
        """One column a quantity, one row a cell, for `pandas.DataFrame(results.table())`: of one frame, or of all with time and frame."""
        frames = range(len(self)) if frame is None else [self._index(frame)]
        parts = []
        for k in frames:
            columns: dict[str, np.ndarray] = {}
            found = self.frame(k)
            count = len(found["uid"])
            columns["frame"] = np.full(count, k)
            columns["time"] = np.full(count, self.times[k])
            columns["colony"] = self.colony_id[found.pop("colony")]
            for name in sorted(found, key=lambda n: (n not in PER_CELL, n)):
                value = found[name]
                if value.ndim == 1:
                    columns[name] = value
                else:
                    letters = "xyz" if name in ("position", "axis") else map(str, range(value.shape[1]))
                    for j, letter in zip(range(value.shape[1]), letters, strict=False):
                        columns[letter if name == "position" else f"{name}_{letter}"] = value[:, j]
            parts.append(columns)
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}

    def lineage(self) -> dict[str, np.ndarray]:
        """Every cell that was ever born in the recorded run: colony, uid, parent, born (step), ended (step or −1), fate ("alive", "divided", …)."""
        size = _committed(self.file)
        births = {n: self.file[f"lineage/births/{n}"][: size["births"]] for n in LINEAGE["births"]}
        ends = {n: self.file[f"lineage/ends/{n}"][: size["ends"]] for n in LINEAGE["ends"]}
        first = self.frame(0)
        colony = np.concatenate([self.colony_id[first["colony"]], births["colony_id"]])
        uid = np.concatenate([first["uid"], births["uid"]])
        parent = np.concatenate([first["parent"], births["parent"]])
        born = np.concatenate([np.full(len(first["uid"]), self.steps[0]), births["step"]])
        key, end_key = _pair(colony, uid), _pair(ends["colony_id"], ends["uid"])
        order = np.argsort(key)
        at = order[np.searchsorted(key, end_key, sorter=order)]
        ended = np.full(len(uid), -1)
        fate = np.full(len(uid), "alive", dtype="<U8")
        ended[at] = ends["step"]
        fate[at] = np.asarray(FATES)[ends["fate"]]
        return {"colony": colony, "uid": uid, "parent": parent, "born": born, "ended": ended, "fate": fate}

    def state(self, scene: Scene, frame: int = -1, *, device: str | torch.device | None = None) -> State:
        """The state at a frame, from which `simulate` goes on as if it had never stopped. The scene must be the one that was run."""
        k = self._index(frame)
        dtype = getattr(torch, str(self.file.attrs["dtype"]))
        device = torch.device(device if device is not None else "cpu")
        template = scene.unchecked(int(self.colony_id.max()) + 1, seed=int(self.file.attrs["seed"]), dtype=dtype, device=device)
        if template.dim != int(self.file.attrs["dim"]):
            raise checks.refuse("scene", f"{template.dim}-D", f"{self.file.attrs['dim']}-D, as {self.path} is")
        recorded = self.frame(k)
        colony_fields = {n: d[k] for n, d in self.file["frames/colony"].items()} if "frames/colony" in self.file else {}
        missing = [n for n in template.fields if n not in recorded and n not in colony_fields]
        if missing:
            raise InputError(
                f"{self.path} lacks the field {missing[0]!r} that this scene has: it was made by another scene, {self.file.attrs['scene'].splitlines()[0]!r}."
            )
        declared = dict(template.declared)
        for name, (meaning, unit, scope, shape, at_division) in json.loads(self.file.attrs["declared"]).items():
            if name not in declared:
                declared[name] = Field(name, meaning, unit, scope, tuple(shape), torch.from_numpy(recorded[name]).dtype, at_division=at_division)

        def tensor(value: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(value)).to(device)

        fields = {n: tensor(recorded[n] if declared[n].scope == CELL else colony_fields[n]) for n in declared}
        return template.replace(
            **{n: tensor(recorded[n]) for n in PER_CELL}, colony_id=tensor(self.colony_id), next_uid=tensor(self.file["frames/next_uid"][k]),
            step=int(self.steps[k]), time=float(self.times[k]), fields=fields, declared=declared,
        )  # fmt: skip


def _pair(colony: np.ndarray, uid: np.ndarray) -> np.ndarray:
    return colony.astype(np.int64) << 40 | uid.astype(np.int64)

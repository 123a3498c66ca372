"""Results: one HDF5 file of ragged frames, readable while it is written, from which a run resumes
bit for bit.

    /                 attributes: format, version, scene, recipe, seed, dim, dtype, versions
    /colony_id, /stream   (B,)
    /cells/NAME       rows of all frames one after the other: colony, uid, parent, position, axis, length, radius, fields per cell
    /frames/NAME      a row a frame: first_row, counts (B), next_uid (B), births, ends, time, step; /frames/colony/NAME fields per colony
    /signals/NAME     (in scenes with a medium) voxels of all colonies and frames one after the other; /frames/grid/origin, shape (B, 3), first_voxel
    /lineage/births   colony_id, uid, parent, step · /lineage/ends   colony_id, uid, step, fate

A frame holds the whole state, so every frame is a checkpoint. `frames/step` is written last: what
is not counted there did not happen. The file is written in HDF5's single-writer mode and flushed
each frame, so that a kill costs at most the frames since. Files are data only; nothing in them is
executed.
"""

from __future__ import annotations

import json
import operator
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import EllipsisType
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from torchfilm.model import bind
from torchfilm.scene import Scene
from torchfilm.signals.grid import Grid
from torchfilm.state import OUTSIDE, PER_CELL, Field, State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError

FORMAT, VERSION = "torchfilm results", 2
FATES = ("divided", "removed", "left", "failed")
SIGNATURE = b"\x89HDF\r\n\x1a\n"
CHUNK_ROWS, CHUNK_VOXELS = 8192, 32768
LINEAGE = {
    "births": ("colony_id", "uid", "parent", "step"),
    "ends": ("colony_id", "uid", "step", "fate"),
}
# step last: it commits the frame
FRAME_COLUMNS = ("first_row", "counts", "next_uid", "births", "ends", "time", "step")


@contextmanager
def _whole(file: h5py.File, name: str) -> Iterator[None]:
    """What fails in here fails because the file is damaged at `name`."""
    try:
        yield
    except (OSError, KeyError, RuntimeError) as error:
        raise InputError(
            f"{file.filename} is damaged: its {name!r} cannot be read ({error}). Use another copy"
            " of it, or other frames."
        ) from error


def _read(file: h5py.File, name: str, at: int | slice | EllipsisType = ...) -> Any:
    """What a dataset holds there."""
    with _whole(file, name):
        return file[name][at]


def _frames(file: h5py.File) -> int:
    """How many frames count: a last step that does not come after the one before was broken off
    while it was written."""
    steps = _read(file, "frames/step")
    count = len(steps)
    while count > 1 and steps[count - 1] <= steps[count - 2]:
        count -= 1
    return count


def committed(file: h5py.File) -> dict[str, int]:
    """How much of the file counts: frames, rows, births, ends."""
    frames = _frames(file)
    if frames == 0:
        return {"frames": 0, "rows": 0, "voxels": 0, "births": 0, "ends": 0}
    last = partial(_read, file, at=frames - 1)
    rows = int(last("frames/first_row")) + int(last("frames/counts").sum())
    voxels = 0
    if "grid" in file["frames"]:
        voxels = int(last("frames/grid/first_voxel")) + int(last("frames/grid/shape").prod(1).sum())
    return {
        "frames": frames,
        "rows": rows,
        "voxels": voxels,
        "births": int(last("frames/births")),
        "ends": int(last("frames/ends")),
    }


def _open_to_read(path: Path) -> h5py.File:
    """Open a results file, finished, still growing, or left by a kill."""
    if not path.is_file():
        raise checks.input_error("results", str(path), "a results file", "No such file.")
    error: Exception | None = None
    with open(path, "rb") as raw:
        head = raw.read(48)
    # a single-writer open of a file that was cut would wait for the rest for ever: its superblock
    # says how long it should be
    size = path.stat().st_size
    if head.startswith(SIGNATURE[: len(head)]) and (
        len(head) < 48 or (head[8] >= 2 and int.from_bytes(head[28:36], "little") > size)
    ):
        of = f" of {int.from_bytes(head[28:36], 'little')}" if len(head) == 48 else ""
        raise InputError(
            f"{path} is truncated: it has {size}{of} bytes. Use a whole copy of it; of a run that"
            " just begins, look again."
        )
    # of a file that nobody writes (or was killed while writing), what cannot be read will not come:
    # a single-writer open would try again for minutes
    finished = len(head) == 48 and head[8] >= 3 and head[11] == 0
    ways: tuple[dict[str, Any], ...] = ({"swmr": True, "libver": "latest"}, {})
    for options in reversed(ways) if finished else ways:
        try:
            return h5py.File(path, "r", **options)
        except OSError as found:
            error = found
            # but with what this process has it open with since it was written
            if finished and "match" not in str(found):
                break
    raise InputError(
        f"{path} cannot be read as HDF5: it is truncated or not a results file ({error})."
    ) from error


class Results:
    """A results file to read: `len(results)` frames; `results.frame(k)`, `results.table(k)`,
    `results.lineage()`, `results.state(scene, k)`."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.file = _open_to_read(self.path)
        self._inode: int | None = self.path.stat().st_ino
        try:
            with _whole(self.file, "frames/step"):
                ours = self.file.attrs.get("format") == FORMAT and "frames/step" in self.file
            if not ours:
                raise InputError(
                    f"{path} is not a torchfilm results file (its format is"
                    f" {self.file.attrs.get('format')!r})."
                )
            if int(self.file.attrs["version"]) > VERSION:
                raise InputError(
                    f"{path} has format version {self.file.attrs['version']}, newer than this"
                    f" torchfilm reads ({VERSION}). Update torchfilm."
                )
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
        return _frames(self.file)

    def _read(self, name: str, at: int | slice | EllipsisType = ...) -> Any:
        return _read(self.file, name, at)

    def _names(self, group: str) -> tuple[str, ...]:
        """The datasets of a group, none if it is not there."""
        with _whole(self.file, group):
            return tuple(self.file[group]) if group in self.file else ()

    @property
    def times(self) -> np.ndarray:
        """(F,) h."""
        return self._read("frames/time", slice(len(self)))

    @property
    def steps(self) -> np.ndarray:
        return self._read("frames/step", slice(len(self)))

    @property
    def counts(self) -> np.ndarray:
        """(F, B) cells in each colony."""
        return self._read("frames/counts", slice(len(self)))

    @property
    def colony_id(self) -> np.ndarray:
        return self._read("colony_id")

    @property
    def stream(self) -> np.ndarray:
        """(B,) which course of random numbers each colony follows."""
        return self._read("stream" if "stream" in self.file else "colony_id")

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

    @property
    def accuracy(self) -> dict[str, float]:
        """The knobs of accuracy that the scene was given beside its own (`torchfilm.Settings`)."""
        return json.loads(self.file.attrs.get("accuracy", "{}"))

    @property
    def walls(self) -> list[dict[str, Any]]:
        """What cells could not pass, surface by surface: "normal" and "offset" (normal · x there,
        µm) of a flat one, "center" and "radius", µm, of a round one, each entry one number or a
        list of one per colony; and whether it is "soft"."""
        return json.loads(self.file.attrs.get("walls", "[]"))

    def refresh(self) -> None:
        """See what a run has written since."""
        inode = self.path.stat().st_ino if self.path.exists() else None
        if inode != self._inode:  # resumed, which puts a new file there
            old, self.file, self._inode = self.file, _open_to_read(self.path), inode
            old.close()
        if not self.file.swmr_mode:
            return
        self.file["frames/step"].id.refresh()  # first: what it counts has been written before it
        groups = (
            "cells",
            "signals",
            "lineage/births",
            "lineage/ends",
            "frames/colony",
            "frames/grid",
            "frames",
        )
        for dataset in (
            d
            for g in groups
            if g in self.file
            for n, d in self.file[g].items()
            if isinstance(d, h5py.Dataset) and n != "step"
        ):
            dataset.id.refresh()

    def _index(self, frame: int) -> int:
        try:
            frame = operator.index(frame)
        except TypeError as error:
            raise checks.input_error("frame", frame, "a whole number") from error
        if not -len(self) <= frame < len(self):
            raise checks.input_error(
                "frame",
                frame,
                f"from {-len(self)} to {len(self) - 1}: {self.path} has {len(self)} frames",
            )
        return frame % len(self)

    def frame(self, frame: int = -1) -> dict[str, np.ndarray]:
        """Arrays of one frame by name: colony (place in the batch), uid, parent, position, axis,
        length, radius and the fields per cell."""
        k = self._index(frame)
        start = int(self._read("frames/first_row", k))
        stop = start + int(self._read("frames/counts", k).sum())
        return {
            name: self._read(f"cells/{name}", slice(start, stop)) for name in self._names("cells")
        }

    @property
    def signal_names(self) -> tuple[str, ...]:
        """The signals of the medium, if there is one."""
        return self._names("signals")

    def grid(self, frame: int = -1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the voxels of a frame are: lower corners (B, 3) µm, numbers of voxels (B, 3), and
        their spacing (3,) µm."""
        if not self.signal_names:
            raise InputError(f"{self.path} has no medium, so no grid.")
        k = self._index(frame)
        return (
            self._read("frames/grid/origin", k),
            self._read("frames/grid/shape", k),
            np.asarray(self.file.attrs["spacing"]),
        )

    def signal(self, name: str, frame: int = -1) -> list[np.ndarray]:
        """Concentrations of a signal at a frame, one array (nx, ny, nz) a colony."""
        if name not in self.signal_names:
            raise checks.input_error(
                "signal",
                name,
                "one of " + (", ".join(self.signal_names) or "none: the scene has no medium"),
            )
        k = self._index(frame)
        _, shapes, _ = self.grid(k)
        ends = int(self._read("frames/grid/first_voxel", k)) + np.concatenate(
            [[0], np.cumsum(shapes.prod(1))]
        )
        read = partial(self._read, f"signals/{name}")
        return [
            read(slice(a, b)).reshape(tuple(shape))
            for a, b, shape in zip(ends[:-1], ends[1:], shapes, strict=True)
        ]

    def _check_scene(self, scene: Scene, template: State, changed: bool) -> None:
        """Raise InputError that names what a scene has otherwise than the one that was recorded."""
        there = {
            name: (scope, tuple(shape))
            for name, (_, _, scope, shape, _) in json.loads(self.file.attrs["declared"]).items()
        }
        here = {f.name: (f.scope, tuple(f.shape)) for f in template.declared.values()}
        kinds = {
            "it lacks": [n for n in here if n not in there],
            "of another shape there:": [n for n in here if n in there and here[n] != there[n]],
        }
        if any(kinds.values()):
            kinds["not in this scene:"] = [n for n in there if n not in here]
            raise InputError(
                f"{self.path} was recorded with other fields than this scene has ({_told(kinds)})."
                " Take the edit back to go on with it, or start a new run."
            )
        if self.signal_names and template.layout is None:
            raise InputError(
                f"{self.path} was recorded with a Medium ({', '.join(self.signal_names)}), and this"
                " scene has none."
            )
        if not changed:
            self.check_alike(scene)

    def check_alike(self, scene: Scene) -> None:
        """Raise InputError unless this is the scene that was recorded, as far as its effects, their
        parameters and the code of their functions tell."""
        was, now = json.loads(self.file.attrs.get("effects", "null")), scene.listing()
        code, mine = json.loads(self.file.attrs.get("code", "null")), scene.code
        differs = ""
        if was is not None and was != now:
            kinds = {
                "recorded with": [e for e in was if e not in now],
                "this scene has": [e for e in now if e not in was],
            }
            differs = _told(kinds) or "the same effects in another order"
        elif code is not None and code[:2] == mine[:2] and code != mine:
            differs = (
                "a function of its effects was edited since, or what such a function holds on to,"
                " or the values that colonies have each for itself"
            )
        if differs:
            raise InputError(
                f"{self.path} is of another scene: {differs}. If the change is meant, say so:"
                " resume --changed, in Python results.state(scene, changed=True) and Recorder(…,"
                " changed=True)."
            )

    def table(self, frame: int | None = None) -> dict[str, np.ndarray]:
        """One column a quantity, one row a cell, for `pandas.DataFrame(results.table())`: of one
        frame, or of all with time and frame."""
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
                    letters = (
                        "xyz" if name in ("position", "axis") else map(str, range(value.shape[1]))
                    )
                    for j, letter in zip(range(value.shape[1]), letters, strict=False):
                        columns[letter if name == "position" else f"{name}_{letter}"] = value[:, j]
            parts.append(columns)
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}

    def lineage(self) -> dict[str, np.ndarray]:
        """Every cell that was ever born in the recorded run: colony, uid, parent, born (step),
        ended (step or −1), fate ("alive", "divided", …)."""
        size = committed(self.file)
        births = {
            n: self._read(f"lineage/births/{n}", slice(size["births"])) for n in LINEAGE["births"]
        }
        ends = {n: self._read(f"lineage/ends/{n}", slice(size["ends"])) for n in LINEAGE["ends"]}
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
        return {
            "colony": colony,
            "uid": uid,
            "parent": parent,
            "born": born,
            "ended": ended,
            "fate": fate,
        }

    def state(
        self,
        scene: Scene,
        frame: int = -1,
        *,
        device: str | torch.device | None = None,
        changed: bool = False,
    ) -> State:
        """The state at a frame, from which `simulate` goes on as if it had never stopped. The scene
        must be the one that was run, or, if `changed`, one that has the same fields."""
        k = self._index(frame)
        dtype = getattr(torch, str(self.file.attrs["dtype"]))
        device = torch.device(device if device is not None else "cpu")
        model = bind(
            scene,
            int(self.colony_id.max()) + 1,
            seed=int(self.file.attrs["seed"]),
            dtype=dtype,
            device=device,
            check_first=False,
        )
        template = model.start()
        if template.dim != int(self.file.attrs["dim"]):
            raise checks.input_error(
                "scene", f"{template.dim}-D", f"{self.file.attrs['dim']}-D, as {self.path} is"
            )
        self._check_scene(scene, template, changed)
        recorded = self.frame(k)
        layout = template.layout
        if layout is not None:
            origin, shape, spacing = self.grid(k)
            corner, voxels = torch.from_numpy(origin).to(device), torch.from_numpy(shape).to(device)
            layout = layout.on(
                Grid(corner, voxels, (float(spacing[0]), float(spacing[1]), float(spacing[2])))
            )
            recorded |= {
                OUTSIDE + n: np.concatenate([x.reshape(-1) for x in self.signal(n, k)])
                for n in self.signal_names
            }
        colony_fields = {
            n: self._read(f"frames/colony/{n}", k) for n in self._names("frames/colony")
        }
        declared = dict(template.declared)
        for name, (meaning, unit, scope, shape, at_division) in json.loads(
            self.file.attrs["declared"]
        ).items():
            if name not in declared:
                declared[name] = Field(
                    name,
                    meaning,
                    unit,
                    scope,
                    tuple(shape),
                    torch.from_numpy(
                        recorded[name] if name in recorded else np.atleast_1d(colony_fields[name])
                    ).dtype,
                    at_division=at_division,
                )

        def tensor(value: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(value)).to(device)

        fields = {n: tensor(recorded[n] if n in recorded else colony_fields[n]) for n in declared}
        return template.replace(
            **{n: tensor(recorded[n]) for n in PER_CELL},
            colony_id=tensor(self.colony_id),
            stream=tensor(self.stream),
            next_uid=tensor(self._read("frames/next_uid", k)),
            step=int(self.steps[k]),
            time=float(self.times[k]),
            fields=fields,
            declared=declared,
            layout=layout,
        )


def _told(kinds: dict[str, list[str]]) -> str:
    return "; ".join(
        f"{kind} {', '.join(map(repr, names))}" for kind, names in kinds.items() if names
    )


def _pair(colony: np.ndarray, uid: np.ndarray) -> np.ndarray:
    return colony.astype(np.int64) << 40 | uid.astype(np.int64)

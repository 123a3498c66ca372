"""Opening results files and reading their datasets: complete files, growing files, and files that a
killed run left."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import EllipsisType
from typing import Any

import h5py

from torchfilm.io.layout import FORMAT, VERSION
from torchfilm.io.schema import ROWS, check_attributes, check_datasets, check_lengths, damaged
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError

# What HDF5 and h5py raise for a damaged file: a MemoryError where it says that it is huge.
DAMAGE = (
    OSError, KeyError, RuntimeError, ValueError, TypeError, IndexError, MemoryError, OverflowError,
    AttributeError,
)  # fmt: skip
SIGNATURE = b"\x89HDF\r\n\x1a\n"


@contextmanager
def blaming_file(file: h5py.File, name: str) -> Iterator[None]:
    """Raise InputError, which names the damaged dataset, for any failure of HDF5 inside."""
    try:
        yield
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(
            f"{file.filename} is damaged: its {name!r} cannot be read ({error}). Use another copy"
            " of it, or other frames."
        ) from error


def read_dataset(file: h5py.File, name: str, at: int | slice | EllipsisType = ...) -> Any:
    """The rows `at` of a dataset. Raises InputError if they cannot be read."""
    with blaming_file(file, name):
        found = file[name][at]
    if isinstance(at, slice) and at.stop is not None and len(found) < at.stop - (at.start or 0):
        raise damaged(file, f"its {name!r} ends before row {at.stop}")
    return found


def dataset_names(file: h5py.File, group: str) -> tuple[str, ...]:
    """The datasets of a group; empty if there is no such group."""
    with blaming_file(file, group):
        return tuple(file[group]) if group in file else ()


def read_attribute(file: h5py.File, name: str, missing: str | None = None) -> Any:
    """What an attribute holds as JSON, or `missing` does. Raises InputError if it cannot be
    read."""
    with blaming_file(file, name):
        return json.loads(file.attrs[name] if missing is None else file.attrs.get(name, missing))


def frame_count(file: h5py.File) -> int:
    """Number of complete frames. Steps increase from frame to frame; a last step that does not was
    interrupted while it was written, and its frame is not counted."""
    steps = read_dataset(file, "frames/step")
    count = len(steps)
    while count > 1 and steps[count - 1] <= steps[count - 2]:
        count -= 1
    return count


def committed(file: h5py.File, frames: int | None = None) -> dict[str, int]:
    """The sizes of the complete part of the file: frames, rows, voxels, births, ends. frames: how
    many it had when it was asked; a run may have written more since."""
    frames = frame_count(file) if frames is None else frames
    if frames == 0:
        return {"frames": 0, "rows": 0, "voxels": 0, "births": 0, "ends": 0}
    last = partial(read_dataset, file, at=frames - 1)
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


def refresh(file: h5py.File) -> None:
    """See what a run has written since, in a file that may grow."""
    if not file.swmr_mode:
        return
    # first, because all that it counts was written before it
    file["frames/step"].id.refresh()
    for group in ROWS:
        for name, dataset in file.get(group, {}).items():
            if isinstance(dataset, h5py.Dataset) and f"{group}/{name}" != "frames/step":
                dataset.id.refresh()


def inode_of_open(file: h5py.File) -> int:
    """The inode of the open file, also after another file took its path."""
    return os.fstat(file.id.get_vfd_handle()).st_ino


def open_results(path: Path) -> h5py.File:
    """Open a torchfilm results file with at least one complete frame. Raises InputError for any
    other file."""
    file = _open_hdf5(path)
    try:
        with blaming_file(file, "frames/step"):
            ours = file.attrs.get("format") == FORMAT and "frames/step" in file
        if not ours:
            raise InputError(
                f"{path} is not a torchfilm results file (its format is"
                f" {file.attrs.get('format')!r})."
            )
        with blaming_file(file, "version"):
            version = int(file.attrs["version"])
            if version != file.attrs["version"] or version < 1:
                raise ValueError(f"it is {file.attrs['version']}")
        if version > VERSION:
            raise InputError(
                f"{path} has format version {version}, newer than this torchfilm"
                f" reads ({VERSION}). Update torchfilm."
            )
        with blaming_file(file, "/"):
            checks.only_own_data(file)
            refresh(file)  # to look at a dataset is to know how long it was then
            check_attributes(file)
            frames = frame_count(file)  # before the lengths of what it counts are looked at
            if frames == 0:
                raise InputError(f"{path} holds no finished frame.")
            check_lengths(file, check_datasets(file), committed(file, frames))
    except InputError:
        file.close()
        raise
    return file


def is_results(path: Path) -> bool:
    """Whether a file is HDF5 and says that it is one of torchfilm's results."""
    try:
        with _open_hdf5(path) as file:
            return file.attrs.get("format") == FORMAT
    except InputError:
        return False


def _open_hdf5(path: Path) -> h5py.File:
    """Open an HDF5 file to read: complete, growing, or left by a killed run."""
    if not path.is_file():
        why = "This is a folder." if path.is_dir() else "No such file."
        raise checks.input_error("results", str(path), "a results file", why)
    error: Exception | None = None
    with open(path, "rb") as raw:
        head = raw.read(48)
    # A single-writer open of a truncated file waits without end for the missing bytes. Its
    # superblock gives the length that the file should have.
    size = path.stat().st_size
    if head.startswith(SIGNATURE[: len(head)]) and (
        len(head) < 48 or (head[8] >= 2 and int.from_bytes(head[28:36], "little") > size)
    ):
        of = f" of {int.from_bytes(head[28:36], 'little')}" if len(head) == 48 else ""
        raise InputError(
            f"{path} is truncated: it has {size}{of} bytes. Use a complete copy of it. If its run"
            " has just started, try again."
        )
    # If no process writes the file (or the writer was killed), unreadable bytes stay unreadable. A
    # single-writer open would retry for minutes.
    finished = len(head) == 48 and head[8] >= 3 and head[11] == 0
    ways: tuple[dict[str, Any], ...] = ({"swmr": True, "libver": "latest"}, {})
    for options in reversed(ways) if finished else ways:
        try:
            return h5py.File(path, "r", **options)
        except OSError as found:
            error = found
            # "match": this process still has the file open with the options of its writer
            if finished and "match" not in str(found):
                break
    raise InputError(
        f"{path} cannot be read as HDF5: it is truncated or not a results file ({error})."
    ) from error

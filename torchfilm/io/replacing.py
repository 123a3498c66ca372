"""New results files beside old ones: a file is written under another name in the same folder, and
takes its own path once it holds a complete frame."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py

from torchfilm.io.layout import AT_CELLS, CHUNK_ROWS, FORMAT, create_framed, create_table
from torchfilm.io.reading import SIGNATURE, committed, inode_of_open, open_results
from torchfilm.tools import checks

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

# POSIX renames an open file, and replaces one that others have open. Windows does neither.
RENAMES_OPEN_FILES = os.name != "nt"
# no cache of chunks: each is written once, and to flush a cache takes longer with every frame
WRITING: dict[str, Any] = {"libver": "latest", "rdcc_nbytes": 0}
JUST_MADE = 0.2  # s, by when a file that a process has created is locked
CHUNKS_AT_ONCE = 16  # that are copied: whole ones, so that each is compressed once


def replacement_of(path: Path) -> Path:
    """Where the new file is written until it replaces the one at `path`."""
    return path.with_name(path.name + ".new")


def check_replaceable(path: Path) -> None:
    """Raise InputError for an HDF5 file of another kind, such as a study, and for a file that
    another process has open for writing other than as results."""
    try:
        with h5py.File(path, "r") as file:
            ours = file.attrs.get("format", FORMAT) == FORMAT
    except OSError as error:
        if isinstance(error, BlockingIOError):  # the lock of HDF5: the other process writes
            raise _written_by_another(path) from error
        return  # not HDF5, or results that a killed run left
    if not ours:
        raise checks.input_error(
            "record",
            str(path),
            "a results file, where it replaces one",
            "This is another kind of file, such as a study. Choose another path.",
        )


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Other processes find that the file beside the results is being written. HDF5 itself gives its
    lock back where readers are to follow."""
    if fcntl is None or not RENAMES_OPEN_FILES:
        yield
        return
    with path.open("rb") as file:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield


def _is_held(path: Path) -> bool:
    """Whether a process, also this one, holds or writes the file."""
    try:
        with path.open("rb") as file:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # it has gone, or its file system knows no locks
        pass
    return False


def create_file(path: Path) -> h5py.File:
    """Create a new HDF5 file. A file that an earlier run left at this path is deleted first: its
    inode may still be open elsewhere, so it is not truncated. Raises InputError where another
    process is writing it."""
    if path.is_symlink():
        rule, hint = "a path beside which no link stands", f"Remove {path}: it is a link."
        raise checks.input_error("record", str(path).removesuffix(".new"), rule, hint)
    if path.exists():
        _check_ours(path)
        if time.time() - path.stat().st_mtime < JUST_MADE and not _is_held(path):
            time.sleep(JUST_MADE)  # from the creation of a file to its lock there are moments
        if _is_held(path):
            raise _written_by_another(path)
        check_replaceable(path)
        path.unlink(missing_ok=True)
    try:
        return h5py.File(path, "x", **WRITING)
    except FileExistsError as error:
        raise _written_by_another(path) from error
    except OSError as error:
        path.unlink(missing_ok=True)
        raise checks.input_error(
            "record",
            str(path),
            "in a folder where HDF5 can create and lock files",
            f"{error}. On a file system without locks, set HDF5_USE_FILE_LOCKING=FALSE.",
        ) from error


def _check_ours(path: Path) -> None:
    """Raise InputError for a file beside the results that no run has left there."""
    with path.open("rb") as file:
        head = file.read(len(SIGNATURE))
    if head != SIGNATURE[: len(head)]:
        rule = f"a path beside which {path.name} is free"
        hint = f"{path} is no results file: move it, or choose another path."
        raise checks.input_error("record", str(path).removesuffix(".new"), rule, hint)


def _written_by_another(path: Path) -> checks.InputError:
    return checks.input_error(
        "record",
        str(path).removesuffix(".new"),
        "a file that no other process writes",
        "Choose another path, or wait until that process has closed it.",
    )


def put_in_place(file: h5py.File, source: Path, path: Path) -> h5py.File:
    """Write the open file `source` to the disk and rename it to `path`, in one step for all
    readers. Returns the file, open as before. Readers of the old file keep it."""
    if not source.exists() or source.stat().st_ino != inode_of_open(file):
        raise _written_by_another(path)  # where no locks are
    if path.exists():
        shutil.copymode(path, source)
    file.flush()
    os.fsync(file.id.get_vfd_handle())
    if RENAMES_OPEN_FILES:
        os.replace(source, path)
        return file
    file.close()
    try:
        os.replace(source, path)
    except PermissionError as error:
        raise checks.input_error(
            "record",
            str(path),
            "a file that nothing has open",
            "This operating system cannot replace an open file. Close it in the other process, or"
            " here: results.close(), or `with tf.Results(…) as results:`.",
        ) from error
    file = h5py.File(path, "r+", **WRITING)
    file.swmr_mode = True
    return file


def copy_committed(source: Path, out: h5py.File) -> None:
    """Copy the complete frames of a results file to a new file, open for writing. Incomplete frames
    and the marks that a killed writer leaves are not copied."""
    with open_results(source) as file:
        keep = committed(file)
        for name, value in file.attrs.items():
            out.attrs[name] = value
        sizes = {
            "cells": keep["rows"],
            AT_CELLS: keep["rows"],
            "signals": keep["voxels"],
            "frames": keep["frames"],
            "lineage/births": keep["births"],
            "lineage/ends": keep["ends"],
        }

        def copy(name: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset):
                out.require_group(name)  # also an empty one: it says that there was nothing
                return
            size = next((n for group, n in sizes.items() if name.startswith(group + "/")), None)
            if size is None:
                out.create_dataset(name, data=item[...])
                return
            if name.startswith(("cells/", f"{AT_CELLS}/")):
                # files of earlier versions have longer chunks
                create_framed(out, name, item.dtype, item.shape[1:], CHUNK_ROWS)
            elif name.startswith("signals/"):
                create_framed(out, name, item.dtype, item.shape[1:], item.chunks[0])
            else:
                create_table(out, name, item.dtype, item.shape[1:])
            copied = out[name]
            copied.resize(size, axis=0)
            several = CHUNKS_AT_ONCE * copied.chunks[0]
            for start in range(0, size, several):
                stop = min(size, start + several)
                copied[start:stop] = item[start:stop]

        file.visititems(copy)

"""New results files beside old ones: a file is written under another name in the same folder, and
takes its own path once it holds a complete frame."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import h5py

from torchfilm.io.layout import AT_CELLS, CHUNK_ROWS, FORMAT, create_framed, create_table
from torchfilm.io.reading import committed, open_results
from torchfilm.tools import checks

# POSIX renames an open file, and replaces one that others have open. Windows does neither.
RENAMES_OPEN_FILES = os.name != "nt"
CHUNKS_AT_ONCE = 16  # that are copied: whole ones, so that each is compressed once


def beside(path: Path) -> Path:
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
            raise checks.input_error(
                "record",
                str(path),
                "a file that no other process writes",
                "Choose another path, or wait until that process has closed it.",
            ) from error
        return  # not HDF5, or results that a killed run left
    if not ours:
        raise checks.input_error(
            "record",
            str(path),
            "a results file, where it replaces one",
            "This is another kind of file, such as a study. Choose another path.",
        )


def create_file(path: Path) -> h5py.File:
    """Create a new HDF5 file. A file that an earlier run left at this path is deleted first: its
    inode may still be open elsewhere, so it is not truncated."""
    if path.exists():
        check_replaceable(path)
        path.unlink()
    try:
        return h5py.File(path, "x", libver="latest")
    except OSError as error:
        path.unlink(missing_ok=True)
        raise checks.input_error(
            "record",
            str(path),
            "in a folder where HDF5 can create and lock files",
            f"{error}. On a file system without locks, set HDF5_USE_FILE_LOCKING=FALSE.",
        ) from error


def put_in_place(file: h5py.File, source: Path, path: Path) -> h5py.File:
    """Write the open file `source` to the disk and rename it to `path`, in one step for all
    readers. Returns the file, open as before. Readers of the old file keep it."""
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
            "a file that no other process has open",
            "This operating system cannot replace an open file. Close it there.",
        ) from error
    file = h5py.File(path, "r+", libver="latest")
    file.swmr_mode = True
    return file


def copy_committed(source: Path, target: Path) -> h5py.File:
    """Copy the complete frames of a results file to a new file, and return that, open for writing.
    Incomplete frames and the marks that a killed writer leaves are not copied."""
    out = create_file(target)
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
    return out

"""HDF5 files of the design layer: how one is read or replaced, and columns of values."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import torch

import torchfilm as tf
from design.parameters import Value
from torchfilm import checks

Stamp = str  # of a file, by which it is known again
UNREADABLE = "unreadable"
SPARE_BYTES = 1 << 18  # of a file that grows by a generation


def stamp(path: Path) -> Stamp | None:
    """The mark that a file at a path got as it was written, by which it is known again; None where
    there is no file, and of one of an earlier version."""
    if not path.is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("written", "")) or None
    except OSError:
        return UNREADABLE


@contextmanager
def replacing(
    path: Path, form: str, version: int, about: Mapping[str, Any], kept: str,
    before: Stamp | None,
) -> Iterator[h5py.File]:  # fmt: skip
    """A new file beside an older one, which it replaces at the end: a kill at any moment costs at
    most what is being written. about: plain data; kept: what the older file holds, for the message;
    before: the `stamp` of the file that it may replace. Raises SimulationError where the file
    cannot be written, and where another process has put its own there."""
    beside = path.with_name(path.name + ".new")
    # a disk that fills while HDF5 writes may end the process
    needed = (path.stat().st_size if path.exists() else 0) + SPARE_BYTES
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise tf.SimulationError(
            f"no room to write {path}: {free} bytes are free in {path.parent.resolve()}, and it may"
            f" need {needed}. Free some space. The file keeps the {kept}."
        )
    try:
        _remove_left_over(beside)
        with h5py.File(beside, "x") as file:
            file.attrs.update(
                {
                    "format": form,
                    "version": version,
                    "about": json.dumps(about),
                    "torchfilm": tf.__version__,
                    "torch": str(torch.__version__),
                    "written": secrets.token_hex(16),
                }
            )
            yield file
        if stamp(path) not in (None, before):
            beside.unlink(missing_ok=True)
            raise tf.SimulationError(
                f"{path} has been written by another process since this one read or wrote it."
                " Nothing of it is replaced. Give each search a file of its own."
            )
        os.replace(beside, path)
    except (BlockingIOError, FileExistsError) as error:
        raise tf.SimulationError(
            f"could not write {path}: another process is writing it. Give each process a file of"
            f" its own. The file keeps the {kept}."
        ) from error
    except (tf.SimulationError, NotImplementedError, RecursionError):
        raise
    except (OSError, RuntimeError) as error:  # HDF5 raises both
        beside.unlink(missing_ok=True)
        raise tf.SimulationError(
            f"could not write {path}: {error}. Is the disk full, or a quota reached? The file keeps"
            f" the {kept}."
        ) from error


def _remove_left_over(path: Path) -> None:
    """Remove a file that a killed process left. Raises BlockingIOError for one that a process is
    writing: opened to append it keeps what it has."""
    if not path.exists():
        return
    try:
        h5py.File(path, "a").close()
    except OSError as error:
        if isinstance(error, BlockingIOError):
            raise
    path.unlink(missing_ok=True)


@contextmanager
def reading(path: Path, form: str, version: int, what: str) -> Iterator[h5py.File]:
    """A file to read. what: what it should be, as messages name it. Raises InputError for a file of
    another format or a later version, and for what is missing or broken in it."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != form:
                found = file.attrs.get("format")
                raise tf.InputError(f"{path} is not a {what} (its format is {found!r}).")
            if int(file.attrs["version"]) > version:
                raise tf.InputError(
                    f"{path} has format version {file.attrs['version']}; this torchfilm reads"
                    f" versions up to {version}. Update torchfilm."
                )
            checks.only_own_data(file)
            yield file
    except tf.InputError:
        raise
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, IndexError) as error:
        raise tf.InputError(
            f"{path} cannot be read: it is truncated or not a {what} ({error})."
        ) from error


def write_values(group: h5py.Group, name: str, column: Sequence[Value]) -> None:
    """The values of a parameter: as text where all are text, as JSON where some are."""
    text = [isinstance(v, str) for v in column]
    mixed = any(text) and not all(text)
    found = group.create_dataset(
        f"values/{name}",
        data=[json.dumps(v) for v in column] if mixed else column,
        dtype=h5py.string_dtype() if any(text) else None,
    )
    if mixed:
        found.attrs["encoding"] = "JSON"


def read_values(group: h5py.Group) -> dict[str, list[Value]]:
    """The columns that `write_values` wrote, by name."""
    out = {}
    for name, column in group["values"].items():
        found = (column.asstr() if h5py.check_string_dtype(column.dtype) else column)[...].tolist()
        mixed = column.attrs.get("encoding") == "JSON"
        out[name] = [json.loads(v) for v in found] if mixed else found
    return out

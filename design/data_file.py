"""HDF5 files of the design layer: how one replaces an older one, and columns of values."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import torch

import torchfilm as tf
from design.parameters import Value


@contextmanager
def replacing(
    path: Path, form: str, version: int, about: Mapping[str, Any], kept: str
) -> Iterator[h5py.File]:
    """A new file beside an older one, which it replaces at the end: a kill at any moment costs at
    most what is being written. about: plain data; kept: what the older file holds, for the message.
    Raises SimulationError where the file cannot be written."""
    beside = path.with_name(path.name + ".new")
    try:
        with h5py.File(beside, "w") as file:
            file.attrs.update(
                {
                    "format": form,
                    "version": version,
                    "about": json.dumps(about),
                    "torchfilm": tf.__version__,
                    "torch": str(torch.__version__),
                }
            )
            yield file
        os.replace(beside, path)
    except OSError as error:
        raise tf.SimulationError(
            f"could not write {path}: {error}. Is the disk full? The file keeps the {kept}."
        ) from error


def write_values(group: h5py.Group, name: str, column: Sequence[Value]) -> None:
    """The values of a parameter, as text where any of them is text."""
    text = any(isinstance(v, str) for v in column)
    group.create_dataset(
        f"values/{name}",
        data=[str(v) for v in column] if text else column,
        dtype=h5py.string_dtype() if text else None,
    )

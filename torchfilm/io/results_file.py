"""An open results file: what it says of its scene, and how to read its data sets."""

from __future__ import annotations

from pathlib import Path
from types import EllipsisType
from typing import Any, Self

import h5py

from torchfilm.io.identity import declared_fields
from torchfilm.io.layout import INTERNAL_BEFORE, INTERNAL_ENDING_BEFORE
from torchfilm.io.reading import dataset_names, open_results, read_attribute, read_dataset
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError


class ResultsFile(metaclass=checks.KnownKeywords):
    """What `Results` knows beside its frames. Raises InputError if the file is not a readable
    results file."""

    def __init__(self, path: str | Path):
        self.path = checks.file_path("path", path)
        self._place = self.path.resolve()  # the path may be relative to a folder that is left
        self._open = open_results(self.path)

    @property
    def file(self) -> h5py.File:
        """The HDF5 file. Raises InputError where it is closed."""
        if not self._open:
            raise InputError(f"{self.path} is closed: read inside `with tf.Results(…) as results:`")
        return self._open

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, as leaving `with` does; again does nothing."""
        self._open.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._place,)  # another process opens the file itself

    def _read(self, name: str, at: int | slice | EllipsisType = ...) -> Any:
        return read_dataset(self.file, name, at)

    def _names(self, group: str) -> tuple[str, ...]:
        return dataset_names(self.file, group)

    @property
    def attributes(self) -> dict[str, Any]:
        """Scene, recipe, seed, versions, …"""
        return dict(self.file.attrs)

    @property
    def recipe(self) -> tuple[str, dict[str, Any]] | None:
        """Name and parameters of the ready-made scene; None for a scene of the user's own."""
        found = read_attribute(self.file, "recipe")
        return None if found is None else (found[0], found[1])

    @property
    def settings(self) -> dict[str, Any]:
        """The parameters given to a scene function of the user's own."""
        return read_attribute(self.file, "settings", "{}")

    @property
    def accuracy(self) -> dict[str, float]:
        """The knobs of accuracy given to the scene beside its own (`torchfilm.Settings`)."""
        return read_attribute(self.file, "accuracy", "{}")

    @property
    def walls(self) -> list[dict[str, Any]]:
        """The surfaces that cells could not pass. A flat one has "normal" and "offset" (normal · x
        on it, µm), a round one "centre" and "radius", µm. Each entry is one number, or a list of
        one per colony. "soft" says whether the surface yields."""
        found = read_attribute(self.file, "walls", "[]")  # of earlier versions with "center"
        return [{n.replace("center", "centre"): x for n, x in wall.items()} for wall in found]

    @property
    def periodic(self) -> dict[str, tuple[float, float]]:
        """The faces of axes along which space is periodic for cells, (low, high) µm."""
        found = read_attribute(self.file, "periodic", "{}")
        return {axis: (low, high) for axis, (low, high) in found.items()}

    @property
    def type_names(self) -> list[str]:
        """The names of the cells' types 0, 1, …, as far as the scene gave them some."""
        return read_attribute(self.file, "type_names", "[]")

    @property
    def internal_fields(self) -> set[str]:
        """The fields that serve the numerics: `table` shows them only with `internals`."""
        given = self.file.attrs.get("internal")
        if given is not None:
            return set(read_attribute(self.file, "internal"))
        names = declared_fields(self.file.attrs)
        return {n for n in names if n in INTERNAL_BEFORE or n.endswith(INTERNAL_ENDING_BEFORE)}

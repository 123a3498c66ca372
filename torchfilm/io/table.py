"""The table of a run: one row per cell and frame, one column per quantity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchfilm.io.parameters import column_names
from torchfilm.physics import capsule
from torchfilm.state import OUTSIDE
from torchfilm.tools.checks import InputError, install

if TYPE_CHECKING:
    from torchfilm.io.lineage import Lineage
    from torchfilm.io.results import Results

# Columns that every table has, in this order; those of places and directions follow `parent`.
FIRST = ("frame", "time", "colony", "cell", "parent")
PLACES = ("x", "y", "z", "angle", "tilt")
SHAPE = ("length", "radius", "volume", "age", "born")
OWN = {*FIRST, *PLACES, *SHAPE, "axis_x", "axis_y", "axis_z"}
GIVEN = ("colony", "uid", "parent", "position", "axis", "length", "radius")


# Which cells a table shows, (N,) bool, by the ids of their colonies and their uids, (N,) each.
Keep = Callable[[np.ndarray, np.ndarray], np.ndarray]


def needed(module: str, extra: str, package: str = "") -> Any:
    """A module of an extra. Raises InputError, which names the extra, where it is missing."""
    try:
        return import_module(module)
    except ImportError as error:
        name = package or module
        raise InputError(f"this needs {name}: {install(extra)}.") from error


def data_frame(columns: dict[str, np.ndarray]) -> Any:
    """The columns as a pandas.DataFrame."""
    return needed("pandas", "tables").DataFrame(columns)


class Tables:
    """The tables of a results file. internals: with the fields that serve the numerics."""

    def __init__(self, results: Results, lineage: Lineage, internals: bool):
        self.results, self.lineage, self.internals = results, lineage, internals

    def __call__(self, frames: Sequence[int], keep: Keep | None = None) -> dict[str, np.ndarray]:
        """The columns of some frames, in order, for all cells or for those to `keep`."""
        parts = [self._frame(k, keep) for k in frames]
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}

    def _frame(self, k: int, keep: Keep | None) -> dict[str, np.ndarray]:
        results, found = self.results, self.results.frame(k)
        signals = results.signals_at_cells(k)
        if keep is not None:
            rows = keep(results.colony_id[found["colony"]], found["uid"])
            found = {name: x[rows] for name, x in found.items()}
            signals = {name: x[rows] for name, x in signals.items()}
        place, time = found["colony"], float(results.times[k])
        ids = results.colony_id[place]
        born = self.lineage.born_of(ids, found["uid"])
        columns = {
            "frame": np.full(len(place), k),
            "time": np.full(len(place), time),
            "colony": ids,
            "cell": found["uid"],
            "parent": found["parent"],
            **_pose(found["position"], found["axis"], self.internals),
            "length": found["length"],
            "radius": found["radius"],
            "volume": _volume(found["length"], found["radius"]),
            "age": time - born,
            "born": born,
        }
        fields = {**found, **{n: x[place] for n, x in results.colony_fields(k).items()}}
        hidden = set() if self.internals else results.internal_fields
        for name in sorted(fields.keys() - hidden - set(GIVEN)):
            columns |= _components(f"field.{name}" if name in OWN else name, fields[name])
        for name, value in signals.items():
            columns[OUTSIDE + name] = value
        values = results.parameters(k)
        for path, name in column_names(list(values), set(columns)).items():
            columns[name] = values[path][place]
        return columns


def _pose(position: np.ndarray, axis: np.ndarray, internals: bool) -> dict[str, np.ndarray]:
    """Centre, µm, and direction, rad; with `internals` the axis, too."""
    columns = dict(zip("xyz", position.T, strict=False))
    columns["angle"] = np.arctan2(axis[:, 1], axis[:, 0])
    if axis.shape[1] == 3:
        columns["tilt"] = np.arctan2(axis[:, 2], np.hypot(axis[:, 0], axis[:, 1]))
    if internals:
        columns |= {f"axis_{n}": x for n, x in zip("xyz", axis.T, strict=False)}
    return columns


def _volume(length: np.ndarray, radius: np.ndarray) -> np.ndarray:
    return capsule.volume(torch.from_numpy(length), torch.from_numpy(radius)).numpy()


def _components(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of one quantity: itself, or one per component."""
    if value.ndim == 1:
        return {name: value}
    flat = value.reshape(len(value), int(np.prod(value.shape[1:])))
    return {f"{name}_{j}": column for j, column in enumerate(flat.T)}

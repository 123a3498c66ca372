"""The table of a run or a state: one row per cell and frame, one column per quantity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchfilm.io.blocks import Block, blocks
from torchfilm.io.parameters import column_names
from torchfilm.physics import capsule
from torchfilm.state import CELL, COLONY, OUTSIDE, State
from torchfilm.tools import checks
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
        parts = [self._columns(block, keep) for block in blocks(self.results, frames)]
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}

    def _columns(self, block: Block, keep: Keep | None) -> dict[str, np.ndarray]:
        """The columns of frames in which the parameters of colonies are the same."""
        columns, place = self.of_cells(block, keep)
        values = self.parameters(block, columns)
        return columns | {name: x[place] for name, x in values.items()}

    @property
    def hidden(self) -> set[str]:
        """The fields that are not shown."""
        return set() if self.internals else self.results.internal_fields

    def of_cells(
        self, block: Block, keep: Keep | None = None
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The columns without parameters, and the place of each cell's colony, (N,)."""
        results = self.results
        found, signals, which = block.cells(), block.signals(), block.which
        of_colonies = block.colony_fields(found["colony"])
        if keep is not None:
            rows = keep(results.colony_id[found["colony"]], found["uid"])
            found, signals, of_colonies = (
                {name: x[rows] for name, x in part.items()}
                for part in (found, signals, of_colonies)
            )
            which = which[rows]
        place, time = found["colony"], results.times[block.frames][which]
        found |= {"colony": results.colony_id[place]}
        born = self.lineage.born[self.lineage.rows(found["colony"], found["uid"])]
        columns = {
            "frame": block.frames[which],
            **_of_cells(time, found, self.internals),
            "age": time - born,
            "born": born,
        }
        fields = {n: x for n, x in (found | of_colonies).items() if n not in self.hidden}
        return columns | of_fields(fields, signals), place

    def parameters(self, block: Block, columns: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The parameters with one value per colony, (B,), by the shortest names that the `columns`
        leave free."""
        values = self.results.parameters(block.frames[0])
        names = column_names(list(values), set(columns))
        return {name: values[path] for path, name in names.items()}


@checks.known_keywords
def cell_table(state: State, *, internals: bool = False) -> dict[str, np.ndarray]:
    """The cells of a state, one row per cell and one column per quantity, each (N,):
    `pandas.DataFrame(tf.cell_table(state))`.

    The columns are those of `Results.table`, but for frame, age and born, which a state does not
    know, and parameters. internals: with the axis, and with the fields that serve the numerics.
    """
    if not isinstance(state, State):
        raise checks.input_error("cell_table(state)", state, "a tf.State")
    on_cpu = lambda x: x.detach().cpu().numpy().copy()  # a table may be changed, a state not
    found = {"uid": state.uid, "colony": state.own_colony_id, "parent": state.parent}
    found |= {n: getattr(state, n) for n in ("position", "axis", "length", "radius")}
    for name, value in state.fields.items():
        declared = state.declared[name]
        if declared.scope in (CELL, COLONY) and (internals or not declared.internal):
            per_cell = declared.scope == CELL
            found[name] = value if per_cell else value.index_select(0, state.colony)
    contact = state.contact()
    signals = {} if contact is None else {n: on_cpu(x) for n, x in contact.found.items()}
    columns = {n: on_cpu(x) for n, x in found.items()}
    return _of_cells(state.time, columns, internals) | of_fields(columns, signals)


def _of_cells(
    time: float | np.ndarray, found: Mapping[str, np.ndarray], internals: bool
) -> dict[str, np.ndarray]:
    """The columns that all cells have."""
    return {
        "time": np.broadcast_to(time, len(found["uid"])).copy(),
        "colony": found["colony"],
        "cell": found["uid"],
        "parent": found["parent"],
        **_pose(found["position"], found["axis"], internals),
        "length": found["length"],
        "radius": found["radius"],
        "volume": volumes(found["length"], found["radius"]),
    }


def of_fields(
    fields: Mapping[str, np.ndarray], signals: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The columns of fields, and of the signals at the cells."""
    columns: dict[str, np.ndarray] = {}
    for name in sorted(fields.keys() - set(GIVEN)):
        columns |= _components(f"field.{name}" if name in OWN else name, fields[name])
    return columns | {OUTSIDE + name: value for name, value in signals.items()}


def _pose(position: np.ndarray, axis: np.ndarray, internals: bool) -> dict[str, np.ndarray]:
    """Centre, µm, and direction, rad; with `internals` the axis, too."""
    columns = dict(zip("xyz", position.T, strict=False))
    columns["angle"] = np.arctan2(axis[:, 1], axis[:, 0])
    if axis.shape[1] == 3:
        columns["tilt"] = np.arctan2(axis[:, 2], np.hypot(axis[:, 0], axis[:, 1]))
    if internals:
        columns |= {f"axis_{n}": x for n, x in zip("xyz", axis.T, strict=False)}
    return columns


def volumes(length: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Volume of each cell, (N,) µm³, from its length and radius, µm."""
    return capsule.volume(torch.from_numpy(length), torch.from_numpy(radius)).numpy()


def _components(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of one quantity: itself, or one per component."""
    if value.ndim == 1:
        return {name: value}
    flat = value.reshape(len(value), int(np.prod(value.shape[1:])))
    return {f"{name}_{j}": column for j, column in enumerate(flat.T)}

"""Initial cells: given directly, from arrays, or from files of segmented images (CSV, HDF5)."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.contacts import gaps_nearby
from torchfilm.state import CELL_TYPE, RESERVED, Field, State
from torchfilm.tools import checks

# The names of columns for position and axis.
POSITION, AXIS = ("x", "y", "z"), ("axis_x", "axis_y", "axis_z")
# Columns by which segmentation programs number cells and frames; any other column becomes a field.
BOOKKEEPING = ("label", "frame", "id", "cell_id", "track", "track_id", "index")


@dataclass(frozen=True)
class Cells:
    """Initial cells.

    position: (N, d) µm. axis: (N, d), of any length above 0. length: (N,) µm of the centreline.
    radius: (N,) µm. cell_type: (N,) integers or None. colony: (N,) or None. extra: further fields
    by name, (N,) each. With a colony for each cell, a batch has as many colonies as the greatest
    number requires. Without it, every colony starts from a copy of all cells. Raises InputError for
    invalid values.
    """

    position: Any
    axis: Any
    length: Any = 2.0
    radius: Any = 0.5
    cell_type: Any = None
    colony: Any = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        position = _array("position", self.position, np.float64)
        if position.ndim != 2 or position.shape[1] not in (2, 3):
            raise checks.input_error(
                "Cells.position", f"an array of shape {position.shape}", "of shape (N, 2) or (N, 3)"
            )
        count = position.shape[0]
        axis = _array("axis", self.axis, np.float64)
        if axis.ndim == 1 and axis.shape[0] == position.shape[1]:
            axis = np.broadcast_to(axis, position.shape)
        if axis.shape != position.shape:
            raise checks.input_error(
                "Cells.axis",
                f"an array of shape {axis.shape}",
                f"of shape {position.shape}, like position",
            )
        size = np.sqrt((axis**2).sum(1))
        if (size == 0).any():
            raise checks.input_error(
                f"Cells.axis[{int(np.argmin(size))}]",
                axis[int(np.argmin(size))].tolist(),
                "a direction that is not zero",
            )
        parts: dict[str, Any] = {"position": position, "axis": axis / size[:, None]}
        for name, above in (("length", False), ("radius", True)):
            values: np.ndarray = (
                np.broadcast_to(_array(name, getattr(self, name), np.float64), (count,))
                if np.ndim(getattr(self, name)) == 0
                else _column(name, getattr(self, name), count)
            )
            bad = np.flatnonzero(values <= 0 if above else values < 0)
            if bad.size:
                raise checks.input_error(
                    f"Cells.{name}[{bad[0]}]",
                    float(values[bad[0]]),
                    "above 0" if above else "at least 0",
                    "In µm; length is the centreline's, without caps.",
                )
            parts[name] = values
        for name in ("cell_type", "colony"):
            if getattr(self, name) is not None:
                values = _column(name, getattr(self, name), count)
                bad = np.flatnonzero((values != np.round(values)) | (values < 0))
                if bad.size:
                    raise checks.input_error(
                        f"Cells.{name}[{bad[0]}]", float(values[bad[0]]), "a whole number from 0"
                    )
                parts[name] = values.astype(np.int64)
        for name in self.extra:
            if not name.isidentifier() or name in RESERVED:
                raise checks.input_error(
                    "Cells column",
                    name,
                    "a name that the state does not use itself",
                    "Rename or delete it.",
                )
        parts["extra"] = {name: _column(name, values, count) for name, values in self.extra.items()}
        for name, values in parts.items():
            object.__setattr__(self, name, values)

    @staticmethod
    def single(dim: int, length: float = 2.0, radius: float = 0.5) -> Cells:
        """One cell at the origin along x."""
        return Cells(np.zeros((1, dim)), np.eye(dim)[:1], length, radius)

    @property
    def count(self) -> int:
        return self.position.shape[0]

    @property
    def colonies(self) -> int:
        """The least number of colonies that the cells require; 1 without colony numbers."""
        return int(self.colony.max()) + 1 if self.colony is not None and self.count else 1

    @property
    def dim(self) -> int:
        return self.position.shape[1]

    def batch_size(self, colonies: int) -> int:
        """How many colonies a batch of `colonies` has; 1 stands for as many as the cells require.
        Raises InputError for fewer."""
        if colonies not in (1, self.colonies) and colonies < self.colonies:
            raise checks.input_error(
                "colonies",
                colonies,
                f"at least {self.colonies}, since a cell has colony {self.colonies - 1}",
            )
        return max(colonies, self.colonies)

    def state(self, colonies: int, seed: int, device: torch.device, dtype: torch.dtype) -> State:
        """The state of these cells, with no fields except cell_type and the extra columns."""
        if self.colony is None:
            index = np.tile(np.arange(self.count), colonies)
            colony = np.repeat(np.arange(colonies), self.count)
        else:
            colonies = self.batch_size(colonies)
            index = np.argsort(self.colony, kind="stable")
            colony = self.colony[index]
        counts = np.bincount(colony, minlength=colonies)
        uid = np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)

        def tensor(values: np.ndarray, dtype: torch.dtype) -> Tensor:
            return torch.as_tensor(np.array(values[index]), dtype=dtype, device=device)

        state = State(
            colony=torch.as_tensor(colony, dtype=torch.int64, device=device),
            uid=torch.as_tensor(uid, dtype=torch.int64, device=device),
            parent=torch.full((len(index),), -1, dtype=torch.int64, device=device),
            position=tensor(self.position, torch.float64),
            axis=tensor(self.axis, dtype),
            length=tensor(self.length, dtype),
            radius=tensor(self.radius, dtype),
            colony_id=torch.arange(colonies, device=device),
            stream=torch.arange(colonies, device=device),
            next_uid=torch.as_tensor(counts, dtype=torch.int64, device=device),
            seed=seed,
        )
        axis = state.axis / (state.axis * state.axis).sum(1, keepdim=True).sqrt()
        state = state.replace(axis=axis)
        if self.cell_type is not None:
            state = state.declare(CELL_TYPE).with_fields(
                cell_type=tensor(self.cell_type, torch.int64)
            )
        for name, values in self.extra.items():
            state = state.declare(Field(name, "given with the first cells")).with_fields(
                **{name: tensor(values, dtype)}
            )
        return state

    def overlaps(self, depth: float = 0.0) -> list[tuple[int, int, float]]:
        """Pairs of cells that overlap by more than `depth` µm, deepest first: (cell, cell, µm)."""
        t = lambda x: torch.as_tensor(np.array(x))
        position, axis, length, radius = (
            t(self.position),
            t(self.axis),
            t(self.length),
            t(self.radius),
        )
        colony = (
            t(self.colony)
            if self.colony is not None
            else torch.zeros(self.count, dtype=torch.int64)
        )
        i, j, gap = gaps_nearby(position, axis, length, radius, colony, self.colonies)
        order = torch.argsort(gap)
        return [(int(i[k]), int(j[k]), -float(gap[k])) for k in order.tolist() if gap[k] < -depth]

    @staticmethod
    def from_table(
        columns: Mapping[str, Sequence[float] | np.ndarray], source: str = "table"
    ) -> Cells:
        """Cells from columns of equal length, one row per cell.

        Columns: x, y and, in space, z (µm); length (µm, of the centreline, without caps); angle
        (rad, in the plane), or axis_x, axis_y and, in space, axis_z; optional radius (µm),
        cell_type, colony. Any other column becomes a field of the cells. Raises InputError if a
        column is missing or has bad values, or if two cells of a colony have one position. Warns
        of angles that look like degrees, and of columns that number cells or frames, such as label
        and frame.
        """
        left = dict(columns)
        dim = 3 if "z" in left else 2
        missing = [n for n in POSITION[:dim] if n not in left] + [
            n for n in ("length",) if n not in left
        ]
        if missing:
            raise checks.InputError(
                f"{source} lacks the column {missing[0]!r}; it has {', '.join(columns)}."
            )
        sizes = {n: len(v) for n, v in left.items()}
        if len(set(sizes.values())) > 1:
            raise checks.InputError(
                f"{source}: all columns must have the same length; they have"
                f" {', '.join(f'{n} {k}' for n, k in sizes.items())}."
            )
        if sizes["x"] == 0:
            raise checks.InputError(
                f"{source} has no cell, only a header. Give one line per cell, at least one."
            )
        given = [n for n in AXIS if n in left]
        if "angle" in left and given:
            raise checks.InputError(
                f"{source} has the columns 'angle' and {', '.join(map(repr, given))}, which both"
                " give the direction. Give only one of the two."
            )
        position = np.stack([np.asarray(left.pop(n), dtype=np.float64) for n in POSITION[:dim]], 1)
        if "angle" in left:
            angle = np.asarray(left.pop("angle"), dtype=np.float64)
            _warn_of_degrees(angle, source)
            axis = np.stack([np.cos(angle), np.sin(angle)] + [np.zeros_like(angle)] * (dim - 2), 1)
        elif all(n in left for n in AXIS[:dim]):
            axis = np.stack([np.asarray(left.pop(n), dtype=np.float64) for n in AXIS[:dim]], 1)
        else:
            raise checks.InputError(
                f"{source} lacks the cells' direction: give the column 'angle' (rad), or"
                f" {', '.join(AXIS[:dim])}."
            )
        _check_places(position, left.get("colony"), source)
        known = {n: left.pop(n) for n in ("length", "radius", "cell_type", "colony") if n in left}
        _warn_of_bookkeeping(left, source)
        return Cells(position, axis, **known, extra=left)

    @staticmethod
    def from_csv(path: str | Path) -> Cells:
        """Cells from a CSV file with a header line; columns as in `from_table`, separated by
        commas.
        """
        names, rows = _read_csv(path)
        columns: dict[str, list[float]] = {name: [] for name in names}
        for number, row in rows:
            line = f"{path}, line {number}"
            if len(row) > len(names):
                raise checks.InputError(
                    f"{line}: more values than the {len(names)} columns of the header. Decimal"
                    " commas? Write decimal points."
                )
            if len(row) < len(names):
                values = f"{len(row)} value{'s' if len(row) > 1 else ''}"
                raise checks.InputError(
                    f"{line}, column {names[len(row)]!r}: no value; the line has {values} for"
                    f" {len(names)} columns."
                )
            for name, text in zip(names, row, strict=True):
                try:
                    columns[name].append(float(text))
                except ValueError as error:
                    raise checks.InputError(
                        f"{line}, column {name!r}: {text!r} is not a number."
                    ) from error
        return Cells.from_table(columns, str(path))

    @staticmethod
    def from_hdf5(path: str | Path, group: str = "/") -> Cells:
        """Cells from an HDF5 file with one data set per column (as in `from_table`) in `group`."""
        import h5py

        with _readable(path, "rb"):
            pass
        try:
            opened = h5py.File(path, "r")
        except OSError as error:
            raise checks.InputError(f"{path} cannot be read as HDF5 ({error}).") from error
        with opened as file:
            if group not in file:
                raise checks.input_error("group", group, f"a group of {path}")
            columns = {
                n: np.asarray(d) for n, d in file[group].items() if isinstance(d, h5py.Dataset)
            }
        return Cells.from_table(columns, str(path))


def _check_places(
    position: np.ndarray, colony: Sequence[float] | np.ndarray | None, source: str
) -> None:
    """Raise InputError if two rows of a table have the same centre in one colony."""
    of = np.zeros(len(position)) if colony is None else np.asarray(colony, dtype=np.float64)
    places, first, counts = np.unique(
        np.column_stack([of, position]), axis=0, return_index=True, return_counts=True
    )
    again = np.flatnonzero(counts > 1)
    if again.size:
        at = again[np.argmin(first[again])]
        raise checks.InputError(
            f"{source}: {counts[at]} cells have the same position, {places[at, 1:].tolist()}, the"
            f" first of them cell {first[at]} (counted from 0; such positions: {again.size}). Is a"
            " cell listed twice, or are there several frames in one table? Keep one cell of each."
        )


def _warn_of_degrees(angle: np.ndarray, source: str) -> None:
    """Warn of angles beyond a full turn: in radians they would be strange, in degrees usual."""
    beyond = np.abs(angle) > 2 * np.pi
    if beyond.any():
        warnings.warn(
            f"{source}: the column 'angle' reaches {float(np.abs(angle[beyond]).max()):g}, and"
            f" torchfilm reads it in radians ({int(beyond.sum())} of {angle.size} values are over a"
            " full turn, 2π). If they are degrees, convert them: angle = numpy.deg2rad(angle).",
            RuntimeWarning,
            stacklevel=3,
        )


def _warn_of_bookkeeping(extra: Mapping[str, Any], source: str) -> None:
    """Warn of columns that number cells or frames: they become fields of the cells."""
    found = [name for name in extra if name.lower() in BOOKKEEPING]
    if not found:
        return
    frames = {len(np.unique(np.asarray(extra[n]))) for n in found if n.lower() == "frame"}
    several = (
        f" The table has {max(frames)} frames, and the cells of all frames start together: keep the"
        " rows of one frame."
        if max(frames, default=1) > 1
        else ""
    )
    warnings.warn(
        f"{source}: these columns number cells or frames, and become fields that daughters inherit:"
        f" {', '.join(map(repr, found))}. Delete them from the table.{several}",
        RuntimeWarning,
        stacklevel=3,
    )


def _read_csv(path: str | Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The names in a CSV file's header, and its other lines with their line numbers.

    Blank lines are skipped.
    """
    with _readable(path, "r", encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file, skipinitialspace=True)
        try:
            rows = [(reader.line_num, row) for row in reader if row]
        except (UnicodeDecodeError, csv.Error) as error:
            raise checks.InputError(
                f"{path} cannot be read as CSV: it must be text in UTF-8 ({error})."
            ) from error
    if not rows:
        raise checks.InputError(
            f"{path} is empty: it requires a header, such as x,y,angle,length, and one line per"
            " cell."
        )
    line, names = rows[0][0], [name.strip() for name in rows[0][1]]
    for mark, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and mark in names[0]:
            raise checks.InputError(
                f"{path}, line {line}: columns are separated by {word}. Write commas between them,"
                " and decimal points."
            )
    for name in names:
        # a line of numbers is not a header; another check reports that more clearly
        if names.count(name) > 1 and "x" in names:
            raise checks.InputError(
                f"{path}, line {line}: the header has the column {name!r} twice. Remove one."
            )
    return names, rows[1:]


def _readable(path: str | Path, mode: str, **options: Any) -> Any:
    """An open file. Raises InputError if the file cannot be read."""
    try:
        return open(path, mode, **options)
    except OSError as error:
        raise checks.InputError(f"{path} cannot be read: {error.strerror or error}.") from error


def _array(name: str, given: Any, dtype: type) -> np.ndarray:
    """An array of finite numbers, or InputError."""
    try:
        values: np.ndarray = np.asarray(
            given.detach().cpu() if isinstance(given, Tensor) else given, dtype=dtype
        )
    except (TypeError, ValueError) as error:
        raise checks.input_error(f"Cells.{name}", given, "an array of numbers") from error
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        at = tuple(int(k) for k in bad[0])
        raise checks.input_error(
            f"Cells.{name}[{', '.join(map(str, at))}]", float(values[at]), "finite"
        )
    return values


def _column(name: str, given: Any, count: int) -> np.ndarray:
    """An array of shape (count,), or InputError."""
    values = _array(name, given, np.float64)
    if values.shape != (count,):
        raise checks.input_error(
            f"Cells.{name}",
            f"an array of shape {values.shape}",
            f"of shape ({count},), one for each cell",
        )
    return values

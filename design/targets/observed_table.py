"""Tables of observed cells: their columns and units."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.statistics import SeenCells
from torchfilm import checks

COLONY = "colony"
# what a column means, and by which units its name may end; each in µm, rad or h, None: in pixels
UNITS: dict[str, dict[str, float | None]] = {
    "length": {"um": 1.0, "px": None},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0},
    "time": {"h": 1.0, "min": 1.0 / 60.0},
}
KIND = {"x": "length", "y": "length", "length": "length", "angle": "angle", "age": "time"}
HINTS = {
    "length": 'Give pixel_size=… (µm a pixel) or length_unit="um", or call the column "{0}_um".',
    "angle": 'Give angle_unit="degrees" or "radians", or call the column "{0}_deg" or "{0}_rad".',
    "time": 'Give time_unit="h" or "min", or call the column "{0}_h" or "{0}_min".',
}


@dataclass(frozen=True)
class Units:
    """The units that arguments state; `Observed.from_table` documents them."""

    pixel_size: float | None = None
    length_unit: str | None = None
    angle_unit: str | None = None
    time_unit: str | None = None

    def __post_init__(self) -> None:
        if self.pixel_size is not None:
            checks.number("pixel_size", self.pixel_size, above=0.0, hint="µm a pixel.")
        for name, allowed in (
            ("length_unit", ("um", "px")),
            ("angle_unit", ("degrees", "radians")),
            ("time_unit", ("h", "min")),
        ):
            if getattr(self, name) is not None:
                checks.choice(name, getattr(self, name), allowed)
        if self.length_unit == "um" and self.pixel_size is not None:
            raise checks.input_error(
                "pixel_size",
                self.pixel_size,
                'left out with length_unit="um"',
                "Lengths are in µm.",
            )

    def stated(self, kind: str) -> str:
        """The unit of a kind of column, as a name ends; "" where none is stated."""
        if kind == "length":
            return self.length_unit or ("" if self.pixel_size is None else "px")
        if kind == "angle":
            return {"degrees": "deg", "radians": "rad", None: ""}[self.angle_unit]
        return self.time_unit or ""

    def factor(self, kind: str, unit: str, column: str) -> float:
        """What turns numbers of a unit into µm, rad or h."""
        found = UNITS[kind][unit]
        if found is not None:
            return found
        if self.pixel_size is None:
            raise checks.input_error(
                "pixel_size", None, f"given: the column {column!r} is in pixels", "In µm a pixel."
            )
        return self.pixel_size

    def check_used(self, used: set[tuple[str, str]]) -> None:
        """Raises InputError for a unit that no column has. used: kind and unit of each that went by
        an argument, and ("pixels", "") where there are any."""
        for name, kind in (
            ("angle_unit", "angle"),
            ("time_unit", "time"),
            ("length_unit", "length"),
        ):
            if getattr(self, name) is not None and (kind, self.stated(kind)) not in used:
                raise checks.input_error(
                    name, getattr(self, name), "left out: the unit of no column depends on it"
                )
        if self.pixel_size is not None and ("pixels", "") not in used:
            raise checks.input_error(
                "pixel_size", self.pixel_size, "left out: no column is in pixels"
            )


def read_table(
    table: str | Path | Mapping[str, Any],
    species: tuple[str, ...],
    units: Units,
    columns: Mapping[str, str],
) -> SeenCells:
    """The cells of a table, sorted by colony. columns: names in the table where they differ.

    Raises InputError for a column that is missing, is not numbers or has no unit.
    """
    source, raw = _columns(table)
    meant = (*KIND, COLONY, *species)
    for name in columns:
        checks.choice("Observed(columns)", name, meant)
    found: dict[str, Tensor] = {}
    used: set[tuple[str, str]] = set()
    for name, kind in KIND.items():
        known = _find(source, raw, name, kind, columns)
        if known is None:
            continue
        column, unit = known
        if not unit:
            unit = units.stated(kind)
            used.add((kind, unit))
        if not unit:
            raise tf.InputError(
                f"{source}: the column {column!r} has no unit. {HINTS[kind].format(name)}"
            )
        factor = units.factor(kind, unit, column)
        if UNITS[kind][unit] is None:
            used.add(("pixels", ""))
        found[name] = factor * _numbers(source, raw, column)
    units.check_used(used)
    for name in species:
        column = columns.get(name, name)
        if column not in raw:
            raise _missing(source, column, raw)
        found[name] = _numbers(source, raw, column)
    if ("x" in found) != ("y" in found):
        raise _missing(source, "y" if "x" in found else "x", raw)
    if not found:
        raise tf.InputError(
            f"{source} has none of the columns {', '.join(KIND)} or species; it has"
            f" {', '.join(raw)}. Name yours by columns={{…}}."
        )
    return _cells(found, species, _colonies(raw, columns.get(COLONY, COLONY), columns))


def _cells(
    found: dict[str, Tensor], species: tuple[str, ...], owner: np.ndarray | None
) -> SeenCells:
    """Sorted by colony."""
    rows = len(next(iter(found.values())))
    place = np.zeros(rows, np.int64) if owner is None else np.unique(owner, return_inverse=True)[1]
    order = torch.from_numpy(np.argsort(place, kind="stable"))
    colony = torch.from_numpy(place.astype(np.int64))[order]
    get = lambda name: found[name][order] if name in found else None
    angle = get("angle")
    return SeenCells(
        colony=colony,
        counts=torch.bincount(colony),
        position=torch.stack([found["x"], found["y"]], 1)[order] if "x" in found else None,
        axis=None if angle is None else torch.stack([angle.cos(), angle.sin()], 1),
        length=get("length"),
        age=get("age"),
        levels=torch.stack([found[n] for n in species], 1)[order] if species else None,
    )


def _find(
    source: str, raw: Mapping[str, Any], name: str, kind: str, columns: Mapping[str, str]
) -> tuple[str, str] | None:
    """The name of a column in the table and the unit at its end, "" where there is none; None
    where the table lacks the column."""
    if name in columns and columns[name] not in raw:
        raise _missing(source, columns[name], raw)
    allowed = (name, *(f"{name}_{unit}" for unit in UNITS[kind]))
    given = [columns[name]] if name in columns else [n for n in allowed if n in raw]
    if len(given) > 1:
        raise tf.InputError(f"{source} has {' and '.join(map(repr, given))}: keep one of them.")
    if not given:
        return None
    end = given[0].rpartition("_")[2]
    return given[0], end if end in UNITS[kind] and "_" in given[0] else ""


def _columns(table: Any) -> tuple[str, Mapping[str, Any]]:
    """A name for messages, and the columns of a table by name."""
    if isinstance(table, (str, Path)):
        return str(table), _read_csv(Path(table))
    if not hasattr(table, "keys") or not hasattr(table, "__getitem__"):
        raise checks.input_error(
            "table", type(table).__name__, "the path of a CSV file, or columns by name"
        )
    found = {str(name): np.asarray(table[name]) for name in table.keys()}  # noqa: SIM118
    sizes = {name: len(column) for name, column in found.items()}
    if len(set(sizes.values())) > 1:
        raise checks.input_error("table", sizes, "columns of one length")
    if not found or not max(sizes.values()):
        raise checks.input_error("table", sizes, "a row for each cell, at least one")
    return "the table", found


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file, skipinitialspace=True) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise tf.InputError(f"{path} cannot be read as CSV ({error}).") from error
    if len(rows) < 2:
        raise tf.InputError(f"{path} has no cells: give a header and a line for each cell.")
    header = [name.strip() for name in rows[0]]
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise tf.InputError(
                f"{path}, row {number}: {len(row)} values for {len(header)} columns. Write commas"
                " between values, and decimal points."
            )
    return {name: np.array([row[k] for row in rows[1:]]) for k, name in enumerate(header)}


def _numbers(source: str, raw: Mapping[str, Any], column: str) -> Tensor:
    """A column of finite numbers, (N,) float64."""
    for row, value in enumerate(raw[column], 1):
        try:
            good = math.isfinite(float(value))
        except (TypeError, ValueError):
            good = False
        if not good:
            raise tf.InputError(
                f"{source}: {str(value)!r} in cell {row}, column {column!r}, is not a number."
                " Leave such cells out."
            )
    return torch.from_numpy(np.asarray(raw[column]).astype(np.float64))


def _colonies(raw: Mapping[str, Any], column: str, columns: Mapping[str, str]) -> np.ndarray | None:
    """Which colony each cell belongs to, as given; None: all to one."""
    if column in raw:
        return np.asarray(raw[column])
    if COLONY in columns:
        raise _missing("the table", column, raw)
    return None


def _missing(source: str, column: str, raw: Mapping[str, Any]) -> tf.InputError:
    near = checks.nearest(column, raw)
    hint = f" Did you mean {near!r}?" if near else ""
    return tf.InputError(f"{source} lacks the column {column!r}; it has {', '.join(raw)}.{hint}")

"""Cells from tables: which column means what, and its unit, its direction and its frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchfilm.micrographs.capsule_fit import capsule_of_area, capsule_of_moments
from torchfilm.micrographs.column_sets import COLUMN_SETS, ColumnSet, matching
from torchfilm.micrographs.record import Micrograph, listed
from torchfilm.tools import checks
from torchfilm.tools.tables import Table, Units
from torchfilm.tools.warn_once import warn

PLACE, AXIS = ("x", "y", "z"), ("axis_x", "axis_y", "axis_z")
# the quantities that a table may have, and the kind of their units
KINDS = {**dict.fromkeys((*PLACE, "length", "radius", "width"), "length"), "angle": "angle"}
PLAIN = (*AXIS, "cell_type", "colony")
# Columns by which programs number cells, frames and rows: never fields of the cells. pandas writes
# the numbers of the rows under an empty name.
LABELS = ("label", "id", "cell_id", "track_id", "track")
FRAMES = ("frame",)
ROWS = ("index", "", "unnamed: 0")
# What tables of torchfilm's states and results have besides: it follows from other columns, or from
# the run.
OF_STATES, OF_RESULTS = ("time", "cell", "parent", "volume"), ("age", "born")
# angles from which on too few are within a quarter turn for it to be chance
ENOUGH = 8


@dataclass(frozen=True)
class Reading:
    """How a table is to be read; `Cells.from_table` documents it."""

    pixel_size: float | None = None
    length_unit: str | None = None
    columns: str | Mapping[str, str] | None = None
    angle_unit: str | None = None
    angle_turns: str | None = None
    y: str | None = None
    length_with_caps: bool = False
    radius: float | None = None
    frame: Any = None
    fields: Sequence[str] | Mapping[str, str] | None = None
    centre: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.columns, str):
            checks.choice("columns", self.columns, tuple(COLUMN_SETS))
            for name, idle in (
                ("y", self.y), ("angle_turns", self.angle_turns), ("radius", self.radius),
                ("length_with_caps", self.length_with_caps or None),
                ("length_unit", self.length_unit),
            ):  # fmt: skip
                if idle is not None:
                    raise checks.input_error(
                        name, idle, f"left out with columns={self.columns!r}, which settles it"
                    )
        elif self.columns is not None:
            if not isinstance(self.columns, Mapping):
                raise checks.input_error(
                    "columns",
                    self.columns,
                    f"names of columns by quantity, or one of {', '.join(map(repr, COLUMN_SETS))}",
                )
            for name, column in self.columns.items():
                checks.choice("columns", name, (*KINDS, *PLAIN, "label", "frame"))
                if not isinstance(column, str) or list(self.columns.values()).count(column) > 1:
                    raise checks.input_error(
                        f"columns[{name!r}]", column, "the name of a column, used once"
                    )
        for name, value, allowed in (
            ("y", self.y, ("up", "down")),
            ("angle_turns", self.angle_turns, ("clockwise", "counterclockwise")),
        ):
            if value is not None:
                checks.choice(name, value, allowed)
        for name, flag in (("length_with_caps", self.length_with_caps), ("centre", self.centre)):
            checks.choice(name, flag, (True, False))
        given = [self.fields] if isinstance(self.fields, str) else self.fields
        if given is not None and not isinstance(given, (Sequence, Mapping)):
            raise checks.input_error("fields", given, "names of columns, or columns by field")
        if self.radius is not None:
            checks.number("radius", self.radius, above=0.0, hint="µm.")

    @property
    def named(self) -> Mapping[str, str]:
        """The names of columns that the user gives."""
        return self.columns if isinstance(self.columns, Mapping) else {}


def table_cells(table: Table, reading: Reading) -> dict[str, Any]:
    """The arguments of `Cells` for a table."""
    known = COLUMN_SETS[reading.columns] if isinstance(reading.columns, str) else None
    if known is not None:
        _check_columns(table, known, reading.columns)
    table, label = _one_frame(table, reading, known)
    used: set[str] = set()
    found = (
        _own_columns(table, reading, label, used)
        if known is None
        else _set_columns(table, reading, known, label)
    )
    for name in ("cell_type", "colony"):
        if (column := reading.named.get(name, name)) in table.columns:
            used.add(column)
            found[name] = table.numbers(column, optional=True)
        elif name in reading.named:
            raise table.missing(column)
    _check_labels(table, label, found.get("colony"))
    _check_places(table, found["position"], found.get("colony"), label)
    found["extra"] = _fields(table, reading, used)
    shift = _shift(found["position"], found.get("colony"), reading.centre)
    found["position"] = found["position"] + shift
    if reading.pixel_size is not None and found["position"].shape[1] == 2:
        down = known is not None or reading.y == "down"
        found["micrograph"] = Micrograph(
            table.source, reading.pixel_size, shift, y_down=down, label=label
        )
    return found


def _check_columns(table: Table, known: ColumnSet, name: Any) -> None:
    """Raise InputError if the table lacks a column of the set."""
    for names in known.needed:
        here = [n for n in names if n in table.columns]
        if len(here) > 1:
            raise checks.InputError(
                f"{table.source} has {' and '.join(map(repr, here))}: keep one of them."
            )
        if not here:
            other = [k for k in matching(tuple(table.columns)) if k != name]
            raise table.missing(
                names[0],
                f"They look like columns={other[0]!r}."
                if other
                else f"For tables of {known.program}; for others, name the columns by"
                " columns={…}, or give the label image to Cells.from_masks.",
            )


def _one_frame(
    table: Table, reading: Reading, known: ColumnSet | None
) -> tuple[Table, np.ndarray | None]:
    """The rows of one frame, and the labels of their cells as text, if there are any."""
    column = _bookkeeping(table, "frame", reading.named, FRAMES if known is None else known.frame)
    if column is None:
        if reading.frame is not None:
            raise table.missing(
                reading.named.get("frame", "frame"), 'Name it by columns={"frame": …}.'
            )
    else:
        frames = _tidy(table.columns[column])
        there = list(dict.fromkeys(frames))
        if reading.frame is None and len(there) > 1:
            raise checks.InputError(
                f"{table.source} has {len(there)} frames: {listed(there)}. Cells start from one"
                " of them: say which by frame=…."
            )
        if reading.frame is not None:
            wanted = _tidy(np.array([reading.frame]))[0]
            if wanted not in there:
                raise checks.input_error(
                    "frame", reading.frame, f"one of the frames of {table.source}: {listed(there)}"
                )
            table = table.take(np.array([f == wanted for f in frames]))
    column = _bookkeeping(table, "label", reading.named, LABELS if known is None else known.label)
    return table, None if column is None else np.array(_tidy(table.columns[column]))


def _bookkeeping(
    table: Table, quantity: str, named: Mapping[str, str], names: Sequence[str]
) -> str | None:
    """The column of frames or labels, in capitals or not."""
    if quantity in named:
        if named[quantity] not in table.columns:
            raise table.missing(named[quantity])
        return named[quantity]
    lower = {name.lower(): name for name in table.columns}
    return next((lower[n.lower()] for n in names if n.lower() in lower), None)


def _tidy(values: np.ndarray) -> list[str]:
    """Values as texts, whole numbers without a point."""
    texts = []
    for value in values.tolist():
        if isinstance(value, int) and not isinstance(value, bool):
            texts.append(str(value))  # a float has not all digits of a long label
            continue
        try:
            number = float(value)
            texts.append(str(int(number)) if number == int(number) else str(value))
        except (TypeError, ValueError, OverflowError):
            texts.append(str(value).strip())
    return texts


def _own_columns(
    table: Table, reading: Reading, label: np.ndarray | None, used: set[str]
) -> dict[str, Any]:
    """Position, axis, length and radius, µm, of a table in columns x, y, length, … or as named."""
    units = Units(reading.pixel_size, reading.length_unit, reading.angle_unit)
    by: set[tuple[str, str]] = set()
    found: dict[str, np.ndarray] = {}
    for name, kind in KINDS.items():
        known = table.quantity(name, kind, reading.named, units, by)
        if known is None:
            continue
        column, unit, factor = known
        used.add(column)
        values = table.numbers(column, optional=name in ("radius", "width"))
        if kind == "angle":
            _warn_of_units(values, unit, 2 * math.pi, column, table.source)
        found[name] = factor * values
    for name in AXIS:
        if (column_name := reading.named.get(name, name)) in table.columns:
            used.add(column_name)
            found[name] = table.numbers(column_name)
        elif name in reading.named:
            raise table.missing(column_name)
    _check_complete(table, found)
    units.check_used(by)
    dim = 3 if "z" in found else 2
    if dim == 3 and reading.y == "down":
        raise checks.input_error("y", "down", '"up" for cells in space')
    sign = -1.0 if reading.y == "down" else 1.0
    position = np.stack([found[n] for n in PLACE[:dim]], 1)
    position[:, 1] *= sign
    length, radius = _sizes(table, found, reading, label)
    return {
        "position": position,
        "axis": _direction(table, found, reading, dim, sign),
        "length": length,
        "radius": radius,
    }


def _check_complete(table: Table, found: Mapping[str, np.ndarray]) -> None:
    for name in ("x", "y", "length"):
        if name not in found:
            other = matching(tuple(table.columns))
            looks = f"They look like columns={other[0]!r}." if other else ""
            raise table.missing(name, looks or table.in_other_case(KINDS))


def _direction(
    table: Table, found: Mapping[str, np.ndarray], reading: Reading, dim: int, sign: float
) -> np.ndarray:
    """The axes (N, d). sign: −1 where y goes down in the table."""
    given = [n for n in AXIS if n in found]
    if "angle" in found and given:
        raise checks.InputError(
            f"{table.source} has the columns 'angle' and {', '.join(map(repr, given))}, which both"
            " give the direction. Give only one of the two."
        )
    if "angle" in found:
        angle = found["angle"]
        if reading.angle_turns is not None:
            sign = -1.0 if reading.angle_turns == "clockwise" else 1.0
        parts = [np.cos(angle), sign * np.sin(angle)] + [np.zeros_like(angle)] * (dim - 2)
        return np.stack(parts, 1)
    if reading.angle_turns is not None:
        raise checks.input_error(
            "angle_turns", reading.angle_turns, "left out: the table has no column 'angle'"
        )
    if not all(n in found for n in AXIS[:dim]):
        raise checks.InputError(
            f"{table.source} lacks the cells' direction: give the column 'angle', or"
            f" {', '.join(AXIS[:dim])}. {table.in_other_case(KINDS)}".rstrip()
        )
    axis = np.stack([found[n] for n in AXIS[:dim]], 1)
    axis[:, 1] *= sign
    return axis


def _sizes(
    table: Table, found: Mapping[str, np.ndarray], reading: Reading, label: np.ndarray | None
) -> tuple[np.ndarray, Any]:
    """The lengths of the centrelines and the radii, µm."""
    given = [n for n in ("radius", "width") if n in found]
    if reading.radius is not None:
        given.append("radius=")
    if len(given) > 1:
        raise checks.InputError(
            f"{table.source}: {' and '.join(given)} both give the radius. Keep one of them."
        )
    radius: Any = reading.radius
    if "radius" in found or "width" in found:
        radius = found["radius"] if "radius" in found else 0.5 * found["width"]
    if not reading.length_with_caps:
        return found["length"], 0.5 if radius is None else radius
    if radius is None:
        raise checks.InputError(
            f"{table.source}: length_with_caps=True requires the radius: give radius=… (µm), or a"
            " column 'radius' or 'width'."
        )
    length = found["length"] - 2.0 * np.asarray(radius)
    short = np.flatnonzero(length < 0)
    if short.size:
        at = int(short[0])
        width = found["length"][at] - length[at]
        raise checks.InputError(
            f"{_cell(table, at, label)} is {found['length'][at]:.4g} µm long with caps, which is"
            f" less than its width, {width:.4g} µm (such cells: {short.size}). Check the radius,"
            " pixel_size, and whether lengths include the caps."
        )
    return length, radius


def _set_columns(
    table: Table, reading: Reading, known: ColumnSet, label: np.ndarray | None
) -> dict[str, Any]:
    """Position, axis, length and radius, µm, of a table of a program."""
    if reading.pixel_size is None:
        raise checks.input_error(
            "pixel_size", None, f"given, since {known.program} measures in pixels", "µm a pixel."
        )
    size = checks.number("pixel_size", reading.pixel_size, above=0.0, hint="µm a pixel.")
    names = [next(n for n in ns if n in table.columns) for ns in known.needed]
    x, y, major, minor, angle = (table.numbers(name) for name in names)
    unit = Units(angle_unit=reading.angle_unit).stated("angle") or known.angle_unit
    _warn_of_units(angle, unit, known.widest, names[4], table.source)
    along, across = ((0.25 * axis) ** 2 - known.pixel for axis in (major, minor))
    bad = np.flatnonzero((across <= 0) | (along < across * (1 - 1e-9)))
    if bad.size:
        raise checks.InputError(
            f"{_cell(table, int(bad[0]), label)} has axes of {major[bad[0]]:.4g} and"
            f" {minor[bad[0]]:.4g} pixels: a cell has a width, and its major axis is the longer one"
            f" (such cells: {bad.size}). Leave out regions of a few pixels."
        )
    there = [name for name in known.area if name in table.columns]
    area = table.numbers(there[0], optional=True) if there else None
    if area is not None and (area <= 0).any():
        at = int(np.argmin(area))
        raise checks.InputError(
            f"{_cell(table, at, label)} has an area of {area[at]:g} pixels: it must be above 0."
        )
    length, radius = (
        capsule_of_moments(along, across) if area is None else capsule_of_area(area, along)
    )
    return {
        "position": size * np.stack([x - known.first, known.first - y], 1),
        "axis": known.axis(np.deg2rad(angle) if unit == "deg" else angle),
        "length": size * length,
        "radius": size * radius,
    }


def _warn_of_units(angle: np.ndarray, unit: str, widest: float, column: str, source: str) -> None:
    """Warn of radians beyond what there can be, and of degrees that all lie within ±π."""
    most = float(np.abs(angle).max())
    if unit == "rad" and most > widest * (1 + 1e-6):
        beyond = int((np.abs(angle) > widest * (1 + 1e-6)).sum())
        warn(
            f"{source}: the column {column!r} reaches {most:g}, and torchfilm reads it in radians"
            f" ({beyond} of {angle.size} values are over {widest:.4g}). If they are degrees, give"
            ' angle_unit="degrees", or call the column "angle_deg".',
            category=RuntimeWarning,
        )
    if unit == "deg" and angle.size >= ENOUGH and 0 < most <= math.pi:
        warn(
            f"{source}: all {angle.size} values of the column {column!r} lie within ±{most:.3g},"
            " and torchfilm reads them in degrees. If they are radians, give"
            ' angle_unit="radians", or call the column "angle_rad".',
            category=RuntimeWarning,
        )


def _fields(table: Table, reading: Reading, used: set[str]) -> dict[str, np.ndarray]:
    """The columns that become fields of the cells: those that are named, or of a table in
    torchfilm's own columns all others."""
    if reading.fields is not None:
        given = [reading.fields] if isinstance(reading.fields, str) else reading.fields
        named = dict(given) if isinstance(given, Mapping) else {n: n for n in given}
        for column in named.values():
            if column not in table.columns:
                raise table.missing(column)
        return {name: table.numbers(column, optional=True) for name, column in named.items()}
    if reading.columns is not None:
        return {}
    numbering = (*LABELS, *FRAMES, *ROWS)
    left = [n for n in table.columns if n not in used and n.lower() not in numbering]
    if all(n in table.columns for n in OF_STATES):  # signals outside have dots
        own = lambda name: name.removeprefix("field.")  # beside a column of its name
        left = [n for n in left if n not in OF_STATES + OF_RESULTS and own(n).isidentifier()]
        return {own(name): table.numbers(name, optional=True) for name in left}
    return {name: table.numbers(name, optional=True) for name in left}


def _shift(position: np.ndarray, colony: np.ndarray | None, centre: bool) -> np.ndarray:
    """By how much cells are moved, (N, d) µm: each colony's mean to the origin, or not at all."""
    if not centre:
        return np.zeros_like(position)
    place = np.zeros(len(position)) if colony is None else colony
    _, of, counts = np.unique(place, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(of, column) for column in position.T], 1)
    return -(sums / counts[:, None])[of]


def _cell(table: Table, row: int, label: np.ndarray | None) -> str:
    return table.place(row) + ("" if label is None else f", label {label[row]}")


def _check_labels(table: Table, label: np.ndarray | None, colony: np.ndarray | None) -> None:
    """Raise InputError if two cells of a colony have one label."""
    if label is None:
        return
    keys = [*zip(label.tolist(), np.zeros(len(label)) if colony is None else colony, strict=True)]
    first: dict[Any, int] = {}
    for row, key in enumerate(keys):
        if first.setdefault(key, row) != row:
            raise checks.InputError(
                f"{_cell(table, row, label)}: {table.place(first[key])} has this label, too"
                f" ({len(keys) - len(set(keys))} of {len(keys)} rows repeat a label). Is a cell"
                " listed twice, or are there several frames or fields of view in one table?"
            )


def _check_places(
    table: Table, position: np.ndarray, colony: np.ndarray | None, label: np.ndarray | None
) -> None:
    """Raise InputError if two cells of a colony have one centre."""
    of = np.zeros(len(position)) if colony is None else colony
    places, first, counts = np.unique(
        np.column_stack([of, position]), axis=0, return_index=True, return_counts=True
    )
    again = np.flatnonzero(counts > 1)
    if again.size:
        at = again[np.argmin(first[again])]
        raise checks.InputError(
            f"{_cell(table, int(first[at]), label)}: {counts[at]} cells have the same position,"
            f" {places[at, 1:].tolist()} (such positions: {again.size}). Is a cell listed twice, or"
            " are there several frames in one table? Keep one cell of each."
        )

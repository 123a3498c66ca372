"""Tables with a row for each cell: CSV files and columns by name, their numbers and units."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchfilm.tools import checks

# by which units the names of columns may end; each in µm, rad or h, None: in pixels
UNITS: dict[str, dict[str, float | None]] = {
    "length": {"um": 1.0, "px": None},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0},
    "time": {"h": 1.0, "min": 1.0 / 60.0, "s": 1.0 / 3600.0},
}
HINTS = {
    "length": 'Give pixel_size=… (µm a pixel) or length_unit="um", or call the column "{0}_um".',
    "angle": 'Give angle_unit="degrees" or "radians", or call the column "{0}_deg" or "{0}_rad".',
    "time": 'Give time_unit="h", "min" or "s", or call the column "{0}_h", "{0}_min" or "{0}_s".',
}
# the same units as people write them, too; there are two signs for micro
SPELLINGS = {"µm": "um", "\u03bcm": "um", "degrees": "deg", "radians": "rad"}


@dataclass(frozen=True)
class Units:
    """The units that arguments state. pixel_size: µm a pixel. length_unit: "um" ("µm") or "px".
    angle_unit: "degrees" ("deg") or "radians" ("rad"). time_unit: "h", "min" or "s"."""

    pixel_size: float | None = None
    length_unit: str | None = None
    angle_unit: str | None = None
    time_unit: str | None = None

    def __post_init__(self) -> None:
        if self.pixel_size is not None:
            checks.number("pixel_size", self.pixel_size, above=0.0, hint="µm a pixel.")
        for name, kind, usual in (
            ("length_unit", "length", ("um", "px")),
            ("angle_unit", "angle", ("degrees", "radians")),
            ("time_unit", "time", ("h", "min", "s")),
        ):
            given = getattr(self, name)
            if given is not None and _unit(given) not in UNITS[kind]:
                checks.choice(name, given, usual)
        if _unit(self.length_unit) == "um" and self.pixel_size is not None:
            raise checks.input_error(
                "pixel_size",
                self.pixel_size,
                f'left out with length_unit="{self.length_unit}"',
                "Lengths are in µm.",
            )

    def stated(self, kind: str) -> str:
        """The unit of a kind of column, as a name ends; "" where none is stated."""
        if kind == "length":
            return _unit(self.length_unit) or ("" if self.pixel_size is None else "px")
        return _unit(self.angle_unit if kind == "angle" else self.time_unit)

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


def _unit(given: object) -> str:
    """A unit as a name ends; "" where none is given, or what is no text."""
    return SPELLINGS.get(given, given) if isinstance(given, str) else ""


@dataclass(frozen=True)
class Table:
    """Columns of equal length by name, as they were given (texts, from a CSV file).

    source: for messages. lines: the line of the file for each row, counted from 1; None for columns
    that are not from a file.
    """

    source: str
    columns: Mapping[str, np.ndarray]
    lines: np.ndarray | None = None

    @staticmethod
    def read(table: Any, source: str = "the table") -> Table:
        """The table of a CSV file (its path) or of columns by name (a dictionary or DataFrame); or
        a table as it is.

        A CSV file is UTF-8, with a header, commas between columns and decimal points. Raises
        InputError for a file that is not, and for columns of unequal length or without rows.
        """
        if isinstance(table, Table):
            return table
        if isinstance(table, (str, Path)):
            return _read_csv(Path(table))
        if not hasattr(table, "keys") or not hasattr(table, "__getitem__"):
            raise checks.input_error(
                "table", type(table).__name__, "the path of a CSV file, or columns by name"
            )
        found: dict[str, np.ndarray] = {}
        for name in table.keys():  # noqa: SIM118
            column = table[name]
            values = np.asarray(column.detach().cpu() if hasattr(column, "detach") else column)
            if isinstance(column, np.ma.MaskedArray) and column.mask.any():
                values = np.where(column.mask, np.nan, values)
            if values.ndim != 1 or str(name) in found:
                raise checks.InputError(
                    f"{source}: the column {str(name)!r} is there twice, or is not a list of"
                    " numbers."
                )
            found[str(name)] = values
        sizes = {name: len(column) for name, column in found.items()}
        if len(set(sizes.values())) > 1:
            raise checks.InputError(
                f"{source}: all columns must have the same length; they have"
                f" {', '.join(f'{n} {k}' for n, k in sizes.items())}."
            )
        if not found or not max(sizes.values()):
            raise checks.InputError(f"{source} has no cell: give a row for each, at least one.")
        return Table(source, found)

    @property
    def rows(self) -> int:
        return len(next(iter(self.columns.values())))

    def take(self, rows: np.ndarray) -> Table:
        """Some of the rows, by index or mask."""
        return Table(
            self.source,
            {name: column[rows] for name, column in self.columns.items()},
            (np.arange(1, self.rows + 1) if self.lines is None else self.lines)[rows],
        )

    def place(self, row: int) -> str:
        """Where a row is, for messages."""
        if self.lines is None:
            return f"{self.source}, row {row + 1}"
        word = "row" if self.source == "the table" else "line"
        return f"{self.source}, {word} {self.lines[row]}"

    def numbers(self, column: str, *, optional: bool = False) -> np.ndarray:
        """A column of finite numbers, (N,) float64. Raises InputError with the first row that has
        none. optional: whether the table may do without the column, for the message."""
        values = self.columns[column]
        if values.dtype.kind in "mM":
            raise self._clock(column)
        try:
            if values.dtype.kind == "c":  # numpy would drop the imaginary part
                raise TypeError
            found = np.asarray(values, dtype=np.float64)
            bad = np.flatnonzero(~np.isfinite(found))
        except (TypeError, ValueError):
            found, bad = np.zeros(0), np.flatnonzero([not _is_number(v) for v in values])
        if len(bad):
            more = f" (in {len(bad)} of {self.rows} rows)" if len(bad) > 1 else ""
            hint = "Leave such cells out."
            if len(bad) == self.rows:
                needed = "This column is needed: give a number for each cell."
                number = f"Leave the column out, or write 0 for {str(values[0])!r}, 1 for the next."
                hint = number if optional else needed
            raise checks.InputError(
                f"{self.place(int(bad[0]))}, column {column!r}: {str(values[bad[0]])!r} is not a"
                f" number{more}. {hint}"
            )
        return found

    def _clock(self, column: str) -> checks.InputError:
        """For a column of dates or durations: numpy would count their nanoseconds, or what unit
        they have."""
        hours = f"(table[{column!r}] - table[{column!r}].min()) / pandas.Timedelta('1h')"
        return checks.InputError(
            f"{self.source}, column {column!r} has {self.columns[column].dtype}, and numbers are"
            f" needed: {hours} are hours."
        )

    def column(self, name: str, kind: str, columns: Mapping[str, str]) -> tuple[str, str] | None:
        """The column that holds a quantity, and the unit at the end of its name, "" where there is
        none; None where the table lacks it.

        name: such as "x", which may be the column x, x_um or x_px. kind: of `UNITS`. columns: the
        names of columns by quantity, where they differ.
        """
        if name in columns and columns[name] not in self.columns:
            raise self.missing(columns[name])
        spelt = (*UNITS[kind], *(other for other, unit in SPELLINGS.items() if unit in UNITS[kind]))
        allowed = (name, *(f"{name}_{unit}" for unit in spelt))
        given = [columns[name]] if name in columns else [n for n in allowed if n in self.columns]
        if len(given) > 1:
            raise checks.InputError(
                f"{self.source} has {' and '.join(map(repr, given))}: keep one of them."
            )
        if not given:
            return None
        end = _unit(given[0].rpartition("_")[2])
        return given[0], end if end in UNITS[kind] and "_" in given[0] else ""

    def quantity(
        self,
        name: str,
        kind: str,
        columns: Mapping[str, str],
        units: Units,
        used: set[tuple[str, str]],
    ) -> tuple[str, str, float] | None:
        """The column that holds a quantity, its unit, and what turns its numbers into µm, rad or h;
        None where the table lacks it.

        name, kind, columns: as for `column`. used: gains what arguments state, for
        `Units.check_used`. Raises InputError for a unit that neither the name of the column nor an
        argument states.
        """
        known = self.column(name, kind, columns)
        if known is None:
            return None
        column, unit = known
        if not unit:
            unit = units.stated(kind)
            used.add((kind, unit))
        if not unit:
            raise checks.InputError(
                f"{self.source}: the column {column!r} has no unit. {HINTS[kind].format(name)}"
            )
        if UNITS[kind][unit] is None:
            used.add(("pixels", ""))
        return column, unit, units.factor(kind, unit, column)

    def missing(self, column: str, hint: str = "") -> checks.InputError:
        """The error for a column that the table lacks; raise what this returns."""
        near = checks.nearest(column, self.columns)
        cased = next((n for n in self.columns if n.lower() == column.lower()), None)
        if not hint and cased:
            hint = f"Did you mean {cased!r}? Upper and lower case count."
        hint = hint or (f"Did you mean {near!r}?" if near else "")
        return checks.InputError(
            f"{self.source} lacks the column {column!r}; it has {', '.join(self.columns)}."
            + (f" {hint}" if hint else "")
        )

    def in_other_case(self, kinds: Mapping[str, str]) -> str:
        """A hint at columns whose names differ from those of quantities only in upper and lower
        case; "" where there are none. kinds: of `UNITS`, by name of quantity."""
        spelt = {
            name + end: name
            for name, kind in kinds.items()
            for end in ("", *(f"_{unit}" for unit in UNITS[kind]))
        }
        there = {spelt[n] for n in self.columns if n in spelt}
        cased: dict[str, str] = {}
        for column in self.columns:
            name = spelt.get(column.lower())
            if name is not None and name not in there:
                cased.setdefault(name, column)
        if not cased:
            return ""
        # a unit in capitals would not be known of a column that is given by its name
        units_fit = all(n.endswith(n.lower()[len(name) :]) for name, n in cased.items())
        return (
            f"Upper and lower case count: rename {', '.join(cased.values())} to"
            f" {', '.join(n.lower() for n in cased.values())}"
            + f", or give columns={cased!r}." * units_fit
            + "." * (not units_fit)
        )


def _is_number(value: Any) -> bool:
    if isinstance(value, complex):
        return False
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def _read_csv(path: Path) -> Table:
    """Blank lines are skipped."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, skipinitialspace=True)
            rows = [(reader.line_num, row) for row in reader if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise checks.InputError(
            f"{path} cannot be read as CSV: it must be text in UTF-8 ({error})."
        ) from error
    except OSError as error:
        raise checks.InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    if not rows:
        raise checks.InputError(
            f"{path} is empty: it requires a header, such as x_um,y_um,angle_rad,length_um, and one"
            " line per cell."
        )
    (line, header), rows = rows[0], rows[1:]
    names = [name.strip() for name in header]
    _check_header(path, line, names)
    if not rows:
        raise checks.InputError(
            f"{path} has no cell, only a header. Give one line per cell, at least one."
        )
    for number, row in rows:
        _check_row(f"{path}, line {number}", row, names)
    columns = {name: np.array([row[k] for _, row in rows]) for k, name in enumerate(names)}
    return Table(str(path), columns, np.array([number for number, _ in rows]))


def _check_header(path: Path, line: int, names: Sequence[str]) -> None:
    for mark, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and mark in names[0]:
            raise checks.InputError(
                f"{path}, line {line}: columns are separated by {word}. Write commas between them,"
                f' and decimal points; or give pandas.read_csv("{path.name}", sep={mark!r},'
                " decimal=…) in place of the path."
            )
    if all(map(_is_number, names)):
        raise checks.InputError(
            f"{path}, line {line}: numbers instead of a header. Begin with the names of the"
            " columns, such as x_um,y_um,angle_rad,length_um."
        )
    for name in names:
        if names.count(name) > 1:
            raise checks.InputError(
                f"{path}, line {line}: the header has the column {name!r} twice. Remove one."
            )


def _check_row(line: str, row: Sequence[str], names: Sequence[str]) -> None:
    if len(row) > len(names):
        raise checks.InputError(
            f"{line}: more values than the {len(names)} columns of the header. Decimal commas?"
            " Write decimal points."
        )
    if len(row) < len(names):
        values = f"{len(row)} value{'s' if len(row) > 1 else ''}"
        raise checks.InputError(
            f"{line}, column {names[len(row)]!r}: no value; the line has {values} for"
            f" {len(names)} columns."
        )

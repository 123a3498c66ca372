"""Cells as a script sees them: one object each, with attributes that the script may read and set.

A `Sheet` holds the columns of some cells and reads each when it is first used. A `Cell` is a row of
it. What a script sets stays in the cell's own dictionary until it is written back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

UNSET = object()  # the value of a variable that a cell does not have
LEVELS = ("species", "signals")
# What the model decides; a script that sets one of these changes nothing in CellModeller either.
READ_ONLY = (
    "id", "idx", "pos", "dir", "length", "radius", "volume", "ends", "time", "neighbours", "cts",
    "cellAdh", "signals",
)  # fmt: skip


class Sheet:
    """Columns of some cells. read: the values of a name, one per cell, or None if there is no such
    name. levels: "species" and "signals" (M, K) where the model has them."""

    def __init__(
        self,
        read: Callable[[str], Sequence[Any] | None],
        levels: Mapping[str, Callable[[], np.ndarray]],
    ):
        self._read, self._makers = read, levels
        self._columns: dict[str, Sequence[Any] | None] = {}
        self._levels: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def value(self, name: str, row: int) -> Any:
        """The value of a cell; UNSET if it has none."""
        if name in self._makers:
            return self.level(name)[row]
        if name not in self._columns:
            self._columns[name] = self._read(name)
        column = self._columns[name]
        return UNSET if column is None else column[row]

    def level(self, name: str) -> np.ndarray:
        """Species or signals of the cells, (M, K), which a script may change in place."""
        if name not in self._levels:
            values = self._makers[name]()
            self._levels[name] = values, values.copy()
        return self._levels[name][0]

    def changed_species(self) -> np.ndarray | None:
        """The species (M, K), if the script has changed them in place."""
        if "species" not in self._levels:
            return None
        now, before = self._levels["species"]
        return None if np.array_equal(now, before, equal_nan=True) else now


class Cell:
    """A cell as CellModeller's scripts know it."""

    __slots__ = ("__dict__", "_row", "_sheet")

    def __init__(self, sheet: Sheet, row: int):
        self._sheet, self._row = sheet, row

    def __getattr__(self, name: str) -> Any:
        # only for what the script has not set
        value = UNSET if name.startswith("_") else self._sheet.value(name, self._row)
        if value is UNSET:
            raise AttributeError(
                f"this cell has no {name!r}: neither torchfilm nor init(cell) gives it one"
            )
        if isinstance(value, list) and name not in READ_ONLY:
            self.__dict__[name] = value  # which may be changed in place
        return value


def written(cells: Iterable[Cell]) -> dict[str, tuple[list[int], list[Any]]]:
    """What a script has set, by name: the rows of the cells and the values."""
    found: dict[str, tuple[list[int], list[Any]]] = {}
    for cell in cells:
        row = cell._row
        for name, value in cell.__dict__.items():
            if name not in found:
                found[name] = ([], [])
            rows, values = found[name]
            rows.append(row)
            values.append(value)
    return found

"""Tables of observed cells: their columns and units."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.statistics import SeenCells
from torchfilm import checks, tables

COLONY, FRAME = "colony", "frame"
# columns of times; each colony has one
TIMES = (
    "time", "time_h", "time_min", "time_s", "timepoint", "t", "t_h", "t_min", "t_s", "hour",
    "hours", "minute", "minutes",
)  # fmt: skip
KIND = {"x": "length", "y": "length", "length": "length", "angle": "angle", "age": "time"}
LONGEST = 100.0  # µm, the median of bacteria, filaments aside
ROUNDED = 1e-3  # share by which a time may differ from that of a column


def read_table(
    table: str | Path | Mapping[str, Any],
    species: tuple[str, ...],
    units: tables.Units,
    columns: Mapping[str, str],
    length_with_caps: bool,
    time: float | None = None,
) -> tuple[SeenCells, float | None]:
    """The cells of a table, sorted by colony, and when they were observed, h: as a column says, or
    `time`. columns: names in the table where they differ.

    Raises InputError for a column that is missing, is not numbers or has no unit, for several
    frames or times, and for lengths and ages that no cell has.
    """
    given = tables.Table.read(table)
    meant = (*KIND, COLONY, *species)
    if not isinstance(columns, Mapping):
        raise checks.input_error(
            "Observed(columns)",
            columns,
            'names of columns, such as {"x": "centroid_x"}',
            'Cells.from_table(…, columns="skimage").table() turns the table of a program into one.',
        )
    for name in columns:
        checks.choice("Observed(columns)", name, meant)
    _check_one_frame(given, columns)
    owner = colonies_of(given, columns)
    _check_one_time(given, columns, owner)
    found: dict[str, Tensor] = {}
    used: set[tuple[str, str]] = set()
    for name, kind in KIND.items():
        known = given.quantity(name, kind, columns, units, used)
        if known is None:
            continue
        column, _, factor = known
        numbers = given.numbers(column)
        if name in ("length", "age"):
            _check_positive(given, column, numbers, name == "length" and length_with_caps)
        found[name] = factor * torch.tensor(numbers)  # pandas may give what is read-only
    _warn_of_length(given, found.get("length", torch.zeros(0)))
    time = _time(given, columns, units, time)
    units.check_used(used)
    for name in species:
        column = columns.get(name, name)
        if column not in given.columns:
            hint = "" if name in columns else f'Name yours by columns={{{name!r}: "…"}}.'
            near = checks.nearest(column, given.columns)
            raise given.missing(column, f"Did you mean {near!r}? {hint}".strip() if near else hint)
        found[name] = torch.tensor(given.numbers(column))
    if ("x" in found) != ("y" in found):
        raise given.missing("y" if "x" in found else "x")
    if not found:
        raise tf.InputError(
            f"{given.source} has none of the columns {', '.join(KIND)} or species; it has"
            f" {', '.join(given.columns)}. Name yours by columns={{…}}."
        )
    _check_twice(given, found, owner)
    if (radius := _radius(given, units)) is not None:
        found["radius"] = radius
    return _cells(found, species, owner), time


def _check_twice(
    given: tables.Table, found: Mapping[str, Tensor], owner: np.ndarray | None
) -> None:
    """Raise InputError if two cells of a colony have one centre."""
    if "x" not in found:
        return
    of = np.zeros(given.rows) if owner is None else np.unique(owner, return_inverse=True)[1]
    places = np.column_stack([of, found["x"], found["y"]])
    _, first, counts = np.unique(places, axis=0, return_index=True, return_counts=True)
    again = first[counts > 1]
    if again.size:
        raise tf.InputError(
            f"{given.place(int(again.min()))}: another cell of the colony has the same centre (such"
            f" cells: {again.size}). Is a cell listed twice? Keep one of each."
        )


def _check_positive(given: tables.Table, column: str, numbers: np.ndarray, above: bool) -> None:
    """Raise InputError, which names the first such row, for numbers below 0; `above`: and for 0,
    which is the length of a centreline of a round cell, but of no cell with its caps."""
    bad = np.flatnonzero(numbers <= 0.0 if above else numbers < 0.0)
    if len(bad):
        more = f" (in {len(bad)} of {given.rows} rows)" if len(bad) > 1 else ""
        raise tf.InputError(
            f"{given.place(int(bad[0]))}, column {column!r}: {numbers[bad[0]]:g} is not"
            f" {'above 0' if above else '0 or more'}{more}. Leave such cells out, or give the"
            " column that is meant by columns={…}."
        )


def _check_one_time(
    table: tables.Table, columns: Mapping[str, str], owner: np.ndarray | None
) -> None:
    """Raise InputError for a colony that is listed at several times, in a column of times. owner:
    which colony each cell belongs to."""
    column = next((c for c in table.columns if c.lower() in TIMES), None)
    if column is None or columns.get(COLONY) == column:
        return
    times = np.array([str(x) for x in table.columns[column].tolist()])
    for colony in [None] if owner is None else np.unique(owner):
        own = times if owner is None else times[owner == colony]
        if len(set(own)) > 1:
            where = "" if owner is None else f" of colony {colony}"
            raise tf.InputError(
                f"{table.source} has {len(set(own))} times{where} in the column {column!r}, from"
                f" {own[0]} to {own[-1]}. Observed has colonies of one time: keep the rows of one,"
                " or take ObservedCourse.from_table."
            )


def _time(
    table: tables.Table, columns: Mapping[str, str], units: tables.Units, stated: float | None
) -> float | None:
    """When the cells were observed, h: as a column time_h or time_min says, or as stated. Colonies
    of several times, each of one, have none that is known. Raises InputError where both differ."""
    known = table.column("time", "time", {})
    if known is None or not known[1] or columns.get(COLONY) == known[0]:
        return stated  # without a unit it may be the number of a frame
    column, unit = known
    times = np.unique(units.factor("time", unit, column) * table.numbers(column))
    if len(times) > 1:
        return stated
    found = float(times[0])
    if stated is not None and abs(found - stated) > ROUNDED * abs(stated):
        rule = f"{found:g} h, as the column {column!r} says"
        hint = "Leave the column out where it is another time."
        raise checks.input_error("Observed(time)", stated, rule, hint)
    if found <= 0.0:
        raise tf.InputError(
            f"{table.source}, column {column!r}: {found:g} h is not above 0. Cells of the first"
            " frame say how runs begin, which Scene(founders=…) does."
        )
    return found if stated is None else stated


def _radius(table: tables.Table, units: tables.Units) -> Tensor | None:
    """Of each cell, µm, where a column with a unit says it of all."""
    known = table.column("radius", "length", {})
    unit = known and (known[1] or units.stated("length"))
    if not known or not unit or (unit == "px" and units.pixel_size is None):
        return None
    try:
        found = units.factor("length", unit, known[0]) * table.numbers(known[0])
    except tf.InputError:  # a number that is missing: the width serves a warning alone
        return None
    return torch.tensor(found) if (found > 0.0).all() else None


def _check_one_frame(table: tables.Table, columns: Mapping[str, str]) -> None:
    """Raise InputError for several frames of one movie: their cells are no colony of one time."""
    column = next((c for c in table.columns if c.lower() == FRAME), None)
    if column is None or columns.get(COLONY) == column:
        return
    frames = list(dict.fromkeys(table.columns[column].tolist()))
    if len(frames) > 1:
        raise tf.InputError(
            f"{table.source} has {len(frames)} frames in the column {column!r}, from"
            f" {frames[0]!r} to {frames[-1]!r}. Colonies are observed at one time: keep the rows of"
            f' one frame. If each frame is a colony of its own, give columns={{"colony":'
            f" {column!r}}}."
        )


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
        radius=get("radius"),
    )


def colonies_of(table: tables.Table, columns: Mapping[str, str]) -> np.ndarray | None:
    """Which colony each cell belongs to, as given but for space around a name; None: all to one."""
    column = columns.get(COLONY, COLONY)
    if column in table.columns:
        given = [x.strip() if isinstance(x, str) else x for x in table.columns[column].tolist()]
        for row, name in enumerate(given):
            if name is None or name == "" or name != name:
                raise tf.InputError(
                    f"{table.place(row)}, column {column!r}: the cell has no colony. Give it one,"
                    " or leave its row out."
                )
        named = any(isinstance(x, str) for x in given)
        odd = [x for x in dict.fromkeys(given) if isinstance(x, str) and not x.isdigit()]
        if odd and any(isinstance(x, str) and x.isdigit() for x in given):
            checks.warn(
                f"{table.source}, column {column!r}: {', '.join(odd[:8])} among numbers counts as"
                " colonies of their own. Leave such rows out if they are none."
            )
        return np.array([str(x) for x in given] if named else given)
    if COLONY in columns:
        raise table.missing(column)
    return None


def _warn_of_length(given: tables.Table, length: Tensor) -> None:
    """Warn of cells, µm, that are longer than bacteria are."""
    if len(length) and float(length.median()) > LONGEST:
        checks.warn(  # the same words for each frame of a course, to be read once
            f"{given.source}: cells are longer than {LONGEST:g} µm (median), as bacteria rarely"
            " are. Lengths are in µm, or in pixels with pixel_size in µm, not in nm."
        )


def warn_of_empty(results: tf.Results, table: Mapping[str, np.ndarray]) -> None:
    """Warn of colonies of a results file that have no cells in the table of a frame."""
    empty = sorted(set(results.colony_id.tolist()) - set(table["colony"].tolist()))
    if empty:
        checks.warn(
            f"Observed.from_results: colonies {', '.join(map(str, empty[:8]))} of {results.path}"
            " have no cells in this frame and are left out: what is observed is of the others."
        )

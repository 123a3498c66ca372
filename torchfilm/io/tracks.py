"""Tracked cells of a microscope: tables with a row for each cell in each frame, and the files of
the Cell Tracking Challenge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchfilm.tools import checks, tables
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

MEANT = ("cell", "parent", "colony", "time", "length")
NONE = -1  # of a parent
SEVERAL = 3  # intervals of a colony, to know what is usual there
OTHER = 1.2  # times an interval between frames, that is another one
GAP = 1.5  # intervals between a mother and her daughter, above which frames are missing
MOST_CELLS, MOST_COLONIES = 2**40, 2**20  # of which a tree tells numbers apart
HALVED = 0.75  # of its length: less, from one frame to the next, tells of a division
LOST = "lost"  # the fate of a track that ends before the movie, without daughters


@dataclass(frozen=True)
class Tracks:
    """One row for each track, sorted by the hour at which it begins.

    source: the file or the table, for messages. colony, cell, parent (−1: none known): (N,) int64.
    first, last: h, of its first and last frame. birth_length, end_length: µm, in these frames, NaN
    where lengths are not known. end: h, of the last frame of its movie. interval: between frames.
    """

    source: str
    colony: np.ndarray
    cell: np.ndarray
    parent: np.ndarray
    first: np.ndarray
    last: np.ndarray
    birth_length: np.ndarray
    end_length: np.ndarray
    end: np.ndarray
    interval: float


def table_tracks(
    table: Any,
    columns: Mapping[str, str],
    units: tables.Units,
    width: float | None,
    join: bool,
    end: float | None,
) -> Tracks:
    """The tracks of a table with a row for each cell in each frame. width: of the cells, µm, which
    lengths include; None where they are those of centrelines. join: see `_checked`. end: see
    `_ended`."""
    given = tables.Table.read(table)
    for name in columns:
        checks.choice("Lineage.from_table(columns)", name, MEANT)
    used: set[tuple[str, str]] = set()
    time = given.quantity("time", "time", columns, units, used)
    if time is None:
        raise given.missing("time_h", "Give the hour of each row, as time_h or time_min.")
    hours = time[2] * given.numbers(time[0])
    length = given.quantity("length", "length", columns, units, used)
    sizes = (
        np.full(given.rows, np.nan) if length is None else length[2] * _with_gaps(given, length[0])
    )
    if width is not None:
        sizes = sizes - checks.number("Lineage.from_table(width)", width, above=0.0)
    if (sizes < 0.0).any():
        row = int(np.flatnonzero(sizes < 0.0)[0])
        less = "" if width is None else f", less than the width of {width:g} µm that is taken off"
        raise InputError(
            f"{given.place(row)}: {sizes[row]:.3g} µm is no length of a centreline{less}. Give a"
            " smaller width, or leave such rows out."
        )
    units.check_used(used)
    cell = _whole(given, columns.get("cell", "cell"), MOST_CELLS)
    colony = np.zeros(given.rows, np.int64)
    if "colony" in {**given.columns, **columns}:
        colony = _whole(given, columns.get("colony", "colony"), MOST_COLONIES)
    parent = _parents(given, columns.get("parent", "parent"), cell)
    tracks = _of_rows(given.source, colony, cell, parent, hours, sizes)
    if end is None:
        _warn_of_ends(given.source, colony, hours)
    return _checked(_ended(tracks, end, "Lineage.from_table(end)"), join)


def _of_rows(
    source: str,
    colony: np.ndarray,
    cell: np.ndarray,
    parent: np.ndarray,
    hours: np.ndarray,
    sizes: np.ndarray,
) -> Tracks:
    """The tracks of rows, (R,) each, in any order."""
    order = np.lexsort((hours, cell, colony))
    colony, cell, parent = colony[order], cell[order], parent[order]
    hours, sizes = hours[order], sizes[order]
    begins = np.ones(len(cell), bool)
    begins[1:] = (colony[1:] != colony[:-1]) | (cell[1:] != cell[:-1])
    twice = np.flatnonzero(~begins & (np.diff(hours, prepend=-np.inf) <= 0.0))
    if twice.size:
        k = int(twice[0])
        raise InputError(
            f"{source}: cell {cell[k]} of colony {colony[k]} has two rows at {hours[k]:g} h."
        )
    starts = np.flatnonzero(begins)
    ends = np.append(starts[1:], len(cell)) - 1
    shrunk = np.flatnonzero(~begins & (sizes < HALVED * np.roll(sizes, 1)))
    if shrunk.size:
        cells = dict.fromkeys(cell[shrunk].tolist())
        some = ", ".join(map(str, list(cells)[:8]))
        warn(
            f"{source}: {len(cells)} cells get shorter by a quarter or more from one frame to the"
            f" next (such as {some}): have they divided? Each daughter is a cell with a number of"
            " its own, and her mother as parent."
        )
    # a program may name the mother in the first row of a track alone
    mothers = np.maximum.reduceat(parent, starts)
    of_track = np.repeat(np.arange(len(starts)), ends - starts + 1)
    odd = np.flatnonzero((parent != NONE) & (parent != mothers[of_track]))
    if odd.size:
        k = int(odd[0])
        raise InputError(
            f"{source}: cell {cell[k]} of colony {colony[k]} has two parents, {parent[k]} and"
            f" {mothers[of_track[k]]}."
        )
    over = {c: float(hours[colony == c].max()) for c in np.unique(colony).tolist()}
    end = np.array([over[c] for c in colony[starts].tolist()])
    return Tracks(
        source, colony[starts], cell[starts], mothers, hours[starts], hours[ends], sizes[starts],
        sizes[ends], end, _interval(colony, hours),
    )  # fmt: skip


def challenge_tracks(path: str | Path, interval: float, join: bool, end: float | None) -> Tracks:
    """The tracks of a file of the Cell Tracking Challenge: label, first and last frame, parent (0:
    none). interval: h between frames. join: see `_checked`. end: see `_ended`."""
    path = checks.file_path("Lineage.from_ctc(path)", path)
    checks.number("Lineage.from_ctc(interval)", interval, above=0.0)
    if path.is_dir() or not path.is_file():
        rule = "the file of tracks, such as 01_GT/TRA/man_track.txt or 01_RES/res_track.txt"
        raise checks.input_error("Lineage.from_ctc(path)", str(path), rule)
    try:
        rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        numbers = np.array([[int(x) for x in row] for row in rows if row], np.int64)
    except (ValueError, UnicodeDecodeError, OverflowError) as error:
        rule = "four whole numbers in each line: label, first frame, last frame, parent"
        raise InputError(f"{path} must have {rule} ({error}).") from error
    if numbers.ndim != 2 or numbers.shape[1] != 4:
        raise InputError(f"{path} must have four whole numbers in each line: L B E P.")
    cell, first, last, parent = numbers.T
    if (cell < 1).any() or (parent < 0).any() or max(cell.max(), parent.max()) >= MOST_CELLS:
        rule = f"from 1, below 2**{MOST_CELLS.bit_length() - 1}, and of no parent 0"
        raise InputError(f"{path}: labels must be whole numbers {rule}.")
    none, nothing = np.full(len(cell), np.nan), np.zeros(len(cell), np.int64)
    if len(np.unique(cell)) < len(cell) or (last < first).any():
        raise InputError(f"{path}: each label must be there once, and end after it begins.")
    tracks = Tracks(
        str(path), nothing, cell, np.where(parent == 0, NONE, parent), interval * first,
        interval * last, none, none, np.full(len(cell), interval * last.max()), interval,
    )  # fmt: skip
    return _checked(_ended(tracks, end, "Lineage.from_ctc(end)"), join)


def _ended(tracks: Tracks, end: float | None, name: str) -> Tracks:
    """The tracks of movies that all went on to the hour `end`, also where no cell was left; or, if
    it is None, each to its last cell."""
    if end is None:
        return tracks
    end, last = checks.number(name, end), float(tracks.end.max())
    if end < last - 1e-5 * abs(last):  # as a message writes it
        raise checks.input_error(name, end, f"h, at least {last:g}, when cells were last seen")
    return replace(tracks, end=np.full(len(tracks.end), max(end, last)))


def _warn_of_ends(source: str, colony: np.ndarray, hours: np.ndarray) -> None:
    """Warn of colonies that end before another one with the same frames, (R,) each: they may have
    died out."""
    frames = {int(c): np.unique(hours[colony == c]) for c in np.unique(colony)}
    longest = max(frames.values(), key=len)
    early = [
        c for c, own in frames.items()
        if len(own) < len(longest) and np.array_equal(own, longest[: len(own)])
    ]  # fmt: skip
    if early:
        some, last = ", ".join(map(str, early[:8])), float(longest[-1])
        warn(
            f"{source}: colony {some} ends before others, the first of them at"
            f" {min(float(frames[c][-1]) for c in early):g} h of {last:g}: the last cells count as"
            f" alive there. If none was left, give end={last:g}, and they were lost."
        )


def _interval(colony: np.ndarray, hours: np.ndarray) -> float:
    """The usual time between frames of a colony, h; inf where each has one. Warns of colonies that
    were seen at other intervals than others."""
    frames = np.unique(np.stack([colony.astype(float), hours], 1), axis=0)
    same = np.diff(frames[:, 0]) == 0
    apart, of = np.diff(frames[:, 1])[same], frames[1:, 0][same]
    if not len(apart):
        return np.inf
    known = [c for c in np.unique(of) if (of == c).sum() >= SEVERAL]
    each = {int(c): float(np.median(apart[of == c])) for c in known}
    one, other = (f(each, key=each.__getitem__) if each else 0 for f in (min, max))
    if each and each[other] > OTHER * each[one]:
        warn(
            f"frames of colony {one} are {each[one]:.3g} h apart, those of colony {other}"
            f" {each[other]:.3g} h: the lineage takes {np.median(apart):.3g} h for all. Read movies"
            " of different intervals as lineages of their own."
        )
    return float(np.median(apart))


def _with_gaps(given: tables.Table, column: str) -> np.ndarray:
    """A column of numbers, NaN where one is missing: the row tells that the cell was there."""
    values = given.columns[column]
    empty = np.array(
        [v is None or v != v or v in ("", "nan", "NaN", "NA") for v in values.tolist()]
    )
    found = np.full(given.rows, np.nan)
    if not empty.all():
        found[~empty] = given.take(~empty).numbers(column)
    return found


def _whole(given: tables.Table, column: str, below: int) -> np.ndarray:
    """A column of whole numbers from 0, (N,) int64."""
    if column not in given.columns:
        raise given.missing(column)
    values = given.columns[column]
    if values.dtype.kind in "OU" and any(isinstance(v, str) and _is_name(v) for v in values):
        name = next(v for v in values if isinstance(v, str) and _is_name(v))
        raise InputError(
            f"{given.source}, column {column!r}: {str(name)!r} is a name, and a number is needed,"
            f" such as pandas.factorize(table[{column!r}])[0] makes of names."
        )
    numbers = given.numbers(column)
    bad = np.flatnonzero((numbers != np.round(numbers)) | (numbers < 0) | (numbers >= below))
    if bad.size:
        row = int(bad[0])
        rule = f"a whole number from 0, below 2**{below.bit_length() - 1}"
        raise InputError(f"{given.place(row)}, column {column!r}: {numbers[row]:g} must be {rule}.")
    return numbers.astype(np.int64)


def _is_name(text: str) -> bool:
    """Whether a text is none of a number."""
    try:
        float(text)
    except ValueError:
        return bool(text.strip())
    return False


def _parents(given: tables.Table, column: str, cell: np.ndarray) -> np.ndarray:
    """The parent of each row, −1 where none is named: by nothing, by a number below 0, or by 0
    where no cell is 0."""
    if column not in given.columns:
        raise given.missing(column, "Give the cell from which each descends, −1 of those of none.")
    values, least = [], 0 if (cell == 0).any() else 1
    for row, text in enumerate(given.columns[column].tolist()):
        if text is None or text == "" or text != text:
            values.append(NONE)
            continue
        try:
            number = float(text)
        except (TypeError, ValueError):
            number = np.nan
        if not abs(number) < MOST_CELLS or number != np.round(number):
            rule = "a whole number, or empty where it has no parent"
            raise InputError(f"{given.place(row)}, column {column!r}: {text!r} must be {rule}.")
        values.append(int(number) if number >= least else NONE)
    return np.array(values, np.int64)


def _checked(tracks: Tracks, join: bool) -> Tracks:
    """Sorted by their beginnings. join: those with one daughter are one cell with her. Raises
    InputError for parents that are not possible; warns of cells with one daughter or with more than
    two, and of gaps between mothers and daughters."""
    checks.choice("join", join, (True, False))
    found = _taken(tracks, np.argsort(tracks.first, kind="stable"))
    mothers = _mothers(found)
    count = np.bincount(mothers[mothers >= 0], minlength=len(mothers))
    whole = _not_divided(found, mothers)
    if join and (count == 1).any():
        found = _joined(found, mothers, (count == 1) & whole)
        mothers = _mothers(found)
        count = np.bincount(mothers[mothers >= 0], minlength=len(mothers))
    source, known = found.source, np.flatnonzero(mothers >= 0)
    hint = "" if join else " join=True takes a cell and its only daughter for one."
    several = len(np.unique(found.colony)) > 1
    for some, what, more in ((count == 1, "one daughter", hint), (count > 2, "more than two", "")):
        if some.any():
            names = zip(found.colony[some][:8].tolist(), found.cell[some][:8].tolist(), strict=True)
            cells = ", ".join(f"{b} of colony {a}" if several else str(b) for a, b in names)
            warn(
                f"{source}: {int(some.sum())} cells have {what} (such as {cells}): tracks may be"
                f" cut or wrongly joined there. They count as divided.{more}"
            )
    gaps = found.first[known] - found.last[mothers[known]] > GAP * found.interval
    if gaps.any():
        warn(
            f"{source}: {int(gaps.sum())} cells begin later than a frame after their parent's last"
            " one: when they were born, and what lengths they had then, is not known so well."
        )
    return found


def _taken(tracks: Tracks, rows: np.ndarray) -> Tracks:
    """Some of the tracks, in this order."""
    columns = (f.name for f in fields(tracks) if f.name not in ("source", "interval"))
    return replace(tracks, **{name: getattr(tracks, name)[rows] for name in columns})


def _mothers(tracks: Tracks) -> np.ndarray:
    """The row of each track's parent, (N,), −1 where none is known. Raises InputError for a parent
    that is no cell, or that is there as its daughter begins, or later."""
    source, cells = tracks.source, zip(tracks.colony.tolist(), tracks.cell.tolist(), strict=True)
    place = {key: k for k, key in enumerate(cells)}
    mothers = np.full(len(tracks.cell), NONE)
    for k in np.flatnonzero(tracks.parent != NONE).tolist():
        mother = place.get((int(tracks.colony[k]), int(tracks.parent[k])))
        if mother is None:
            raise InputError(
                f"{source}: cell {tracks.cell[k]} has the parent {tracks.parent[k]}, which is no"
                " cell of its colony. Give −1, 0 or nothing where it is not known. Of a run: a cell"
                " that lived between two frames is in none; record more of them (every=)."
            )
        if tracks.first[mother] >= tracks.first[k]:
            raise InputError(
                f"{source}: cell {tracks.cell[k]} begins at {tracks.first[k]:g} h, no later than"
                f" its parent {tracks.parent[k]}."
            )
        if tracks.last[mother] >= tracks.first[k]:
            raise InputError(
                f"{source}: cell {tracks.parent[k]} is there at {tracks.last[mother]:g} h, and its"
                f" daughter {tracks.cell[k]} from {tracks.first[k]:g} h on. Are cells of several"
                " movies one? A column colony tells them apart."
            )
        mothers[k] = mother
    return mothers


def _not_divided(tracks: Tracks, mothers: np.ndarray) -> np.ndarray:
    """Which tracks no daughter begins so much shorter than they end that they must have divided,
    (N,) bool."""
    whole, known = np.ones(len(mothers), bool), np.flatnonzero(mothers >= 0)
    halved = tracks.birth_length[known] < HALVED * tracks.end_length[mothers[known]]
    whole[mothers[known[halved]]] = False
    return whole


def _joined(tracks: Tracks, mothers: np.ndarray, single: np.ndarray) -> Tracks:
    """Each track and its only daughter as one, of the mother's number. single: those to join with
    theirs, (N,) bool. Mothers stand before daughters."""
    root = np.arange(len(mothers))
    end = root.copy()  # the last part of each
    for k in np.flatnonzero(mothers >= 0).tolist():
        if single[mothers[k]]:
            root[k] = root[mothers[k]]
            end[root[k]] = k
    kept = np.flatnonzero(root == np.arange(len(root)))
    above = mothers[kept]
    parent = np.where(above < 0, NONE, tracks.cell[root[above]])
    last, length = tracks.last[end[kept]], tracks.end_length[end[kept]]
    return replace(_taken(tracks, kept), parent=parent, last=last, end_length=length)

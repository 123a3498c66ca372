"""The HDF5 file of a study.

    /             attributes: format, version, torchfilm, torch, about (JSON: scene, parameters,
                  target, method, …)
    /streams      (R,) streams of random numbers, one for each replicate
    /batches/     rows, first_stream and those of BATCH: a row for each batch
    /designs/     point (N, D), loss (N,), losses (N, R), cells (N, R); NaN and 0 where a replicate
                  was not grown; reasons, JSON by replicate; goals (N, G) and each_goals (N, R, G),
                  where there are several
    /slopes/K/    gradient (n, D) and curvature (n, D, D) of batch K, where they were wanted
    /residuals/K  (n, number of readings) of batch K, where they were wanted
    /values/NAME  (N,) the values of each parameter; as JSON where numbers are mixed with text
    /finals/      the same of the finals, the designs on fresh seeds

After each batch a new file is written beside the old one and then replaces it, so that a kill at
any moment costs at most one batch. The file holds data only; nothing in it is executed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from design.data_file import Stamp, read_values, reading, replacing, write_values
from design.entries import Entry
from design.slopes import Slopes
from torchfilm import checks

FORMAT, VERSION = "torchfilm study", 3
# Of a batch, by the same names in the file and in an Entry.
BATCH = ("size", "replicates", "seconds", "copies", "choosing")


@dataclass(frozen=True, eq=False)
class StudyData:
    """What a study file holds: `Study` documents its parts."""

    about: dict[str, Any]
    streams: tuple[int, ...]
    entries: list[Entry]
    finals: list[Entry]


def write_study(path: Path, data: StudyData, before: Stamp | None) -> Stamp | None:
    """Write a study, in place of the older file whose `stamp` is `before`, and return the new one.
    Raises SimulationError where that fails."""
    kept = "earlier batches. Run the search again to resume it"
    with replacing(path, FORMAT, VERSION, data.about, kept, before) as file:
        file["streams"] = np.asarray(data.streams, np.int64)
        names = data.about["names"]
        _write_entries(file, data.entries, names, len(data.streams))
        if data.finals:
            most = max(e.replicates for e in data.finals)
            _write_entries(file.create_group("finals"), data.finals, names, most)
        mark = str(file.attrs["written"])
    return mark


def _write_entries(
    group: h5py.Group, entries: Sequence[Entry], names: Sequence[str], most: int
) -> None:
    """most: replicates of any batch."""
    group["batches/rows"] = [len(e.points) for e in entries]
    group["batches/first_stream"] = [e.streams[0] for e in entries]
    for name in BATCH:
        group[f"batches/{name}"] = [getattr(e, name) for e in entries]
    wide = lambda x, fill: np.concatenate(
        [x, np.full((len(x), most - x.shape[1], *x.shape[2:]), fill, x.dtype)], 1
    )
    group["designs/point"] = np.concatenate([e.points for e in entries])
    group["designs/loss"] = np.concatenate([e.loss for e in entries])
    group["designs/losses"] = np.concatenate([wide(e.losses, np.nan) for e in entries])
    group["designs/cells"] = np.concatenate([wide(e.cells, 0) for e in entries])
    count = next((e.goals.shape[1] for e in entries if e.goals is not None), 0)
    if count:
        none = lambda e, *shape: np.full((len(e.points), *shape, count), np.nan)
        group["designs/goals"] = np.concatenate(
            [none(e) if e.goals is None else e.goals for e in entries]
        )
        each = [none(e, most) if e.each_goals is None else e.each_goals for e in entries]
        group["designs/each_goals"] = np.concatenate([wide(x, np.nan) for x in each])
    for number, slopes in enumerate(e.slopes for e in entries):
        if slopes is not None:
            group[f"slopes/{number}/gradient"] = slopes.gradient
            group[f"slopes/{number}/curvature"] = slopes.curvature
    for number, entry in enumerate(entries):
        if entry.residuals is not None:
            group[f"residuals/{number}"] = entry.residuals
    words = [
        json.dumps({str(k): e.reasons[r, k] for k in range(e.replicates) if (r, k) in e.reasons})
        for e in entries
        for r in range(len(e.points))
    ]
    group.create_dataset("designs/reasons", data=words, dtype=h5py.string_dtype())
    for name in names:
        write_values(group, name, [v[name] for e in entries for v in e.values])


def read_study(path: Path) -> StudyData:
    """The study in a file. Raises InputError where the file cannot be read."""
    if not path.is_file():
        raise checks.input_error(
            "study",
            str(path),
            "a study file",
            "This path is a folder." if path.is_dir() else "There is no such file.",
        )
    with reading(path, FORMAT, VERSION, "torchfilm study") as file:
        about, streams = json.loads(file.attrs["about"]), tuple(file["streams"][...].tolist())
        tuple(about["names"])
        finals = _read_entries(file["finals"]) if "finals" in file else []
        return StudyData(about, streams, _read_entries(file, streams), finals)


def _read_entries(group: h5py.Group, streams: tuple[int, ...] | None = None) -> list[Entry]:
    """streams: of the replicates; None: those that the file states."""
    batches, designs = ({n: d[...] for n, d in group[g].items()} for g in ("batches", "designs"))
    columns = read_values(group)
    values = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    out: list[Entry] = []
    at = 0
    batches.setdefault("copies", np.ones_like(batches["rows"]))  # version 1 has none
    batches.setdefault("first_stream", np.zeros_like(batches["rows"]))  # nor has version 2
    batches.setdefault("choosing", np.zeros(len(batches["rows"])))  # nor have early files of 3
    columns_of = (batches[n].tolist() for n in ("rows", "first_stream", *BATCH))
    for rows, first, size, replicates, seconds, copies, choosing in zip(*columns_of, strict=True):
        mine = slice(at, at + rows)
        reasons = {
            (r, int(k)): words
            for r, text in enumerate(designs["reasons"][mine])
            for k, words in json.loads(text).items()
        }
        out.append(
            Entry(
                points=designs["point"][mine],
                loss=designs["loss"][mine],
                losses=designs["losses"][mine, :replicates],
                cells=designs["cells"][mine, :replicates],
                reasons=reasons,
                size=size,
                seconds=seconds,
                values=values[mine],
                streams=(streams or tuple(range(first, first + replicates)))[:replicates],
                slopes=_read_slopes(group, len(out)),
                copies=copies,
                goals=designs["goals"][mine] if "goals" in designs else None,
                each_goals=(
                    designs["each_goals"][mine, :replicates] if "each_goals" in designs else None
                ),
                choosing=choosing,
                residuals=_read_residuals(group, len(out)),
            )
        )
        at += rows
    for name, column in {**designs, **columns}.items():
        if len(column) != at:
            raise ValueError(f"its batches have {at} designs, but {name} lists {len(column)}")
    if not np.isfinite(designs["loss"]).all():
        raise ValueError("a design has no loss")
    return out


def _read_residuals(group: h5py.Group, batch: int) -> np.ndarray | None:
    found = group.get(f"residuals/{batch}")
    return None if found is None else found[...]


def _read_slopes(group: h5py.Group, batch: int) -> Slopes | None:
    found = group.get(f"slopes/{batch}")
    return None if found is None else Slopes(found["gradient"][...], found["curvature"][...])

"""A study: every evaluation of a search in one HDF5 file. A search resumes from it with the same
results as if it had never stopped.

    /             attributes: format, version, torchfilm, torch, about (JSON: scene, parameters,
                  target, method, …)
    /streams      (R,) streams of random numbers, one for each replicate
    /batches/     rows, size, replicates, seconds, copies: a row for each batch
    /designs/     point (N, D), loss (N,), losses (N, R), cells (N, R); NaN and 0 where a replicate
                  was not grown; reasons, JSON by replicate
    /slopes/K/    gradient (n, D) and curvature (n, D, D) of batch K, where they were wanted
    /values/NAME  (N,) the values of each parameter

After each batch a new file is written beside the old one and then replaces it, so that a kill at
any moment costs at most one batch. The file holds data only; nothing in it is executed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

import torchfilm as tf
from design.parameters import Value, show_value
from design.slopes import Slopes
from torchfilm import checks

FORMAT, VERSION = "torchfilm study", 2
DIGESTS = ("founders and functions", "code of the target")
LONGEST, SHORT = 300, 48  # characters of a refusal, and of one value in it


@dataclass(frozen=True, eq=False)
class Entry:
    """One batch and its results.

    points (n, D); loss (n,); losses and cells (n, R); reasons of failures, by (row, replicate);
    size: share of the full size; replicates: how many were grown; seconds; values: the parameters
    of each point. slopes: where the method asked for them; copies: colonies that were grown for
    each loss, for its derivatives.
    """

    points: np.ndarray
    loss: np.ndarray
    losses: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    size: float
    replicates: int
    seconds: float
    values: Sequence[dict[str, Value]]
    slopes: Slopes | None = None
    copies: int = 1

    @property
    def colonies(self) -> float:
        """Colonies simulated; a smaller one counts as its share of the full size."""
        return len(self.points) * self.replicates * self.size * self.copies


@dataclass(eq=False)
class Study:
    """The evaluations of a search, and the file that keeps them, if any.

    about: what the losses depend on, as plain data; names: of the parameters; streams: of the
    replicates.
    """

    about: dict[str, Any]
    names: tuple[str, ...]
    streams: tuple[int, ...]
    path: Path | None = None
    entries: list[Entry] = field(default_factory=list)

    @property
    def colonies(self) -> float:
        """Colonies simulated so far; a smaller one counts as its share of the full size."""
        return sum(e.colonies for e in self.entries)

    @property
    def seconds(self) -> float:
        return sum(e.seconds for e in self.entries)

    def full(self) -> list[Entry]:
        """The batches at full size with all replicates. Only their losses are comparable."""
        return [e for e in self.entries if self.is_full(e)]

    def is_full(self, entry: Entry) -> bool:
        """Whether a batch was grown to full size with all replicates."""
        return entry.size == 1.0 and entry.replicates == len(self.streams)

    def best(self) -> tuple[np.ndarray, float, np.ndarray] | None:
        """Point (D,), loss and losses (R,) of the best design that was grown to full size, the
        first of equal ones. None before there is one."""
        full = self.full()
        if not full:
            return None
        entry = min(full, key=lambda e: float(e.loss.min()))
        row = int(entry.loss.argmin())
        return entry.points[row], float(entry.loss[row]), entry.losses[row]

    def table(self, most: int = 20) -> str:
        """The best designs that were grown to full size, the first of equal ones first: loss, its
        spread between replicates, cells, and the values of the parameters. most: rows."""
        rows = [
            (float(e.loss[k]), e.losses[k], e.cells[k], e.values[k])
            for e in self.full()
            for k in range(len(e.loss))
        ]
        rows.sort(key=lambda row: row[0])
        text = [["loss", "±", "cells", *self.names]]
        for loss, losses, cells, values in rows[: max(most, 0)]:
            spread = f"{losses.std(ddof=1):.2g}" if len(losses) > 1 else ""
            shown = [show_value(values[name]) for name in self.names]
            text.append([f"{loss:.4f}", spread, f"{cells.mean():.0f}", *shown])
        wide = [max(map(len, column)) for column in zip(*text, strict=True)]
        lines = ["  ".join(x.rjust(w) for x, w in zip(r, wide, strict=True)) for r in text]
        hidden = len(rows) - (len(text) - 1)
        return "\n".join(lines + ([f"and {hidden} more"] if hidden else []))

    def failures(self) -> list[tuple[str, int]]:
        """The reasons of failures and how many colonies each has, the most frequent first.

        Reasons that differ in their numbers only count as one; the first of them is given.
        """
        kinds: dict[str, list[str]] = {}
        for entry in self.entries:
            for reason in entry.reasons.values():
                kind = re.sub(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", "#", reason)
                kinds.setdefault(kind, []).append(reason)
        return [(alike[0], len(alike)) for alike in sorted(kinds.values(), key=len, reverse=True)]

    def convergence(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """After each batch: colonies simulated, seconds spent and the lowest loss so far (NaN
        before there is one), (K,) each."""
        colonies = np.cumsum([e.colonies for e in self.entries])
        seconds = np.cumsum([e.seconds for e in self.entries])
        lowest = [e.loss.min() if self.is_full(e) else np.inf for e in self.entries]
        best = np.minimum.accumulate(lowest) if lowest else np.empty(0)
        return colonies, seconds, np.where(np.isfinite(best), best, np.nan)

    def add(self, entry: Entry) -> None:
        """Add a batch, and write the file. Raises SimulationError where that fails."""
        self.entries.append(entry)
        if self.path is not None:
            self._write(self.path)

    def _write(self, path: Path) -> None:
        beside = path.with_name(path.name + ".new")
        try:
            with h5py.File(beside, "w") as file:
                file.attrs.update(
                    {
                        "format": FORMAT,
                        "version": VERSION,
                        "about": json.dumps(self.about),
                        "torchfilm": tf.__version__,
                        "torch": str(torch.__version__),
                    }
                )
                file["streams"] = np.asarray(self.streams, np.int64)
                self._write_tables(file)
                for name in self.names:
                    column = [v[name] for e in self.entries for v in e.values]
                    if any(isinstance(v, str) for v in column):
                        file.create_dataset(
                            f"values/{name}",
                            data=[str(v) for v in column],
                            dtype=h5py.string_dtype(),
                        )
                    else:
                        file[f"values/{name}"] = column
            os.replace(beside, path)
        except OSError as error:
            raise tf.SimulationError(
                f"could not write {path}: {error}. Is the disk full? The file keeps the earlier"
                " batches. Run the search again to resume it."
            ) from error

    def _write_tables(self, file: h5py.File) -> None:
        replicates = len(self.streams)
        file["batches/rows"] = [len(e.points) for e in self.entries]
        for name in ("size", "replicates", "seconds", "copies"):
            file[f"batches/{name}"] = [getattr(e, name) for e in self.entries]
        wide = lambda x, fill: np.concatenate(
            [x, np.full((len(x), replicates - x.shape[1]), fill, x.dtype)], 1
        )
        file["designs/point"] = np.concatenate([e.points for e in self.entries])
        file["designs/loss"] = np.concatenate([e.loss for e in self.entries])
        file["designs/losses"] = np.concatenate([wide(e.losses, np.nan) for e in self.entries])
        file["designs/cells"] = np.concatenate([wide(e.cells, 0) for e in self.entries])
        for number, slopes in enumerate(e.slopes for e in self.entries):
            if slopes is not None:
                file[f"slopes/{number}/gradient"] = slopes.gradient
                file[f"slopes/{number}/curvature"] = slopes.curvature
        words = [
            json.dumps(
                {str(k): e.reasons[r, k] for k in range(e.replicates) if (r, k) in e.reasons}
            )
            for e in self.entries
            for r in range(len(e.points))
        ]
        file.create_dataset("designs/reasons", data=words, dtype=h5py.string_dtype())

    @classmethod
    def open(
        cls, path: str | Path, about: dict[str, Any], names: Sequence[str], streams: Sequence[int]
    ) -> Study:
        """The study at a path, or a new one where there is no file. Raises InputError for the study
        of another search."""
        path = Path(path)
        if not path.exists():
            if not path.parent.is_dir():
                raise checks.input_error(
                    "study", str(path), "in a folder that exists", f"Make {path.parent} first."
                )
            return cls(about, tuple(names), tuple(streams), path)
        study = cls.read(path)
        differ = [n for n in {**about, **study.about} if about.get(n) != study.about.get(n)]
        if differ:
            raise tf.InputError(_refusal(path, differ, study.about, about))
        return study

    @classmethod
    def read(cls, path: str | Path) -> Study:
        """The study in a file. Raises InputError where the file cannot be read."""
        path = Path(path)
        if not path.is_file():
            raise checks.input_error(
                "study",
                str(path),
                "a study file",
                "This path is a folder." if path.is_dir() else "There is no such file.",
            )
        try:
            with h5py.File(path, "r") as file:
                if file.attrs.get("format") != FORMAT:
                    raise tf.InputError(
                        f"{path} is not a torchfilm study (its format is"
                        f" {file.attrs.get('format')!r})."
                    )
                if int(file.attrs["version"]) > VERSION:
                    raise tf.InputError(
                        f"{path} has format version {file.attrs['version']}; this torchfilm reads"
                        f" versions up to {VERSION}. Update torchfilm."
                    )
                about = json.loads(file.attrs["about"])
                study = cls(
                    about, tuple(about["names"]), tuple(file["streams"][...].tolist()), path
                )
                study.entries = _entries(file)
        except tf.InputError:
            raise
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise tf.InputError(
                f"{path} cannot be read: it is truncated or not a study file ({error})."
            ) from error
        return study


def _refusal(
    path: Path, names: list[str], there: Mapping[str, Any], here: Mapping[str, Any]
) -> str:
    """The message for the study of another search: what differs, then as many values as fit."""
    # the listed effects are those in the middle of the bounds, so bounds change them too
    names = sorted(names, key=lambda name: (name in DIGESTS, name == "effects"))
    out = f"{path.name} is the study of another search. Different: {', '.join(names)}."
    close = " Give another path, or restore the search."
    for name in names:
        if name in DIGESTS:  # their values say nothing to a reader
            continue
        old, new = _differing(there.get(name), here.get(name))
        detail = f" {name}: {_cut(old)} there, {_cut(new)} here."
        if len(out) + len(detail) + len(close) <= LONGEST:
            out += detail
    return out + close


def _differing(old: Any, new: Any) -> tuple[str, str]:
    """The parts of two values that differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = [n for n in {**old, **new} if old.get(n) != new.get(n)]
        return _differing(
            [f"{n}={old[n]}" for n in names if n in old],
            [f"{n}={new[n]}" for n in names if n in new],
        )
    if isinstance(old, list) and isinstance(new, list):
        one, other = [x for x in old if x not in new], [x for x in new if x not in old]
        if len(one) == len(other) == 1:
            return _differing(one[0], other[0])
        return ", ".join(map(str, one)) or "none", ", ".join(map(str, other)) or "none"
    before, after = str(old), str(new)
    shortest = min(len(before), len(after))
    same = next((k for k in range(shortest) if before[k] != after[k]), shortest)
    # keep the whole argument that differs
    begin = max((m.end() for m in re.finditer(r"[(,]\s*", before[:same])), default=0)
    if shortest > SHORT:
        before, after = before[begin:], after[begin:]
    return before, after


def _cut(text: str) -> str:
    return text if len(text) <= SHORT else text[: SHORT - 1] + "…"


def _entries(file: h5py.File) -> list[Entry]:
    batches, designs = ({n: d[...] for n, d in file[g].items()} for g in ("batches", "designs"))
    columns = {
        name: (d.asstr() if h5py.check_string_dtype(d.dtype) else d)[...].tolist()
        for name, d in file["values"].items()
    }
    values = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    out: list[Entry] = []
    at = 0
    columns_of = ("rows", "size", "replicates", "seconds", "copies")
    batches.setdefault("copies", np.ones_like(batches["rows"]))  # version 1 has none
    for rows, size, replicates, seconds, copies in zip(
        *(batches[n].tolist() for n in columns_of), strict=True
    ):
        mine = slice(at, at + rows)
        reasons = {
            (r, int(k)): words
            for r, text in enumerate(designs["reasons"][mine])
            for k, words in json.loads(text).items()
        }
        losses, cells = designs["losses"][mine, :replicates], designs["cells"][mine, :replicates]
        out.append(
            Entry(
                designs["point"][mine],
                designs["loss"][mine],
                losses,
                cells,
                reasons,
                size,
                replicates,
                seconds,
                values[mine],
                _slopes(file, len(out)),
                copies,
            )
        )
        at += rows
    if at != len(designs["point"]):
        raise ValueError(f"its batches have {at} designs, but it lists {len(designs['point'])}")
    return out


def _slopes(file: h5py.File, batch: int) -> Slopes | None:
    found = file.get(f"slopes/{batch}")
    return None if found is None else Slopes(found["gradient"][...], found["curvature"][...])

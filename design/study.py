"""A study: every evaluation of a search in one file, from which it goes on as if it had never
stopped.

    /             attributes: format, version, about (JSON: scene, parameters, target, method, …), torchfilm, torch
    /streams      (R,) streams of random numbers, one a replicate
    /batches/     rows, size, replicates, seconds: a row for each batch that was asked and told
    /designs/     point (N, D), loss (N,), losses (N, R), cells (N, R), NaN and 0 where a replicate was not grown; reasons, JSON by replicate
    /values/NAME  (N,) the parameters themselves

The file is written anew after each batch beside the old one and then takes its place, so that a
kill at any moment costs at most one batch. Files are data only; nothing in them is executed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

import torchfilm as tf
from design.parameters import Value
from torchfilm import checks

FORMAT, VERSION = "torchfilm study", 1


@dataclass(frozen=True, eq=False)
class Entry:
    """One batch: what was asked, and what was found. points (n, D), loss (n,), losses and cells (n,
    R); reasons by (row, replicate); size: share of the full size; replicates: how many were grown;
    seconds; values: the parameters of each point."""

    points: np.ndarray
    loss: np.ndarray
    losses: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    size: float
    replicates: int
    seconds: float
    values: Sequence[dict[str, Value]]

    @property
    def colonies(self) -> float:
        """Simulated, in colonies of full size: a smaller one counts by its share."""
        return len(self.points) * self.replicates * self.size


@dataclass(eq=False)
class Study:
    """The evaluations of a search, and the file that keeps them, if any.

    about: what they depend on, plain data; names: of the parameters; streams: of the replicates.
    """

    about: dict[str, Any]
    names: tuple[str, ...]
    streams: tuple[int, ...]
    path: Path | None = None
    entries: list[Entry] = field(default_factory=list)

    @property
    def colonies(self) -> float:
        """Simulated so far, in colonies of full size."""
        return sum(e.colonies for e in self.entries)

    @property
    def seconds(self) -> float:
        return sum(e.seconds for e in self.entries)

    def full(self) -> list[Entry]:
        """The batches at full size with all replicates, the only ones whose losses can be
        compared."""
        return [e for e in self.entries if self.is_full(e)]

    def is_full(self, entry: Entry) -> bool:
        """Whether a batch was grown to full size with all replicates."""
        return entry.size == 1.0 and entry.replicates == len(self.streams)

    def best(self) -> tuple[np.ndarray, float, np.ndarray] | None:
        """Point (D,), loss and losses (R,) of the best design that was grown to full size; the
        first of equals. None before there is one."""
        full = self.full()
        if not full:
            return None
        entry = min(full, key=lambda e: float(e.loss.min()))
        row = int(entry.loss.argmin())
        return entry.points[row], float(entry.loss[row]), entry.losses[row]

    def failures(self) -> list[tuple[str, int]]:
        """Why colonies failed and how many, the commonest reason first; told without its numbers,
        which differ from colony to colony."""
        words: dict[str, list[str]] = {}
        for entry in self.entries:
            for reason in entry.reasons.values():
                words.setdefault(re.sub(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", "#", reason), []).append(
                    reason
                )
        return [(alike[0], len(alike)) for alike in sorted(words.values(), key=len, reverse=True)]

    def convergence(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """After each batch: colonies and seconds spent so far, and the best loss yet (NaN before
        there is one), (K,) each."""
        colonies = np.cumsum([e.colonies for e in self.entries])
        seconds = np.cumsum([e.seconds for e in self.entries])
        lowest = [e.loss.min() if self.is_full(e) else np.inf for e in self.entries]
        best = np.minimum.accumulate(lowest) if lowest else np.empty(0)
        return colonies, seconds, np.where(np.isfinite(best), best, np.nan)

    def add(self, entry: Entry) -> None:
        """Note a batch, and write the file."""
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
                f"could not write {path}: {error}. Is the disk full? What was written before is"
                " safe; run the search again to go on."
            ) from error

    def _write_tables(self, file: h5py.File) -> None:
        replicates = len(self.streams)
        file["batches/rows"] = [len(e.points) for e in self.entries]
        for name in ("size", "replicates", "seconds"):
            file[f"batches/{name}"] = [getattr(e, name) for e in self.entries]
        wide = lambda x, fill: np.concatenate(
            [x, np.full((len(x), replicates - x.shape[1]), fill, x.dtype)], 1
        )
        file["designs/point"] = np.concatenate([e.points for e in self.entries])
        file["designs/loss"] = np.concatenate([e.loss for e in self.entries])
        file["designs/losses"] = np.concatenate([wide(e.losses, np.nan) for e in self.entries])
        file["designs/cells"] = np.concatenate([wide(e.cells, 0) for e in self.entries])
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
        """The study at a path, to go on with, or a new one. Raises InputError where the file is of
        another search."""
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
            shown = "; ".join(
                f"{n}: {study.about.get(n)!r} there, {about.get(n)!r} here" for n in differ
            )
            raise tf.InputError(
                f"{path} is the study of another search. {shown}. Give the study of this search, or"
                " another path for a new one."
            )
        return study

    @classmethod
    def read(cls, path: str | Path) -> Study:
        """A study from its file."""
        path = Path(path)
        if not path.is_file():
            raise checks.input_error(
                "study",
                str(path),
                "a study file",
                "That is a folder." if path.is_dir() else "No such file.",
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
                        f"{path} has format version {file.attrs['version']}, newer than this"
                        f" torchfilm reads ({VERSION}). Update torchfilm."
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


def _entries(file: h5py.File) -> list[Entry]:
    batches, designs = ({n: d[...] for n, d in file[g].items()} for g in ("batches", "designs"))
    columns = {
        name: (d.asstr() if h5py.check_string_dtype(d.dtype) else d)[...].tolist()
        for name, d in file["values"].items()
    }
    values = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    out, at = [], 0
    for rows, size, replicates, seconds in zip(
        *(batches[n].tolist() for n in ("rows", "size", "replicates", "seconds")), strict=True
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
            )
        )
        at += rows
    if at != len(designs["point"]):
        raise ValueError(f"its batches have {at} designs, and it lists {len(designs['point'])}")
    return out

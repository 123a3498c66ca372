"""The history of a search as a table: a row for each design of each batch, in the order in which
they were grown."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from design.entries import Entry
from torchfilm import checks

OWN = (
    "batch", "finals", "size", "replicates", "first_seed", "colonies", "loss", "failed", "reason",
    "cells",
)  # fmt: skip
NUMBERED = ("loss_", "goal_")


def history_of(
    names: Sequence[str], entries: Sequence[Entry], finals: Sequence[Entry]
) -> dict[str, list[Any]]:
    """Columns by name; see `Study.history`."""
    every = [*entries, *finals]
    named = _column_names(names)
    rows = [*_rows(named, entries, False), *_rows(named, finals, True)]
    replicates = max((e.replicates for e in every), default=0)
    count = max((e.goals.shape[1] for e in every if e.goals is not None), default=0)
    goals = [f"goal_{k}" for k in range(count)]
    columns = [*OWN, *named.values(), *goals, *(f"loss_{k}" for k in range(replicates))]
    return {name: [row.get(name, np.nan) for row in rows] for name in columns}


def _column_names(names: Sequence[str]) -> dict[str, str]:
    """The column of each parameter: its name, or where that is a column already, another."""
    return {n: f"parameter {n}" if n in OWN or n.startswith(NUMBERED) else n for n in names}


def _rows(
    named: Mapping[str, str], entries: Sequence[Entry], finals: bool
) -> Iterator[dict[str, Any]]:
    """named: the column of each parameter."""
    for batch, entry in enumerate(entries):
        for k, values in enumerate(entry.values):
            reasons = [why for (row, _), why in entry.reasons.items() if row == k]
            row = {
                "batch": batch,
                "finals": finals,
                "size": entry.size,
                "replicates": entry.replicates,
                "first_seed": entry.streams[0],
                "colonies": entry.colonies / len(entry.points),
                "loss": float(entry.loss[k]),
                "failed": len(reasons),
                "reason": reasons[0] if reasons else "",
                "cells": float(entry.cells[k].mean()),
                **{column: values[name] for name, column in named.items()},
                **{f"loss_{r}": float(x) for r, x in enumerate(entry.losses[k])},
            }
            if entry.goals is not None:
                row |= {f"goal_{g}": float(x) for g, x in enumerate(entry.goals[k])}
            yield row


def write_csv(path: str | Path, columns: dict[str, list[Any]]) -> None:
    """Write columns as a CSV file. Raises InputError for a file that is there already."""
    path = checks.file_path("history", path)
    if path.exists():
        raise checks.input_error("history", str(path), "a new file", "It is there already.")
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    checks.write_whole(path, text.getvalue())

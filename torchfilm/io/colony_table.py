"""The table of a run with one row per colony and frame: cells, deaths, means, parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.io.blocks import Block, blocks
from torchfilm.io.reading import dataset_names, read_dataset
from torchfilm.io.table import FIRST, OWN, SHAPE, Tables, of_fields
from torchfilm.state import FATES

if TYPE_CHECKING:
    from torchfilm.io.results import Results

TYPE = "cell_type"
LATE = 1e-9  # relative: an end at the time of a frame, by sums of steps that round differently


def colony_table(
    results: Results, frames: Sequence[int], internals: bool = False
) -> dict[str, np.ndarray]:
    """The columns, (frames · colonies) each, frame by frame, of all colonies in the order of the
    batch. internals: with the fields that serve the numerics."""
    tables = Tables(results, results.lineage(), internals)
    count = len(results.colony_id)
    times = results.times[list(frames)]
    columns = {
        "frame": np.repeat(np.asarray(frames), count),
        "time": np.repeat(times, count),
        "colony": np.tile(results.colony_id, len(frames)),
        "cells": results.counts[list(frames)].reshape(-1),
    }
    parts = [_of_block(tables, block) for block in blocks(results, frames)]
    columns["biovolume"] = np.concatenate([part.pop("biovolume") for part in parts])
    columns |= _types([part.pop(TYPE) for part in parts], results.type_names)
    columns |= _ends(tables, times)
    return columns | {n: np.concatenate([part[n] for part in parts]) for n in parts[0]}


def _of_block(tables: Tables, block: Block) -> dict[str, np.ndarray]:
    """Of some frames the volume of all cells, the numbers of cells of each type (rows, types),
    means, fields of colonies, and parameters."""
    results = tables.results
    cells, place = tables.of_cells(block)
    count = len(results.colony_id)
    size = count * len(block.frames)
    row = block.which * count + place
    of_colonies = _colony_fields(tables, block)
    number = np.bincount(row, minlength=size)
    total = lambda x: np.bincount(row, weights=x.astype(float), minlength=size)
    columns = {"biovolume": total(cells["volume"]), TYPE: np.zeros((size, 0), int)}
    if TYPE in cells and len(row):
        kinds = int(cells[TYPE].max()) + 1
        columns[TYPE] = np.bincount(row * kinds + cells[TYPE], minlength=size * kinds)
        columns[TYPE] = columns[TYPE].reshape(size, kinds)
    others = {"born", TYPE, *of_colonies, *FIRST, *(OWN - set(SHAPE))}
    for name, x in cells.items():
        if name not in others:
            none = np.full(size, np.nan)
            columns[f"mean.{name}"] = np.divide(total(x), number, out=none, where=number > 0)
    columns |= of_colonies
    values = tables.parameters(block, cells)
    return columns | {name: np.tile(x, len(block.frames)) for name, x in values.items()}


def _colony_fields(tables: Tables, block: Block) -> dict[str, np.ndarray]:
    """The fields of colonies at some frames, (rows,) each."""
    file, group = tables.results.file, "frames/colony"
    low, high = int(block.frames.min()), int(block.frames.max()) + 1
    found = {}
    for name in set(dataset_names(file, group)) - tables.hidden:
        values = read_dataset(file, f"{group}/{name}", slice(low, high))[block.frames - low]
        found[name] = values.reshape(-1, *values.shape[2:])
    return of_fields(found, {})


def _types(parts: Sequence[np.ndarray], names: Sequence[str]) -> dict[str, np.ndarray]:
    """The number of cells of each type, by its name, from those of each part, (rows, types)."""
    kinds = max(len(names), *(x.shape[1] for x in parts))
    each = np.concatenate([np.pad(x, ((0, 0), (0, kinds - x.shape[1]))) for x in parts])
    named = [*names, *map(str, range(len(names), kinds))]
    return {f"cells.{name}": each[:, k] for k, name in enumerate(named)}


def _ends(tables: Tables, times: np.ndarray) -> Mapping[str, np.ndarray]:
    """How many cells had ended until each of these times, by their fates, of those that occur."""
    tree, ids = tables.lineage, tables.results.colony_id
    place = np.argsort(ids)[np.searchsorted(np.sort(ids), tree.colony)]
    columns = {}
    for fate in FATES:
        mine = tree.fate == fate
        if mine.any():
            ended, where = tree.ended[mine], place[mine]
            rows = [np.bincount(where[ended <= t * (1 + LATE)], minlength=len(ids)) for t in times]
            columns[fate] = np.concatenate(rows)
    return columns

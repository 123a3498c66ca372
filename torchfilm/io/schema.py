"""What a results file must hold for its parts to be read: its attributes, its datasets and their
lengths; and what a frame must be for a run to go on from it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from torchfilm.io.layout import AT_CELLS, LINEAGE, LINEAGE_LATER
from torchfilm.tools.checks import InputError

if TYPE_CHECKING:
    from torchfilm.io.results import Results

WHOLE, NUMBER, ANY = "iu", "fiu", "fiub"  # kinds of NumPy's types
WORDS = {WHOLE: "whole numbers", NUMBER: "numbers", ANY: "numbers"}
# Of every file: what its entries are, and how many axes it has.
DATASETS = {
    "colony_id": (WHOLE, 1),
    **{f"cells/{n}": (WHOLE, 1) for n in ("uid", "parent", "colony")},
    **{f"cells/{n}": (NUMBER, 1) for n in ("length", "radius")},
    **{f"cells/{n}": (NUMBER, 2) for n in ("position", "axis")},
    **{f"frames/{n}": (WHOLE, 1) for n in ("first_row", "births", "ends", "step")},
    **{f"frames/{n}": (WHOLE, 2) for n in ("counts", "next_uid")},
    "frames/time": (NUMBER, 1),
    **{
        f"lineage/{t}/{n}": (WHOLE, 1)
        for t in LINEAGE
        for n in LINEAGE[t]
        if n not in LINEAGE_LATER
    },
}
GRID = {"origin": (NUMBER, 3), "shape": (WHOLE, 3), "first_voxel": (WHOLE, 1)}
OF_GROWTH = ("growth_rate", "division_threshold")  # fields without which no cell grows or divides
# How many rows the groups of a file have that belong to its complete frames.
ROWS = {
    "cells": "rows",
    AT_CELLS: "rows",
    "signals": "voxels",
    "lineage/births": "births",
    "lineage/ends": "ends",
    "frames": "frames",
    "frames/colony": "frames",
    "frames/grid": "frames",
}


def _is_recipe(found: Any) -> bool:
    two = isinstance(found, list) and len(found) == 2
    return found is None or (two and isinstance(found[0], str) and isinstance(found[1], dict))


def _are_spans(found: Any) -> bool:
    pair = lambda x: isinstance(x, list) and len(x) == 2 and all(map(_is_number, x))
    return isinstance(found, dict) and all(map(pair, found.values()))


def _is_number(found: Any) -> bool:
    return isinstance(found, (int, float)) and not isinstance(found, bool)


def _are_fields(found: Any) -> bool:
    five = lambda x: (
        isinstance(x, list)
        and len(x) == 5
        and isinstance(x[3], list)
        and all(isinstance(x[k], str) for k in (0, 1, 2, 4))
    )
    return isinstance(found, dict) and all(map(five, found.values()))


def _are_texts(found: Any) -> bool:
    return isinstance(found, list) and all(isinstance(x, str) for x in found)


# What the attributes hold as JSON. Those that files of earlier versions lack may be missing.
ATTRIBUTES: dict[str, Callable[[Any], bool]] = {
    "declared": _are_fields,
    "recipe": _is_recipe,
    "settings": lambda x: isinstance(x, dict),
    "accuracy": lambda x: isinstance(x, dict) and all(map(_is_number, x.values())),
    "walls": lambda x: isinstance(x, list) and all(isinstance(w, dict) for w in x),
    "periodic": _are_spans,
    "internal": _are_texts,
    "type_names": _are_texts,
    "earlier": lambda x: isinstance(x, list) and all(isinstance(run, dict) for run in x),
    "effects": lambda x: x is None or _are_texts(x),
    "code": lambda x: x is None or isinstance(x, (list, dict, str)),
}
NEEDED = ("declared", "recipe")


def damaged(file: h5py.File, what: str) -> InputError:
    """The error for a file that is not whole."""
    return InputError(f"{file.filename} is damaged: {what}. Use another copy of it.")


def check_attributes(file: h5py.File) -> None:
    """Raise InputError for an attribute of the scene that is missing or of another kind."""
    for name, fits in ATTRIBUTES.items():
        if name not in file.attrs:
            if name in NEEDED:
                raise damaged(file, f"its {name!r} is missing")
            continue
        try:
            sound = fits(json.loads(file.attrs[name]))
        except (TypeError, ValueError, RecursionError):
            sound = False
        if not sound:
            raise damaged(file, f"its {name!r} is not what torchfilm writes")
    for name, least in (("dim", 2), ("seed", 0), ("every", 1), ("dt", 0)):
        value = file.attrs.get(name)
        if not isinstance(value, (int, float, np.number)) or not least <= value < np.inf:
            raise damaged(file, f"its {name!r} is {value}")
    if file.attrs.get("dtype") not in ("float32", "float64"):
        raise damaged(file, f"its 'dtype' is {file.attrs.get('dtype')!r}")


Shapes = dict[str, tuple[str, tuple[int, ...]]]  # kind of type, and shape, by name


def check_datasets(file: h5py.File) -> Shapes:
    """The kinds and shapes of torchfilm's own datasets, without what others have added. Raises
    InputError for one that is missing or of another kind."""
    wanted, found = dict(DATASETS), _shapes(file)
    declared = json.loads(file.attrs["declared"])
    for scope, group in (("cell", "cells"), ("colony", "frames/colony")):
        wanted |= {f"{group}/{n}": (ANY, 0) for n, about in declared.items() if about[2] == scope}
    if file.get("signals"):
        wanted |= {f"frames/grid/{n}": about for n, about in GRID.items()}
        wanted |= {n: (NUMBER, 1) for n in found if n.startswith("signals/")}
    for name, (kinds, axes) in wanted.items():
        if name not in found:
            raise damaged(file, f"its {name!r} is missing")
        kind, shape = found[name]
        if kind not in kinds or (axes and len(shape) != axes) or not shape:
            along = "" if not axes else f" along {axes} axes"
            raise damaged(file, f"its {name!r} does not hold {WORDS[kinds]}{along}")
    colonies, dim = found["colony_id"][1][0], int(file.attrs["dim"])
    for name in ("frames/counts", "frames/next_uid", "stream"):
        if name in found and found[name][1][-1] != colonies:
            raise damaged(file, f"its {name!r} is not of {colonies} colonies")
    for name in ("cells/position", "cells/axis"):
        if found[name][1][1] != dim:
            raise damaged(file, f"its {name!r} is not of {dim} dimensions")
    return {name: found[name] for name in wanted}


def _shapes(file: h5py.File) -> Shapes:
    """The kinds and shapes of the datasets in the groups of a results file."""
    found: Shapes = {}
    for group in ("/", *ROWS):
        parts = file.get(group, {})
        if not isinstance(parts, (h5py.Group, dict)):
            raise damaged(file, f"its {group!r} is no group")
        for name, part in parts.items():
            if isinstance(part, h5py.Dataset):
                key = name if group == "/" else f"{group}/{name}"
                found[key] = part.dtype.kind, part.shape
    return found


def check_lengths(file: h5py.File, shapes: Shapes, sizes: Mapping[str, int]) -> None:
    """Raise InputError for a dataset that is too short. shapes: of those that must be there. sizes:
    of the complete part of the file, as `committed` tells them."""
    for name, (_, shape) in shapes.items():
        group = name.rpartition("/")[0]
        if group and shape[0] < (least := sizes[ROWS[group]]):
            raise damaged(file, f"its {name!r} has {shape[0]} rows, and should have {least}")


def check_frame(results: Results, frame: int, cells: Mapping[str, np.ndarray]) -> None:
    """Raise InputError for a frame from which no run can go on. cells: its columns."""
    counts, uid, place = results.counts[frame], cells["uid"], cells["colony"]
    owners = np.repeat(np.arange(len(counts)), counts)
    wrong = ""
    if not np.array_equal(owners, place):
        wrong = "its cells are not those that its colonies count"
    elif len(np.unique(np.stack([place, uid]), axis=1).T) < len(uid):
        wrong = "two cells of a colony have one number"
    elif len(uid) and (uid.min() < 0 or (uid >= results.next_uid(frame)[place]).any()):
        wrong = "the numbers of new cells would be those of cells that there are"
    elif not all(np.isfinite(cells[n]).all() for n in ("position", "axis", "length", "radius")):
        wrong = "the place, axis, length or radius of a cell is not finite"
    elif not ((cells["length"] >= 0).all() and (cells["radius"] > 0).all()):
        wrong = "the length or radius of a cell is below 0"
    elif any(np.isnan(cells[n]).any() for n in OF_GROWTH if n in cells):
        wrong = "a cell's growth rate or division threshold is no number"
    elif not (np.isfinite(results.times[frame]) and results.steps[frame] >= 0):
        wrong = "its time or step is none"
    if wrong:
        raise damaged(results.file, f"in frame {frame} {wrong}")

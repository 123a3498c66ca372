"""Colonies of a run laid side by side: one shift for each, the same in all frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.tools import checks

if TYPE_CHECKING:
    from torchfilm.io.results import Results

GAP = 0.1  # between colonies, as a share of their width


@dataclass(frozen=True, eq=False)
class SideBySide:
    """Colonies by their places in the batch (b,), and their shifts (b, 3), µm: the first stays
    where it is, and each next one is moved by whole voxels of the medium, in rows as on a sheet.

    low, high: corners (3,) of the lattice of voxels that covers the grids of all colonies in all
    frames, as counts of voxels from `origin` (3,), µm; None in a run without a medium.
    """

    places: np.ndarray
    shift: np.ndarray
    origin: np.ndarray | None = None
    low: np.ndarray | None = None
    high: np.ndarray | None = None


def chosen_colonies(results: Results, colonies: Sequence[int] | None) -> np.ndarray:
    """The places (b,) of colonies given by their ids; of all without any."""
    ids = results.colony_id.tolist()
    if colonies is None:
        return np.arange(len(ids))
    if not isinstance(colonies, (list, tuple, range)) or not len(colonies):
        raise checks.input_error("colonies", colonies, "a list of at least one colony's id")
    for colony in colonies:
        if colony not in ids:
            known = ", ".join(map(str, ids))
            raise checks.input_error("colonies", list(colonies), f"of the run's colonies: {known}")
    if len(set(colonies)) != len(colonies):
        raise checks.input_error("colonies", list(colonies), "different colonies")
    return np.asarray([ids.index(colony) for colony in colonies])


def side_by_side(results: Results, places: np.ndarray, frames: Sequence[int]) -> SideBySide:
    """The layout of some colonies for some frames."""
    low, high = extent(results, places, frames)
    columns = math.ceil(math.sqrt(len(places)))
    row, column = np.divmod(np.arange(len(places)), columns)
    width = (high - low) * (1 + GAP)
    shift = np.stack([column * width[0], -row * width[1], 0.0 * row], 1)
    if not results.signal_names:
        return SideBySide(places, shift)
    grids = [results.grid(k) for k in frames]
    spacing, origin = grids[0][2], grids[0][0][places[0]]
    # grids grow by whole voxels, so that one lattice serves a colony in all frames
    corner = grids[0][0][places] + shift
    shift = shift + np.round((corner - origin) / spacing) * spacing - (corner - origin)
    start = np.stack([np.round((g[0][places] + shift - origin) / spacing) for g in grids])
    stop = start + np.stack([g[1][places] for g in grids])
    low, high = start.min((0, 1)).astype(np.int64), stop.max((0, 1)).astype(np.int64)
    # two voxels along x and y at least: readers take an image of fewer for one of another kind
    return SideBySide(places, shift, origin, low, np.maximum(high, low + np.array([2, 2, 1])))


def extent(
    results: Results, places: np.ndarray, frames: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The corners (3,), µm, of the box around the cells and the grids of some colonies in some
    frames. A colony of which there is nothing has a box of 1 µm."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in frames:
        found = results.frame(k)
        mine = np.isin(found["colony"], places)
        reach = found["length"][mine] / 2 + found["radius"][mine]
        at = found["position"][mine]
        if len(at):
            dim = at.shape[1]
            low[:dim] = np.minimum(low[:dim], (at - reach[:, None]).min(0))
            high[:dim] = np.maximum(high[:dim], (at + reach[:, None]).max(0))
        if results.signal_names:
            origin, shape, spacing = results.grid(k)
            low = np.minimum(low, origin[places].min(0))
            high = np.maximum(high, (origin + shape * spacing)[places].max(0))
    empty = ~(low < high)
    return np.where(empty, 0.0, low), np.where(empty, 1.0, high)

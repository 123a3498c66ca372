"""Quantities of cells, for measures, and how they vary in space: along a coordinate, and with the
distance of two cells."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfilm.state import CELL, OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups

EQUAL = 1e-20  # a variance, relative to the mean square, that roundings of many cells' mean make


def quantity(measure: str, state: State, name: object) -> Tensor:
    """One number for each cell, (N,) float64: a field, "length", "radius", "volume", a signal at
    the cells as "out.NAME", or the numbers themselves. Raises InputError, which names the measure,
    for anything else."""
    if isinstance(name, Tensor):
        if name.shape != (state.cells,) or name.is_complex():
            rule = f"({state.cells},), one number for each cell"
            raise checks.input_error(f"{measure}(name)", tuple(name.shape), rule)
        return name.double()
    contact = state.contact()
    fields = [n for n, f in state.declared.items() if f.scope == CELL and not f.internal]
    known = {n: state.fields[n] for n in fields if state.fields[n].dim() == 1}
    known |= {} if contact is None else {OUTSIDE + n: x for n, x in contact.found.items()}
    known |= {"length": state.length, "radius": state.radius, "volume": state.volume}
    if not isinstance(name, str) or name not in known:
        raise checks.input_error(f"{measure}(name)", name, "one of " + ", ".join(map(repr, known)))
    return known[name].double()


def kinds_of(measure: str, state: State, name: object) -> Tensor:
    """A field of whole numbers of the cells, (N,) int64. Raises InputError for other fields."""
    known = [n for n, f in state.declared.items() if f.scope == CELL and not f.internal]
    if not isinstance(name, str) or name not in known:
        hint = (
            "" if name != "cell_type" else "Give the first cells a type: Cells(…, cell_type=[0])."
        )
        raise checks.input_error(f"{measure}(name)", name, f"a field of the cells: {known}", hint)
    value = state.fields[name]
    if value.dim() != 1 or not bool((value == value.round()).all()):
        raise checks.input_error(f"{measure}(name)", name, "a field of one whole number for a cell")
    return value.long()


def checked_edges(measure: str, edges: Any, least: float = -torch.inf) -> list[float]:
    """Ascending edges of bins, µm. Raises InputError, which names the measure, for others."""
    given = edges.tolist() if isinstance(edges, Tensor) else edges
    if not isinstance(given, Iterable):
        rule = "two or more, µm, ascending"
        raise checks.input_error(f"{measure}(edges)", edges, rule, "Such as range(0, 21, 2).")
    found = [checks.number(f"{measure}(edges)", e, least=least) for e in given]
    if len(found) < 2 or any(b <= a for a, b in itertools.pairwise(found)):
        raise checks.input_error(f"{measure}(edges)", list(edges), "two or more, µm, ascending")
    return found


def binned_mean(groups: Groups, value: Tensor, place: Tensor, edges: Sequence[float]) -> Tensor:
    """The mean of (N,) over the members of each group in each bin, (G, K); NaN in a bin without
    any."""
    bins, count = len(edges) - 1, groups.size * (len(edges) - 1)
    at = torch.bucketize(place.detach().contiguous(), place.new_tensor(edges), right=True) - 1
    inside = torch.nonzero((at >= 0) & (at < bins)).squeeze(1)
    of_bins = Groups((groups.owner * bins + at).index_select(0, inside), count)
    total = of_bins.sum(value.index_select(0, inside))
    return (total / of_bins.counts).view(groups.size, bins)


def pair_correlation(state: State, value: Tensor, edges: Sequence[float]) -> Tensor:
    """See `measure.correlation`; (B, K)."""
    found = np.full((state.colonies, len(edges) - 1), np.nan)
    # a bin holds its lower edge, and not its upper one
    limits = np.nextafter(np.array(edges), -np.inf)
    counts = state.counts.tolist()
    space, box = state.space, None
    where = state.position.double()
    if space is not None:
        period = where.new_tensor(space.period)  # 0 along an axis without faces
        where = space.inside(where) - where.new_tensor(space.low)
        # the difference may be rounded up to a whole period
        where = torch.where((period > 0) & (where >= period), torch.zeros_like(where), where)
        box = period.cpu().numpy()
    parts = zip(value.cpu().split(counts), where.cpu().split(counts), strict=True)
    for colony, (own, place) in enumerate(parts):
        if not len(own):
            continue
        apart = (own - own.mean()).numpy()
        variance = np.square(apart).mean()
        if variance <= EQUAL * float(own.square().mean()):  # the mean of equal numbers is rounded
            continue
        tree = cKDTree(place.numpy(), boxsize=box)
        sums = tree.count_neighbors(tree, limits, weights=(apart, apart), cumulative=False)
        pairs = tree.count_neighbors(tree, limits, cumulative=False)
        if edges[0] == 0.0:  # pairs at one place, but for each cell with itself
            sums[1] += sums[0] - np.square(apart).sum()
            pairs[1] += pairs[0] - len(apart)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.where(pairs[1:] > 0, sums[1:] / pairs[1:], np.nan)
        found[colony] = means / variance
    return value.new_tensor(found)

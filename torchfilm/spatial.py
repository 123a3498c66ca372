"""Quantities of cells, for measures, and how they vary in space: along a coordinate, and with the
distance of two cells."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchfilm.state import CELL, OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups

BLOCK = 2048  # cells whose distances to all others of their colony are in memory at once


def quantity(measure: str, state: State, name: object) -> Tensor:
    """One number for each cell, (N,) float64: a field, a signal at the cells as "out.NAME", or the
    numbers themselves. Raises InputError, which names the measure, for anything else."""
    if isinstance(name, Tensor):
        if name.shape != (state.cells,) or name.is_complex():
            rule = f"({state.cells},), one number for each cell"
            raise checks.input_error(f"{measure}(name)", tuple(name.shape), rule)
        return name.double()
    contact = state.contact()
    fields = [n for n, f in state.declared.items() if f.scope == CELL and not f.internal]
    known = {n: state.fields[n] for n in fields if state.fields[n].dim() == 1}
    known |= {} if contact is None else {OUTSIDE + n: x for n, x in contact.found.items()}
    known |= {"length": state.length, "radius": state.radius}
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
    found = [checks.number(f"{measure}(edges)", e, least=least) for e in edges]
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
    limits, bins = value.new_tensor(edges), len(edges) - 1
    found = value.new_full((state.colonies, bins), torch.nan)
    counts = state.counts.tolist()
    parts = zip(value.split(counts), state.position.double().split(counts), strict=True)
    for colony, (own, place) in enumerate(parts):
        if not len(own):
            continue
        apart = own - own.mean()
        sums, pairs = value.new_zeros(bins), value.new_zeros(bins)
        for first in range(0, len(own), BLOCK):
            rows = slice(first, first + BLOCK)
            distance = _distances(state, place[rows], place)
            at = torch.bucketize(distance, limits, right=True) - 1
            at[torch.arange(len(at)), torch.arange(first, first + len(at))] = -1  # with itself
            inside = (at >= 0) & (at < bins)
            product = (apart[rows, None] * apart)[inside]
            sums += torch.bincount(at[inside], product, minlength=bins)
            pairs += torch.bincount(at[inside], minlength=bins)
        found[colony] = sums / pairs / apart.square().mean()
    return found


def _distances(state: State, one: Tensor, other: Tensor) -> Tensor:
    """Between places (n, d) and (m, d), (n, m) µm; in a periodic space to the nearest image."""
    square = one.new_zeros(len(one), len(other))
    for k in range(one.shape[1]):
        x = one[:, k, None] - other[:, k]
        x = x if state.space is None else x + state.space.shift_along(k, x)
        square += x * x
    return square.sqrt()

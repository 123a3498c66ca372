"""Quantities in space: along a coordinate, by distance, and between neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.measure.of_a_state import of_a_state
from torchfilm.measure.shape import below_edge, below_top, colony_centre
from torchfilm.physics.nearby import pairs_within
from torchfilm.spatial import EQUAL, binned_mean, checked_edges, pair_correlation, quantity
from torchfilm.state import State
from torchfilm.tools import checks, row_checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread
from torchfilm.tools.vectors import safe_norm


@of_a_state
def profile(
    state: State, name: str | Tensor, edges: row_checks.Numbers, *, along: str | Tensor = "x"
) -> Tensor:
    """The mean of a quantity over the cells of each colony in bins along a coordinate, (B, K)
    float64; NaN in a bin without cells.

    name: a field of the cells, "length", "radius", "volume", a signal at them as "out.NAME", or
    numbers, (N,). edges: of the bins, K + 1 of them, µm, ascending; a bin has its lower edge, not
    its upper one. along: "x", "y", "z", "radius" from the colony's centre (of volume) in the x–y
    plane, "edge" as `below_edge` and "top" as `below_top` have it, or a coordinate of your own,
    (N,)."""
    value, limits = quantity("profile", state, name), checked_edges("profile", edges)
    return binned_mean(state.groups, value, place_along("profile", state, along), limits)


def place_along(measure: str, state: State, along: str | Tensor) -> Tensor:
    """The coordinate of each cell, (N,) µm, as `profile` has it."""
    if isinstance(along, Tensor):
        return quantity(measure, state, along)
    checks.choice(f"{measure}(along)", along, (*"xyz"[: state.dim], "radius", "edge", "top"))
    if along in ("edge", "top"):
        return below_edge(state) if along == "edge" else below_top(state)
    if along != "radius":
        return state.position[:, "xyz".index(along)]
    apart = state.position - colony_centre(state).index_select(0, state.colony)
    return safe_norm(apart[:, :2].double().T)


@of_a_state
@torch.no_grad()
def correlation(state: State, name: str | Tensor, edges: row_checks.Numbers) -> Tensor:
    """How alike a quantity y is in two cells of a colony by the distance of their centres, (B, K)
    float64: the mean of (yᵢ − ȳ)(yⱼ − ȳ) over the pairs in each bin of distances, over the variance
    of y. 1 for pairs as alike as a cell is itself, 0 where nothing is shared (−1/(n − 1) of n
    cells); its first maximum beyond 0 is at 1.12 wavelengths of stripes in the plane, where it
    follows J₀(2πr/λ), and at one in a narrow channel. NaN without pairs or variance.

    name: as for `profile`. edges: of the bins, K + 1 of them, µm, ascending from 0 or more. In a
    periodic space distances are those to the nearest image."""
    value = quantity("correlation", state, name)
    return pair_correlation(state, value, checked_edges("correlation", edges, 0.0))


@of_a_state
@torch.no_grad()
def moran(state: State, name: str | Tensor, gap: float) -> Tensor:
    """Moran's I of a quantity y between neighbours, (B,) float64: the mean of (yᵢ − ȳ)(yⱼ − ȳ) over
    a colony's pairs whose surfaces are at most `gap` µm apart, over the variance of y (Biometrika
    37, 17, 1950). 1 where neighbours are alike, −1/(n − 1) on average where n cells have been
    shuffled; NaN without pairs or variance. name: as for `profile`."""
    value = quantity("moran", state, name)
    first, second, _ = neighbours(state, gap)
    apart = value - (state.groups.sum(value) / state.counts).index_select(0, state.colony)
    pairs = Groups(state.colony.index_select(0, first), state.colonies)
    together = apart.index_select(0, first) * apart.index_select(0, second)
    variance = state.groups.sum(apart * apart) / state.counts
    found = pairs.sum(together) / pairs.counts / variance
    # the mean of equal numbers is rounded
    square = state.groups.sum(value * value) / state.counts
    return torch.where(variance > EQUAL * square, found, torch.nan)


@of_a_state
@one_torch_thread()
@torch.no_grad()
def neighbours(state: State, gap: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of cells of one colony whose surfaces are at most `gap` µm apart, each pair once.

    Returns first and second, (P,) int64, and the distance of their centres, (P,) float64 µm. A
    colony's pairs and their order do not depend on the rest of the batch. In a periodic space cells
    at opposite faces are neighbours, too.
    """
    checks.number("neighbours(gap)", gap, least=0.0)
    cells = state.position, state.axis, state.length, state.radius
    i, j = pairs_within(*cells, state.groups, gap, state.space)
    between = (state.position.index_select(0, j) - state.position.index_select(0, i)).T
    if state.space is not None:
        between = between + state.space.shift(between)
    return i, j, safe_norm(between)

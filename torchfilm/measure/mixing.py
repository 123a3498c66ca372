"""How strains are mixed: numbers, heterozygosity, clusters, and neighbours of one kind."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.measure.of_a_state import of_a_state
from torchfilm.measure.space import neighbours, place_along
from torchfilm.spatial import checked_edges, kinds_of
from torchfilm.state import State
from torchfilm.tools import checks, row_checks
from torchfilm.tools.connected import components
from torchfilm.tools.ragged import order_within


@of_a_state
@torch.no_grad()
def strains(
    state: State, name: str = "cell_type", *, kinds: row_checks.Numbers | None = None
) -> dict[int, Tensor]:
    """How many cells of each kind a colony has: (B,) int64 by the values of a field of whole
    numbers, such as the cell type or a neutral label that daughters inherit. kinds: of which to
    tell; None: of all that some colony has, so that one that has died out everywhere is not
    among them."""
    kind = kinds_of("strains", state, name)
    count = lambda k: torch.bincount(state.colony[kind == k], minlength=state.colonies)
    wanted = kind.unique().tolist() if kinds is None else kinds
    return {checks.integer("kinds", k, least=-(2**63)): count(k) for k in wanted}


@of_a_state
@torch.no_grad()
def heterozygosity(
    state: State,
    name: str = "cell_type",
    *,
    edges: row_checks.Numbers | None = None,
    along: str | Tensor = "radius",
) -> Tensor:
    """The probability that two cells drawn at random, with replacement, are of different kinds,
    1 − Σ p², of each colony: (B,) float64. 0 where one kind is fixed; NaN without cells.

    name: as for `strains`. edges: of bins, µm, ascending, R + 1 of them: then it is that of each
    bin, (B, R), NaN in one without cells (as in Hallatschek et al., PNAS 104, 19926, 2007). along:
    as for `profile`, such as "y" for a front that runs along y, or (N,) distances from where the
    colony began."""
    kind = kinds_of("heterozygosity", state, name)
    rings, ring = 1, torch.zeros_like(state.colony)
    if edges is not None:
        limits = checked_edges("heterozygosity", edges)
        place = place_along("heterozygosity", state, along).contiguous()
        rings = len(limits) - 1
        ring = torch.bucketize(place, place.new_tensor(limits), right=True) - 1
    inside = (ring >= 0) & (ring < rings)
    bins = (state.colony * rings + ring)[inside]
    count = lambda x: torch.bincount(x, minlength=state.colonies * rings).double()
    total, kept = count(bins), kind[inside]
    squares = torch.zeros_like(total)
    for k in kept.unique().tolist():
        squares += (count(bins[kept == k]) / total) ** 2
    found = torch.where(total > 0, 1.0 - squares, torch.nan).reshape(state.colonies, rings)
    return found[:, 0] if edges is None else found


@of_a_state
@torch.no_grad()
def clusters(state: State, gap: float, name: str | None = None) -> Tensor:
    """Which cluster each cell belongs to, (N,) int64: cells hang together where their surfaces are
    at most `gap` µm apart. Clusters are numbered from 0 in each colony, the largest first, and of
    equal ones that with the first cell.

    name: a field of whole numbers, as for `strains`: then only cells of one kind hang together.
    """
    first, second, _ = neighbours(state, gap)
    if name is not None:
        kind = kinds_of("clusters", state, name)
        alike = kind[first] == kind[second]
        first, second = first[alike], second[alike]
    of = components(first, second, state.cells)
    sizes = torch.bincount(of)
    # their first cells: of several writes to one place torch keeps any, of a minimum the least
    number = torch.arange(state.cells, device=state.device)
    begin = number.new_full((len(sizes),), state.cells).scatter_reduce(0, of, number, "amin")
    order = order_within(-sizes, begin)
    order = order[torch.argsort(state.colony[begin[order]], stable=True)]
    colony = state.colony[begin[order]]
    place = torch.arange(len(order), device=state.device)
    rank = torch.empty_like(place)
    rank[order] = place - torch.searchsorted(colony, colony)
    return rank[of]


@of_a_state
@torch.no_grad()
def alike_neighbours(state: State, gap: float, name: str = "cell_type") -> Tensor:
    """The share of a colony's pairs of neighbours, at most `gap` µm apart, that are of one kind:
    (B,) float64, NaN without pairs. Kinds of one size that are well mixed come to 1 −
    `heterozygosity`, but for 1/N, and kinds that have sorted to nearly 1; large cells beside small
    ones have more neighbours each. name: a field of whole numbers, as for `strains`.
    """
    kind = kinds_of("alike_neighbours", state, name)
    first, second, _ = neighbours(state, gap)
    where = state.colony[first]
    count = lambda x: torch.bincount(x, minlength=state.colonies).double()
    return count(where[kind[first] == kind[second]]) / count(where)

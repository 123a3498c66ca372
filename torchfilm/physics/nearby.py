"""Pairs of cells that are near each other, and their gaps: for measures, rules and checks."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.physics.contacts import Capsules, contact_gaps
from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.space import PeriodicSpace, near_images


@torch.no_grad()
def gaps_nearby(
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony: Tensor,
    colonies: int,
    within: float = 0.0,
    space: PeriodicSpace | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of one colony that may be within `within` µm, and their gaps, in float64.

    position, axis: (N, d). length, radius: (N,). colony: (N,) int64. space: as of `Capsules`; of
    two cells several images of which are near, the gap is the least. Returns first, second and gap,
    each (P,).
    """
    position, axis, length, radius = (x.double() for x in (position, axis, length, radius))
    cells = position, axis, length, radius, colony, colonies, within
    if space is None or not colony.numel():
        first, second = Neighbourhood(*cells).pairs()
        return first, second, contact_gaps(_capsules(position, axis, length, radius), first, second)
    images, first, second = near_images(space, *cells)
    first, second = images.distinct(first, second)
    of_images = (x.index_select(0, images.cell) for x in (axis, length, radius))
    gap = contact_gaps(_capsules(images.position, *of_images), first, second)
    i, j = images.cells_of(first, second)
    count = length.numel()
    key, place = torch.unique(
        torch.minimum(i, j) * count + torch.maximum(i, j), return_inverse=True
    )
    least = gap.new_full(key.shape, torch.inf).scatter_reduce(0, place, gap, "amin")
    return key // count, key % count, least


def pairs_within(
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony: Tensor,
    colonies: int,
    gap: float,
    space: PeriodicSpace | None = None,
) -> tuple[Tensor, Tensor]:
    """Pairs of one colony whose surfaces are less than `gap` µm apart: first and second, (P,). The
    rest as for `gaps_nearby`."""
    cells = position, axis, length, radius, colony, colonies
    first, second, apart = gaps_nearby(*cells, within=gap, space=space)
    near = torch.nonzero(apart < gap).squeeze(1)
    return first.index_select(0, near), second.index_select(0, near)


def _capsules(position: Tensor, axis: Tensor, length: Tensor, radius: Tensor) -> Capsules:
    return Capsules(position.T.contiguous(), axis.T.contiguous(), 0.5 * length, radius)

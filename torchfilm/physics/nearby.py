"""Pairs of cells that are near each other, and their gaps: for measures, rules and checks."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.compiled import DEGREES
from torchfilm.physics.contacts import Capsules, contact_gaps
from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.space import PeriodicSpace, near_images
from torchfilm.tools.numba_calls import as_array, unavailable
from torchfilm.tools.ragged import Groups

PAIRS_EACH = 4  # for which there is room at first, a cell
_called: set[int] = set()  # dimensions in which the kernel has been called


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


@torch.no_grad()
def pairs_within(
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    groups: Groups,
    within: float,
    space: PeriodicSpace | None = None,
) -> tuple[Tensor, Tensor]:
    """Pairs of one colony whose surfaces are at most `within` µm apart: first and second, (P,), by
    a kernel where there can be one. groups: the cells of each colony, which stand side by side. The
    rest as for `gaps_nearby`. A colony has the same pairs in the same order whatever the batch. The
    kernel finds none in a colony with numbers that are not finite; torch refuses these."""
    cells = position, axis, length, radius
    if position.device.type != "cpu" or space is not None or unavailable():
        i, j, gap = gaps_nearby(*cells, groups.owner, groups.size, within, space)
        keep = torch.nonzero(gap <= within).squeeze(1)
        return i.index_select(0, keep), j.index_select(0, keep)
    from torchfilm.kernels.compiling import first_call
    from torchfilm.kernels.memory import kept
    from torchfilm.kernels.nearby import close_pairs

    dim, count, found = position.shape[1], len(length), np.zeros(1, np.int64)
    x, along, half, wide = (as_array(v, torch.float64) for v in (position, axis, length, radius))
    given = groups.begin.numpy(), x, along, 0.5 * half, wide, float(within)
    size = PAIRS_EACH * count
    while True:
        first, second = np.empty((2, size), np.int64)
        name = f"neighbours, {dim}-D"
        with nullcontext() if dim in _called else first_call(name, f"{name}, some seconds"):
            kept.call(close_pairs, *given, first, second, found, DEGREES[dim])
        _called.add(dim)
        if found[0] <= size:
            one, other = (torch.from_numpy(side[: found[0]]) for side in (first, second))
            return one, other
        size = int(found[0])


def _capsules(position: Tensor, axis: Tensor, length: Tensor, radius: Tensor) -> Capsules:
    return Capsules(position.T.contiguous(), axis.T.contiguous(), 0.5 * length, radius)

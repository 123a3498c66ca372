"""The check that the first cells of a colony lie apart."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.physics.contacts import gaps_nearby
from torchfilm.tools.warn_once import warn

# Centres nearer than this share of a radius count as one place.
SAME_PLACE = 1e-6


@torch.no_grad()
def check_apart(
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony: Tensor,
    colony_id: Tensor,
    uid: Tensor,
) -> None:
    """Warn, once for all pairs, if two cells of a colony have the same centre, or overlap by more
    than a radius (the smaller one of the two).

    position, axis (N, d); length, radius (N,) µm; colony (N,) int64, place in the batch; colony_id
    (B,); uid (N,). Messages name cells by uid and colonies by id.
    """
    if len(uid) <= 1:
        return
    i, j, gap = gaps_nearby(position, axis, length, radius, colony, len(colony_id))
    between = (position.index_select(0, i) - position.index_select(0, j)).double()
    least = torch.minimum(radius.index_select(0, i), radius.index_select(0, j)).double()

    def name(pair: Tensor) -> str:
        first, second = int(i[pair]), int(j[pair])
        return (
            f"cells {int(uid[first])} and {int(uid[second])} of colony"
            f" {int(colony_id[int(colony[first])])}"
        )

    deep = torch.nonzero(-gap > least).squeeze(1)
    if not deep.numel():
        return
    same = deep[(between * between).sum(1)[deep] <= (SAME_PLACE * least[deep]) ** 2]
    if same.numel():
        at = [round(x, 3) for x in position[int(i[same[0]])].tolist()]
        found = (
            f"{name(same[0])} start at the same place, {at} (such pairs: {same.numel()}). Is a cell"
            " listed twice? Delete one of each pair, or move it."
        )
    else:
        worst = deep[torch.argmin(gap[deep])]
        found = (
            f"{name(worst)} start {-float(gap[worst]):.3g} µm deep in one another (pairs that"
            f" overlap by over a radius: {deep.numel()}). The first steps may push them through one"
            " another. Push the cells apart by Cells.relaxed(); or check the unit of the table"
            " (µm) and its lengths (of the centreline, without caps)."
        )
    warn(found, category=RuntimeWarning)

"""The checks that the first cells of a colony lie apart, have room between walls, and lie not in
them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfilm.physics.contacts import gaps_nearby
from torchfilm.physics.surfaces import FlatSurface, Surface
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


@torch.no_grad()
def check_room(surfaces: Sequence[Surface], position: Tensor, radius: Tensor, ids: Tensor) -> None:
    """Warn where a cell is wider than what two hard, parallel planes leave it.

    position (N, d); radius (N,) µm; ids (N,), of the cells' colonies.
    """
    flat = [s for s in surfaces if isinstance(s, FlatSurface) and not s.wall.yields]
    for one, other in itertools.combinations(flat, 2):
        (near, way), (far, back) = (s.gap_of_points(position, ids) for s in (one, other))
        width, opposite = near + far, (way * back).sum(0) < -1 + 1e-9
        narrow = torch.nonzero(opposite & (width < 2 * radius * (1 - 1e-6))).squeeze(1)
        if narrow.numel():
            k = int(narrow[0])
            names = dict.fromkeys(type(s.wall).__name__ for s in (one, other))
            warn(
                f"{' and '.join(names)}: {float(width[k]):.3g} µm between two hard sides, too"
                f" narrow for a cell that is {2 * float(radius[k]):.3g} µm wide: it will lie in"
                " both. Place them farther apart, or give them a stiffness."
            )
            return


@torch.no_grad()
def check_inside(
    surfaces: Sequence[Surface], position: Tensor, axis: Tensor, length: Tensor, radius: Tensor,
    ids: Tensor, uid: Tensor,
) -> None:  # fmt: skip
    """Warn where a cell lies a radius deep, or deeper, in a hard wall.

    position, axis (N, d); length, radius (N,) µm; ids (N,), of the cells' colonies; uid (N,).
    """
    axis, half = axis.double(), 0.5 * length.double()
    for surface in surfaces:
        if surface.wall.yields:
            continue
        s = surface.deepest(position, axis, half, ids)
        behind = -surface.gap_of_points(position + s.unsqueeze(1) * axis, ids)[0]
        deep = torch.nonzero(behind >= -SAME_PLACE * radius).squeeze(1)
        if not deep.numel():
            continue
        k = int(deep[behind[deep].argmax()])
        warn(
            f"{type(surface.wall).__name__}: cell {int(uid[k])} of colony {int(ids[k])} starts"
            f" {float(behind[k] + radius[k]):.3g} µm deep in it (cells at least a radius deep:"
            f" {deep.numel()}). The first steps move it out, unless another wall is in the way:"
            " then it stays. Move it, make it shorter, or make room.",
            category=RuntimeWarning,
        )
        return

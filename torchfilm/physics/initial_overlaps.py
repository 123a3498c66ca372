"""The checks that the first cells of a colony lie apart, and have room between walls."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfilm.physics.nearby import gaps_nearby
from torchfilm.physics.space import PeriodicSpace
from torchfilm.physics.surfaces import FlatSurface, RoundSurface, Surface, per_cell
from torchfilm.tools.warn_once import warn

# Centres nearer than this share of a radius count as one place.
SAME_PLACE = 1e-6
# The part of an axis along a plane on which the cell stands, but for rounding.
ACROSS = 1e-6


@torch.no_grad()
def check_apart(
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony: Tensor,
    colony_id: Tensor,
    uid: Tensor,
    space: PeriodicSpace | None = None,
) -> None:
    """Warn, once for all pairs, if two cells of a colony have the same centre, or overlap by more
    than a radius (the smaller one of the two).

    position, axis (N, d); length, radius (N,) µm; colony (N,) int64, place in the batch; colony_id
    (B,); uid (N,). Messages name cells by uid and colonies by id.
    """
    if len(uid) <= 1:
        return
    i, j, gap = gaps_nearby(position, axis, length, radius, colony, len(colony_id), space=space)
    between = (position.index_select(0, i) - position.index_select(0, j)).double()
    if space is not None:
        between = between + space.shift(between.T).T
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
        remedy = "Cells.relaxed()" if space is None else "Cells.relaxed(periodic=…)"
        found = (
            f"{name(worst)} start {-float(gap[worst]):.3g} µm deep in one another (pairs that"
            f" overlap by over a radius: {deep.numel()}). The first steps may push them through one"
            f" another. Push the cells apart by {remedy}; or check the unit of the table"
            " (µm) and its lengths (of the centreline, without caps)."
        )
    warn(found, category=RuntimeWarning)


@torch.no_grad()
def check_between_planes(
    surfaces: Sequence[Surface], position: Tensor, radius: Tensor, ids: Tensor
) -> None:
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
def check_fits(
    surfaces: Sequence[Surface], position: Tensor, length: Tensor, radius: Tensor, ids: Tensor,
    uid: Tensor,
) -> bool:  # fmt: skip
    """Warn where a cell is longer than what a hard box or ball leaves it, however it lies; whether
    all fit.

    position (N, d); length, radius (N,) µm; ids (N,), of the cells' colonies; uid (N,).
    """
    room: dict[int, list[Tensor]] = {}  # by wall: the squares of what opposite sides leave
    for one, other in itertools.combinations([s for s in surfaces if not s.wall.yields], 2):
        if one.wall is not other.wall or not isinstance(one, FlatSurface):
            continue
        (near, way), (far, back) = (s.gap_of_points(position, ids) for s in (one, other))
        if bool(((way * back).sum(0) < -1 + 1e-9).all()):
            left = (near + far - 2 * radius).clamp(min=0.0)
            room.setdefault(id(one.wall), []).append(left * left)
    longest = {
        k: torch.stack(x).sum(0).sqrt() for k, x in room.items() if len(x) == position.shape[1]
    }
    for surface in surfaces:
        most = longest.get(id(surface.wall))
        if isinstance(surface, RoundSurface) and surface.inside and not surface.wall.yields:
            most = 2 * (per_cell(surface.radius, ids, position) - radius)
        if most is None:
            continue
        over = torch.nonzero(length > most + 1e-6 * radius).squeeze(1)
        if over.numel():
            k = int(over[0])
            warn(
                f"{type(surface.wall).__name__}: cell {int(uid[k])} of colony {int(ids[k])} is"
                f" {float(length[k] + 2 * radius[k]):.3g} µm long, and there is room for"
                f" {max(0.0, float(most[k])) + 2 * float(radius[k]):.3g} µm: it will lie in the"
                " wall. Make room, shorten the cell, or give the wall a stiffness.",
                category=RuntimeWarning,
            )
            return False
    return True


@torch.no_grad()
def check_turned(
    surfaces: Sequence[Surface], position: Tensor, axis: Tensor, length: Tensor, radius: Tensor,
    ids: Tensor, uid: Tensor,
) -> None:  # fmt: skip
    """Warn where a cell lies straight across two hard, parallel planes and is longer than what they
    leave it: nothing turns it. Arguments as for `check_fits`, and axis (N, d).
    """
    flat = [s for s in surfaces if isinstance(s, FlatSurface) and not s.wall.yields]
    for one, other in itertools.combinations(flat, 2):
        (near, way), (far, back) = (s.gap_of_points(position, ids) for s in (one, other))
        width, opposite = near + far, (way * back).sum(0) < -1 + 1e-9
        turned = axis.T.double()
        across = (turned - (way * turned).sum(0) * way).norm(dim=0) < ACROSS
        jammed = opposite & across & (length + 2 * radius > width * (1 + 1e-6))
        jammed &= 2 * radius <= width * (1 + 1e-6)  # of wider ones `check_between_planes` warns
        if bool(jammed.any()):
            k, names = int(torch.nonzero(jammed)[0]), (type(s.wall).__name__ for s in (one, other))
            warn(
                f"{' and '.join(dict.fromkeys(names))}: cell {int(uid[k])} of colony {int(ids[k])},"
                f" which is {float(length[k] + 2 * radius[k]):.3g} µm long, starts straight across"
                f" the {float(width[k]):.3g} µm between two hard sides (such cells:"
                f" {int(jammed.sum())}). It lies in both, and contact does not turn it. Turn"
                " its axis a little.",
                category=RuntimeWarning,
            )
            return

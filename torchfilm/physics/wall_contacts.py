"""Contacts of cells with walls: their rows in the contact problem, and moves cut at walls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import NEAR, POINTS_ON_MOVE
from torchfilm.physics.capsule import rotate
from torchfilm.physics.surfaces import FlatSurface, Surface
from torchfilm.tools.reads import reads_are_free, rows_where
from torchfilm.tools.vectors import cross, dot, safe_sqrt

# Position (P, d) float64, axis (P, d) and half length (P,) of some capsules.
Pose = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class WallContacts:
    """W rows of one cell and one wall.

    cell: (W,). gap: (W,) µm. row: (W, D). surface: (W,) index of the touched surface. Where rows
    share one contact (see `find_wall_contacts`), gap and row of each are multiplied by the root of
    its share. pull: (W,) stiffness · Δt of rows that pull (see `adhesion`), 0 of others; None if
    there are none.
    """

    cell: Tensor
    gap: Tensor
    row: Tensor
    surface: Tensor
    pull: Tensor | None = None

    def take(self, index: Tensor) -> WallContacts:
        """The rows at `index`."""
        return WallContacts(
            *(x.index_select(0, index) for x in (self.cell, self.gap, self.row, self.surface))
        )


def find_wall_contacts(
    surfaces: Sequence[Surface],
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony_id: Tensor,
    include_near: bool = False,
    reach: Tensor | None = None,
) -> WallContacts:
    """One row for each capsule end that overlaps a wall (gap < 0).

    A sphere met from outside gives one more row, for the nearest point, wherever it is on the cell.

    position: (N, d) float64, absolute. axis: (N, d). length, radius: (N,). colony_id: (N,) selects
    a wall's value per colony. include_near: as in `contacts_of`, for walls that are not soft.
    reach: (N,) µm, instead: rows are made for gaps up to it, and gaps are returned as they are.
    """
    half = 0.5 * length
    tried: list[tuple[Tensor, ...]] = []
    for number, surface in enumerate(surfaces):
        margin = torch.zeros_like(radius) if reach is None else reach
        if include_near and surface.wall.stiffness is None:
            margin = NEAR * radius
        for s, end, root in _contact_candidates(surface, position, axis, half, colony_id):
            point = position + (s.unsqueeze(1) * axis).to(position.dtype)
            distance, way = surface.gap_of_points(point, colony_id)
            gap = distance.to(length.dtype) - radius
            near = (gap < margin) & (root > 0)
            if include_near:
                root = root * (1.0 - gap / margin.clamp(min=1e-30)).clamp(min=0.0, max=1.0)
                gap = gap.clamp(max=0.0)
            of = torch.full_like(colony_id, number)
            tried.append((near, s, 0.5 * end, root, gap, way.T.to(axis.dtype), of))
    degrees = 4 if axis.shape[1] == 2 else 7
    none = colony_id.new_empty(0), length.new_empty(0), length.new_empty(0, degrees)
    found = [(*none, none[0])]
    for keep, (_, *parts) in zip(rows_where(*(near for near, *_ in tried)), tried, strict=True):
        s, end, root, gap, way, of = (x.index_select(0, keep) for x in parts)
        n, a = way.T, axis.index_select(0, keep).T
        row = torch.cat([n, cross(s * a, n), (end * dot(n, a)).unsqueeze(0)])
        found.append((keep, root * gap, (root * row).T, of))
    return WallContacts(*(torch.cat(part) for part in zip(*found, strict=True)))


def _contact_candidates(
    surface: Surface, position: Tensor, axis: Tensor, half: Tensor, colony_id: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """The points of each capsule that may touch a surface.

    For each point: its arc length from the centre, which end it moves with as the cell grows (±1,
    or 0), and the root of its share of the contact; each (N,).

    On a sphere met from outside, the nearest point slides along the cell and has a whole row. The
    two ends share another row, by the distance of the nearest point from each. When the nearest
    point arrives at an end, that end has no share left and the other end has it all, as at a plane.
    So no force appears or vanishes suddenly, whatever a cell does.
    """
    one = torch.ones_like(half)
    if isinstance(surface, FlatSurface) or surface.inside:
        return [(half, one, one), (-half, -one, one)]
    # −1 … 1 along the cell; the nearest point of a spherical cell is at one of its ends
    at = (surface.foot(position, axis, colony_id).to(half.dtype) / half.clamp(min=1e-9)).clamp(
        -1, 1
    )
    return [
        (at * half, torch.trunc(at.detach()), one),
        (half, one, safe_sqrt(0.5 * (1 - at))),
        (-half, -one, safe_sqrt(0.5 * (1 + at))),
    ]


def reach_of(length: Tensor, move: Tensor) -> Tensor:
    """How far points of cells may move, at most, in their moves (N, D): (N,) µm."""
    dim = 2 if move.shape[1] == 4 else 3
    way, turn = (x.square().sum(1).sqrt() for x in (move[:, :dim], move[:, dim:-1]))
    return way + 0.5 * turn * length + 0.5 * move[:, -1].clamp(min=0.0)


def poses_along(position: Tensor, axis: Tensor, length: Tensor, move: Tensor):
    """Poses of cells after a share of their moves (N, D), as `share_to_wall` takes them."""
    dim = position.shape[1]

    def at(share: float) -> Pose:
        return (
            position + share * move[:, :dim].to(position.dtype),
            rotate(axis, share * move[:, dim:-1]),
            0.5 * (length + share * move[:, -1]),
        )

    return at


def share_to_wall(
    surface: Surface,
    at: Callable[[float], Pose],
    radius: Tensor,
    colony_id: Tensor,
    reach: Tensor,
    gives: Tensor | bool = False,
) -> Tensor:
    """The share of its move after which each cell comes to lie its radius behind a wall, (P,),
    nearly: of a move that turns, or at a round wall, it is interpolated.

    A cell that was deeper gets no deeper; but in a wall that gives way it may come deeper by its
    radius. The check is needed because a wall that a cell did not touch before the move may have no
    row in the solve. at: returns, for a share of the move, position (P, d) float64, axis (P, d) and
    half length (P,). reach: no point of a cell moves farther, (P,) µm. gives: (P,) or for all.
    """

    def gap(share: float) -> Tensor:
        position, axis, half = at(share)
        deepest = surface.deepest(
            position, axis.to(position.dtype), half.to(position.dtype), colony_id
        )
        distance, _ = surface.gap_of_points(
            position + deepest.unsqueeze(1) * axis.to(position.dtype), colony_id
        )
        return distance.to(radius.dtype) - radius

    out, before = torch.ones_like(radius), gap(0.0)
    soft = torch.as_tensor(gives, device=radius.device)
    limit = torch.where(soft, before.clamp(max=0.0) - radius, torch.minimum(before, -radius))
    if reads_are_free(radius.device) and not bool((before - reach < limit).any()):
        return out
    places = 1 if isinstance(surface, FlatSurface) or surface.inside else POINTS_ON_MOVE
    for k in range(places):
        after = gap((k + 1) / places)
        through = (after < limit) & (out > k / places)
        part = (before - limit) / torch.where(through, before - after, 1.0)
        out = torch.where(through, torch.minimum(out, (k + part) / places), out)
        before = after
    return out

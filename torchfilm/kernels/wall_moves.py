"""Moves cut at walls: which share of its move takes a cell no deeper than it may go, as in
`physics.wall_contacts`."""

from __future__ import annotations

import math

from torchfilm.kernels.bilateral_scheme import POINTS_ON_MOVE
from torchfilm.kernels.capsules import clamp
from torchfilm.kernels.compiling import lean
from torchfilm.kernels.moves import AT, MOVE, WAY, bounded, carry_out, rotate
from torchfilm.kernels.rows import FLAT, OUTSIDE, degrees, wall_gap


@lean
def _depth(kind, place, size, x, i, axis, j, half, radius, dof):
    """The gap of a capsule's deepest point to a wall; x[i]: its position, axis[j]: its axis."""
    z, az = (x[i, 2], axis[j, 2]) if len(dof) == 8 else (0.0, 0.0)
    ax, ay = axis[j, 0], axis[j, 1]
    if kind == FLAT:
        rise = place[0] * ax + place[1] * ay + place[2] * az
    else:
        rise = (place[0] - x[i, 0]) * ax + (place[1] - x[i, 1]) * ay + (place[2] - z) * az
    s = -half if rise > 0 else half
    if kind == OUTSIDE:
        s = clamp(rise, half)
    distance, _, _, _ = wall_gap(kind, place, size, x[i, 0] + s * ax, x[i, 1] + s * ay, z + s * az)
    return distance - radius


@lean
def _depth_after(kind, place, size, x, axis, i, length, radius, scratch, share, turn, dof):
    """The gap of cell i's deepest point to a wall after a share of its move, scratch[MOVE], in
    which it would turn by the angle `turn`."""
    end = degrees(dof) - 1
    d = 2 if len(dof) == 4 else 3
    for k in range(d):
        scratch[AT, k] = x[i, k] + share * scratch[MOVE, k]
        scratch[WAY, k] = axis[i, k]
    tx, ty, tz = share * scratch[MOVE, d], 0.0, 0.0
    if d == 3:
        ty, tz = share * scratch[MOVE, d + 1], share * scratch[MOVE, d + 2]
    rotate(scratch, WAY, tx, ty, tz, share * turn, dof)
    half = 0.5 * (length + share * scratch[MOVE, end])
    return _depth(kind, place, size, scratch, AT, scratch, WAY, half, radius, dof)


@lean
def share_to_wall(kind, place, size, gives, x, axis, i, length, radius, scratch, turn, reach, dof):
    """The share of its move after which cell i, no point of which moves farther than `reach`, µm,
    comes to lie its radius behind a wall, nearly; one that was deeper gets no deeper; but in a wall
    that `gives` it may come deeper by its radius. A wall that it did not touch may have no row in
    the solve."""
    points = POINTS_ON_MOVE if kind == OUTSIDE else 1
    before = _depth(kind, place, size, x, i, axis, i, 0.5 * length, radius, dof)
    limit = min(before, 0.0) - radius if gives else min(before, -radius)
    if before - reach >= limit:
        return 1.0
    for k in range(points):
        after = _depth_after(
            kind, place, size, x, axis, i, length, radius, scratch, (k + 1) / points, turn, dof
        )
        if after < limit:
            return (k + (before - limit) / (before - after)) / points
        before = after
    return 1.0


@lean
def reach_of(scratch, angle, length, dof):
    """How far the points of a cell may move, at most, µm, by scratch[MOVE], in which it turns by
    `angle`."""
    way = 0.0
    for k in range(2 if len(dof) == 4 else 3):
        way += scratch[MOVE, k] * scratch[MOVE, k]
    longer = max(scratch[MOVE, degrees(dof) - 1], 0.0)
    return math.sqrt(way) + 0.5 * angle * length + 0.5 * longer


@lean
def move_cells(x, axis, length, radius, y, scale, about, bound, least, walls, scratch, dof):
    """Carry out the scaled move y (n, D) of a pass: translations at most `bound` from `about`
    (n, D), rotations at most `bound` at the ends, and no cell deeper than its radius behind a hard
    wall. Then y is what was done. Returns how many cells were cut short. walls: kinds, places,
    sizes, which are soft, and their weights (S, n)."""
    D = degrees(dof)
    count = 0
    for i in range(x.shape[0]):
        angle, cut = bounded(y, i, scale, about, bound, length[i], scratch, dof)
        if walls[0].shape[0] > 0:
            part = _share_to_hard_walls(
                x, axis, i, length[i], radius[i], scratch, angle, walls, dof
            )
            if part < 1.0:
                cut = True
                for k in range(D):
                    scratch[MOVE, k] *= part
                angle *= part
        count += cut
        carry_out(x, axis, length, y, i, scratch, angle, least[i], dof)
    return count


@lean
def _share_to_hard_walls(x, axis, i, length, radius, scratch, angle, walls, dof):
    """The share of cell i's move that no hard wall cuts off."""
    kinds, places, sizes, is_soft, weights = walls
    part, reach = 1.0, reach_of(scratch, angle, length, dof)
    for w in range(kinds.shape[0]):
        if not is_soft[w] and weights[w, i] >= 1.0:
            wall = kinds[w], places[w], sizes[w], False
            part = min(part, share_to_wall(
                *wall, x, axis, i, length, radius, scratch, angle, reach, dof
            ))  # fmt: skip
    return part

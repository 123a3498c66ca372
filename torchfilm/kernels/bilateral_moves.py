"""Moves of bilateral contacts: which share of its move a cell makes, as in
`physics.contact_step.move_cells`."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.bilateral_scheme import POINTS_ON_MOVE
from torchfilm.kernels.capsules import clamp
from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.moves import move_cells, rotate
from torchfilm.kernels.rows import FLAT, OUTSIDE, degrees, wall_gap
from torchfilm.kernels.scheme import MAX_TURN


@kernel
def _depth(kind, place, size, x, axis, half, radius):
    """The gap of a capsule's deepest point to a wall; x, axis: (d,)."""
    z, az = (x[2], axis[2]) if x.shape[0] == 3 else (0.0, 0.0)
    if kind == FLAT:
        rise = place[0] * axis[0] + place[1] * axis[1] + place[2] * az
    else:
        rise = (place[0] - x[0]) * axis[0] + (place[1] - x[1]) * axis[1] + (place[2] - z) * az
    s = -half if rise > 0 else half
    if kind == OUTSIDE:
        s = clamp(rise, half)
    distance, _, _, _ = wall_gap(
        kind, place, size, x[0] + s * axis[0], x[1] + s * axis[1], z + s * az
    )
    return distance - radius


@kernel
def _depth_after(kind, place, size, x, axis, length, radius, move, share, turn, dof):
    """The gap of a capsule's deepest point to a wall after a share of its move (D,), in which it
    would turn by the angle `turn`."""
    D, d = degrees(dof), x.shape[0]
    at, way, turns = x.copy(), axis.copy(), share * move[d : D - 1]
    for k in range(d):
        at[k] += share * move[k]
    ty, tz = (turns[1], turns[2]) if d == 3 else (0.0, 0.0)
    rotate(way.reshape(1, d), 0, turns[0], ty, tz, share * turn, dof)
    return _depth(kind, place, size, at, way, 0.5 * (length + share * move[D - 1]), radius)


@kernel
def _share_to_walls(x, axis, length, radius, move, turn, kinds, places, sizes, dof):
    """The share of its move after which a cell is at most its radius behind any wall; one that was
    deeper may stay so. A wall that it did not touch has no row in the solve."""
    out = 1.0
    for w in range(kinds.shape[0]):
        wall = kinds[w], places[w], sizes[w]
        points = POINTS_ON_MOVE if kinds[w] == OUTSIDE else 1
        before = _depth(*wall, x, axis, 0.5 * length, radius)
        limit = min(before, 0.0) - radius
        for k in range(points):
            share = (k + 1) / points
            after = _depth_after(*wall, x, axis, length, radius, move, share, turn, dof)
            if after < limit and out > k / points:
                out = min(out, (k + (before - limit) / (before - after)) / points)
            before = after
    return out


@kernel
def make_moves(x, axis, length, radius, y, scale, base, kinds, places, sizes, clipped, dof):
    """Carry out the scaled move y, in part where a cell would turn by more than MAX_TURN or go
    through a wall; then y is what was done. Marks the cells that were cut short; returns how many.
    """
    D = degrees(dof)
    d = 2 if D == 4 else 3
    move, count = np.empty(D), 0
    for i in range(x.shape[0]):
        way = turn = 0.0
        for k in range(D):
            move[k] = y[i, k] * scale[i, k]
        for k in range(d):
            way += move[k] * move[k]
        for k in range(d, D - 1):
            turn += move[k] * move[k]
        way, turn = math.sqrt(way), math.sqrt(turn)
        share = MAX_TURN / turn if turn > MAX_TURN else 1.0
        reach = way + 0.5 * turn * length[i] + 0.5 * max(move[D - 1], 0.0)
        if kinds.shape[0] > 0 and share * reach > radius[i]:
            move *= share
            share *= _share_to_walls(
                x[i], axis[i], length[i], radius[i], move, share * turn, kinds, places, sizes, dof
            )
        clipped[i] = share < 1
        count += clipped[i]
        for k in range(D):
            y[i, k] *= share
    unbound = np.zeros((x.shape[0], d)), np.inf
    move_cells(x, axis, length, y, scale, *unbound, base, dof)
    return count

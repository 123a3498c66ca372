"""Moves of bilateral contacts: which share of its move a cell makes, as in
`physics.contact_step.move_cells`."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.moves import MOVE, carry_out
from torchfilm.kernels.rows import degrees
from torchfilm.kernels.scheme import MAX_TURN
from torchfilm.kernels.wall_moves import reach_of, share_to_wall


@kernel
def make_moves(x, axis, length, radius, y, scale, base, kinds, places, sizes, roots, is_soft,
               clipped, dof):  # fmt: skip
    """Carry out the scaled move y, in part where a cell would turn by more than MAX_TURN or go
    through a wall; then y is what was done. roots, is_soft: weights of walls, (S, n), and which are
    soft. Marks the cells that were cut short; returns how many.
    """
    D = degrees(dof)
    d = 2 if D == 4 else 3
    scratch, count = np.empty((3, D)), 0
    for i in range(x.shape[0]):
        turn = 0.0
        for k in range(D):
            scratch[MOVE, k] = y[i, k] * scale[i, k]
        for k in range(d, D - 1):
            turn += scratch[MOVE, k] * scratch[MOVE, k]
        turn = math.sqrt(turn)
        share = MAX_TURN / turn if turn > MAX_TURN else 1.0
        for k in range(D):
            scratch[MOVE, k] *= share
        part, ways = 1.0, (share * turn, reach_of(scratch, share * turn, length[i], dof))
        for w in range(kinds.shape[0]):
            wall = kinds[w], places[w], sizes[w], is_soft[w] > 0 or roots[w, i] < 1.0
            part = min(part, share_to_wall(
                *wall, x, axis, i, length[i], radius[i], scratch, *ways, dof
            ))  # fmt: skip
        share *= part
        clipped[i] = share < 1
        count += clipped[i]
        for k in range(D):
            y[i, k] *= share
            scratch[MOVE, k] = y[i, k] * scale[i, k]
        carry_out(x, axis, length, y, i, scratch, share * turn, base[i], dof)
    return count

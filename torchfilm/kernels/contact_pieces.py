"""Contacts and their rows in pieces, for the threads of a team.

Each piece puts what it finds where there is room for the most that it may find; the leader then
moves the pieces together, so that all is as one thread would have left it.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.contacts import (
    COLUMNS,
    PAIRS,
    clear_block,
    most_rows,
    near_contacts_of,
    pair_rows_of,
    room_for_contacts,
)
from torchfilm.kernels.lanes import copy_row
from torchfilm.kernels.memory import room
from torchfilm.kernels.solve_pieces import BOX
from torchfilm.kernels.team import LEAST, LOOP, PIECES, array_at, pieces_for, share_out

# The loops, after those of the solve: contacts of near pairs, and rows of contacts.
NEAR, MAKE_ROWS = 8, 9
# Places on the board: numbers of cells, pairs, contacts, rows at walls, and rows for which there is
# room; then addresses.
CELLS, NEAR_PAIRS, CONTACTS, WALLS, ROOM = range(BOX + 1, BOX + 6)
(
    X, AXIS, HALF, RADIUS, SCALE, FIRST, SECOND, KEEP, POINTS, GAP, H, GAPS, ONE, TWO, KIND, BLOCKS,
    FOUND, MARGIN, PERIODS,
) = range(BOX + 6, BOX + 25)  # fmt: skip


@lean
def shares(board, cells, many):
    """Whether a team shares work on so many pairs or contacts of a colony."""
    return pieces_for(board, cells) > 1 and many >= board[LEAST] // 4


@kernel
def _put_cells_on_board(memory, board, x, axis, half, radius, periods, margin):
    """Tell the team where the cells are. Returns where each piece puts how much it finds."""
    pieces = pieces_for(board, x.shape[0])
    board[PIECES], board[CELLS] = pieces, x.shape[0]
    board[X], board[AXIS] = x.ctypes.data, axis.ctypes.data
    board[HALF], board[RADIUS] = half.ctypes.data, radius.ctypes.data
    blocks = room(memory, (pieces * COLUMNS, PAIRS), np.float64)
    for k in range(pieces):
        clear_block(blocks[k * COLUMNS :])
    found, box = room(memory, (pieces,), np.int64), room(memory, (1,), np.float64)
    box[0] = margin
    board[BLOCKS], board[FOUND], board[MARGIN] = (
        blocks.ctypes.data, found.ctypes.data, box.ctypes.data,
    )  # fmt: skip
    board[PERIODS] = periods.ctypes.data
    return found


@lean
def _put_contacts_on_board(board, found):
    first, second, keep, points, gap = found
    board[NEAR_PAIRS], board[CONTACTS] = first.shape[0], keep.shape[0]
    board[FIRST], board[SECOND] = first.ctypes.data, second.ctypes.data
    board[KEEP], board[POINTS] = keep.ctypes.data, points.ctypes.data
    board[GAP] = gap.ctypes.data


@lean
def shared_near_contacts(memory, board, x, axis, half, radius, periods, first, second, margin,
                         dof):  # fmt: skip
    """The pairs (first, second), and their contacts as `near_contacts` finds them."""
    m = first.shape[0]
    keep, points, gap = room_for_contacts(memory, m)
    found = _put_cells_on_board(memory, board, x, axis, half, radius, periods, margin)
    _put_contacts_on_board(board, (first, second, keep, points, gap))
    share_out(board, NEAR)
    new = found[0]
    for k in range(1, found.shape[0]):
        start = m * k // found.shape[0]
        for r in range(start, start + found[k]):
            keep[new], gap[new] = keep[r], gap[r]
            points[new, 0], points[new, 1] = points[r, 0], points[r, 1]
            new += 1
    return first, second, keep[:new], points[:new], gap[:new]


@lean
def shared_pair_rows(memory, board, x, axis, half, radius, periods, scale, contacts, walls, rows,
                     margin, dof):  # fmt: skip
    """As `pair_rows`."""
    most, m = most_rows(dof), contacts[2].shape[0]
    h, gaps, one, two, kind = rows
    found = _put_cells_on_board(memory, board, x, axis, half, radius, periods, margin)
    _put_contacts_on_board(board, contacts)
    board[WALLS], board[ROOM], board[SCALE] = walls, gaps.shape[0], scale.ctypes.data
    board[H], board[GAPS], board[KIND] = h.ctypes.data, gaps.ctypes.data, kind.ctypes.data
    board[ONE], board[TWO] = one.ctypes.data, two.ctypes.data
    share_out(board, MAKE_ROWS)
    new = found[0]
    for k in range(1, found.shape[0]):
        start = walls + most * (m * k // found.shape[0])
        for r in range(start, found[k]):
            copy_row(h, 2 * new, h, 2 * r, dof)
            copy_row(h, 2 * new + 1, h, 2 * r + 1, dof)
            gaps[new], one[new], two[new], kind[new] = gaps[r], one[r], two[r], kind[r]
            new += 1
    return new


@kernel(inline=True)
def _vectors(board, k, dof):
    return array_at(board, k, np.float64, (board[CELLS], 2 if len(dof) == 4 else 3))


@kernel(inline=True)
def _numbers(board, k):
    return array_at(board, k, np.float64, (board[CELLS],))


@lean
def do_contact_piece(board, k, like, dof):
    """Do piece k of the loop that is offered."""
    pieces = board[PIECES]
    x, axis = _vectors(board, X, dof), _vectors(board, AXIS, dof)
    half, radius = _numbers(board, HALF), _numbers(board, RADIUS)
    pairs, contacts, walls = board[NEAR_PAIRS], board[CONTACTS], board[WALLS]
    first = array_at(board, FIRST, np.int32, (pairs,))
    second = array_at(board, SECOND, np.int32, (pairs,))
    keep = array_at(board, KEEP, np.int32, (contacts,))
    points = array_at(board, POINTS, np.float64, (contacts, 2))
    gap = array_at(board, GAP, np.float64, (contacts,))
    margin = array_at(board, MARGIN, np.float64, (1,))[0]
    periods = array_at(board, PERIODS, np.float64, (3,))
    found = array_at(board, FOUND, np.int64, (pieces,))
    block = array_at(board, BLOCKS, np.float64, (pieces * COLUMNS, PAIRS))
    block = block[k * COLUMNS : (k + 1) * COLUMNS]
    begin, end = contacts * k // pieces, contacts * (k + 1) // pieces
    if board[LOOP] == NEAR:
        found[k] = near_contacts_of(
            x,
            axis,
            half,
            radius,
            periods,
            first,
            second,
            margin,
            begin,
            end,
            keep,
            points,
            gap,
            block,
            dof,
        )
        return
    size = board[ROOM]
    scale = array_at(board, SCALE, np.float64, (board[CELLS], len(dof)))
    rows = (
        array_at(board, H, like, (2 * size, len(dof))), array_at(board, GAPS, like, (size,)),
        array_at(board, ONE, np.int32, (size,)), array_at(board, TWO, np.int32, (size,)),
        array_at(board, KIND, np.uint8, (size,)),
    )  # fmt: skip
    place = walls + most_rows(dof) * begin
    found[k] = pair_rows_of(
        x, axis, half, radius, periods, scale, (first, second, keep, points, gap), begin, end,
        place, rows, margin, block, dof,
    )  # fmt: skip

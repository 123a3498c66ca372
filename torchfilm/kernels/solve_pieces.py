"""The loops of the contact solve in pieces, for the threads of a team."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels import solve_parts as parts
from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.memory import copied, room, zeros
from torchfilm.kernels.team import BLOCK, LOOP, NUMBERS, PIECES, array_at, range_of

# The loops: gaps after the first move, what the rows' forces ask of the cells, a product of CG, a
# step along it, its next direction, the bounds on a step, its change of gaps, and the step.
GAPS, CELLS, PRODUCT, ALONG, DIRECTION, BOUNDS, CHANGES, ADVANCE = range(8)
# Places on the board: numbers of cells and rows, whether lengths creep, and whether nothing has
# pushed yet; then addresses.
N, ROWS, CREEPS, FREE = range(NUMBERS, NUMBERS + 4)
(
    H, ONE, TWO, E, Q, V, PUSHED, ACT, STALE, ALPHA, LOW, Y, G, Z, D, P, INVERSE, SLOPE, OWN, BEGIN,
    HALVES, LENGTHS, MINE_BEGIN, MINE, ON, COUNTS, SUMS, BOX,
) = range(NUMBERS + 4, NUMBERS + 32)  # fmt: skip


@lean
def rows_of_pieces(memory, one, two, rows, n, pieces):
    """The rows of the cells of each piece, in their order: where each piece's begin, and the rows.
    A row of two pieces stands in both. No rows where there are no pieces."""
    if pieces == 0:
        return room(memory, (0,), np.int64), room(memory, (0,), np.int32)
    owner = room(memory, ((n + BLOCK - 1) // BLOCK,), np.int64)
    for k in range(pieces):
        first, end = range_of(k, pieces, n)
        owner[first // BLOCK : (end + BLOCK - 1) // BLOCK] = k
    begin = zeros(memory, (pieces + 1,), np.int64)
    for r in range(rows):
        a, b = owner[one[r] // BLOCK], owner[two[r] // BLOCK]
        begin[a + 1] += 1
        begin[b + 1] += a != b
    for k in range(pieces):
        begin[k + 1] += begin[k]
    fill, mine = copied(memory, begin, pieces), room(memory, (begin[pieces],), np.int32)
    for r in range(rows):
        a, b = owner[one[r] // BLOCK], owner[two[r] // BLOCK]
        mine[fill[a]] = r
        fill[a] += 1
        if a != b:
            mine[fill[b]] = r
            fill[b] += 1
    return begin, mine


@lean
def put_on_board(board, work, n, rows):
    """Tell the team where the arrays are: `work`, in the order of their places. They must be kept
    as long as the team works on them."""
    (h, one, two, e, q, v, pushed, act, stale, alpha, low, y, g, z, d, p, inverse, slope, own,
     begin, halves, lengths, mine_begin, mine, on, counts, sums, box) = work  # fmt: skip
    board[N], board[ROWS], board[PIECES] = n, rows, counts.shape[0]
    board[FREE] = pushed.shape[0] == 0
    board[H], board[ONE], board[TWO] = h.ctypes.data, one.ctypes.data, two.ctypes.data
    board[E], board[Q], board[V] = e.ctypes.data, q.ctypes.data, v.ctypes.data
    board[PUSHED], board[ACT] = pushed.ctypes.data, act.ctypes.data
    board[STALE], board[ALPHA], board[LOW] = stale.ctypes.data, alpha.ctypes.data, low.ctypes.data
    board[Y], board[G], board[Z] = y.ctypes.data, g.ctypes.data, z.ctypes.data
    board[D], board[P], board[INVERSE] = d.ctypes.data, p.ctypes.data, inverse.ctypes.data
    board[SLOPE], board[OWN] = slope.ctypes.data, own.ctypes.data
    board[BEGIN], board[HALVES] = begin.ctypes.data, halves.ctypes.data
    board[LENGTHS], board[MINE_BEGIN] = lengths.ctypes.data, mine_begin.ctypes.data
    board[MINE], board[ON], board[COUNTS] = mine.ctypes.data, on.ctypes.data, counts.ctypes.data
    board[SUMS], board[BOX] = sums.ctypes.data, box.ctypes.data


@kernel(inline=True)
def _column(board, k, like):
    return array_at(board, k, like, (board[N],))


@kernel(inline=True)
def _moves(board, k, like, dof):
    return array_at(board, k, like, (board[N], len(dof)))


@kernel(inline=True)
def _row_numbers(board, k, like):
    return array_at(board, k, like, (board[ROWS],))


@kernel(inline=True)
def _half_rows(board, like, dof):
    """H, one and two."""
    rows = board[ROWS]
    h = array_at(board, H, like, (2 * rows, len(dof)))
    return h, array_at(board, ONE, np.int32, (rows,)), array_at(board, TWO, np.int32, (rows,))


@kernel(inline=True)
def _sums(board):
    return array_at(board, SUMS, np.float64, (3, (board[N] + BLOCK - 1) // BLOCK))


@lean
def _of_rows(board, loop, k, like, dof):
    """A piece of GAPS, CHANGES or ADVANCE: the rows."""
    rows, pieces = board[ROWS], board[PIECES]
    first, end = rows * k // pieces, rows * (k + 1) // pieces
    h, one, two = _half_rows(board, like, dof)
    e, q = _row_numbers(board, E, like), _row_numbers(board, Q, like)
    if loop != ADVANCE:
        p = _moves(board, Y if loop == GAPS else D, like, dof)
        parts.times_rows(h, one, two, p, q, first, end, dof)
    if loop != CHANGES:
        v = _row_numbers(board, V, like)
        pushed = array_at(board, PUSHED, like, (0 if board[FREE] else rows,))
        act, stale = _row_numbers(board, ACT, np.uint8), _column(board, STALE, np.uint8)
        parts.advance_rows(e, q, array_at(board, BOX, like, (1,)), first, end)
        parts.put_forces(e, pushed, v, one, two, act, stale, first, end)


@lean
def _of_cells(board, k, like, dof):
    """A piece of CELLS."""
    n, rows = board[N], board[ROWS]
    first, end = range_of(k, board[PIECES], n)
    h, one, two = _half_rows(board, like, dof)
    v, act = _row_numbers(board, V, like), _row_numbers(board, ACT, np.uint8)
    alpha, low = _column(board, ALPHA, like), _column(board, LOW, like)
    slope, own = _column(board, SLOPE, like), _column(board, OWN, like)
    y, g, z = _moves(board, Y, like, dof), _moves(board, G, like, dof), _moves(board, Z, like, dof)
    d, p = _moves(board, D, like, dof), _moves(board, P, like, dof)
    inverse = array_at(board, INVERSE, like, (n, len(dof), len(dof)))
    begin = array_at(board, BEGIN, np.int64, (n + 1,))
    halves = array_at(board, HALVES, np.int32, (2 * rows,))
    lengths = array_at(board, LENGTHS, np.uint8, (3, n))
    stale, sums = _column(board, STALE, np.uint8), _sums(board)
    at = array_at(board, MINE_BEGIN, np.int64, (k + 2,))
    mine = array_at(board, MINE, np.int32, (at[k + 1],))[at[k] :]
    on = array_at(board, ON, np.int32, (at[k + 1],))[at[k] :]
    count = parts.keep_pushing(act, mine, on)
    array_at(board, COUNTS, np.int64, (k + 1,))[k] = count
    parts.put_scaled(g, alpha, y, first, end, dof)
    forced = on[:count] if board[FREE] else mine
    parts.add_own_forces(h, one, two, forced, v, g, first, end, dof)
    parts.refresh_blocks(
        h, begin, halves, act, alpha, y, low, g, lengths, own, inverse, stale, first, end, dof
    )
    for a in range(first, end, BLOCK):
        b = min(a + BLOCK, end)
        sums[0, a // BLOCK] = parts.precondition(inverse, g, z, a, b, dof)
        sums[1, a // BLOCK] = parts.put_slopes(g, lengths, slope, own, a, b, dof)
    parts.first_direction(d, p, z, first, end)


@lean
def _of_product(board, k, like, dof):
    """A piece of PRODUCT."""
    first, end = range_of(k, board[PIECES], board[N])
    h, one, two = _half_rows(board, like, dof)
    alpha, sums = _column(board, ALPHA, like), _sums(board)
    z, p = _moves(board, Z, like, dof), _moves(board, P, like, dof)
    begin = array_at(board, MINE_BEGIN, np.int64, (k + 1,))[k]
    count = array_at(board, COUNTS, np.int64, (k + 1,))[k]
    on = array_at(board, ON, np.int32, (begin + count,))[begin:]
    parts.add_own_product(h, one, two, on, p, z, first, end, dof)
    for a in range(first, end, BLOCK):
        b = min(a + BLOCK, end)
        sums[0, a // BLOCK] = parts.add_curvature(alpha, z, p, a, b, dof)


@lean
def _of_step(board, loop, k, like, dof):
    """A piece of ALONG or DIRECTION."""
    n = board[N]
    first, end = range_of(k, board[PIECES], n)
    z, p = _moves(board, Z, like, dof), _moves(board, P, like, dof)
    t = array_at(board, BOX, like, (1,))[0]
    if loop == DIRECTION:
        parts.next_direction(p, z, t, first, end)
        return
    d, g, sums = _moves(board, D, like, dof), _moves(board, G, like, dof), _sums(board)
    inverse = array_at(board, INVERSE, like, (n, len(dof), len(dof)))
    for a in range(first, end, BLOCK):
        b = min(a + BLOCK, end)
        sums[0, a // BLOCK] = parts.go_along(d, g, z, p, inverse, t, a, b, dof)


@lean
def _of_move(board, loop, k, like, dof):
    """A piece of BOUNDS or ADVANCE: the cells."""
    n = board[N]
    first, end = range_of(k, board[PIECES], n)
    y, d, low = _moves(board, Y, like, dof), _moves(board, D, like, dof), _column(board, LOW, like)
    lengths = array_at(board, LENGTHS, np.uint8, (3, n))
    if loop == ADVANCE:
        box = array_at(board, BOX, like, (1,))
        parts.advance(y, d, low, lengths, board[CREEPS] > 0, box, first, end, dof)
        return
    alpha, sums = _column(board, ALPHA, like), _sums(board)
    slope, own = _column(board, SLOPE, like), _column(board, OWN, like)
    sums[2, k] = parts.stop_at_bounds(y, d, low, lengths, slope, own, first, end, dof)
    for a in range(first, end, BLOCK):
        b = min(a + BLOCK, end)
        sums[0, a // BLOCK], sums[1, a // BLOCK] = parts.of_drag(alpha, y, d, a, b, dof)


@lean
def do_piece(board, k, like, dof):
    """Do piece k of the loop that is offered."""
    loop = board[LOOP]
    if loop == PRODUCT:
        _of_product(board, k, like, dof)
    elif loop in (ALONG, DIRECTION):
        _of_step(board, loop, k, like, dof)
    elif loop == CELLS:
        _of_cells(board, k, like, dof)
    if loop in (BOUNDS, ADVANCE):
        _of_move(board, loop, k, like, dof)
    if loop in (GAPS, CHANGES, ADVANCE):
        _of_rows(board, loop, k, like, dof)


@lean
def total_of(board, k):
    """The sum over blocks of cells, in their order, of what a loop left in row k of its sums."""
    sums, total = _sums(board), 0.0
    for block in range(sums.shape[1]):
        total += sums[k, block]
    return total


@lean
def least_of(board):
    """How far all cells may go along a step, after BOUNDS."""
    sums, most = _sums(board), np.inf
    for k in range(board[PIECES]):
        most = min(most, sums[2, k])
    return most

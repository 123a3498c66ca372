"""Threads that work on one colony: how they share out pieces of its loops.

One thread leads. It offers the pieces of a loop, takes pieces itself, and waits only for pieces
that others have begun. The others assist: each takes a piece that nobody has. So one that comes
late, or that the system has put aside, holds up no more than the piece in its hands. Pieces write
to places of their own, and the leader adds up sums of fixed blocks of cells in their order: a
result does not depend on who computed what.

What they have in common stands on a board, (WORDS,) int64: the offer, and addresses of arrays. An
empty board stands for a thread that is alone.
"""

from __future__ import annotations

import os
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types

from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.lanes import intrinsic, long_of
from torchfilm.kernels.memory import pointer

INT64 = ir.IntType(64)

# Cells of a block, whose share of a sum is added up by itself.
BLOCK = 64
# Pieces of a loop for each thread of a team: more even out what threads get done, and cost more.
PIECES_A_THREAD = 2
# Places on the board, of which those that threads write at the same time are far apart: the offer
# and what is done of it; then which loop it is, threads, pieces and by what they are done, and the
# cells from which a colony is shared; then what pieces need.
OFFER, DONE, LOOP, THREADS, PIECES, TAKER, LEAST, NUMBERS = 0, 16, 32, 33, 34, 35, 36, 37
WORDS = 112
# What stands in the place of an offer when there will be no more.
OVER = -1
# An offer: the first piece that nobody has, and one more than the last, in 16 bits each. A thread
# that was put aside may find the same offer again, of a later loop: that piece is free as well.
SIXTEEN = 0xFFFF
# Looks at the offer before a waiting thread lets others have the processor.
LOOKS = 500

# Whether threads can let others have the processor; where they cannot, there are no teams.
AVAILABLE = hasattr(os, "sched_yield")
if AVAILABLE:
    _give_way: Any = types.ExternalFunction("sched_yield", types.int32())
else:

    @lean
    def _give_way():
        return 0


def _place(context, builder, kind, board, index):
    data = context.make_array(kind)(context, builder, board).data
    return builder.gep(data, [index])


@intrinsic
def look(typing, board, k):
    """board[k], and all that was written before it was put there."""

    def emit(context, builder, signature, given):
        place = long_of(context, builder, signature, given, 1)
        at = _place(context, builder, signature.args[0], given[0], place)
        return builder.load_atomic(at, "acquire", 8)

    return types.int64(board, k), emit


@intrinsic
def put(typing, board, k, value):
    """board[k] = value, after all that was written before."""

    def emit(context, builder, signature, given):
        place, word = (long_of(context, builder, signature, given, m) for m in (1, 2))
        at = _place(context, builder, signature.args[0], given[0], place)
        builder.store_atomic(word, at, "release", 8)
        return context.get_dummy_value()

    return types.void(board, k, value), emit


@intrinsic
def count_one(typing, board, k):
    """board[k] += 1, after all that was written before."""

    def emit(context, builder, signature, given):
        place = long_of(context, builder, signature, given, 1)
        at = _place(context, builder, signature.args[0], given[0], place)
        builder.atomic_rmw("add", at, ir.Constant(INT64, 1), "acq_rel")
        return context.get_dummy_value()

    return types.void(board, k), emit


@intrinsic
def exchange(typing, board, k, old, new):
    """board[k] = new, if it is old. Returns whether it was."""

    def emit(context, builder, signature, given):
        place, was, wanted = (long_of(context, builder, signature, given, m) for m in (1, 2, 3))
        at = _place(context, builder, signature.args[0], given[0], place)
        found = builder.cmpxchg(at, was, wanted, "acq_rel", "acquire")
        return builder.extract_value(found, 1)

    return types.boolean(board, k, old, new), emit


@lean
def next_of(which, taken):
    """The first of the numbers `which` that no thread has taken, or −1. taken: (1,) int64, how many
    have been."""
    while True:
        k = look(taken, 0)
        if k >= which.shape[0]:
            return -1
        if exchange(taken, 0, k, k + 1):
            return which[k]


@kernel(inline=True)
def array_at(board, k, like, shape):
    """The array of this shape whose address stands at board[k]; of the type of `like`."""
    return numba.carray(pointer(board[k], like), shape)


@kernel
def board_at(address):
    """The board at this address."""
    return numba.carray(pointer(address, np.int64), (WORDS,))


def new_board(threads: int, least: int, taker: int) -> np.ndarray:
    """A board for so many threads, which share colonies of `least` cells or more. taker: the
    address of what they do pieces by."""
    board = np.zeros(WORDS, np.int64)
    board[THREADS], board[LEAST], board[TAKER] = threads, least, taker
    return board


@intrinsic
def _call_taker(typing, function, board):
    """What the function at this address returns for the leader of this board."""

    def emit(context, builder, signature, given):
        kind = ir.FunctionType(INT64, [INT64, INT64])
        function = builder.inttoptr(given[0], kind.as_pointer())
        return builder.call(function, [given[1], ir.Constant(INT64, 1)])

    return types.int64(function, board), emit


@lean
def share_out(board, loop):
    """Do a loop together with those who assist."""
    board[LOOP] = loop
    put(board, DONE, 0)
    put(board, OFFER, board[PIECES])
    others = board[PIECES] - _call_taker(board[TAKER], board.ctypes.data)
    looks = 0
    while look(board, DONE) < others:
        looks += 1
        if looks > LOOKS:
            _give_way()


@lean
def take(board, leads):
    """Take a piece that nobody has: the first one, or −1 where there is none; or, as soon as there
    is one, the last, or −1 when there will be no more."""
    looks = 0
    while True:
        word = look(board, OFFER)
        if word == OVER:
            return -1
        first, end = word >> 16, word & SIXTEEN
        if first < end:
            if exchange(board, OFFER, word, word + (1 << 16) if leads else word - 1):
                return first if leads else end - 1
        elif leads:
            return -1
        else:
            looks += 1
            if looks > LOOKS:
                _give_way()


@lean
def pieces_for(board, n):
    """Pieces of the loops over n cells; 1 where one thread does better."""
    if board.shape[0] == 0 or n < board[LEAST]:
        return 1
    return min((n + BLOCK - 1) // BLOCK, PIECES_A_THREAD * board[THREADS])


@lean(inline=True)
def range_of(k, pieces, n):
    """The first of the cells of piece k, in whole blocks, and one more than the last."""
    blocks = (n + BLOCK - 1) // BLOCK
    return blocks * k // pieces * BLOCK, min(blocks * (k + 1) // pieces * BLOCK, n)

"""The loops over contacts, and of their solve, that a team does piece by piece: see `team`.

They are compiled as functions of their own, of which the board has the address. As a part of the
step they would be compiled with each function that calls them, which took a minute more.
"""

from __future__ import annotations

import threading
from functools import cache

import numpy as np
from numba import types

from torchfilm.kernels.compiling import first_call, native
from torchfilm.kernels.contact_pieces import NEAR, do_contact_piece
from torchfilm.kernels.solve_pieces import do_piece
from torchfilm.kernels.team import DONE, LOOP, board_at, count_one, take

# A function that is being compiled is compiled once, whichever threads want it.
_compiling = threading.Lock()


def taker(dtype: type, lanes: int):
    """As `_taker`, from any thread."""
    with _compiling:
        return _taker(dtype, lanes)


@cache
def _taker(dtype: type, lanes: int):
    """A compiled function that takes pieces, of rows of this type and with so many columns. It gets
    the address of a board, and whether it leads: then it returns when no piece is left, with how
    many it did; else it assists, until there will be no more."""
    dof = (0,) * lanes

    def take_pieces(address, leads):
        board, count = board_at(address), 0
        like: np.ndarray = np.empty(0, dtype)
        k = take(board, leads)
        while k >= 0:
            if board[LOOP] >= NEAR:
                do_contact_piece(board, k, like, dof)
            else:
                do_piece(board, k, like, dof)
            count += 1
            if not leads:
                count_one(board, DONE)
            k = take(board, leads)
        return count

    take_pieces.__qualname__ += f"_{np.dtype(dtype).name}_{lanes}"  # kept in a file of its own
    name = f"{2 if lanes == 4 else 3}-D, {np.dtype(dtype).name}"
    with first_call(f"{name}, teams", f"contacts of large colonies ({name}), some 20 s"):
        return native(types.int64(types.int64, types.int64), take_pieces)

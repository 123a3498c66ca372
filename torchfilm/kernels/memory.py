"""Memory that a thread keeps from step to step, for the arrays of a kernel.

A large array that is freed goes back to the system, and comes again page by page: each is cleared
by the system and entered in its tables, 1 µs for 4 KB. In colonies of 25,000 cells this took a
quarter of a step. So arrays lie one after the other in `store`, which stays; a kernel gives back
all that it took since some place at once, by `give_back`. What finds no room is allocated as usual;
before the next call the store is made as large as it would have had to be.
"""

from __future__ import annotations

import threading

import numba
import numpy as np
from numba import types

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.lanes import intrinsic

# Places in `marks`: bytes in use, and the most that were; with those that found no room.
TOP, MOST = range(2)
# Arrays begin at multiples of so many bytes: lines of the processor's memory.
LINE = 64
# A store is made smaller when it is so many bytes, and four times, larger than was needed.
ROOMY = 1 << 22


@intrinsic
def pointer(typing, address, kind):
    """A pointer to numbers of this kind: a type, or an array of such numbers."""
    made = types.CPointer(kind.dtype)

    def emit(context, builder, signature, given):
        return builder.inttoptr(given[0], context.get_value_type(made))

    return made(types.int64, kind), emit


@intrinsic
def _bytes_of(typing, kind):
    """Of a number of this kind."""
    size = kind.dtype.bitwidth // 8

    def emit(context, builder, signature, given):
        return context.get_constant(types.int64, size)

    return types.int64(kind), emit


@kernel
def _place(memory, size):
    """The address of so many bytes, or 0 where there is no room."""
    store, marks = memory
    begin = marks[TOP]
    marks[TOP] += (size + LINE - 1) // LINE * LINE
    marks[MOST] = max(marks[MOST], marks[TOP])
    return store.ctypes.data + begin if marks[TOP] <= store.shape[0] else 0


@kernel(inline=True)
def room(memory, shape, kind):
    """An array of this shape, a tuple, and kind, such as np.int32; its numbers are yet to be put
    in."""
    size = _bytes_of(kind)
    for k in range(len(shape)):
        size *= shape[k]
    address = _place(memory, size)
    if address == 0:
        return np.empty(shape, kind)
    return numba.carray(pointer(address, kind), shape)


@kernel(inline=True)
def zeros(memory, shape, kind):
    """As `room`, all 0."""
    out = room(memory, shape, kind)
    flat = out.reshape(-1)
    for k in range(flat.shape[0]):
        flat[k] = 0
    return out


@kernel(inline=True)
def give_back(memory, top):
    """All arrays taken since `marks[TOP]` was this."""
    memory[1][TOP] = top


def no_memory() -> tuple[np.ndarray, np.ndarray]:
    """A store of no size and its marks: all arrays are allocated as usual, so that Python may have
    them."""
    return new_store(0), np.zeros(2, np.int64)


def new_store(size: int) -> np.ndarray:
    """So many bytes, from the beginning of a line."""
    store: np.ndarray = np.empty(size + LINE, np.uint8)
    first = -store.ctypes.data % LINE
    return store[first : first + size]


class KeptMemory(threading.local):
    """A store and its marks, of each thread that calls kernels."""

    def __init__(self) -> None:
        self.store, self.marks = no_memory()

    def call(self, function, *given: object) -> None:
        """function((store, marks), *given); then fit the store to what was needed."""
        function((self.store, self.marks), *given)
        most, size = int(self.marks[MOST]), self.store.size
        if most > size or 4 * most + ROOMY < size:
            self.store = new_store(most + most // 4)
        self.marks[MOST] = 0


kept = KeptMemory()

"""Memory that a thread keeps from step to step, for the arrays of a kernel.

A large array that is freed goes back to the system, and comes again page by page: each is cleared
by the system and entered in its tables, 1 µs for 4 KB. In colonies of 25,000 cells this took a
quarter of a step. So arrays lie one after the other in `store`, which stays; a kernel gives back
all that it took since some place at once, by `give_back`. What finds no room is allocated until it
is given back; before the next call the store is made as large as it would have had to be. So `lean`
kernels need not count who uses an array, as Numba does.
"""

from __future__ import annotations

import threading
from typing import Any

import numba
import numpy as np
from numba import types

from torchfilm.kernels.compiling import OVERWRITES, kernel, lean
from torchfilm.kernels.lanes import intrinsic

# Places in `marks`: bytes in use, and the most that were; with those that found no room. Then the
# address of what was allocated last; there stand that of what was allocated before, and the bytes
# that were in use.
TOP, MOST, LAST = range(3)
MARKS = 3
# Arrays begin at multiples of so many bytes: lines of the processor's memory.
LINE = 64
# A store is made smaller when it is so many bytes, and four times, larger than was needed; what
# was needed is forgotten by this share a call, since large and small colonies may take turns.
ROOMY, FORGOTTEN = 1 << 22, 0.02


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


_allocate: Any = types.ExternalFunction("NRT_Allocate", types.uintp(types.uintp))
_free: Any = types.ExternalFunction("NRT_Free", types.void(types.uintp))


@kernel(inline=True)
def _words_at(address):
    return numba.carray(pointer(address, np.int64), (2,))


@lean
def _place(memory, size):
    """The address of so many bytes."""
    store, marks = memory
    begin = marks[TOP]
    marks[TOP] += (size + LINE - 1) // LINE * LINE
    marks[MOST] = max(marks[MOST], marks[TOP])
    if marks[TOP] <= store.shape[0]:
        return np.int64(store.ctypes.data) + begin
    address = np.int64(_allocate(np.uintp(size + 2 * LINE)))
    if address == 0:
        raise MemoryError("no memory for the contacts of a colony")
    words = _words_at(address)
    words[0], words[1] = marks[LAST], begin
    marks[LAST] = address
    return (address + 2 * LINE - 1) // LINE * LINE


@lean
def _free_since(marks, top):
    """Free what was allocated since so many bytes were in use."""
    while marks[LAST] != 0:
        address = marks[LAST]
        words = _words_at(address)
        if words[1] < top:
            return
        marks[LAST] = words[0]
        _free(np.uintp(address))


@kernel(entry=True)
def free_all(marks):
    """Free all that was allocated because it found no room."""
    _free_since(marks, 0)


@kernel(inline=True)
def room(memory, shape, kind):
    """An array of this shape, a tuple, and kind, such as np.int32; its numbers are yet to be put
    in."""
    size = _bytes_of(kind)
    for k in range(len(shape)):
        size *= shape[k]
    return numba.carray(pointer(_place(memory, size), kind), shape)


@kernel(inline=True)
def zeros(memory, shape, kind):
    """As `room`, all 0."""
    out = room(memory, shape, kind)
    flat = shaped(out, (out.size,))
    for k in range(flat.shape[0]):
        flat[k] = 0
    return out


@kernel
def copied(memory, array, count):
    """The first `count` numbers of an array."""
    out = room(memory, (count,), array.dtype)
    for k in range(count):
        out[k] = array[k]
    return out


@kernel(inline=True)
def shaped(array, shape):
    """The numbers of an array in another shape; it must be contiguous. Numba's own form is a call,
    which takes longer than to go through a short array."""
    return numba.carray(pointer(array.ctypes.data, array), shape)


@lean(inline=True)
def give_back(memory, top):
    """All arrays taken since `marks[TOP]` was this."""
    store, marks = memory
    if OVERWRITES:
        for k in range(min(top, store.shape[0]), min(marks[TOP], store.shape[0])):
            store[k] = 255
    if marks[LAST] != 0:
        _free_since(marks, top)
    marks[TOP] = top


def no_memory() -> tuple[np.ndarray, np.ndarray]:
    """A store of no size and its marks: all arrays are allocated, and stay if nobody frees them, so
    that Python may have them in a test."""
    return new_store(0), np.zeros(MARKS, np.int64)


def new_store(size: int) -> np.ndarray:
    """So many bytes, from the beginning of a line."""
    store: np.ndarray = np.empty(size + LINE, np.uint8)
    first = -store.ctypes.data % LINE
    return store[first : first + size]


class KeptMemory(threading.local):
    """A store and its marks, of each thread that calls kernels. It stays until smaller colonies
    are stepped, or the thread ends."""

    def __init__(self) -> None:
        self.store, self.marks = no_memory()
        self.needed = 0.0  # bytes, by the calls of late

    def call(self, function, *given: object) -> None:
        """function((store, marks), *given); then fit the store to what was needed."""
        try:
            function((self.store, self.marks), *given)
        finally:
            if self.marks[LAST] != 0:
                free_all(self.marks)
        most, size = int(self.marks[MOST]), self.store.size
        self.marks[MOST] = 0
        self.needed = max(most, self.needed * (1 - FORGOTTEN))
        if most > size or 4 * self.needed + ROOMY < size:
            try:
                self.store = new_store(most + most // 4)
            except MemoryError:  # the step itself has found room
                return


kept = KeptMemory()

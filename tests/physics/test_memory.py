"""Memory that kernels keep from step to step."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.kernels import memory
from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.memory import (
    LAST,
    LINE,
    MARKS,
    MOST,
    TOP,
    KeptMemory,
    give_back,
    room,
    zeros,
)


@kernel(entry=True)
def addresses(kept, out):
    """Where arrays of 5 × 3, 0 and 7 numbers lie, and one in the place of the last."""
    a = room(kept, (5, 3), np.float64)
    b = room(kept, (0,), np.int32)
    top = kept[1][TOP]
    c = zeros(kept, (7,), np.uint8)
    a[:] = 1.0
    give_back(kept, top)
    d = room(kept, (2,), np.float32)
    found = a.ctypes.data, b.ctypes.data, c.ctypes.data, d.ctypes.data
    for k in range(4):
        out[k] = found[k]
    out[4], out[5] = c.sum(), a.sum()


def test_arrays_lie_one_after_the_other_and_what_is_given_back_is_used_again():
    store, marks, out = memory.new_store(1000), np.zeros(MARKS, np.int64), np.zeros(6, np.int64)
    store[:] = 255
    addresses((store, marks), out)
    first = store.ctypes.data
    assert first % LINE == 0
    a, b, c, d = out[:4] - first
    assert (a, b, c, d) == (0, 128, 128, 128)
    assert tuple(out[4:]) == (0, 15)
    assert (store[:120].view(np.float64) == 1.0).all() and (store[120:128] == 255).all()
    assert marks.tolist() == [192, 192, 0]


def test_what_finds_no_room_is_allocated_and_the_store_is_then_made_large_enough():
    kept, out = KeptMemory(), np.zeros(6, np.int64)
    kept.call(addresses, out)
    assert tuple(out[4:]) == (0, 15) and kept.store.size >= 192
    assert (out[:4] % LINE == 0).all() and kept.marks[MOST] == kept.marks[LAST] == 0
    kept.marks[TOP] = 0
    kept.call(addresses, out)
    assert (out[:4] >= kept.store.ctypes.data).all()
    assert (out[:4] < kept.store.ctypes.data + kept.store.size).all()


def test_a_store_much_larger_than_needed_is_made_smaller_after_a_while():
    kept, out, sizes = KeptMemory(), np.zeros(6, np.int64), []
    kept.store, kept.needed = memory.new_store(2 * memory.ROOMY), 2.0 * memory.ROOMY
    for _ in range(200):
        kept.marks[TOP] = 0
        kept.call(addresses, out)
        sizes.append(kept.store.size)
    assert sizes[20] == 2 * memory.ROOMY and sizes[-1] < 1000


@kernel(entry=True)
def many(kept, times, size, out):
    """Takes an array of this size again and again, and gives it back."""
    for k in range(times):
        top = kept[1][TOP]
        taken = room(kept, (size,), np.float64)
        taken[0] = k
        out[0] = kept[1][LAST]
        give_back(kept, top)
    out[1] = kept[1][LAST]


def test_what_found_no_room_is_freed_when_it_is_given_back():
    kept, out = KeptMemory(), np.zeros(2, np.int64)
    kept.call(many, 1000, 1 << 27, out)  # a gigabyte each, of which one page is touched
    assert out[0] != 0 and out[1] == 0


def test_a_lack_of_memory_is_an_error():
    kept, out = KeptMemory(), np.zeros(2, np.int64)
    with pytest.raises(MemoryError, match="contacts of a colony"):
        kept.call(many, 1, 1 << 58, out)
    assert kept.marks[LAST] == 0


def test_each_thread_has_a_store_of_its_own():
    kept, out, found = KeptMemory(), np.zeros(6, np.int64), []
    kept.call(addresses, out)

    def other():
        found.append(kept.store.size)

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert found == [0] and kept.store.size > 0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
def test_steps_have_the_same_bits_whatever_a_store_has_and_held(monkeypatch, dim, contacts):
    """No number is read before it is put in: a store of NaN, one of ones, and none of any size."""
    walls = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]
    effects = [
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.0)),
        tf.Mechanics(walls if dim == 3 else [], dim=dim, contacts=contacts, backend="compiled"),
    ]
    scene = tf.Scene(*effects, dim=dim, dt=0.05)

    def run(size, byte):
        kept = KeptMemory()
        call = kept.call

        def filled(function, *given):
            kept.store = memory.new_store(size)
            kept.store[:] = byte
            call(function, *given)

        kept.call = filled
        monkeypatch.setattr(memory, "kept", kept)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            *_, last = tf.simulate(scene, colonies=2, cells=300, seed=3)
        finally:
            torch.set_num_threads(threads)
        return last

    one = run(1 << 21, 255)
    for size, byte in ((1 << 21, 1), (1 << 21, 0), (0, 0)):
        other = run(size, byte)
        assert torch.equal(one.position, other.position) and torch.equal(one.axis, other.axis)
        assert all(torch.equal(one.fields[name], other.fields[name]) for name in one.fields)

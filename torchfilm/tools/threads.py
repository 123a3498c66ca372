"""Work shared among threads: as many as torch has, each with a range of its own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import pairwise

import torch


class _Given(threading.local):
    """How many threads torch had in a thread of Python before `one_torch_thread`."""

    count: int | None = None


_given = _Given()


def available() -> int:
    """How many threads kernels may use: as many as torch was given, also in `one_torch_thread`."""
    return _given.count or torch.get_num_threads()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch computes in this thread alone, and has its threads again afterwards; kernels of
    torchfilm keep as many threads as torch had.

        with tf.one_torch_thread():
            ...

    For work by kernels with operations of torch between them, on the CPU. Each operation that torch
    shares out leaves its other threads waiting in a loop, which keeps the kernels' threads, and
    other programs, from the processor: on two cores that took up to ten times as long. Runs and
    searches do so by themselves. It makes no difference to kernels; large sums of torch itself may
    differ in their last bits. A thread of Python that first uses torch meanwhile has one, too.
    """
    if _given.count is not None or torch.get_num_threads() == 1:
        yield  # the default of threads to come stays as it is
        return
    _given.count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_given.count)
        _given.count = None


@contextmanager
def given_torch_threads() -> Iterator[None]:
    """Inside of `one_torch_thread`: torch has the threads that it was given."""
    count = _given.count
    if count is None:
        yield
        return
    torch.set_num_threads(count)
    _given.count = None
    try:
        yield
    finally:
        _given.count = count
        torch.set_num_threads(1)


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="torchfilm")


def pool(threads: int) -> ThreadPoolExecutor:
    """The threads of this process."""
    return _pool(os.getpid(), threads)


def shares_of(count: int, least: int, work: Callable[[int, int], object]) -> None:
    """Call work(first, last) for ranges that make up 0 … count: in threads, where each has `least`
    or more to do. The work must not depend on how it is divided."""
    threads = min(available(), count // least)
    if threads < 2:
        work(0, count)
        return
    ends = [count * k // threads for k in range(threads + 1)]
    (first, last), *others = pairwise(ends)
    calls = [pool(threads).submit(work, a, b) for a, b in others]
    try:
        work(first, last)  # by this thread, which need not be woken
    finally:
        for call in calls:
            call.result()

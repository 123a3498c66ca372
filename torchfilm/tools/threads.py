"""Work shared among threads: as many as torch has, each with a range of its own."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import torch

from torchfilm.tools import subnormals

# Seconds of work for which a thread is worth waking: until it begins it takes 0.05 to 0.3 ms.
WORTH_WAKING = 4e-4


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


def submit(work: Callable[..., object], *given: Any) -> Future[object]:
    """Begin work(*given) in another thread of this process. Subnormal numbers are there what they
    are here, so that bits do not depend on the threads."""
    zero = subnormals.are_zero()

    def run() -> object:
        subnormals.set_zero(zero)
        return work(*given)

    return _pool(os.getpid(), available()).submit(run)


class Shared:
    """Work on many things that is done again and again: in several threads where each has enough of
    it, by how long the last call took. It must not depend on how it is divided."""

    def __init__(self) -> None:
        self.seconds = 0.0  # of one thing, in the last call

    def __call__(self, count: int, work: Callable[[int, int], object]) -> None:
        """Call work(first, last) for ranges that make up 0 … count."""
        threads = min(available(), count)
        if WORTH_WAKING > 0:
            threads = min(threads, int(count * self.seconds / WORTH_WAKING))
        ends = [count * k // threads for k in range(threads + 1)] if threads > 1 else [0, count]
        (first, last), *others = pairwise(ends)
        calls = [submit(work, a, b) for a, b in others]
        begin = time.perf_counter()
        try:
            work(first, last)  # by this thread, which need not be woken
            self.seconds = (time.perf_counter() - begin) / max(1, last)
        finally:
            wait(calls)  # also after an error: they work on what belongs to this thread
        for call in calls:
            call.result()

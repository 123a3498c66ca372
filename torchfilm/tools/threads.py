"""Work shared among threads: as many as torch has, each with a range of its own."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np
import torch

from torchfilm.tools import subnormals
from torchfilm.tools.warn_once import warn

# Seconds of work for which a thread is worth waking: until it begins it takes 0.05 to 0.3 ms. At
# 0.3 ms a step of circuits in 64 × 100 cells takes 0.64 ms on two threads, at 0.4 ms one thread did
# it in 0.88; smaller batches and single colonies took as long with either, and longer below 0.2 ms.
WORTH_WAKING = 3e-4


class _Forked:
    """Whether this process is a fork: the threads of its parent are gone, and torch would wait for
    its own for ever."""

    here = False

    def note(self) -> None:
        self.here = True


_forked = _Forked()
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forked.note)


def after_fork() -> None:
    """In a fork torch gets one thread, and a warning says so."""
    if not _forked.here:
        return
    _forked.here = False
    if available() > 1:
        torch.set_num_threads(1)
        _given.count = None
        warn(
            "this process was forked, without the threads of torch, for which it would wait for"
            " ever: torch computes in one thread here. Start processes by"
            " multiprocessing.get_context('spawn')."
        )


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
    after_fork()
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

    def __call__(
        self, count: int, work: Callable[[int, int], object], ends: np.ndarray | None = None
    ) -> None:
        """Call work(first, last) for ranges that make up 0 … count; they begin only at `ends`,
        ascending, if these are given: 0, where things begin that belong together, and count."""
        threads = min(available(), count)
        if WORTH_WAKING > 0:
            threads = min(threads, int(count * self.seconds / WORTH_WAKING))
        cuts = [count * k // threads for k in range(threads + 1)] if threads > 1 else [0, count]
        if ends is not None and threads > 1:
            cuts = ends[np.searchsorted(ends, cuts)].tolist()
        (first, last), *others = pairwise(cuts)
        calls = [submit(work, a, b) for a, b in others if a < b]
        begin = time.perf_counter()
        try:
            work(first, last)  # by this thread, which need not be woken
            self.seconds = (time.perf_counter() - begin) / max(1, last)
        finally:
            if calls:
                wait(calls)  # also after an error: they work on what belongs to this thread
        for call in calls:
            call.result()


class Loop(NamedTuple):
    """work(first, last) for a range of cells. whole: only for ranges of whole colonies."""

    work: Callable[[int, int], object]
    whole: bool = False


class Course:
    """Loops over cells, one after the other, that are done again and again: each thread does all of
    them for colonies of its own, since to hand over each loop would cost more than the loop. The
    cells of a single colony are shared out loop by loop, where they may be."""

    def __init__(self) -> None:
        self._all, self._each = Shared(), [Shared()]

    def __call__(self, loops: Sequence[Loop], ends: np.ndarray) -> None:
        """ends: where the cells of each colony begin, and how many cells there are, (B + 1,)."""
        count = int(ends[-1])
        if len(ends) > 2 or available() == 1:
            self._all(count, _in_turn(loops), ends)
            return
        parts = [(whole, list(part)) for whole, part in groupby(loops, key=lambda x: x.whole)]
        while len(self._each) < len(parts):
            self._each.append(Shared())
        for shared, (whole, part) in zip(self._each, parts, strict=False):
            if whole:
                _in_turn(part)(0, count)
            else:
                shared(count, _in_turn(part))


def _in_turn(loops: Sequence[Loop]) -> Callable[[int, int], object]:
    def work(first: int, last: int) -> None:
        for loop in loops:
            loop.work(first, last)

    return work

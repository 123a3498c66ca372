"""Work shared among threads: as many as torch has, each with a range of its own."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import torch


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="torchfilm")


def pool(threads: int) -> ThreadPoolExecutor:
    """The threads of this process."""
    return _pool(os.getpid(), threads)


def shares_of(count: int, least: int, work: Callable[[int, int], object]) -> None:
    """Call work(first, last) for ranges that make up 0 … count: in threads, where each has `least`
    or more to do. The work must not depend on how it is divided."""
    threads = min(torch.get_num_threads(), count // least)
    if threads < 2:
        work(0, count)
        return
    ends = [count * k // threads for k in range(threads + 1)]
    calls = [pool(threads).submit(work, a, b) for a, b in pairwise(ends)]
    for call in calls:
        call.result()

"""Work shared among threads: as many as torch has, each with a range of its own."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor

# For more numbers than this torch shares out an elementary function. Where other work is done on
# the machine, it then waits for the other threads: milliseconds, for microseconds of work.
FEW = 2048


def in_this_thread(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """An elementary function of each of x (K,), on the CPU by this thread alone. It must be one of
    those that `deterministic_math` lists: their values do not depend on the place in x."""
    if x.device.type != "cpu" or x.numel() <= FEW:
        return function(x)
    return torch.cat([function(part) for part in x.split(FEW)])


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

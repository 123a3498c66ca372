"""How many threads a command computes with."""

from __future__ import annotations

import math
import os
from pathlib import Path

import torch

from torchfilm.tools import checks


def use_threads(given: int | None, colonies: int | None = None) -> None:
    """Set torch's number of threads: the given one, or one for each core that this process may use,
    but no more than the batch has colonies, if that is known. OMP_NUM_THREADS, if set, takes the
    place of the cores."""
    if given is not None:
        checks.integer("--threads", given, least=1)
    if given is None:
        cores = torch.get_num_threads() if "OMP_NUM_THREADS" in os.environ else available_cores()
        given = cores if colonies is None else min(cores, max(1, colonies))
    torch.set_num_threads(given)


def available_cores(groups: Path = Path("/sys/fs/cgroup")) -> int:
    """The cores that this process may use, by its affinity and by the quota of its container."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    quota = _quota(groups)
    return count if quota > count else max(1, math.ceil(quota))


def _quota(groups: Path) -> float:
    """The cores that the control group of a container, of version 2 or 1, grants at once; infinite
    where there is no limit. More threads would have to wait for each other."""
    for names in (["cpu.max"], ["cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"]):
        try:
            words = " ".join((groups / name).read_text(encoding="utf-8") for name in names).split()
        except OSError:
            continue
        if len(words) == 2 and all(word.isdigit() for word in words) and int(words[1]) > 0:
            return int(words[0]) / int(words[1])
    return math.inf

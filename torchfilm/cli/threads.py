"""How many threads a command computes with. The library itself leaves torch's number as it is."""

from __future__ import annotations

import os

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


def available_cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

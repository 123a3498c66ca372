"""How many colonies a batch can hold: the memory that a colony needs, and the memory that is
free."""

from __future__ import annotations

import math
from pathlib import Path

import torch

# Measured peak of a step of the boundary detector (5 species, stiff, one signal), bytes in float32,
# plus half as much again as a reserve
BYTES_A_CELL, BYTES_A_VOXEL = 6000, 60
USE = 0.5  # share of the free memory: other batches and other programs use it too
CELLS = 1000  # assumed cells of a colony whose end is a time


def max_colonies(nodes: int, cells: int | None, dtype: torch.dtype, device: str) -> int:
    """The greatest number of colonies to grow at once, at least 1.

    nodes: grid nodes of a colony; cells: at its end, or None where its end is a time.
    """
    wide = 2 if dtype == torch.float64 else 1
    # a colony may have up to twice the requested cells when it is measured
    bytes_a_colony = wide * (BYTES_A_CELL * 2 * (cells or CELLS) + BYTES_A_VOXEL * nodes)
    return max(1, math.floor(USE * free_bytes(device) / bytes_a_colony))


def free_bytes(device: str) -> int:
    """Bytes of memory that are free on a device."""
    if torch.device(device).type == "cuda":
        # torch reuses the memory that it holds in reserve for its next batch
        return (
            torch.cuda.mem_get_info(torch.device(device))[0]
            + torch.cuda.memory_reserved(device)
            - torch.cuda.memory_allocated(device)
        )
    for line in (
        Path("/proc/meminfo").read_text().splitlines() if Path("/proc/meminfo").exists() else ()
    ):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return 4 * 2**30  # not Linux: a size that any machine has


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error reports that memory ran out."""
    return (
        isinstance(error, (MemoryError, torch.cuda.OutOfMemoryError))
        or "not enough memory" in str(error)
        or "out of memory" in str(error)
    )

"""How many colonies a batch can carry: what a colony is likely to take, and what memory is left."""

from __future__ import annotations

import math
from pathlib import Path

import torch

import torchfilm as tf

# Measured peak of a step of the boundary detector (5 species, stiff, one signal), bytes in float32,
# with half as much again to spare
BYTES_A_CELL, BYTES_A_VOXEL = 6000, 60
USE = 0.5  # of what is left: other batches, and whatever else the machine does
CELLS = 1000  # of a colony whose end is a time


def max_colonies(scene: tf.Scene, cells: int | None, dtype: torch.dtype, device: str) -> int:
    """At most how many colonies of this scene to grow at once, at least 1."""
    first = scene.seed(1, dtype=dtype, device="cpu")
    voxels = 0 if first.layout is None else first.layout.grid.nodes
    wide = 2 if dtype == torch.float64 else 1
    # a colony may have up to twice the cells wanted when it is measured
    return max(
        1,
        math.floor(
            USE
            * left(device)
            / (wide * (BYTES_A_CELL * 2 * (cells or CELLS) + BYTES_A_VOXEL * voxels))
        ),
    )


def left(device: str) -> int:
    """Bytes that can still be taken."""
    if torch.device(device).type == "cuda":
        # what torch holds in reserve is free for its next batch
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
    return 4 * 2**30  # not Linux: what any machine has


def is_lack_of_memory(error: BaseException) -> bool:
    return (
        isinstance(error, (MemoryError, torch.cuda.OutOfMemoryError))
        or "not enough memory" in str(error)
        or "out of memory" in str(error)
    )

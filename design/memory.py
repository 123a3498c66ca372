"""How many colonies a batch can hold: the memory that a colony needs, and the memory that is
free."""

from __future__ import annotations

import math
from pathlib import Path

import torch

# Measured peak of a step of the boundary detector (5 species, stiff, one signal), bytes in float32,
# plus half as much again as a reserve
BYTES_A_CELL, BYTES_A_VOXEL = 6000, 60
# Measured peak of a number that a target keeps after every step, with its derivative, from the note
# to the residuals (`Lasting`, 320 copies of colonies of 200 cells, 120 steps), rounded up
BYTES_A_NOTE = 60
USE = 0.5  # share of the free memory: other batches and other programs use it too
CELLS = 1000  # assumed cells of a colony whose end is a time
HOURS = 1.0  # assumed for its cells to double, where its end is a number of cells


def max_colonies(
    nodes: int, cells: int | None, dtype: torch.dtype, device: str, notes: float = 0.0
) -> int:
    """The greatest number of colonies to grow at once, at least 1.

    nodes: grid nodes of a colony; cells: at its end, or None where its end is a time; notes: the
    numbers for each cell that its target keeps in all (`kept_notes`).
    """
    wide = 2 if dtype == torch.float64 else 1
    count = cells or CELLS
    # a colony may have up to twice the requested cells when it is measured
    bytes_a_colony = (
        wide * (BYTES_A_CELL * 2 * count + BYTES_A_VOXEL * nodes) + BYTES_A_NOTE * notes * count
    )
    return max(1, math.floor(USE * free_bytes(device) / bytes_a_colony))


def kept_notes(
    each: float, founders: int, cells: int | None, until: float | None, dt: float
) -> float:
    """The numbers for each cell that a target keeps until the end of a colony.

    each: after one step (`Target.kept`); founders: cells at the start; cells, until (h): the end,
    whichever comes first; dt: h.
    """
    hours = math.inf if cells is None else HOURS * math.log2(max(cells / founders, 2.0))
    return each * min(hours, math.inf if until is None else until) / dt


def free_bytes(device: str) -> int:
    """Bytes of memory that are free on a device; on a GPU at most what is free on the CPU, where
    kernels take a copy of its colonies."""
    if torch.device(device).type == "cuda":
        # torch reuses the memory that it holds in reserve for its next batch
        there = (
            torch.cuda.mem_get_info(torch.device(device))[0]
            + torch.cuda.memory_reserved(device)
            - torch.cuda.memory_allocated(device)
        )
        return min(there, free_bytes("cpu"))
    for line in _text(Path("/proc/meminfo")).splitlines():
        if line.startswith("MemAvailable:"):
            return min(1024 * int(line.split()[1]), bytes_of_group())
    return 4 * 2**30  # not Linux: a size that any machine has


# Of a control group: the files with its limit, with what it uses, and what of that are copies of
# files, which give way. Version 2 and 1.
GROUP_FILES = ("memory.max", "memory.current", "inactive_file")
OLD_GROUP_FILES = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def bytes_of_group(
    root: Path = Path("/sys/fs/cgroup"), listed: Path = Path("/proc/self/cgroup")
) -> int:
    """Bytes of memory that the control groups of this process leave it, as a container or a job of
    a cluster has them; 2^63 where there are none. What is free on the machine does not show them,
    and who takes more is killed."""
    least = 2**63
    # a container sees its own group at the root, whatever is listed
    for line in ["0::/", "0:memory:/", *_text(listed).splitlines()]:
        _, kind, path = [*line.split(":", 2), "none", ""][:3]
        if kind in ("", "memory"):
            top, names = (root / "memory", OLD_GROUP_FILES) if kind else (root, GROUP_FILES)
            folder = top / path.lstrip("/")
            for place in (folder, *folder.parents):
                least = min(least, _left_by(place, *names))
                if place == top:
                    break
    return least


def _left_by(group: Path, most: str, used: str, kept: str) -> int:
    """Bytes that one control group leaves; 2^63 where it has no limit."""
    limit, taken = (_text(group / name).strip() for name in (most, used))
    if not (limit.isdigit() and taken.isdigit()):
        return 2**63
    lines = [line.split() for line in _text(group / "memory.stat").splitlines()]
    gives_way = [int(words[1]) for words in lines if len(words) == 2 and words[0] == kept]
    return max(0, int(limit) - int(taken) + sum(gives_way))


def _text(path: Path) -> str:
    """The text of a file, "" where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error reports that memory ran out."""
    return (
        isinstance(error, (MemoryError, torch.cuda.OutOfMemoryError))
        or "not enough memory" in str(error)
        or "out of memory" in str(error)
    )

"""Reads of the host from the device: each waits until a GPU has done all it was given.

So a step reads as rarely as it can, and several numbers at once. `tests/test_host_reads.py` counts.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Iterations of many systems at once between two reads whether all are done. A read never changes a
# result, because a finished system does not move. On an H200 (2026-11-27, one run) steps took, with
# 8 and with 2: 128 and 113 ms (1,000 cells), 564 and 594 (65,000), 1,751 and 1,381 (524,000). The
# host launches some 60 operations an iteration, which takes it longer than a read.
READ_EVERY = 2


def reads_are_free(device: torch.device) -> bool:
    """Whether the host may look at a number at any time."""
    return device.type == "cpu"


def numbers(*values: Tensor) -> list[int]:
    """Flags or whole numbers (), by one read."""
    if all(reads_are_free(value.device) for value in values):
        return [int(value) for value in values]
    return torch.stack([value.long() for value in values]).tolist()


def rows_where(*masks: Tensor) -> list[Tensor]:
    """Where each mask (K,) is true, ascending, by one read."""
    if not masks:
        return []
    if len(masks) == 1:
        return [torch.nonzero(masks[0]).squeeze(1)]
    counts = numbers(*(mask.sum() for mask in masks))
    return [known_rows_where(mask, count) for mask, count in zip(masks, counts, strict=True)]


def known_rows_where(mask: Tensor, count: int) -> Tensor:
    """Where a mask (K,) is true, ascending, if it is so `count` times: no read."""
    return torch.nonzero_static(mask, size=count).squeeze(1)

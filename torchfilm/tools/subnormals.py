"""Numbers too small for their type's usual form: below 1.2e-38 in float32 and 2.2e-308 in float64.

Processors take some hundred times as long over them. Signals hold many: far from its source a
concentration falls by a factor a voxel, without end.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch

# The least usual number. (A subnormal one would be read as 0 where this file is compiled while
# they count as 0.)
_LEAST, _HALF = sys.float_info.min, 0.5


def are_zero() -> bool:
    """Whether they count as 0 in this thread of Python."""
    return _LEAST * _HALF == 0.0


def set_zero(wanted: bool) -> None:
    """Let them count as 0 in this thread, or not; some processors know no such choice."""
    torch.set_flush_denormal(wanted)


@contextmanager
def as_zero() -> Iterator[None]:
    """They count as 0 in this thread, and in those that it shares its work with."""
    before = are_zero()
    set_zero(True)
    try:
        yield
    finally:
        set_zero(before)

"""The wall-clock time of each effect."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Timings:
    """Seconds spent under each name, summed over all steps."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def __repr__(self) -> str:
        each = sorted(self.seconds.items(), key=lambda item: -item[1])
        return f"Timings({', '.join(f'{name}: {s:.3g} s' for name, s in each)})"

    @contextmanager
    def of(self, name: str, device: torch.device) -> Iterator[None]:
        """Add the time of this block to `name`.

        It waits for a GPU to finish, so that the GPU's work counts for this block.
        """
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        start = time.perf_counter()
        yield
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

"""Who computes: compiled kernels or torch."""

from __future__ import annotations

import torch

from torchfilm.tools import checks
from torchfilm.tools.numba_calls import unavailable

BACKENDS = ("compiled", "torch")


def check_backend(owner: str, backend: str | None) -> None:
    """Raises InputError for what is no backend. owner: the class that it was given to."""
    if backend is not None:
        checks.choice(f"{owner}.backend", backend, BACKENDS)


def why_torch(owner: str, backend: str | None, device: torch.device) -> str:
    """Why torch computes on a device, or "" where kernels do. Raises InputError where "compiled" is
    asked for and cannot be."""
    if backend == "torch":
        return "backend='torch'"
    off_cpu = f"the device is {device.type}, and kernels are for the CPU"
    why = unavailable() if device.type == "cpu" else off_cpu
    if backend == "compiled" and why:
        raise checks.InputError(f"{owner}.backend = 'compiled', but {why}. Leave backend out.")
    return why

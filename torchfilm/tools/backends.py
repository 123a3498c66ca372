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
    """Why torch computes what is bound to a device, or "" where kernels do. Raises InputError where
    "compiled" is asked for and cannot be. On a GPU torch does, but what is bound to it may have a
    twin on the CPU (`torchfilm.cpu_parts`)."""
    if backend == "torch":
        return "backend='torch'"
    why = unavailable()
    if backend == "compiled" and why:
        raise checks.InputError(f"{owner}.backend = 'compiled', but {why}. Leave backend out.")
    return why or (
        ""
        if device.type == "cpu"
        else f"the state is on {device.type}, and kernels are for the CPU"
    )

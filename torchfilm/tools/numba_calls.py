"""What calls of compiled kernels need: whether there can be any, and arrays."""

from __future__ import annotations

import os
import sys
from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchfilm.tools.warn_once import warn

# Read when numba is imported. Where Intel's vector library is installed, LLVM would call it for
# whole vectors and another one for the rest: a number's bits would depend on its place.
os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")


@cache
def unavailable() -> str:
    """Why kernels cannot be compiled here, or "" where they can."""
    try:
        import numba  # noqa: F401
    except (ImportError, OSError) as error:  # or a library of its own cannot be loaded
        reason = f"Numba cannot be imported ({error})"
        warn(
            f"{reason}: torch computes contacts, circuits and exchange, ten times slower or more."
            " Install numba.",
            category=RuntimeWarning,
        )
        return reason
    return ""


def kernels_loaded(value: Tensor) -> bool:
    """Whether kernels are at hand for this tensor, for work that torch does to the same bits: to
    load them for that alone would cost more."""
    return value.device.type == "cpu" and "numba" in sys.modules


def as_array(value: Tensor, dtype: torch.dtype) -> np.ndarray:
    """A contiguous array of this type, which shares the tensor's memory where it can."""
    value = value.detach() if value.requires_grad else value
    value = value if value.dtype == dtype else value.to(dtype)
    return (value if value.is_contiguous() else value.contiguous()).numpy()


def in_numpy(dtype: torch.dtype) -> type:
    """NumPy's numbers of this type."""
    return np.float32 if dtype == torch.float32 else np.float64


@cache
def column_types() -> dict[torch.dtype, int]:
    """How `kernels.columns` names the types of columns that kernels can take."""
    from torchfilm.kernels import columns

    return {
        torch.float32: columns.FLOAT32, torch.float64: columns.FLOAT64, torch.int64: columns.INT64,
        torch.int32: columns.INT32, torch.bool: columns.BOOL,
    }  # fmt: skip

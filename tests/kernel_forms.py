"""Kernels that only other kernels call, for tests to call."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from torchfilm.kernels.compiling import kernel


@cache
def for_python(inner: Callable) -> Callable:
    """The same function with a form for Python. A call of the inner one would end the process."""
    return kernel(inner.py_func, entry=True)

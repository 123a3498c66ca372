"""A limit on the time that a user's Python may take."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class TooLong(BaseException):
    """Raised in Python code that runs past its limit; not an Exception, so that a script's own
    `except Exception` does not take it."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raises TooLong in the Python code within once it has run for so many seconds. A call into
    compiled code ends first."""
    caller, over = threading.get_ident(), threading.Event()
    lock = threading.Lock()

    def interrupt() -> None:
        with lock:  # not after the code has ended
            if not over.is_set():
                ctypes.pythonapi.PyThreadState_SetAsyncExc(
                    ctypes.c_ulong(caller), ctypes.py_object(TooLong)
                )

    timer = threading.Timer(seconds, interrupt)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        with lock:
            over.set()
        timer.cancel()

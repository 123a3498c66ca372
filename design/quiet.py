"""Other packages at work: what they warn of, and the global generators that they draw from."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

# Filters of warnings and global generators are those of the whole process: while one thread has
# changed them, another must not, or what they were before would be lost.
ALONE = threading.RLock()


@contextmanager
def alone_and_quiet() -> Iterator[None]:
    """One thread at a time, without warnings: for packages that warn of what is handled here."""
    with ALONE, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield

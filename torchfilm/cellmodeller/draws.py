"""Random numbers of a script: Python's `random` and `numpy.random`, seeded anew for each call.

The seed of a call depends on the seed of the run, the stream of the colony, the step, what is
called, and the cell. So draws do not depend on the batch or on a restart.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

# ruff: noqa: NPY002 - scripts use numpy's global generator


@contextmanager
def kept() -> Iterator[None]:
    """Leaves both generators as they were before."""
    before, before_numpy = random.getstate(), np.random.get_state()
    try:
        yield
    finally:
        random.setstate(before)
        np.random.set_state(before_numpy)


def seed(*key: int | str) -> None:
    """Seed both generators from a key, such as (seed, stream, step, "update")."""
    word = hashlib.blake2b(repr(key).encode(), digest_size=8).digest()
    random.seed(int.from_bytes(word, "little"))
    np.random.seed(int.from_bytes(word[:4], "little"))

"""Warnings that are given once where one request of the user makes and binds many scenes."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

# What has been said so far; None outside `once`. A context variable, so that threads do not silence
# each other.
_SAID: ContextVar[set[str] | None] = ContextVar("said", default=None)
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)


@contextmanager
def once(said: Iterable[str] = ()) -> Iterator[set[str]]:
    """Within, `warn` gives no text twice, and none of `said`. Gives the set of texts so far. A
    `once` within another one belongs to it."""
    outer = _SAID.get()
    known = {*said, *(outer or ())}
    token = _SAID.set(known)
    try:
        yield known
    finally:
        _SAID.reset(token)
        if outer is not None:
            outer |= known


@contextmanager
def quietly() -> Iterator[None]:
    """Within, `warn` gives nothing: what is bound here, the user has bound or will bind himself."""
    token = _QUIET.set(True)
    try:
        yield
    finally:
        _QUIET.reset(token)


def warn(text: str, *, stacklevel: int) -> None:
    """Warn of what is probably a mistake, unless a surrounding `once` has said so already.
    stacklevel: as for `warnings.warn`, counted from the caller."""
    if _QUIET.get():
        return
    said = _SAID.get()
    if said is None or text not in said:
        warnings.warn(text, stacklevel=stacklevel + 1)
    if said is not None:
        said.add(text)

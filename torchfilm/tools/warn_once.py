"""Warnings that are given once where one request of the user makes and binds many scenes."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

# Modules between a user's line and a warning: torch runs steps again for a gradient.
WITHIN = ("torchfilm", "design", "torch", "contextlib")
# What a warning is about that says nothing of the designs of a search: some make next to nothing.
SMALL_SPECIES = "small species"
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


def warn(text: str, *, category: type[Warning] = UserWarning, of: str | None = None) -> None:
    """Warn of what is probably a mistake, at the user's line, unless a surrounding `once` has said
    so already. of: what it is about, where its text has numbers that differ between the designs of
    a search; by default it is known by its text."""
    if _QUIET.get():
        return
    said, known = _SAID.get(), text if of is None else of
    if said is None or known not in said:
        warnings.warn(text, category, stacklevel=_users_level() + 1)
    if said is not None:
        said.add(known)


def _users_level() -> int:
    """The stacklevel, counted from the caller of `warn`, of the nearest line that is neither
    torchfilm's nor of what runs in between."""
    frame, level = sys._getframe(2), 1
    while frame.f_globals.get("__name__", "").partition(".")[0] in WITHIN:
        if frame.f_back is None:
            return 1
        frame, level = frame.f_back, level + 1
    return level

"""Growth recordings, kept while the process lives, so that every batch of a search shares them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import torchfilm as tf

MOST_BYTES = 2**30  # of recorded steps; above this, the least recently used recordings are dropped
_kept: dict[Any, tf.GrowthRecording] = {}
_lock = threading.Lock()


def find_or_record(
    key: tuple[Any, ...],
    streams: tuple[int, ...],
    cells: int | None,
    record: Callable[[], tf.GrowthRecording],
) -> tf.GrowthRecording:
    """Return a kept recording that serves these streams up to `cells` cells, or start a new one.

    key: everything else that the growth depends on. record: starts a new recording.
    """
    with _lock:  # threads of one search share the recordings
        found = _find(key, streams, cells) or record()
        _keep((*key, found.streams, found.cells), found)
        return found


def _find(
    key: tuple[Any, ...], streams: tuple[int, ...], cells: int | None
) -> tf.GrowthRecording | None:
    for known, recording in list(_kept.items()):
        # a colony leaves the recording at its own end, so a longer recording serves as well
        long_enough = recording.cells is None or (cells is not None and recording.cells >= cells)
        if known[:-2] == key and set(streams) <= set(recording.streams) and long_enough:
            return recording
    return None


def _keep(key: tuple[Any, ...], recording: tf.GrowthRecording) -> None:
    """Keep it as the latest in use. Recordings grow while they are used, so that each use drops
    others above the limit."""
    _kept.pop(key, None)
    while _kept and sum(x.nbytes for x in (*_kept.values(), recording)) > MOST_BYTES:
        _kept.pop(next(iter(_kept)))
    _kept[key] = recording

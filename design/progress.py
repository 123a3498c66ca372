"""The progress bar of a search and of a robustness check: colonies simulated."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import torchfilm as tf

if TYPE_CHECKING:
    from tqdm import tqdm

FORM = "{desc} |{bar}| {n:.0f}/{total:.0f} colonies {elapsed}<{remaining}{postfix}"


def open_bar(
    total: float, progress: bool | None, name: str = "search", note: str = ""
) -> AbstractContextManager[tqdm | None]:
    """A bar of `total` colonies, or None where `progress` wants none; None as progress: a bar in a
    notebook and on a terminal. Needs tqdm (the `app` extra)."""
    if not tf.progress.wanted(progress):
        return nullcontext()
    bar = tf.progress.bar(total, name, FORM)
    bar.set_postfix_str(note)
    return bar


def advance(bar: tqdm | None, colonies: float) -> None:
    """Add colonies to a bar, if there is one."""
    if bar is not None:
        bar.update(colonies)

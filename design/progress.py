"""The progress bar of a search and of a robustness check: colonies simulated."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import torchfilm as tf

if TYPE_CHECKING:
    from tqdm import tqdm


def open_bar(
    total: float, progress: bool, name: str = "search", note: str = ""
) -> AbstractContextManager[tqdm | None]:
    """A bar of `total` colonies, or None without `progress`. Needs tqdm (the `app` extra)."""
    if not progress:
        return nullcontext()
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise tf.InputError(
            'a progress bar needs tqdm: pip install "torchfilm[app]", or give progress=False.'
        ) from error
    form = "{desc} |{bar}| {n:.0f}/{total:.0f} colonies {elapsed}<{remaining}{postfix}"
    bar = tqdm(total=total, bar_format=form, desc=name, disable=None, mininterval=0.3)
    bar.set_postfix_str(note)
    return bar


def advance(bar: tqdm | None, colonies: float) -> None:
    """Add colonies to a bar, if there is one."""
    if bar is not None:
        bar.update(colonies)

"""The progress bars of searches, robustness checks and inference."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import torchfilm as tf
from design.study import Study

if TYPE_CHECKING:
    from tqdm import tqdm

FORM = "{desc} |{bar}| {n:.0f}/{total:.0f} COUNTED {elapsed}<{remaining}{postfix}"


def open_bar(
    total: float,
    progress: bool | None,
    name: str = "search",
    note: str = "",
    *,
    counted: str = "colonies",
) -> AbstractContextManager[tqdm | None]:
    """A bar of `total` colonies, or of what else is counted, or None where `progress` wants none;
    None as progress: a bar in a notebook and on a terminal. Needs tqdm (the `app` extra)."""
    if not tf.progress.wanted(progress):
        return nullcontext()
    bar = tf.progress.bar(total, name, FORM.replace("COUNTED", counted))
    bar.set_postfix_str(note)
    return bar


def finish(bar: tqdm | None) -> None:
    """Show a bar full whose work is done with fewer than its total, if there is one: designs take
    several colonies each, and the rest may pay for none."""
    if bar is not None:
        bar.total = bar.n
        bar.refresh()


def show(bar: tqdm | None, study: Study) -> None:
    """Show the colonies and the lowest loss of a search so far."""
    if bar is None:
        return
    found = study.best()
    advance(bar, min(study.colonies, bar.total) - bar.n)
    failed = study.failed
    best = "no full-size colony yet" if found is None else f"best loss {found[1]:.4f}"
    bar.set_postfix_str(best + (f", {failed} colonies failed" if failed else ""))


def advance(bar: tqdm | None, colonies: float) -> None:
    """Add to what a bar counts, if there is one."""
    if bar is not None:
        bar.update(colonies)

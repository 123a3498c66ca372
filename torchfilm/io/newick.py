"""Trees in Newick format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np


def newick(
    root: int,
    daughters: Mapping[int, Sequence[int]],
    lengths: np.ndarray,
    name: Callable[[int], str],
) -> str:
    """The tree below a row, without recursion: it may be thousands of branches deep. daughters: of
    each row that has some; lengths: of the branches, (N,); name: of a row."""
    text: list[str] = []
    stack: list[int | str] = [root]
    while stack:
        item = stack.pop()
        if isinstance(item, str):
            text.append(item)
            continue
        stack.append(f"{name(item)}:{lengths[item]:.6g}")
        if of := daughters.get(item):
            stack.append(")")
            for daughter in reversed(of):
                stack += [daughter, ","]
            stack[-1] = "("
    return "".join(text)


def with_ancestors(kept: np.ndarray, mothers: np.ndarray) -> np.ndarray:
    """Rows (N,) bool and all their ancestors. mothers: the row of each one's mother, −1 where it
    has none."""
    kept = kept.copy()
    new = np.flatnonzero(kept)
    while new.size:
        above = np.unique(mothers[new])
        new = above[(above >= 0) & ~kept[above]]
        kept[new] = True
    return kept

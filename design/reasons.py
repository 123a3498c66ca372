"""The reasons of failures, counted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

TIME = r"^at \S+ h: | at \S+ h$"
NUMBER = r"[-+]?\d+(\.\d+)?(e[+-]?\d+)?"


def tally(reasons: Iterable[str]) -> list[tuple[str, int]]:
    """The reasons without their times, and how often each came, most first. Those that differ in
    numbers alone are one, in the words of the first."""
    firsts: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for words in reasons:
        untimed = re.sub(TIME, "", words)
        kind = re.sub(NUMBER, "#", untimed)
        counts[firsts.setdefault(kind, untimed)] += 1
    return counts.most_common()

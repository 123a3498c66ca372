"""Watches the global variables of a script: results do not hold them."""

from __future__ import annotations

import copy
from types import ModuleType
from typing import Any

import numpy as np

PLAIN = (bool, int, float, complex, str, type(None), np.number, np.bool_)
MOST = 10_000  # entries of a list that is compared


class GlobalsWatch:
    """The numbers, texts, lists and dicts among a module's global variables, as they were."""

    def __init__(self, module: ModuleType):
        self.module = module
        self.before = {
            name: copy.deepcopy(value)
            for name, value in vars(module).items()
            if not name.startswith("__") and _is_plain(value)
        }

    def changed(self) -> list[str]:
        """The names of those that differ from before, and of new ones."""
        now = {n: v for n, v in vars(self.module).items() if not n.startswith("__")}
        new = [n for n, v in now.items() if n not in self.before and _is_plain(v)]
        return sorted(
            [*new, *(n for n, v in self.before.items() if n not in now or not _same(v, now[n]))]
        )

    def restore(self) -> None:
        """Sets them back, and removes new ones."""
        for name in self.changed():
            if name in self.before:
                setattr(self.module, name, copy.deepcopy(self.before[name]))
            else:
                delattr(self.module, name)


def _is_plain(value: Any) -> bool:
    if isinstance(value, PLAIN):
        return True
    if isinstance(value, np.ndarray):
        return value.size <= MOST and value.dtype.kind in "biufc"
    if isinstance(value, (list, tuple, set)):
        return len(value) <= MOST and all(map(_is_plain, value))
    if isinstance(value, dict):
        return len(value) <= MOST and all(_is_plain(x) for item in value.items() for x in item)
    return False


def _same(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(v, other[k]) for k, v in one.items())
    return bool(one == other) or (one != one and other != other)

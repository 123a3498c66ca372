"""Watches the global variables of a script: results do not hold them."""

from __future__ import annotations

import copy
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

PLAIN = (bool, int, float, complex, str, type(None), np.number, np.bool_)
MOST = 10_000  # entries of a list that is compared


class GlobalsWatch:
    """The numbers, texts, lists and dicts among a module's global variables, as they were, also
    those in objects and classes of its own and in the defaults of its functions."""

    def __init__(self, module: ModuleType):
        self.module = module
        self.before = copy.deepcopy(self._now())

    def changed(self) -> list[str]:
        """The names of those that differ from before, and of new ones."""
        now = self._now()
        return sorted(
            n
            for n in {**self.before, **now}
            if n not in now or n not in self.before or not _same(self.before[n], now[n])
        )

    def restore(self) -> None:
        """Sets them back, and removes new ones."""
        for name in self.changed():
            holder, _, last = name.rpartition(".")
            owner = getattr(self.module, holder) if holder else self.module
            if name in self.before:
                setattr(owner, last, copy.deepcopy(self.before[name]))
            else:
                delattr(owner, last)

    def _now(self) -> dict[str, Any]:
        """The values by name; those in an object as "object.name"."""
        found = {n: v for n, v in vars(self.module).items() if not n.startswith("__")}
        for holder, owner in list(found.items()):
            kind = owner if isinstance(owner, (type, FunctionType)) else type(owner)
            if getattr(kind, "__module__", None) != self.module.__name__:
                continue
            inner = {n: v for n, v in getattr(owner, "__dict__", {}).items() if n[:2] != "__"}
            if isinstance(owner, FunctionType) and owner.__defaults__ is not None:
                inner["__defaults__"] = owner.__defaults__
            found.update({f"{holder}.{n}": v for n, v in inner.items()})
        return {n: v for n, v in found.items() if _is_plain(v)}


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

"""Which names the code of a user's function speaks of."""

from __future__ import annotations

import inspect
from types import CodeType, FunctionType
from typing import Any


def names_in(*functions: Any) -> set[str] | None:
    """Names of attributes and globals, and texts, in the code of functions and of those that they
    call by name; None where one is no function written in Python, so that nobody can tell."""
    found: set[str] = set()
    seen: set[int] = set()
    waiting = list(functions)
    while waiting:
        function = waiting.pop()
        if not isinstance(function, FunctionType):
            return None
        if id(function) in seen:
            continue
        seen.add(id(function))
        named = _of_code(function.__code__)
        found |= named
        inside = inspect.getclosurevars(function).nonlocals.values()
        called = [function.__globals__.get(name) for name in named]
        waiting += [x for x in (*inside, *called) if isinstance(x, FunctionType)]
    return found


def _of_code(code: CodeType) -> set[str]:
    found = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, str):
            found.add(constant)
        elif isinstance(constant, CodeType):
            found |= _of_code(constant)
    return found

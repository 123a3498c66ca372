"""Which names the code of a user's function speaks of."""

from __future__ import annotations

import builtins
import dis
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
import torch

KNOWN_MODULES = ("torch", "math", "numpy", "torchfilm")
PLAIN = (int, float, bool, str, torch.Tensor, np.ndarray, np.generic, type(None))
ANY_NAME = ("getattr", "vars", "dir", "eval", "exec", "globals", "locals")


def names_in(whole: str, *functions: Any) -> set[str] | None:
    """The names of attributes and the texts in the code of functions and of those that they call by
    name; None where nobody can tell: one is no function written in Python, calls what is none, or
    takes an attribute of this name, `whole`, otherwise than as in `whole.name` or
    `whole["name"]`."""
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
        named = _of_code(function.__code__, whole)
        if named is None or named & set(ANY_NAME):
            return None
        found |= named
        used = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
        used += [function.__globals__[name] for name in named if name in function.__globals__]
        for cell in function.__closure__ or ():
            try:
                used.append(cell.cell_contents)
            except ValueError:  # not set yet
                return None
        for thing in used:
            if isinstance(thing, FunctionType):
                waiting.append(thing)
            elif not _is_plain(thing):
                return None
    return found


def _is_plain(thing: Any) -> bool:
    """Whether something reads no attribute of what a function gives to it."""
    if isinstance(thing, ModuleType):
        return thing.__name__.split(".")[0] in KNOWN_MODULES
    module, name = (getattr(thing, of, "") for of in ("__module__", "__name__"))
    if isinstance(module, str) and module.split(".")[0] in KNOWN_MODULES:
        return True
    is_builtin = isinstance(name, str) and getattr(builtins, name, None) is thing
    return isinstance(thing, PLAIN) or (is_builtin and thing is not None)


def _of_code(code: CodeType, whole: str) -> set[str] | None:
    found = set(code.co_names)
    steps = [s for s in dis.get_instructions(code) if s.opname not in ("CACHE", "PUSH_NULL")]
    for k, step in enumerate(steps[:-1]):
        if step.opname not in ("LOAD_ATTR", "LOAD_METHOD") or step.argval != whole:
            continue
        after = steps[k + 1]
        by_text = after.opname == "LOAD_CONST" and isinstance(after.argval, str)
        if not (after.opname in ("LOAD_ATTR", "LOAD_METHOD") or by_text):
            return None
    for constant in code.co_consts:
        if isinstance(constant, str):
            found.add(constant)
        elif isinstance(constant, CodeType):
            inner = _of_code(constant, whole)
            if inner is None:
                return None
            found |= inner
    return found

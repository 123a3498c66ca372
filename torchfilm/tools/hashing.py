"""What a thing is made of, as a digest: equal for things that are alike, in this process and in
another."""

from __future__ import annotations

import dataclasses
import dis
import hashlib
import re
from collections.abc import Mapping
from functools import partial
from types import CodeType, FunctionType, MethodType
from typing import Any

import numpy as np
import torch


def without_addresses(words: str) -> str:
    """How a thing is written, without where it lies in the memory of this process."""
    return re.sub(r" at 0x[0-9a-f]+", "", words)


def digest(*things: Any) -> str:
    """A short hexadecimal word that differs where numbers, arrays, options or the code of functions
    differ.

    Lists and tuples, and floats of any precision, go by what they hold. Functions go by what they
    do: their code, defaults, what they hold on to and what they use of their own module, not their
    names, line numbers or docstrings; objects of a user's class by their attributes and functions.
    What is imported from elsewhere is not looked into, and versions of Python may compile one
    function in two ways.
    """
    made = hashlib.sha256()
    _add(made, things, set())
    return made.hexdigest()[:16]


def _add(made: Any, thing: Any, within: set[int]) -> None:
    if isinstance(thing, torch.Tensor):
        thing = thing.detach().cpu().numpy()
    if isinstance(thing, np.ndarray):
        if thing.dtype.kind == "f":
            # a number from a file is the number that was written, in whatever precision
            thing = thing.astype(np.float64)
        made.update(
            f"array {thing.dtype} {thing.shape} ".encode() + np.ascontiguousarray(thing).tobytes()
        )
        return
    if isinstance(thing, (str, bytes, int, float, bool, complex, type(None))):
        made.update(f"{type(thing).__name__} {thing!r};".encode())
        return
    if id(thing) in within:  # a thing that holds itself, as a function that calls itself does
        made.update(b"again;")
        return
    within = within | {id(thing)}
    # a list may have been a tuple before it was in a file
    made.update(f"{'list' if isinstance(thing, tuple) else type(thing).__name__}(".encode())
    for part in _parts(thing):
        _add(made, part, within)
    made.update(b")")


OURS = ("torchfilm", "design", "torch", "numpy", "builtins")


def _parts(thing: Any) -> list[Any]:
    if isinstance(thing, FunctionType):
        held = [c.cell_contents for c in thing.__closure__ or () if not _is_empty(c)]
        code = thing.__code__
        # its first constant may be its docstring, which does nothing
        used = code.co_consts[1:] if code.co_consts[:1] == (thing.__doc__,) else code.co_consts
        return [
            code.co_code,
            code.co_names,
            used,
            thing.__defaults__,
            thing.__kwdefaults__,
            *held,
            *_globals(thing),
        ]
    if isinstance(thing, MethodType):
        return [thing.__func__, thing.__self__]
    if isinstance(thing, partial):
        return [thing.func, thing.args, thing.keywords]
    if isinstance(thing, CodeType):
        return [thing.co_code, thing.co_names, thing.co_consts]
    if isinstance(thing, Mapping):
        return [x for key, value in thing.items() for x in (key, value)]
    if isinstance(thing, (tuple, list)):
        return list(thing)
    if isinstance(thing, (set, frozenset)):
        return sorted(map(repr, thing))
    if (
        isinstance(thing, type)
        or not hasattr(thing, "__dict__")
        or type(thing).__module__ == "builtins"
    ):
        return [without_addresses(repr(thing))]
    kind = type(thing)
    if dataclasses.is_dataclass(thing):
        # what is not shown is not given by the user but worked out
        given = [getattr(thing, f.name) for f in dataclasses.fields(thing) if f.repr]
    elif kind.__module__.split(".")[0] in OURS:
        return [kind.__qualname__, without_addresses(repr(thing))]
    else:
        given = [x for name, value in vars(thing).items() for x in (name, value)]
    # a class of the user's own is also what its functions do
    own = [c for c in kind.__mro__ if c.__module__.split(".")[0] not in OURS]
    return [
        kind.__qualname__,
        *given,
        *(f for c in own for f in vars(c).values() if isinstance(f, FunctionType)),
    ]


def _globals(function: FunctionType) -> list[Any]:
    """What a function uses of its own module: numbers, texts, arrays and other functions of it."""
    names: list[str] = []
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        names += [
            i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")
        ]
        codes += [c for c in code.co_consts if isinstance(c, CodeType)]
    used = [function.__globals__.get(name) for name in dict.fromkeys(names)]
    plain = (str, int, float, bool, tuple, list, dict, np.ndarray, torch.Tensor)
    return [
        x
        for x in used
        if isinstance(x, plain)
        or (isinstance(x, FunctionType) and x.__module__ == function.__module__)
    ]


def _is_empty(cell: Any) -> bool:
    try:
        return cell.cell_contents is cell  # raises where nothing was put in yet
    except ValueError:
        return True

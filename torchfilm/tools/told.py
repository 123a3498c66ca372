"""What a thing is made of, as a digest: equal for things that are alike, in this process and in another."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from types import CodeType, FunctionType
from typing import Any

import numpy as np
import torch


def digest(*things: Any) -> str:
    """A short hexadecimal word that differs where numbers, arrays, options or the code of functions differ.

    Functions go by what they do, their code, defaults and what they hold on to, not by their names or line numbers; other objects by their public
    representation. Python's own versions may compile one function in two ways.
    """
    made = hashlib.sha256()
    _add(made, things, set())
    return made.hexdigest()[:16]


def _add(made: Any, thing: Any, within: set[int]) -> None:
    if isinstance(thing, torch.Tensor):
        thing = thing.detach().cpu().numpy()
    if isinstance(thing, np.ndarray):
        made.update(f"array {thing.dtype} {thing.shape} ".encode() + np.ascontiguousarray(thing).tobytes())
        return
    if isinstance(thing, (str, bytes, int, float, bool, complex, type(None))):
        made.update(f"{type(thing).__name__} {thing!r};".encode())
        return
    if id(thing) in within:  # a thing that holds itself, as a function that calls itself does
        made.update(b"again;")
        return
    within = within | {id(thing)}
    made.update(f"{type(thing).__name__}(".encode())
    for part in _parts(thing):
        _add(made, part, within)
    made.update(b")")


def _parts(thing: Any) -> list[Any]:
    if isinstance(thing, FunctionType):
        held = [c.cell_contents for c in thing.__closure__ or () if not _is_empty(c)]
        return [thing.__code__, thing.__defaults__, thing.__kwdefaults__, *held]
    if isinstance(thing, CodeType):
        return [thing.co_code, thing.co_names, thing.co_consts]
    if isinstance(thing, Mapping):
        return [x for key, value in thing.items() for x in (key, value)]
    if isinstance(thing, (tuple, list)):
        return list(thing)
    if isinstance(thing, (set, frozenset)):
        return sorted(map(repr, thing))
    if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        # what is not shown is not given by the user but worked out
        return [type(thing).__qualname__, *(getattr(thing, f.name) for f in dataclasses.fields(thing) if f.repr)]
    return [re.sub(r" at 0x[0-9a-f]+", "", repr(thing))]


def _is_empty(cell: Any) -> bool:
    try:
        return cell.cell_contents is cell  # raises where nothing was put in yet
    except ValueError:
        return True

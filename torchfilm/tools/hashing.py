"""Digests of Python objects: equal for equal content, in this process and in another."""

from __future__ import annotations

import dataclasses
import dis
import hashlib
import inspect
import re
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from datetime import date, time, timedelta
from decimal import Decimal
from fractions import Fraction
from functools import cache, partial
from pathlib import Path, PurePath
from types import CodeType, FunctionType, MappingProxyType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch.nn.parameter import is_lazy


def without_addresses(text: str) -> str:
    """A text, such as a repr, without memory addresses of this process."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def digest(*things: Any) -> str:
    """A short hexadecimal word that differs where numbers, arrays, options or functions differ.

    Lists and tuples count as equal if their items do, and floats of any precision if their values
    do. A function counts by its code, its defaults, its closure and the globals of its own module
    that it uses, and so do the functions and values that it names in other modules of the user's,
    which are all but Python's and those of installed packages. Its name, line numbers and docstring
    do not count. An object of a user's class counts by its attributes, and by its class's methods,
    properties and plain values, but for names that begin with an underscore. A torch.nn module
    counts by its form and its weights, wherever it is defined. Classes that a function names do not
    count, nor what it imports as it runs. Different versions of Python may compile one function in
    different ways, and so give different digests.
    """
    return _Word(weights=True).of(things)


def digest_of_code(*things: Any) -> str:
    """As `digest`, but that the weights of networks do not count, which training changes."""
    return _Word(weights=False).of(things)


def digest_of_weights(*things: Any) -> str:
    """A word for the weights of the networks that these use; "" without a network."""
    modules = [x for net in networks(*things) for x in net.modules()]
    # in training mode a module may change its buffers as it runs
    buffers = [dict(x.named_buffers(recurse=False)) for x in modules if not x.training]
    found = [dict(x.named_parameters(recurse=False)) for x in modules]
    return digest(found, buffers) if found else ""


def networks(*things: Any) -> list[torch.nn.Module]:
    """The torch.nn modules that these use, in a fixed order; those inside of others are theirs."""
    return [x for x in _objects(things) if isinstance(x, torch.nn.Module)]


def trained(*things: Any) -> list[torch.Tensor]:
    """The tensors that these use and an optimiser may change: weights, and those that require
    gradients."""
    found: list[torch.Tensor] = []
    for thing in _objects(things):
        if isinstance(thing, torch.nn.Module):
            found += thing.parameters()
        elif isinstance(thing, torch.Tensor) and thing.is_leaf and thing.requires_grad:
            found.append(thing)
    return [x for x in found if not (is_lazy(x) or x.is_inference())]


def _objects(things: tuple[Any, ...]) -> Iterator[Any]:
    """Every object that counts for a digest, once; a module for all that it holds."""
    seen: dict[int, Any] = {}  # with the object itself, whose id may not be given to another
    queue = list(reversed(things))
    while queue:
        thing = queue.pop()
        if isinstance(thing, _NUMBERS) or id(thing) in seen:
            continue
        seen[id(thing)] = thing
        yield thing
        if not isinstance(thing, (torch.nn.Module, torch.Tensor)):
            queue += reversed(_parts(thing, weights=True))


# Values that count as they are written.
_VALUES = (
    str, bytes, int, float, bool, complex, type(None), range, Decimal, Fraction, date, time,
    timedelta, PurePath,
)  # fmt: skip
_NUMBERS = (*_VALUES, np.ndarray)
_MANY = (tuple, list, set, frozenset, deque, np.ndarray)


class _Word:
    """The digest of some things while it is made. weights: whether those of networks count. depth:
    how many sets it is within."""

    def __init__(self, *, weights: bool, depth: int = 0):
        self.weights, self.depth, self.hasher = weights, depth, hashlib.sha256()
        #: the numbers of what refers to others and was met before, by their ids; with the objects
        #: themselves, whose ids may not be given to others
        self.met: dict[int, tuple[int, Any]] = {}

    def of(self, thing: Any, enclosing: frozenset[int] = frozenset()) -> str:
        self._add(thing, enclosing)
        return self.hasher.hexdigest()[:16]

    def _add(self, thing: Any, enclosing: frozenset[int]) -> None:
        if isinstance(thing, torch.Tensor):
            thing = _numbers_of(thing)
        if isinstance(thing, np.generic):  # hours and the like have no number of Python's
            thing = np.asarray(thing) if thing.dtype.kind in "mMV" else thing.item()
        if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
            if thing.dtype.kind == "f":
                # a number from a file equals the written number, in any precision
                thing = thing.astype(np.float64)
            about = f"array {thing.dtype} {thing.shape} ".encode()
            self.hasher.update(about + np.ascontiguousarray(thing).tobytes())
            return
        if isinstance(thing, _VALUES):
            shown = repr(thing)
            shown = shown if isinstance(thing, (str, bytes)) else without_addresses(shown)
            self.hasher.update(f"{type(thing).__name__} {shown};".encode())
            return
        if id(thing) in enclosing:  # an object that contains itself, such as a recursive function
            self.hasher.update(b"again;")
            return
        if id(thing) in self.met:  # what refers to one another has many ways to each
            self.hasher.update(f"object {self.met[id(thing)][0]} again;".encode())
            return
        if _is_plain_object(thing):
            self.met[id(thing)] = len(self.met), thing
        enclosing = enclosing | {id(thing)}
        if isinstance(thing, (set, frozenset)):
            self.hasher.update(" ".join(self._words(thing, enclosing)).encode())
            return
        # a list may have been a tuple before it was written to a file
        kind = "list" if isinstance(thing, tuple) else type(thing).__name__
        self.hasher.update(f"{kind}(".encode())
        parts = _parts(thing, weights=self.weights)
        for part in parts:
            self._add(part, enclosing)
        if isinstance(thing, FunctionType) and any(isinstance(x, FunctionType) for x in parts):
            self.met[id(thing)] = len(self.met), thing
        self.hasher.update(b")")

    def _words(self, members: set[Any] | frozenset[Any], enclosing: frozenset[int]) -> list[str]:
        """What counts of a set: the words of its members, which have no order. Of sets that sets
        of objects hold, their sizes alone: each is a digest of its own, and would take long."""
        word = lambda x: _Word(weights=self.weights, depth=self.depth + 1).of(x, enclosing)
        return ["set", str(len(members)), *(sorted(map(word, members)) if self.depth < 2 else [])]


# The names of the script that runs, in its own process and in those that it starts.
SCRIPT = ("__main__", "__mp_main__")
OURS = ("torchfilm", "design", "torch", "numpy", "builtins")


def _parts(thing: Any, *, weights: bool) -> list[Any]:
    """The parts of an object that count for its digest."""
    if isinstance(thing, FunctionType):
        closure = [c.cell_contents for c in thing.__closure__ or () if not _is_empty(c)]
        return [
            thing.__code__,
            thing.__defaults__,
            thing.__kwdefaults__,
            *closure,
            *_globals(thing),
        ]
    if isinstance(thing, MethodType):
        return [thing.__func__, thing.__self__]
    if isinstance(thing, partial):
        return [thing.func, thing.args, thing.keywords]
    if isinstance(thing, CodeType):
        return _instructions(thing)
    if isinstance(thing, Mapping):
        return [x for key, value in thing.items() for x in (key, value)]
    if isinstance(thing, (tuple, list, deque)):
        return list(thing)
    if isinstance(thing, np.ndarray):
        return [thing.shape, *thing.ravel().tolist()]
    if isinstance(thing, (set, frozenset)):
        return sorted(thing, key=lambda x: without_addresses(repr(x)))
    if (
        isinstance(thing, type)
        or not (hasattr(thing, "__dict__") or _slots(thing))
        or type(thing).__module__ == "builtins"
    ):
        return [_imported(without_addresses(repr(thing)))]
    kind = type(thing)
    if dataclasses.is_dataclass(thing):
        # fields without repr are derived, not given by the user
        given = [getattr(thing, f.name) for f in dataclasses.fields(thing) if f.repr]
    elif kind.__module__.split(".")[0] in OURS:
        about = [kind.__qualname__, without_addresses(repr(thing))]
        return about + (_inside(thing, weights) if isinstance(thing, torch.nn.Module) else [])
    else:
        held = getattr(thing, "__dict__", {}) | _slots(thing)
        if isinstance(thing, torch.nn.Module):
            held = {n: x for n, x in held.items() if n not in OF_MODULES}
            held["inside"] = _inside(thing, weights)
        given = [x for name, value in held.items() for x in (name, value)]
    # a user's class also counts by its functions
    own = [c for c in kind.__mro__ if c.__module__.split(".")[0] not in OURS]
    return [kind.__qualname__, *given, *(x for c in own for x in _of_class(c))]


def _instructions(code: CodeType) -> list[Any]:
    """What a code does: its arguments, its instructions with the constants that they load, and
    where errors are caught. A docstring is loaded by none, but its place among the constants would
    change the others' numbers."""
    arguments = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
    found: list[Any] = [*arguments, code.co_flags & ARGUMENTS_AND_KIND, code.co_exceptiontable]
    of_values = {*dis.hasconst, *dis.hasname}
    for i in dis.get_instructions(code):
        if i.opname != "EXTENDED_ARG":
            found += [i.opname, i.argval if i.opcode in of_values else i.arg]
    return found


# *arguments, **arguments, generators and coroutines
ARGUMENTS_AND_KIND = (
    inspect.CO_VARARGS | inspect.CO_VARKEYWORDS | inspect.CO_GENERATOR | inspect.CO_COROUTINE
    | inspect.CO_ASYNC_GENERATOR
)  # fmt: skip
# Of what a function or a class uses, these count, wherever their types are defined. (None is what a
# name that is not there yet gives; paths differ where a project is copied.)
PLAIN = (
    *(kind for kind in _VALUES if kind not in (type(None), PurePath)), tuple, list, set, frozenset,
    deque, dict,
    MappingProxyType, SimpleNamespace, np.generic, np.ndarray, torch.Tensor, partial,
)  # fmt: skip


def _of_class(kind: type) -> list[Any]:
    """What counts of a class, besides the attributes of its objects."""
    found: list[Any] = []
    mine = _of_user(kind.__module__)
    for name, x in vars(kind).items():
        if isinstance(x, (FunctionType, torch.nn.Module, torch.Tensor)):
            found.append(x)
        elif mine and isinstance(x, property):
            found += [f for f in (x.fget, x.fset) if f is not None]
        elif mine and isinstance(x, (staticmethod, classmethod)):
            found.append(x.__func__)
        # private ones may be counters and stores, which change as it runs
        elif mine and isinstance(x, PLAIN) and not name.startswith("_"):
            found += [name, x]
    return found


def _of_user(name: str | None) -> bool:
    """Whether a module is the user's: none of Python's, of ours, or of an installed package. A
    script that was run, or a notebook, may have no file."""
    root = (name or "").split(".")[0]
    if root in OURS or root in sys.stdlib_module_names - {*SCRIPT}:
        return False
    file = getattr(sys.modules.get(name or ""), "__file__", None)
    return file is None or not INSTALLED & {*Path(file).parts}


INSTALLED = frozenset({"site-packages", "dist-packages"})
# What torch keeps in each module: its parts, and hooks and the like, which do not count.
OF_MODULES = frozenset(vars(torch.nn.Module()))


def _inside(module: torch.nn.Module, weights: bool) -> list[Any]:
    """The modules in a module, and its numbers."""
    numbers = [dict(module.named_parameters(recurse=False)), dict(module.named_buffers("", False))]
    # (named_children leaves out a module that comes again)
    return [dict(module._modules.items()), *(numbers if weights else [])]


def _numbers_of(value: torch.Tensor) -> Any:
    """The numbers of a tensor as NumPy has them, or a text where it has none."""
    if is_lazy(value) or value.is_meta:
        return "no numbers"
    value = value.detach()
    value = value.dequantize() if value.is_quantized else value.to_dense()
    return (value.double() if value.is_floating_point() else value).cpu().numpy()


def _imported(text: str) -> str:
    """A repr in which a class of the script that runs is named as where the script is imported."""
    for name in SCRIPT:
        text = text.replace(f"<class '{name}.", f"<class '{_script(name)}.")
    return text


def module_of(thing: object) -> str:
    """The name of the module that defines a function or an object's class: for the script that
    runs, that by which others import it, also in the processes that it starts."""
    name = getattr(thing, "__module__", None) or ""
    return _script(name, thing) if name in SCRIPT else name


def _script(name: str, thing: object = None) -> str:
    """The name by which the script that runs is imported; `name` where there is no file of it.
    thing: defined there; another process may have sent it."""
    main = sys.modules.get("__main__")
    code = inspect.unwrap(thing).__code__ if isinstance(thing, FunctionType) else None
    if code is None:  # an object that is called
        own = [vars(c)["__call__"] for c in type(thing).__mro__ if "__call__" in vars(c)]
        code = getattr(own[0], "__code__", None) if own else None
    file = getattr(main, "__file__", None) if code is None else code.co_filename
    spec = getattr(main, "__spec__", None)
    if spec is not None and file == spec.origin:  # by `python -m`
        return str(spec.name)
    if not file or Path(file).suffix != ".py":
        return name
    # a notebook names the file of a cell by the text of the cell, which may change
    in_notebook = Path(file).parent.name.startswith("ipykernel_") or "ipython-input" in file
    return name if in_notebook else Path(file).stem


def _is_plain_object(thing: Any) -> bool:
    """Whether it is an object of a class of a user's, but no dataclass."""
    kind = type(thing)
    return not (
        isinstance(thing, (FunctionType, MethodType, CodeType, partial, type, Mapping, *_MANY))
        or dataclasses.is_dataclass(thing)
        or kind.__module__.split(".")[0] in OURS
    )


def _slots(thing: Any) -> dict[str, Any]:
    """The attributes that an object of a user's class keeps in `__slots__`."""
    names: list[str] = []
    for kind in type(thing).__mro__:
        if kind.__module__.split(".")[0] not in OURS:
            slots = vars(kind).get("__slots__", ())
            own = (slots,) if isinstance(slots, str) else slots
            # Python keeps a name that begins with two underscores under another one
            private = f"_{kind.__name__.lstrip('_')}"
            names += [private + n if re.fullmatch(r"__\w*(?<!__)", n) else n for n in own]
    names = [n for n in names if n not in ("__dict__", "__weakref__")]
    return {n: getattr(thing, n) for n in names if hasattr(thing, n)}


def _globals(function: FunctionType) -> list[Any]:
    """The numbers, texts, arrays, dataclasses, and the functions and objects of its own and other
    modules of the user's that a function uses."""
    names: list[str] = []
    attributes: set[str] = set()
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        names += [
            i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")
        ]
        attributes |= {*code.co_names}
        codes += [c for c in code.co_consts if isinstance(c, CodeType)]
    used = [function.__globals__.get(name) for name in dict.fromkeys(names)]
    seen: set[str] = set()
    for module in used:  # it grows by what the function names of the modules in it
        if isinstance(module, ModuleType) and module.__name__ not in seen:
            seen.add(module.__name__)
            if _of_user(module.__name__):
                used += [vars(module)[n] for n in sorted(attributes & vars(module).keys())]
    # of a function that functools keeps the results of, the function
    used = [x.__wrapped__ if isinstance(x, CACHED) else x for x in used]
    mine = lambda x: x.__module__ == function.__module__ or _of_user(x.__module__)
    return [
        x
        for x in used
        if isinstance(x, PLAIN)
        or (dataclasses.is_dataclass(x) and not isinstance(x, type))
        or (isinstance(x, FunctionType) and mine(x))
        or isinstance(x, torch.nn.Module)
        or type(x).__module__ == function.__module__
        or (_of_user(type(x).__module__) and not isinstance(x, (type, FunctionType)))
    ]


CACHED = type(cache(len))


def _is_empty(cell: Any) -> bool:
    try:
        return cell.cell_contents is cell  # raises ValueError for an empty cell
    except ValueError:
        return True

"""Digests of Python objects: equal for equal content, in this process and in another."""

from __future__ import annotations

import dataclasses
import dis
import hashlib
import re
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from functools import cache, partial
from inspect import unwrap
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any, cast

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
    that it uses; so do functions, numbers and texts that come from other modules of the user's, but
    not from installed packages. Its name, line numbers and docstring do not count. An object of a
    user's class counts by its attributes and those of its class, with methods and properties, a
    torch.nn module by its form and its weights, wherever it is defined. Different versions of
    Python may compile one function in different ways, and so give different digests.
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


_NUMBERS = (str, bytes, int, float, bool, complex, type(None), np.ndarray)


class _Word:
    """The digest of some things while it is made. weights: whether those of networks count."""

    def __init__(self, *, weights: bool):
        self.weights, self.hasher = weights, hashlib.sha256()
        #: the numbers of what refers to others and was met before, by their ids
        self.met: dict[int, int] = {}

    def of(self, thing: Any) -> str:
        self._add(thing, set())
        return self.hasher.hexdigest()[:16]

    def _add(self, thing: Any, enclosing: set[int]) -> None:
        if isinstance(thing, torch.Tensor):
            thing = _numbers_of(thing)
        if isinstance(thing, np.ndarray):
            if thing.dtype.kind == "f":
                # a number from a file equals the written number, in any precision
                thing = thing.astype(np.float64)
            about = f"array {thing.dtype} {thing.shape} ".encode()
            self.hasher.update(about + np.ascontiguousarray(thing).tobytes())
            return
        if isinstance(thing, _NUMBERS):
            self.hasher.update(f"{type(thing).__name__} {thing!r};".encode())
            return
        if id(thing) in enclosing:  # an object that contains itself, such as a recursive function
            self.hasher.update(b"again;")
            return
        if _refers_to_others(thing):  # there may be many ways to each
            if id(thing) in self.met:
                self.hasher.update(f"object {self.met[id(thing)]} again;".encode())
                return
            self.met[id(thing)] = len(self.met)
        enclosing = enclosing | {id(thing)}
        # a list may have been a tuple before it was written to a file
        kind = "list" if isinstance(thing, tuple) else type(thing).__name__
        self.hasher.update(f"{kind}(".encode())
        for part in _parts(thing, weights=self.weights):
            self._add(part, enclosing)
        self.hasher.update(b")")


# The names of the script that runs, in its own process and in those that it starts.
SCRIPT = ("__main__", "__mp_main__")
OURS = ("torchfilm", "design", "torch", "numpy", "builtins")


def _parts(thing: Any, *, weights: bool) -> list[Any]:
    """The parts of an object that count for its digest."""
    if isinstance(thing, FunctionType):
        closure = [c.cell_contents for c in thing.__closure__ or () if not _is_empty(c)]
        code = thing.__code__
        # its first constant may be its docstring, which has no effect
        used = code.co_consts[1:] if code.co_consts[:1] == (thing.__doc__,) else code.co_consts
        return [
            code.co_code,
            code.co_names,
            used,
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
        return [thing.co_code, thing.co_names, thing.co_consts]
    if isinstance(thing, Mapping):
        return [x for key, value in thing.items() for x in (key, value)]
    if isinstance(thing, (tuple, list)):
        return list(thing)
    if isinstance(thing, (set, frozenset)):
        return sorted(map(repr, thing))
    if isinstance(thing, type) and _of_user(thing.__module__):
        return [thing.__qualname__, *_of_class(thing)]
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


def _of_class(kind: type) -> list[Any]:
    """What counts of a user's class: its methods and properties, and plain values by name."""
    found: list[Any] = []
    for name, x in vars(kind).items():
        if isinstance(x, property):
            found += [f for f in (x.fget, x.fset) if f is not None]
        elif isinstance(x, (staticmethod, classmethod)):
            found.append(x.__func__)
        elif isinstance(x, (FunctionType, torch.nn.Module, torch.Tensor)):
            found.append(x)
        elif isinstance(x, PLAIN) and not name.startswith("__") and name != "_abc_impl":
            found += [name, x]
    return found


# What counts as it is, wherever it stands.
PLAIN = (str, int, float, bool, tuple, list, dict, np.ndarray, torch.Tensor)
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
    code = unwrap(thing).__code__ if isinstance(thing, FunctionType) else None
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


def _refers_to_others(thing: Any) -> bool:
    """Whether it is a class of a user's, an object of one that is no dataclass, or a function that
    uses functions or classes."""
    kind = type(thing)
    if isinstance(thing, FunctionType):
        return any(isinstance(x, (FunctionType, type)) for x in _globals(thing))
    if isinstance(thing, type):
        return _of_user(thing.__module__)
    return not (
        isinstance(thing, (MethodType, CodeType, partial, Mapping, tuple, list))
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
        codes += [c for c in code.co_consts if isinstance(c, CodeType)]
        attributes |= {*code.co_names}
    used = [function.__globals__.get(name) for name in dict.fromkeys(names)]
    for module in [x for x in used if isinstance(x, ModuleType) and _of_user(x.__name__)]:
        used += [vars(module)[n] for n in sorted(attributes & vars(module).keys())]
    mine = lambda x: x.__module__ == function.__module__ or _of_user(x.__module__)
    wrapped = lambda x: callable(x) and isinstance(getattr(x, "__wrapped__", None), FunctionType)
    return [
        unwrap(cast(Any, x)) if wrapped(x) else x
        for x in used
        if isinstance(x, PLAIN)
        or (dataclasses.is_dataclass(x) and not isinstance(x, type))
        or ((isinstance(x, (FunctionType, type)) or wrapped(x)) and mine(x))
        or isinstance(x, torch.nn.Module)
        or mine(type(x))
    ]


@cache
def _of_user(name: str | None) -> bool:
    """Whether a module is a file of the user's: neither of Python nor of an installed package."""
    file = getattr(sys.modules.get(name or ""), "__file__", None)
    if not name or name.split(".")[0] in OURS or file is None or Path(file).suffix != ".py":
        return False
    path, installed = Path(file).resolve(), {sysconfig.get_path(k) for k in INSTALLED}
    return not any(path.is_relative_to(Path(root).resolve()) for root in installed)


INSTALLED = ("stdlib", "platstdlib", "purelib", "platlib")


def _is_empty(cell: Any) -> bool:
    try:
        return cell.cell_contents is cell  # raises ValueError for an empty cell
    except ValueError:
        return True

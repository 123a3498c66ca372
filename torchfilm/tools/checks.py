"""Checks of user input, with one message style: the name, the value, the rule, the fix."""

from __future__ import annotations

import abc
import difflib
import functools
import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from torch import Tensor

from torchfilm.tools.call_fits import CallFits
from torchfilm.tools.one_per_colony import Value as Value
from torchfilm.tools.one_per_colony import as_tensor
from torchfilm.tools.warn_once import SMALL_SPECIES as SMALL_SPECIES  # public, for searches
from torchfilm.tools.warn_once import once as once
from torchfilm.tools.warn_once import warn as warn
from torchfilm.tools.whole_files import write_whole as write_whole

Number = float | int
F = TypeVar("F", bound=Callable[..., Any])
ONE_OR_EACH = "Give one number, or one per colony."
WHOLE = torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64
NUMBERS = (*WHOLE, torch.float16, torch.bfloat16, torch.float32, torch.float64)


class InputError(ValueError):
    """Invalid input to torchfilm; raised before anything runs."""


class SimulationError(RuntimeError):
    """A run cannot continue. `colonies` has the ids of the colonies that failed."""

    def __init__(self, message: str, colonies: Sequence[int] = ()):
        super().__init__(message)
        self.colonies = tuple(colonies)


def input_error(name: str, value: object, allowed: str, hint: str = "") -> InputError:
    """The error for an invalid value. The caller raises it."""
    shown = repr(value) if len(repr(value)) < 120 else repr(value)[:117] + "..."
    return InputError(
        f"{name} = {shown} is not allowed: it must be {allowed}." + (f" {hint}" if hint else "")
    )


def install(extra: str) -> str:
    """How to install an extra of torchfilm, which is on no package index, for messages: from its
    folder where it runs from there, else beside what is installed."""
    if (Path(__file__).parents[2] / "pyproject.toml").exists():
        return f'pip install -e ".[{extra}]" in the folder of torchfilm'
    return f'pip install "torchfilm[{extra}]"'


def nearest(given: str, known: Iterable[str]) -> str | None:
    """The known name that was probably meant: a similar one, or one that begins the given name or
    begins with it ("dim" for "dimension"). None: no name is near."""
    known, plain = list(known), lambda n: "".join(filter(str.isalnum, n.lower()))
    near = [n for n in known if plain(n) == plain(given)]
    near = near or difflib.get_close_matches(given, known, n=1)
    if near:
        return near[0]
    begins = (n for n in known if len(min(n, given, key=len)) >= 3)
    return next((n for n in begins if n.startswith(given) or given.startswith(n)), None)


def suggestion(given: object, known: Iterable[object]) -> str:
    """'Did you mean …?' for a name that is like a known one, else ""."""
    names = [k for k in known if isinstance(k, str)]
    near = nearest(given, names) if isinstance(given, str) else None
    return f"Did you mean {near!r}?" if near else ""


def unknown_keyword(
    name: str, given: str, allowed: Sequence[str], instead: Mapping[str, str] | None = None
) -> InputError:
    """The error for a keyword that a function or class does not have, with the nearest one that it
    has; raise what this returns. name: of the function or class, such as "Growth". instead: what to
    write in place of certain keywords, such as those of earlier versions."""
    near = nearest(given, allowed)
    hint = (instead or {}).get(given) or (f"Did you mean {near}?" if near else "")
    return InputError(
        f"{name} has no parameter {given!r}."
        + (f" {hint}" if hint else "")
        + f" It has: {', '.join(allowed) or 'none'}."
    )


def known_keywords(function: F, instead: Mapping[str, str] | None = None) -> F:
    """Let a function raise InputError, with the nearest name, for a keyword that it does not take,
    and for an argument that is missing. instead: as in `unknown_keyword`."""
    call = CallFits(inspect.signature(function))

    @functools.wraps(function)
    def checked(*args: Any, **given: Any) -> Any:
        if not call.fits(args, given):
            check_call(function.__name__, call.signature, args, given, instead)
        return function(*args, **given)

    return cast(F, checked)


def check_call(
    name: str,
    signature: inspect.Signature,
    args: Sequence[Any],
    given: Mapping[str, Any],
    instead: Mapping[str, str] | None = None,
    unnamed: str = "",
) -> None:
    """Raise InputError for arguments that do not fit a signature. instead: as in `unknown_keyword`.
    unnamed: what to write where there are too many arguments without a name."""
    found = {n: p.kind for n, p in signature.parameters.items() if n not in ("self", "cls")}
    stars: dict[Any, str] = {
        inspect.Parameter.VAR_POSITIONAL: "*",
        inspect.Parameter.VAR_KEYWORD: "**",
    }
    allowed = [stars.get(kind, "") + n for n, kind in found.items()]
    if inspect.Parameter.VAR_KEYWORD not in found.values():
        for keyword in given:
            if keyword not in allowed:
                raise unknown_keyword(name, keyword, allowed, instead)
    try:
        signature.bind(*args, **given)
    except TypeError as error:
        many = str(error).startswith("too many positional")
        hint = (unnamed or _named_only(found, args[-1])) if many else ""
        raise InputError(
            f"{name}: {error}.{hint and ' ' + hint} Its parameters: {', '.join(allowed)}."
        ) from None


def _named_only(found: Mapping[str, Any], last: object) -> str:
    """What to write in place of a last argument that has no name but needs one."""
    named = [n for n, kind in found.items() if kind is inspect.Parameter.KEYWORD_ONLY]
    if "out" in named and isinstance(last, (str, os.PathLike)):
        return f"Write out={os.fspath(last)!r}."
    return f"Name them, such as {named[0]}=…." if named else ""


def only_own_data(file: Any) -> None:
    """Raise InputError for an open HDF5 file with parts that lie elsewhere: links, and datasets
    with data in other files. A file from elsewhere could show what it should not."""
    import h5py  # most scripts do without it

    groups, seen = [file], set()
    for group in groups:
        for name in group:
            part = f"{group.name.rstrip('/')}/{name}"
            own = isinstance(group.get(name, getlink=True), h5py.HardLink)
            item = group[name] if own else None
            if isinstance(item, h5py.Dataset):
                own = not (item.is_virtual or item.external)
            elif isinstance(item, h5py.Group):
                place = h5py.h5o.get_info(item.id).addr  # a group may have several names
                groups += [] if place in seen else [item]
                seen.add(place)
            if not own:
                raise InputError(
                    f"{file.filename} is not read: its {part!r} lies in another place. Files of"
                    " torchfilm hold all their data themselves."
                )


def default_device() -> None:
    """Raise InputError where torch makes tensors elsewhere by default: numbers that describe a
    scene would get there."""
    if torch.get_default_device().type != "cpu":
        raise InputError(
            f"torch's default device is {torch.get_default_device()}: leave it at the CPU"
            " (torch.set_default_device('cpu')), and say where colonies are to be computed, such as"
            " tf.simulate(…, device='cuda')."
        )


class KnownKeywords(abc.ABCMeta):
    """The metaclass of classes that raise InputError, with the nearest name, for a keyword that
    they do not take, and for an argument that is missing. (One of abstract classes: a user's
    subclass may be one.)
    instead, unnamed: of such a class, what to write in place of certain keywords, as of earlier
    versions, and of too many arguments without a name."""

    instead: Mapping[str, str] = {}
    unnamed: str = ""

    if not TYPE_CHECKING:  # type checkers see what each class takes, and makes

        def __call__(cls, *args: Any, **given: Any) -> Any:
            call = cls._call()
            if not call.fits(args, given):
                named = cls.instead, cls.unnamed
                check_call(cls.__name__, call.signature, args, given, *named)
            default_device()
            return super().__call__(*args, **given)

    def _call(cls) -> CallFits:
        """Of this class, worked out once."""
        if "_own_call" not in cls.__dict__:
            cls._own_call = CallFits(inspect.signature(cls))
        return cls.__dict__["_own_call"]

    @property
    def __signature__(cls) -> inspect.Signature:
        own = inspect.signature(cls.__init__)  # type: ignore[misc]
        return own.replace(parameters=list(own.parameters.values())[1:])


def integer(name: str, value: object, *, least: int, most: float = math.inf, hint: str = "") -> int:
    """Returns an integer within bounds, of Python or NumPy, as one of Python, or raises
    InputError."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not least <= value <= most:  # type: ignore[operator]
        upto = "" if most == math.inf else f" to {most}"
        raise input_error(name, value, f"a whole number from {least}{upto}", hint)
    return int(value)  # type: ignore[call-overload]


def number(
    name: str,
    value: object,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
    hint: str = "",
) -> float:
    """Returns one finite number within bounds, or raises InputError."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise input_error(name, value, "a number", hint)
    try:
        found = float(value)
    except OverflowError:  # a whole number of Python's, of any length
        raise input_error(name, value, _rule(above, least, most), hint) from None
    if not (math.isfinite(found) and found > above and least <= found <= most):
        raise input_error(name, value, _rule(above, least, most), hint)
    return found


def float_type(name: str, given: object) -> None:
    """Raises InputError for what is no type of numbers that states may have."""
    if given not in (torch.float32, torch.float64):
        raise input_error(name, given, "torch.float32 or torch.float64")


def value(
    name: str,
    given: object,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
    hint: str = ONE_OR_EACH,
) -> float | Tensor:
    """One number, or one per colony: returns a float or a 1-D tensor of floats.

    Raises InputError if an entry is outside the bounds; hint: the forms that are allowed. A tensor
    keeps its gradient.
    """
    given = getattr(given, "one_per_colony", given)  # of a PerColony
    try:
        given = as_tensor(given)
    except (TypeError, ValueError, RuntimeError) as error:
        raise input_error(name, given, "a number, or numbers", hint) from error
    if not isinstance(given, Tensor):
        return number(name, given, above=above, least=least, most=most, hint=hint)
    if torch._C._functorch.is_functorch_wrapped_tensor(given):
        instead = "torch.autograd.grad, tf.tangents, or one value for each colony in place of vmap"
        raise input_error(name, "in a transform of torch.func", "a plain tensor", f"Use {instead}.")
    if given.dim() > 1 or given.dtype not in NUMBERS or given.layout != torch.strided:
        kind = str(given.dtype).removeprefix("torch.")
        raise InputError(
            f"{name} is {kind} of shape {tuple(given.shape)}: it must be one number, or a dense"
            " 1-D tensor of real numbers, one per colony."
        )
    given = given if given.is_floating_point() else given.double()
    detached = given.detach()
    good = torch.isfinite(detached) & (detached > above) & (detached >= least) & (detached <= most)
    if not bool(good.all()):
        where = torch.nonzero(~good.reshape(-1)).reshape(-1)
        at = int(where[0])
        raise InputError(
            f"{name}[{at}] = {float(detached.reshape(-1)[at])} is not allowed ({len(where)} of"
            f" {detached.numel()} values): each must be {_rule(above, least, most)}."
        )
    return given


def part_value(
    name: str,
    given: Any,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    """A value of a part of an effect, such as a wall: as `value`. One that is stated for each
    colony or cell type, or drawn, stays as it is: the effect checks it."""
    stated = hasattr(given, "values") and not hasattr(given, "__array__")  # as tensors have
    if stated or hasattr(given, "draw"):
        return given
    return value(name, given, above=above, least=least, most=most)


def below(low: float | Tensor, high: float | Tensor) -> bool:
    """Whether low < high for every entry."""
    return bool((torch.as_tensor(low).detach() < torch.as_tensor(high).detach()).all())


def corners(
    name: str, low: object, high: object, hint: str = ""
) -> tuple[tuple[float | Tensor, ...], tuple[float | Tensor, ...]]:
    """Two opposite corners, with low < high along every axis, as two tuples.

    Entries are numbers (±inf allowed) or one number per colony.
    """
    if not all(
        isinstance(corner, (tuple, list, Tensor)) or hasattr(corner, "__array__")
        for corner in (low, high)
    ):
        raise input_error(
            f"{name}.low, {name}.high", (low, high), "two corners, such as (0, 0) and (10, 5)"
        )
    lows: tuple[Any, ...] = tuple(low)  # type: ignore[arg-type]
    highs: tuple[Any, ...] = tuple(high)  # type: ignore[arg-type]
    if len(lows) != len(highs) or len(lows) not in (2, 3):
        raise input_error(
            f"{name}.low, {name}.high", (low, high), "two corners of 2 or 3 numbers each"
        )
    checked = []
    for corner, side in ((lows, "low"), (highs, "high")):
        entries: list[float | Tensor] = []
        for k, entry in enumerate(corner):
            single = isinstance(entry, (int, float)) or getattr(entry, "ndim", 1) == 0
            bare = entry.detach() if isinstance(entry, Tensor) else entry
            if single and math.isinf(float(bare)):
                entries.append(float(bare))
            else:
                entries.append(
                    value(
                        f"{name}.{side}[{k}]",
                        float(entry) if single and not isinstance(entry, Tensor) else entry,
                    )
                )
        checked.append(tuple(entries))
    for axis, a, b in zip("xyz", checked[0], checked[1], strict=False):
        if not below(a, b):
            raise input_error(f"{name}.low, {name}.high along {axis}", (a, b), "low < high", hint)
    return checked[0], checked[1]


def _rule(above: float, least: float, most: float) -> str:
    """The bounds in words."""
    parts = ["finite"]
    if above > -math.inf:
        parts.append(f"above {above:g}")
    if least > -math.inf:
        parts.append(f"at least {least:g}")
    if most < math.inf:
        parts.append(f"at most {most:g}")
    return " and ".join(parts)


def choice(name: str, given: object, allowed: Sequence[object]) -> None:
    """Raises InputError if the value is not one of `allowed`; 2.0 is not 2."""
    alike = not isinstance(given, (bool, float)) or type(given) in map(type, allowed)
    if given not in allowed or not alike:
        listed = ", ".join(repr(a) for a in allowed)
        raise input_error(name, given, f"one of {listed}", suggestion(given, allowed))


def vector(name: str, given: object, size: int | None = None) -> tuple[float, ...]:
    """Returns a short tuple of finite numbers, or raises InputError."""
    try:
        entries: tuple[Any, ...] = tuple(given)  # type: ignore[arg-type]
        if any(isinstance(x, str) for x in entries):
            raise TypeError("texts")
        out = tuple(float(x) for x in entries)
    except (TypeError, ValueError) as error:
        raise input_error(name, given, "a sequence of numbers") from error
    if size is not None and len(out) != size:
        raise input_error(name, given, f"a sequence of {size} numbers")
    if not all(map(math.isfinite, out)):
        raise input_error(name, given, "finite")
    return out


LONGEST_NAME = 240  # bytes; file systems take 255, and what is written may first end in ".new"


def file_path(name: str, given: object, suffix: str = "") -> Path:
    """The path of a file, or InputError for what is no path, or has another suffix than this."""
    if not isinstance(given, (str, os.PathLike)):
        raise input_error(name, given, "the path of a file")
    path = Path(given)
    if "\0" in str(path) or any(len(os.fsencode(part)) > LONGEST_NAME for part in path.parts):
        shown = f"{str(path)[:40]!r}…"
        raise InputError(f"{name} = {shown} is no path that a file can have: it is too long, or has"
                         " a NUL in it. Choose another.")  # fmt: skip
    if suffix and path.suffix.lower() != suffix:
        hint = f"Such as {str(path.with_suffix(suffix))!r}." if path.name else ""
        raise input_error(name, given, f"the path of a file that ends in {suffix!r}", hint)
    return path


def device(given: str | torch.device) -> torch.device:
    """The device of that name, if this machine has it."""
    try:
        wanted = torch.device(given)
    except (RuntimeError, TypeError) as error:
        raise input_error("device", given, '"cpu" or "cuda"') from error
    if wanted.type not in ("cpu", "cuda"):
        raise input_error(
            "device",
            str(given),
            '"cpu" or "cuda"',
            "Other devices lack the sparse products and float64 that a step needs.",
        )
    if wanted.type == "cuda" and not torch.cuda.is_available():
        raise input_error(
            "device",
            str(given),
            "a device that this machine has",
            'torch sees no CUDA GPU; use device="cpu".',
        )
    return wanted


def same_device(one: torch.device, other: torch.device) -> bool:
    """Whether these are one device; "cuda" without a number may be any GPU."""
    same_number = None in (one.index, other.index) or one.index == other.index
    return one.type == other.type and same_number

"""Compiling of the kernels with Numba, and where compiled code is kept."""

from __future__ import annotations

import gc
import hashlib
import os
import pickle
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

config: Any = numba.config

# For tests: `memory.give_back` overwrites what is given back, so that who reads it all the same is
# found out.
OVERWRITES = "TORCHFILM_OVERWRITES_MEMORY" in os.environ

# What pickle raises for a file that a crash or a full disk has cut off.
UNREADABLE = (EOFError, pickle.UnpicklingError)


def _digest() -> str:
    """A name for this version of the kernels, at this place: Numba looks at the file of a function
    only, not at the functions that it calls."""
    place = f"{numba.__version__} {Path(__file__).parent} {OVERWRITES}"
    found = hashlib.sha256(os.fsencode(place))  # names of folders may be no text
    for file in sorted(Path(__file__).parent.glob("*.py")):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


# After so many days without use compiled kernels of another version are removed.
KEPT_DAYS = 30


def _wanted_folder() -> Path | None:
    """The user's own cache of torchfilm; None for a user who has no home."""
    given, home = os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~")
    # (by its specification a relative path is to be ignored)
    cache = given if os.path.isabs(given) else os.path.join(home, ".cache")
    return Path(cache) / "torchfilm" if os.path.isabs(cache) else None


def cache_folder() -> Path | None:
    """Where compiled kernels are kept, or None where nothing can be written: the user's own cache,
    since compiled code that others could write must never be loaded. A new version removes what
    older ones left and nobody uses."""
    wanted = _wanted_folder()
    if wanted is None:
        return None
    folder = wanted / f"kernels-{_digest()}"
    try:
        new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f"writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
        os.utime(folder)  # in use
    except OSError:
        return None
    if new:
        _remove_unused(folder)
    return folder


def _remove_unused(mine: Path) -> None:
    """Remove the folders beside `mine` that no process has used for KEPT_DAYS. Another process may
    do the same at once, and what cannot be removed stays. A folder is renamed first: nobody finds
    one that is partly empty."""
    oldest = time.time() - KEPT_DAYS * 86400
    for folder in mine.parent.glob("*kernels-*"):  # also one whose removal was interrupted
        try:
            if folder == mine or folder.is_symlink() or folder.stat().st_mtime >= oldest:
                continue
            gone = folder.with_name(f"removed-{os.getpid()}-{folder.name[-24:]}")
            folder.rename(gone)
        except OSError:
            continue
        shutil.rmtree(gone, ignore_errors=True)


FOLDER = cache_folder()
HOW_OFTEN = "in each process" if FOLDER is None else "once for this installation"


def _mark(name: str) -> Path | None:
    """A file that tells that the kernels of this name were compiled for this processor."""
    if FOLDER is None:
        return None
    processor = hashlib.sha256(
        f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}".encode()
    ).hexdigest()[:8]
    return FOLDER / f"{name.replace(', ', '-')}-{processor}.compiled"


# that this process has spent on compiling what was not in the cache
_spent = [0.0]


def seconds_spent() -> float:
    """How long this process has compiled, s."""
    return _spent[0]


@contextmanager
def _no_garbage_collected() -> Iterator[None]:
    """Python's collector stands still. Numba makes many small objects that live on, and looking
    through them again and again takes 6 % of its time."""
    enabled = gc.isenabled()
    if enabled:
        gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def first_call(name: str, what: str) -> Iterator[None]:
    """Around this process's first call of the kernels of this name, such as "2-D, float32". Says
    that `what` has to be compiled, unless it is in the cache; then notes that it is."""
    mark = _mark(name)
    if mark is not None and mark.exists():
        yield
        return
    remedy = (
        f", since it cannot be kept in {_wanted_folder() or 'a home folder, which you lack'}: set"
        " XDG_CACHE_HOME to a folder that can be written"
    )
    why = remedy if FOLDER is None else ""
    print(f"torchfilm: compiling {what}, {HOW_OFTEN}{why}", file=sys.stderr)
    begin, before = time.perf_counter(), _spent[0]
    with _no_garbage_collected():
        yield
    _spent[0] = before + time.perf_counter() - begin  # with what was compiled inside
    if mark is not None:
        with suppress(OSError):  # a full disk: it is compiled again
            mark.touch()


@contextmanager
def _alone(name: str) -> Iterator[None]:
    """No other process is in here with this name. Numba reads the list of what it has kept of a
    function, adds to it and writes it again; two processes that do so at once would give different
    code one place."""
    if FOLDER is None or fcntl is None:
        yield
        return
    with ExitStack() as held:
        try:
            file = held.enter_context((FOLDER / f"{name}.lock").open("wb"))
            fcntl.flock(file, fcntl.LOCK_EX)
            # not only closed: a process that was forked meanwhile has the file open, too
            held.callback(fcntl.flock, file, fcntl.LOCK_UN)
        except OSError:  # the folder has gone, or its file system knows no locks
            pass
        yield


@cache
def _not_kept(why: str) -> None:
    """Say once that compiled code could not be kept."""
    print(
        f"torchfilm: could not keep what was compiled in {FOLDER}: {why}. It will be compiled again"
        " in the next process. Free some space there, or set XDG_CACHE_HOME to another folder.",
        file=sys.stderr,
    )


def _keep_safely(made: Any) -> None:
    """Keep what is compiled of this function while no other process does. What cannot be kept is
    said; what cannot be read, as after a crash, is compiled again."""
    kept = made._cache
    save, load = kept.save_overload, kept.load_overload

    def save_alone(*given: object) -> None:
        try:
            with _alone(made.py_func.__name__):
                save(*given)
        except OSError as error:
            _not_kept(str(error))

    def load_what_can_be_read(*given: object) -> object:
        try:
            return load(*given)
        except Exception:  # whatever the bytes of a damaged file make of pickle
            _forget(kept)
            return None

    kept.save_overload, kept.load_overload = save_alone, load_what_can_be_read


def _forget(kept: Any) -> None:
    """Remove what is kept of a function."""
    with suppress(OSError):
        kept.flush()


@contextmanager
def _kept_in_folder() -> Iterator[bool]:
    """Functions that Numba is given inside are kept in the folder, if there is one."""
    before = config.CACHE_DIR
    config.CACHE_DIR = "" if FOLDER is None else str(FOLDER)
    try:
        yield FOLDER is not None
    finally:
        config.CACHE_DIR = before


class _Part(JITCodeLibrary):
    """The code of a function that only kernels call. Numba would optimise and compile it by itself,
    with all that it calls; but that is done when the kernel is, and would be done again and again
    for what is called from many places, which took half of the time."""

    def finalize(self) -> None:
        self._raise_if_finalized()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(NativeLowering):
    """To a part, which brings all those that it needs to its callers."""

    _name = "torchfilm_part_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _Part(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        state.flags.no_compile = True
        super().run_pass(state)
        name = object()  # stands for the function that other parts find
        state["cr"] = state["cr"]._replace(cfunc=name)
        needed = dict.fromkeys([state.library, *state.library._linking_libraries])
        state.targetctx.insert_user_function(name, state["cr"].fndesc, list(needed))
        return True


class _PartCompiler(CompilerBase):
    def define_pipelines(self) -> list[Any]:
        made = DefaultPassBuilder.define_nopython_pipeline(self.state)
        made.passes = [
            (_PartLowering if step is NativeLowering else step, what) for step, what in made.passes
        ]
        made.finalize()
        return [made]


# An index without a sign. Numba asks each other one whether it counts from the end of the array,
# which takes up to half of the time of a short loop. To be used where indices come from arrays.
index: Any = np.uint64


def kernel(
    function=None, *, entry: bool = False, any_order: bool = False, inline: bool = False,
    borrows: bool = False,
):  # fmt: skip
    """Compile a function at its first call with new types, without the interpreter's lock.

    entry: Python calls it, so it gets a form for Python, and is kept. Others have neither, which
    saves a third of the time to compile; only kernels may call them (see `for_python`). Sums keep
    their order, unless any_order: then the compiler may choose one, the same for all calls with as
    many terms. Such a function must not write to arrays: the order would depend on how near to each
    other they lie in memory. inline: compile it into its callers; a call with many arrays costs
    more than the work of a short function. borrows: it makes no arrays but by `memory.room`, and
    none of those that it is given is freed meanwhile; so it need not count who uses them, which
    took a tenth of the time of small colonies. It must not return an array that it was given to a
    kernel that counts; and Numba lets it return a new one in a tuple only, so what returns a single
    array counts.
    """
    if function is None:
        return partial(kernel, entry=entry, any_order=any_order, inline=inline, borrows=borrows)
    fast = {"reassoc", "contract", "nsz"} if any_order else False
    compiler: Any = numba.njit if entry else partial(numba.njit, pipeline_class=_PartCompiler)
    with _kept_in_folder() as kept:
        made: Any = compiler(
            nogil=True, cache=kept and entry, error_model="numpy", fastmath=fast,
            forceinline=inline, no_cpython_wrapper=not entry, no_cfunc_wrapper=True,
            _nrt=not borrows,
        )(function)  # fmt: skip
    if not entry and isinstance(made, CPUDispatcher):
        made.__class__ = _Inner
    if kept and entry:
        _keep_safely(made)
    return made


class _Inner(CPUDispatcher):
    """A kernel that only kernels call. Numba would end the process at a call by Python."""

    def add_overload(self, made: Any) -> None:
        self.overloads[tuple(made.signature.args)] = made  # Python finds no code of it

    def __call__(self, *given: object, **named: object) -> object:
        raise TypeError(
            f"{self.py_func.__name__} has no form for Python: call for_python(it), or make it an"
            " entry"
        )


# A kernel that makes no arrays but by `memory.room`.
lean = partial(kernel, borrows=True)


@cache
def for_python(inner):
    """A kernel that only kernels call, for a test or a benchmark to call."""
    options = inner.targetoptions
    order, inline = bool(options["fastmath"]), bool(options["forceinline"])
    return kernel(inner.py_func, entry=True, any_order=order, inline=inline)


def native(signature, function):
    """Compile a function for this signature now, so that it has an address. It is kept as kernels
    are."""
    compile_for: Any = numba.cfunc
    name = function.__qualname__.replace("<locals>.", "")
    make = partial(compile_for, signature, nopython=True, error_model="numpy")
    with _kept_in_folder() as kept, _alone(name):
        if kept:
            try:
                return make(cache=True)(function)
            except OSError as error:
                _not_kept(str(error))
            except UNREADABLE:
                _forget(FunctionCache(function))
        return make(cache=False)(function)

"""The user's functions from a file, reloaded when the file is edited during a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.load_module import run_file

Functions = dict[str, Callable[..., None] | None]
T = TypeVar("T")

SETTLED = 0.05  # s: an edit is loaded once the file has not changed for this long


def load_functions(path: Path, names: tuple[str, ...]) -> Functions:
    """Run a user's Python file and return its functions with the given names.

    Raises InputError if the file defines none of them.
    """
    given = run_file(path)
    found = {name: given.get(name) for name in names}
    if not any(map(callable, found.values())):
        raise checks.InputError(f"{path} defines neither {' nor '.join(names)}.")
    return found


def edited(path: Path) -> tuple[int, int]:
    """Time of a file's last edit, ns, and its size, bytes."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size


def unchanged(now: Tensor, then: Tensor) -> bool:
    """Whether two tensors are equal, with NaN equal to NaN.

    The driver checks for non-finite values; a rule is not responsible for them.
    """
    return torch.equal(now, then) or bool(((now == then) | ((now != now) & (then != then))).all())


class HotReload:
    """Functions by name, and the file (if any) that defines them.

    While `watching` is set, `refresh` loads an edited file. `messages` reports a broken edit, when
    it fails to load or when it first fails; the previous functions stay in use. Messages give the
    simulated time of the last `refresh`. stamp: `edited` of the file as its functions were loaded.
    """

    def __init__(self, path: Path | None, functions: Functions, stamp: tuple[int, int] = (0, 0)):
        self.path, self.functions = path, functions
        self.watching = False
        self.messages: list[str] = []
        self._time = 0.0
        self._stamp = stamp
        self._previous: Functions | None = None
        self._proven = True

    @property
    def proven(self) -> bool:
        """Whether the functions in use have run since they were loaded."""
        return self._proven

    @property
    def can_go_back(self) -> bool:
        """Whether the last good functions take the place of those in use, should these fail."""
        return self.watching and self._previous is not None

    def refresh(self, now: float) -> None:
        """Load the file again if it was edited. now: simulated time, h.

        An editor empties the file before it writes the new text: one that is still changing is left
        for the next call.
        """
        self._time = now
        if not self.watching or self.path is None:
            return
        try:
            stamp = edited(self.path)
            if stamp == self._stamp:
                return
            time.sleep(SETTLED)
            if stamp != edited(self.path):
                return
        except OSError:
            return  # an editor is replacing the file at this moment
        self._stamp = stamp
        try:
            functions = load_functions(self.path, tuple(self.functions))
        except Exception as error:  # user code may raise anything; the run continues
            self._report(error)
            return
        if self._proven:
            self._previous = self.functions
        self.functions, self._proven = functions, False

    def call(self, name: str, act: Callable[[Callable[..., None]], T], otherwise: T) -> T:
        """`act` on the function with that name, or `otherwise` if there is none.

        If the function fails and there is an earlier version, this reports the failure and uses the
        earlier version from then on.
        """
        function = self.functions[name]
        try:
            result = otherwise if function is None else act(function)
        except Exception as error:
            if not self.watching or self._previous is None:
                raise
            self._report(error)
            self.functions, self._previous, self._proven = self._previous, None, True
            return self.call(name, act, otherwise)
        if not self._proven:
            self._proven = True
            self._say("reloaded")
        return result

    def _report(self, error: Any) -> None:
        self._say(f"is broken, the last good rules stay in use: {type(error).__name__}: {error}")

    def _say(self, what: str) -> None:
        name = self.path.name if self.path is not None else "the rules"
        self.messages.append(f"t = {self._time:g} h: {name} {what}")

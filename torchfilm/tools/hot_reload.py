"""The user's functions, from a file that may be edited while a run is going, and what they must not
do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.load_module import run_file

Functions = dict[str, Callable[..., None] | None]
T = TypeVar("T")


def load_functions(path: Path, names: tuple[str, ...]) -> Functions:
    """Run a Python file of the user's and return those of its functions that have one of the
    names."""
    given = run_file(path)
    found = {name: given.get(name) for name in names}
    if not any(map(callable, found.values())):
        raise checks.InputError(f"{path} defines neither {' nor '.join(names)}.")
    return found


def unchanged(now: Tensor, then: Tensor) -> bool:
    """Whether two tensors hold the same, a NaN taken for equal to itself: what is not finite is the
    driver's matter, not a rule's."""
    return torch.equal(now, then) or bool(((now == then) | ((now != now) & (then != then))).all())


class HotReload:
    """Functions by name and the file, if any, that they came from.

    While `watching`, an edit is taken up at the next `refresh`; one that is broken is reported in
    `messages`, at once or when it first fails, and the functions before it go on. Messages carry
    the simulated time of the last `refresh`.
    """

    def __init__(self, path: Path | None, functions: Functions):
        self.path, self.functions = path, functions
        self.watching = False
        self.messages: list[str] = []
        self._time = 0.0
        self._stamp = path.stat().st_mtime_ns if path else 0
        self._previous: Functions | None = None
        self._proven = True

    def refresh(self, time: float) -> None:
        """Take up an edited file if it loads. time: simulated, h."""
        self._time = time
        if not self.watching or self.path is None:
            return
        try:
            stamp = self.path.stat().st_mtime_ns
        except OSError:
            return  # an editor is just replacing the file
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            functions = load_functions(self.path, tuple(self.functions))
        except Exception as error:  # the user's own code may fail in any way; the run goes on
            self._report(error)
            return
        if self._proven:
            self._previous = self.functions
        self.functions, self._proven = functions, False

    def call(self, name: str, act: Callable[[Callable[..., None]], T], otherwise: T) -> T:
        """`act` on the function of that name, or `otherwise` if there is none. If it fails and
        there is an earlier version: report, and go back to that."""
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
            self._say("taken up")
        return result

    def _report(self, error: Any) -> None:
        self._say(f"is broken, still running the last good rules: {type(error).__name__}: {error}")

    def _say(self, what: str) -> None:
        name = self.path.name if self.path is not None else "the rules"
        self.messages.append(f"t = {self._time:g} h: {name} {what}")

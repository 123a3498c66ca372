"""Loads a CellModeller script: runs the file and its `setup(sim)`, with stand-ins for CellModeller.

This is Python that the user names. Nothing else that torchfilm reads can execute.
"""

from __future__ import annotations

import ast
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from torchfilm.cellmodeller import draws, stand_ins
from torchfilm.cellmodeller.globals_watch import GlobalsWatch
from torchfilm.cellmodeller.time_limit import TooLong, time_limit
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

SECONDS = 10.0  # that a script may take to be set up, and each function in its rehearsal
FUNCTIONS = ("setup", "init", "update")
# Random numbers that no call can seed anew.
OTHER_RANDOM = re.compile(
    r"\b(default_rng|RandomState|SystemRandom|random\.Random|urandom|secrets)\b"
)
INNER_IMPORT = re.compile(r"^[ \t]+(import|from)[ \t]", re.MULTILINE)
OLD = re.compile(r"^\s*print\s+[^(\s=]", re.MULTILINE)


@dataclass
class Script:
    """A script that has been set up. text: its source. request: what it asked for, of sim. dt: h.
    helpers: modules that it imports from its folder, which no other script sees. seconds: that it
    may take to be set up, and each function in its rehearsal."""

    path: Path
    text: str
    module: ModuleType
    request: stand_ins.Request
    sim: stand_ins.Simulator
    dt: float
    seconds: float = SECONDS
    helpers: dict[str, ModuleType] = field(default_factory=dict)
    watch: GlobalsWatch | None = None  # of a run

    def function(self, name: str) -> Callable[..., Any] | None:
        found = getattr(self.module, name, None)
        return found if callable(found) else None

    def place_of(self, attribute: str) -> str:
        """The file, and the line where it first sets an attribute of a cell."""
        found = re.search(rf"\.{re.escape(attribute)}\s*[-+*/]?=", self.text)
        line = f", line {self.text[: found.start()].count(chr(10)) + 1}" if found else ""
        return self.path.name + line

    def mentions(self, name: str) -> bool:
        """Whether a word stands in the source."""
        return re.search(rf"\b{re.escape(name)}\b", self.text) is not None

    def limited(self) -> AbstractContextManager[None]:
        """Within, the script may take `seconds`."""
        return time_limit(self.seconds)

    @contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Raise InputError, with the line of the script, for what fails within."""
        try:
            yield
        except TooLong as error:
            raise InputError(
                f"{self._at(error)}: {doing} was stopped here after {self.seconds:g} s. Does it"
                f" loop for ever? Otherwise let it take longer: --set seconds={6 * self.seconds:g},"
                f" or from_cellmodeller(…, seconds={6 * self.seconds:g})."
            ) from None
        except SystemExit as error:
            raise InputError(f"{self._at(error)}: {doing} ends the program.") from error
        except ModuleNotFoundError as error:
            raise InputError(f"{self._at(error)}: {_missing(str(error.name))}") from error
        except InputError as error:
            at = self._at(error)
            if at == self.path.name and (about := re.search(r"^cell\.(\w+)", str(error))):
                at = self.place_of(about[1])
            raise InputError(f"{at}: {error}") from error
        except Exception as error:
            raise InputError(
                f"{self._at(error)}: {doing} fails: {type(error).__name__}: {error}"
            ) from error

    def _at(self, error: BaseException) -> str:
        """The file and the last of its lines that led to an error."""
        frames = traceback.extract_tb(error.__traceback__)
        lines = [f.lineno for f in frames if f.filename == str(self.path)]
        return f"{self.path.name}, line {lines[-1]}" if lines else self.path.name


def is_script(path: Path) -> bool:
    """Whether a file is a CellModeller script: it defines `setup`, `init` and `update`."""
    if path.suffix != ".py" or not path.is_file():
        return False
    text = path.read_text(encoding="utf-8", errors="replace")
    return all(re.search(rf"^def\s+{name}\s*\(", text, re.MULTILINE) for name in FUNCTIONS)


def load(path: Path, seconds: float = SECONDS) -> Script:
    """Run a script and its `setup(sim)`. seconds: that it may take. Raises InputError,
    with the line, for what is refused."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise checks.input_error("script", str(path), "a readable Python file in UTF-8") from error
    module = ModuleType(path.stem)
    module.__file__ = str(path)
    request = stand_ins.Request()
    sim = stand_ins.Simulator(request, module)
    script = Script(path, text, module, request, sim, stand_ins.DT, seconds)
    code = _compiled(path, text)
    with draws.kept(), importing(script), script.errors("loading"):
        draws.seed("load")
        with script.limited(), redirect_stdout(sys.stderr):
            exec(code, vars(module))
            vars(module)["setup"](sim)
    if not request.started:
        raise InputError(f"{path.name}: setup(sim) does not call sim.init(…).")
    if own := OTHER_RANDOM.search(text):
        line = text[: own.start()].count("\n") + 1
        warn(
            f"{path.name}, line {line}: {own.group()} has random numbers of its own. Runs repeat"
            " only with the functions of random and numpy.random."
        )
    script.dt = checks.number("sim.dt", sim.dt, above=0.0)
    sim._at(0)
    return script


@contextmanager
def importing(script: Script) -> Iterator[None]:
    """Within, imports of CellModeller find the stand-ins, and those of the script's folder its
    files."""
    folder = script.path.parent.resolve()
    ours = {script.module.__name__: script.module, **script.helpers}
    others = {name: sys.modules[name] for name in ours if name in sys.modules}
    place = list(sys.path)
    sys.path.insert(0, str(folder))
    sys.modules.update(ours)
    before = {name.split(".")[0] for name in sys.modules}
    try:
        with stand_ins.installed():
            yield
    finally:
        sys.path[:] = place
        for name, module in list(sys.modules.items()):
            top = name.split(".")[0]
            if top not in before and _lies_in(folder, sys.modules.get(top, module)):
                script.helpers[name] = module
        for name in [n for n in {**ours, **script.helpers} if n in sys.modules]:
            del sys.modules[name]
        sys.modules.update(others)


def _lies_in(folder: Path, module: ModuleType) -> bool:
    """Whether a module is a file of a folder, or a package in it."""
    parts = [getattr(module, "__file__", None), *getattr(module, "__path__", [])]
    return any(p is not None and Path(p).resolve().parent == folder for p in parts)


def _compiled(path: Path, text: str) -> Any:
    try:
        return compile(ast.parse(text, str(path)), str(path), "exec", dont_inherit=True)
    except (SyntaxError, ValueError) as error:
        line = getattr(error, "lineno", None)
        at = f"{path.name}, line {line}" if line else path.name
        if OLD.search(text):
            raise InputError(
                f"{at}: the script is written in Python 2 (print without brackets). Convert it"
                " first."
            ) from error
        raise InputError(f"{at}: {getattr(error, 'msg', error)}") from error


def _missing(name: str) -> str:
    """What to do about a module that is not there."""
    if name.split(".")[0] == stand_ins.ROOT:
        known = ", ".join(f"{stand_ins.ROOT}.{n}" for n in stand_ins.CLASSES)
        return f"{name} is not supported by torchfilm; known are {known}."
    return f"the script imports {name}, which is not installed: install it, or delete the import."

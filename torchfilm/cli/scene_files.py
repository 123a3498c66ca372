"""Scenes as a user names them: a ready-made scene by name, a Python file, a model, or a saved
design."""

from __future__ import annotations

import inspect
import json
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torchfilm import scenes
from torchfilm.cellmodeller import from_cellmodeller, is_script
from torchfilm.cli.model_files import is_model, scene_of_model
from torchfilm.scene import Scene
from torchfilm.scenes.recipes import parse_value, to_plain
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.load_module import run_file
from torchfilm.values import PerColony

# What a file with this suffix probably is, and how to use it.
KNOWN_SUFFIXES = {
    ".h5": "This looks like a results file: use `torchfilm resume`, `show` or `info`.",
    ".csv": "This looks like a table of cells: give it with --start.",
}
KNOWN_SUFFIXES[".hdf5"] = KNOWN_SUFFIXES[".h5"]
OTHER_SUFFIX = (
    "torchfilm reads no {} files. Write a Python file that defines `scene = torchfilm.Scene(…)`;"
    " the reactions of a model in another format become a Circuit there."
)


def load_scene(what: str, parameters: dict[str, Any], code: Path | None = None) -> Scene:
    """A ready-made scene by name; or the `scene` of a Python file, a Scene or a function; or what a
    CellModeller script asks for; or a colony with a model in SBML or Antimony; or the scene of a
    saved design (.json). `parameters` replace those of the design. code: the Python file of a
    design whose scene is a function of the user's. Raises InputError for anything else."""
    path = Path(what)
    if path.suffix.lower() == ".json":
        return _scene_of_design(what, parameters, code)
    if code is not None:
        raise checks.input_error("--code", str(code), "left out: it is for a saved design (.json)")
    if not path.suffix and path.name == what:
        return scenes.build(what, parameters)
    if path.is_file() and is_model(path):
        return scene_of_model(path, parameters)
    if not path.is_file() or path.suffix != ".py":
        raise checks.input_error(
            "scene",
            what,
            "the name of a ready scene, or the path of a Python file (.py), of a model in SBML"
            " (.xml) or Antimony (.ant), or of a saved design (.json)",
            _hint(path),
        )
    if is_script(path):
        made = _call(from_cellmodeller, f"CellModeller script {what}", {"path": path, **parameters})
        return made.replace(settings=to_plain(parameters))
    return _scene_of_file(path, what, parameters)


def _scene_of_file(
    path: Path, what: str, parameters: dict[str, Any], function: str | None = None
) -> Scene:
    """The scene that the `scene` of a Python file is or returns; or a function of another name,
    which the file must define itself: a design names it, which may come from elsewhere."""
    names, name = _run_scene_file(path, what), function or "scene"
    if name not in names:
        raise InputError(
            f"{what} does not define `{name}`: write `{name} = torchfilm.Scene(…)`, or a"
            f" function `{name}(…)` that returns one."
        )
    made = names[name]
    if function is not None:
        _check_own(made, function, path, what)
    if callable(made) and not isinstance(made, Scene):
        made = _call_own(made, f"{name}(…) in {what}", parameters, path)
    elif parameters:
        raise checks.input_error(
            "--set",
            list(parameters),
            f"left out: `{name}` in {what} is a Scene, not a function with parameters",
        )
    if not isinstance(made, Scene):
        raise checks.input_error(
            f"{name} in {what}", made, "a Scene, or a function that returns one"
        )
    called = path.stem if made.name == "scene" else made.name
    return made.replace(name=called, settings=to_plain(parameters))


def _hint(path: Path) -> str:
    """What to do where a path is no scene."""
    if path.is_dir():
        return "This is a folder."
    hints = [] if path.exists() else ["No such file."]
    if path.suffix not in ("", ".py") and not is_model(path):
        hints.append(KNOWN_SUFFIXES.get(path.suffix, OTHER_SUFFIX.format(path.suffix)))
    return " ".join(hints)


def _scene_of_design(what: str, parameters: dict[str, Any], code: Path | None) -> Scene:
    plan = design(what)
    given, home = {**plan["parameters"], **parameters}, plan["scene"]
    if plan.get("file") is not None:
        function = str(plan.get("function"))
        made = _scene_of_file(_own_file(what, plan["file"], code), str(code), given, function)
    elif code is not None:
        raise checks.input_error("--code", str(code), f"left out: {what} is of a ready scene")
    elif not home.isidentifier():
        raise checks.input_error(f"scene in {what}", home, "the name of a ready scene")
    else:
        made = load_scene(home, given)
    if not parameters:
        made.warn_if_not(what, plan)
    return made.replace(dt=checks.number(f"dt in {what}", plan.get("dt", made.dt), above=0.0))


def _own_file(what: str, file: Any, code: Path | None) -> Path:
    """The Python file with the function of a saved design, as the user gives it. A design is data,
    and may come from elsewhere: it does not choose what runs. Raises InputError without it."""
    if code is None:
        raise InputError(
            f"{what} is a design of a function in {file!r}, and a design runs no code by itself."
            " Give the Python file, if you trust it: --code FILE.py."
        )
    if not code.is_file() or code.suffix.lower() != ".py":
        raise checks.input_error("--code", str(code), "the path of a Python file")
    return code


def _run_scene_file(path: Path, what: str) -> dict[str, Any]:
    """The names that a Python file defines. Raises InputError, with the line, if it fails."""
    sys.path.insert(0, str(path.parent.resolve()))
    try:
        return run_file(path)
    except Exception as error:
        at = _line(error, path)
        if isinstance(error, InputError):
            raise InputError(f"{what}{at}: {error}") from error
        raise InputError(f"{what} cannot be run: {type(error).__name__}: {error}{at}") from error


def _line(error: Exception, path: Path) -> str:
    """The last line of a file on the way to an error, as " (line 3)"; "" where none is."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    return f" (line {lines[-1]})" if lines else ""


def _check_own(made: Any, function: str, path: Path, what: str) -> None:
    """Raise InputError for what is no function of a file, or one that it has imported."""
    code = getattr(inspect.unwrap(made) if callable(made) else made, "__code__", None)
    if code is None or Path(code.co_filename) != path:
        rule = f"a function that {what} defines itself, and that returns a Scene"
        hint = f"Write def {function}(…): there, also around a partial or a decorated function."
        raise checks.input_error(f"{function} in {what}", made, rule, hint)


def _call(make: Callable[..., Any], name: str, parameters: dict[str, Any]) -> Any:
    """What a scene function returns. Raises InputError for parameters that it does not have."""
    signature = inspect.signature(make)
    try:
        signature.bind(**parameters)
    except TypeError as error:
        unknown = next((n for n in parameters if n not in signature.parameters), "")
        near = checks.suggestion(unknown, signature.parameters) if unknown else ""
        said = f"{name}: {error}. {near}".rstrip()
        said += f" Its parameters are {signature}; give them with --set, or defaults."
        raise InputError(said) from error
    return make(**parameters)


def _call_own(make: Callable[..., Any], name: str, parameters: dict[str, Any], path: Path) -> Any:
    """As `_call`, for a function of a user's file. Raises InputError also where it computes with
    several values, one per colony, as with one number."""
    try:
        return _call(make, name, parameters)
    except TypeError as error:
        several = {n: x for n, x in parameters.items() if isinstance(x, (list, tuple, PerColony))}
        values = {n: x.values if isinstance(x, PerColony) else x for n, x in several.items()}
        alone = {n: x[0] for n, x in values.items() if isinstance(x, (list, tuple)) and x}
        # the one that is at fault, or the first of several
        first = next((n for n in alone if _works(make, {**parameters, n: alone[n]})), None)
        if first is None and len(alone) > 1 and _works(make, {**parameters, **alone}):
            first = next(iter(alone))
        if first is None:
            raise
        own = f"list({first})" if isinstance(several[first], tuple) else first
        raise checks.input_error(
            f"{name}: {first}",
            values[first],
            f"one number, since the function computes with it{_line(error, path)}: {error}",
            "Several values are one per colony, which effects take as they are. For founders that"
            f" differ between colonies write founders=tf.Founders(function, {first}={own}), with a"
            f" function(seed, {first}).",
        ) from error


def _works(make: Callable[..., Any], parameters: dict[str, Any]) -> bool:
    """Whether a function takes these parameters; a trial, which warns of nothing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            make(**parameters)
    except Exception:  # whatever the user's function raises
        return False
    return True


def design(what: str) -> dict[str, Any]:
    """The content of a saved design; empty if `what` is not the path of one. Raises InputError if
    the file is missing or is no design."""
    path = Path(what)
    if path.suffix.lower() != ".json":
        return {}
    if not path.is_file():
        raise checks.input_error("scene", what, "the path of a saved design", "No such file.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what} cannot be read as JSON: {error}.") from error
    if (
        not isinstance(content, dict)
        or not isinstance(content.get("parameters"), dict)
        or not isinstance(content.get("scene"), str)
    ):
        raise InputError(
            f"{what} is no saved design: it must have a `scene` and its `parameters`, as Best.save"
            " writes them."
        )
    for name, kind, allowed in (
        ("cells", int, "a whole number"),
        ("seed", int, "a whole number"),
        ("until", (int, float), "a number"),
    ):
        value = content.get(name)
        if value is not None and (isinstance(value, bool) or not isinstance(value, kind)):
            raise checks.input_error(
                f"{name} in {what}", value, allowed, "Leave it out for the default."
            )
    species = content.get("species", [])
    if not isinstance(species, list) or not all(isinstance(n, str) for n in species):
        raise checks.input_error(f"species in {what}", species, "a list of names")
    return content


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Parameters by name, from NAME=VALUE each. Raises InputError for a name given twice."""
    found: dict[str, Any] = {}
    for text in texts:
        name, value = parse_setting(text)
        if name in found:
            raise checks.input_error("--set", text, f"the only value of {name!r}, given twice")
        found[name] = value
    return found


def parse_setting(text: str) -> tuple[str, Any]:
    """Name and value from NAME=VALUE (see scenes.recipes.parse_value)."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise checks.input_error("--set", text, "NAME=VALUE")
    return name, parse_value(value)

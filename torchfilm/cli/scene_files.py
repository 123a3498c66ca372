"""Scenes by what a user types: the name of a ready one, a Python file, or a design that a search
has saved."""

from __future__ import annotations

import ast
import inspect
import json
import sys
import traceback
from pathlib import Path
from typing import Any

from torchfilm import scenes
from torchfilm.scene import Scene
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.load_module import run_file


def load_scene(what: str, parameters: dict[str, Any], function: str = "scene") -> Scene:
    """A ready-made scene by name, the `function` or Scene of that name of a Python file, or the
    scene of a saved design (.json), with its parameters but for those given."""
    path = Path(what)
    if path.suffix == ".json":
        plan = design(what)
        home = str(plan.get("file") or plan["scene"])
        if Path(home).suffix == ".json":
            raise checks.input_error(
                f"scene in {what}", home, "the name of a ready scene, or the path of a Python file"
            )
        made = load_scene(
            home, {**plan["parameters"], **parameters}, str(plan.get("function") or "scene")
        )
        made.dt = checks.number(f"dt in {what}", plan.get("dt", made.dt), above=0.0)
        return made
    if not path.suffix and path.name == what:
        return scenes.build(what, parameters)
    if not path.is_file() or path.suffix != ".py":
        hint = "" if path.exists() else "No such file."
        raise checks.input_error(
            "scene",
            what,
            "the name of a ready scene, or the path of a Python file or of a design that was saved",
            hint,
        )
    sys.path.insert(0, str(path.parent.resolve()))
    try:
        names = run_file(path)
    except InputError:
        raise
    except Exception as error:
        lines = [
            frame.lineno
            for frame in traceback.extract_tb(error.__traceback__)
            if frame.filename == str(path)
        ]
        at = f" (line {lines[-1]})" if lines else ""
        raise InputError(f"{what} cannot be run: {type(error).__name__}: {error}{at}") from error
    if function not in names:
        raise InputError(
            f"{what} does not define `{function}`: write `{function} = torchfilm.Scene(…)`, or a"
            f" function `{function}(…)` that returns one."
        )
    made = names[function]
    if callable(made) and not isinstance(made, Scene):
        try:
            inspect.signature(made).bind(**parameters)
        except TypeError as error:
            raise InputError(
                f"{function}(…) in {what}: {error}. Its parameters are {inspect.signature(made)};"
                " give them with --set."
            ) from error
        made = made(**parameters)
    elif parameters:
        raise checks.input_error(
            "--set",
            list(parameters),
            f"left out: `{function}` in {what} is a Scene, not a function with parameters",
        )
    if not isinstance(made, Scene):
        raise checks.input_error(
            f"{function} in {what}", made, "a Scene, or a function that returns one"
        )
    if made.name == "scene":
        made.name = path.stem
    made.settings = parameters
    return made


def design(what: str) -> dict[str, Any]:
    """What a saved design says, if `what` is the path of one; else nothing."""
    path = Path(what)
    if path.suffix != ".json":
        return {}
    if not path.is_file():
        raise checks.input_error(
            "scene", what, "the path of a design that was saved", "No such file."
        )
    try:
        told = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{what} cannot be read as JSON: {error}.") from error
    if (
        not isinstance(told, dict)
        or not isinstance(told.get("parameters"), dict)
        or not isinstance(told.get("scene"), str)
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
        value = told.get(name)
        if value is not None and (isinstance(value, bool) or not isinstance(value, kind)):
            raise checks.input_error(
                f"{name} in {what}", value, allowed, "Leave it out for the usual one."
            )
    return told


def parse_setting(text: str) -> tuple[str, Any]:
    """NAME=VALUE; a value that is no Python literal is taken as text."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise checks.input_error("--set", text, "NAME=VALUE")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value

"""A design as JSON, which `torchfilm run` takes."""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import torchfilm as tf
from design.parameters import Value
from design.task import Task
from torchfilm import checks


def write_design(
    path: Path,
    task: Task,
    values: dict[str, Value],
    *,
    loss: float,
    losses: np.ndarray,
    colonies: float,
) -> Path:
    """Write a design of a task, its losses and the number of colonies that the search simulated.
    Replaces an older file."""
    if not path.parent.is_dir():
        raise checks.input_error(
            "path", str(path), "in a folder that exists", f"Make {path.parent} first."
        )
    recipe = task.tried.recipe
    home = {} if recipe else _home(task.family.function)
    end = {
        name: value
        for name, value in (("cells", task.cells), ("until", task.until))
        if value is not None
    }
    saved = {
        "torchfilm": tf.__version__,
        "scene": recipe[0] if recipe else home["function"],
        **home,
        "parameters": {**task.family.fixed, **values},
        **end,
        "seed": task.seed,
        "dt": task.dt,
        "dtype": str(task.dtype)[6:],
        "target": task.target.describe(),
        "species": list(task.target.names),
        "loss": loss,
        "losses": losses.tolist(),
        "colonies": colonies,
    }
    path.write_text(json.dumps(saved, indent=1, default=_plain) + "\n")
    return path


def _home(function: Callable[..., tf.Scene]) -> dict[str, Any]:
    """The file of a user's own scene function, and its name there."""
    made = inspect.unwrap(function)
    code = getattr(made, "__code__", None)
    if code is None or "<" in made.__qualname__:
        raise checks.input_error(
            "scene",
            function,
            "a function at the top level of a file, for a design that is saved",
            "The saved design refers to the function by its name.",
        )
    return {"file": os.path.abspath(code.co_filename), "function": made.__name__}


def _plain(value: Any) -> Any:
    """A value that JSON cannot hold, as one that it can."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise checks.input_error(
        "fixed",
        value,
        "numbers, texts, or arrays of numbers in a design that is saved",
        "Let the scene function make the object from these.",
    )

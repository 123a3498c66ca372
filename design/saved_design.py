"""A design as JSON, which `torchfilm run` takes, and the same in another session."""

from __future__ import annotations

import inspect
import json
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

import torchfilm as tf
from design.growing import FinishedColonies
from design.objective import Objective
from design.parameters import Choice, Parameter, Value
from design.plain_data import NotPlain, from_data, to_data
from design.robustness_check import ScoredDesign, check_robustness
from design.scene_family import scene_function
from design.targets.base import Target
from design.task import Task
from torchfilm import checks

DTYPES = {"float32": torch.float32, "float64": torch.float64}


class FoundDesign(ScoredDesign, Protocol):
    """What is written of a design, such as `Best`."""

    @property
    def loss(self) -> float: ...

    @property
    def losses(self) -> np.ndarray: ...


def write_design(path: Path, design: FoundDesign, *, colonies: float) -> Path:
    """Write a design and its losses, and the number of colonies that the search simulated.
    Replaces an older file."""
    task = design.objective.task
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
        # under the first condition, if there are several
        "parameters": {**task.family.fixed, **design.values, **task.target.arguments[0]},
        **end,
        "seed": task.seed,
        "dt": task.dt,
        "dtype": str(task.dtype)[6:],
        "target": task.target.describe(),
        "species": list(task.target.names),
        "loss": design.loss,
        "losses": design.losses.tolist(),
        "colonies": colonies,
        "search": {
            "names": list(task.space.names),
            "parameters": _data(task.space.parameters),
            "point": design.point.tolist(),
            "target": _data(task.target),
            "replicates": task.replicates,
            "reduce": task.reduce,
            "replay": task.replay,
            "conditions": list(task.target.arguments[0]),
            "losses": design.searched.tolist(),
        },
    }
    saved |= _identity(task.family.function, json.dumps(saved["parameters"], default=_plain))
    checks.write_whole(path, json.dumps(saved, indent=1, default=_plain) + "\n")
    return path


def _identity(function: Callable[..., tf.Scene], parameters: str) -> dict[str, Any]:
    """By what a scene is known to be the same: of the parameters as they will be read from JSON.
    Nothing where they do not make one, such as values by cell type, whose keys become texts."""
    try:
        with warnings.catch_warnings():  # the search has given them
            warnings.simplefilter("ignore")
            scene = function(**json.loads(parameters))
    except Exception:
        return {}
    return {"effects": scene.listing(), "code": scene.code}


def why_unsaved(fixed: Mapping[str, Any]) -> str:
    """Why no design with these fixed arguments can be saved, or ""."""
    try:
        json.dumps(dict(fixed), default=_plain)
    except tf.InputError as error:
        return str(error)
    return ""


@checks.known_keywords
def load_design(
    path: str | Path,
    *,
    scene: Callable[..., tf.Scene] | str | None = None,
    parameters: Sequence[Parameter | Choice] | None = None,
    target: Target | None = None,
) -> SavedDesign:
    """The design in a file that `Best.save` wrote.

    The file is data: no code is executed from it. scene: the scene function, for a design of your
    own one; a ready scene is known by its name. parameters, target: those of the search, for
    `check` and `colonies`; needed where the file cannot hold them: a target of your own class, and
    choices that a function resolves. Raises InputError for a file that is missing or no saved
    design, and for a scene of your own that is not given.
    """
    path = checks.file_path("path", path)
    content = read_design(path)
    if not isinstance(content.get("scene"), str):
        raise tf.InputError(f"{path} names no scene: it is no design that Best.save wrote.")
    if scene is None and "file" in content:
        raise checks.input_error(
            "scene",
            None,
            f"the scene function of {path}: {content['scene']} of {content['file']}",
            f"Import it, and give scene={content['scene']}.",
        )
    function = scene_function(content["scene"] if scene is None else scene)
    if target is not None and content.get("target") not in (None, target.describe()):
        raise checks.input_error(
            "target", target.describe(), f"that of the search: {content['target']}"
        )
    return SavedDesign(path, content, function, parameters, target)


def read_design(path: Path) -> dict[str, Any]:
    """The content of a file with the parameters of a design. Raises InputError for any other
    file."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict) or not isinstance(found["parameters"], dict):
            raise TypeError("its parameters are no table")
        _check_content(found)
    except OSError as error:
        why = error.strerror or error
        raise tf.InputError(f"{path} cannot be read as a saved design: {why}.") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise tf.InputError(
            f"{path} cannot be read as a saved design, which Best.save writes"
            f" ({type(error).__name__}: {error})."
        ) from error
    return found


def _check_content(found: Mapping[str, Any]) -> None:
    """Raise TypeError or KeyError for what no design has."""
    if not isinstance(found.get("loss", 0.0), (int, float)):
        raise TypeError("its loss is no number")
    search = found.get("search", {"names": []})
    if not isinstance(search, dict) or not isinstance(search["names"], list):
        raise TypeError("its search is no table with names")
    if not isinstance(search.get("conditions", []), list):
        raise TypeError("the conditions of its search are no list")
    for name in search["names"]:
        if name not in found["parameters"]:
            raise KeyError(f"{name!r}, of the search, is not among its parameters")
    for name in ("replicates", "reduce", "replay", "point", "losses"):
        if "search" in found and name not in search:
            raise KeyError(f"its search has no {name}")


@dataclass(frozen=True, eq=False, repr=False)
class SavedDesign:
    """A design in another session: `load_design("stripe.json")`.

    `tf.simulate(saved.scene(), **saved.options)` grows the first colony that was scored.

    path, content: the file, and what it holds. function: the scene function. given_parameters,
    given_target: those of the search, where they were given.
    """

    path: Path
    content: Mapping[str, Any]
    function: Callable[..., tf.Scene]
    given_parameters: Sequence[Parameter | Choice] | None = None
    given_target: Target | None = None

    # `saved.check(…)` is `check_robustness(saved, …)`
    check = check_robustness

    @property
    def loss(self) -> float:
        """As when it was saved: on fresh seeds, or else in the search."""
        return float(self._held("loss"))

    @property
    def losses(self) -> np.ndarray:
        """Of each fresh seed (S,), or of each replicate in the search (R,)."""
        return np.array(self._held("losses"))

    @property
    def values(self) -> dict[str, Value]:
        """Its parameters by name; in a file of an earlier version with those that were fixed."""
        every = self.content["parameters"]
        names = self.content["search"]["names"] if "search" in self.content else every
        return {name: every[name] for name in names}

    def scene(self, **arguments: float) -> tf.Scene:
        """The scene with these parameters, for one colony or any number of them. Of several
        conditions under the first, or under the `arguments` that are given. Warns where it is not
        the one that was scored."""
        if wrong := [n for n in arguments if n not in self._under]:
            under = ", ".join(self._under) or "nothing: it was searched under one condition"
            raise checks.input_error("scene", wrong[0], f"an argument of its conditions: {under}")
        given = self.content["parameters"]
        made = self.function(**given)
        made.warn_if_not(self.path, self.content)
        return self.function(**{**given, **arguments}) if arguments else made

    @property
    def _under(self) -> list[str]:
        """The arguments by which the conditions differ, under which it was searched."""
        return self.content.get("search", {}).get("conditions", [])

    @property
    def options(self) -> dict[str, Any]:
        """Those of `tf.simulate` that grow the colonies that were scored, to the bit: end, step,
        seed, dtype."""
        names = ("cells", "until", "dt", "seed")
        saved = {n: self.content[n] for n in names if self.content.get(n) is not None}
        return {**saved, "dtype": self.dtype}

    @property
    def dtype(self) -> torch.dtype:
        """In which it was searched."""
        name = self._held("dtype")
        checks.choice(f"dtype in {self.path}", name, tuple(DTYPES))
        return DTYPES[name]

    @property
    def target(self) -> Target:
        """The target of the search. Raises InputError where the file does not hold it, and it is
        not given."""
        return self._part("target", self.given_target)

    @cached_property
    def objective(self) -> Objective:
        """The objective that scored it. Raises InputError where the file does not hold the target
        or the parameters of the search, and they are not given. Warns where the scene is not the
        one that was scored."""
        parameters = self._part("parameters", self.given_parameters)
        target = self.target
        self.scene()
        every, free = self.content["parameters"], (*self._search["names"], *self._under)
        options: dict[str, Any] = {
            "fixed": {name: value for name, value in every.items() if name not in free},
            **{name: self._search[name] for name in ("replicates", "reduce", "replay")},
            **{name: self.content.get(name) for name in ("cells", "until", "dt", "seed")},
        }
        return Objective(Task(self.function, parameters, target, dtype=self.dtype, **options))

    @property
    def point(self) -> np.ndarray:
        """The coordinates of its parameters (D,): as they were, or those of values that have been
        edited since."""
        found, space = np.array(self._search["point"]), self.objective.task.space
        same = [
            math.isclose(new, old, rel_tol=1e-12)
            if isinstance(old, float) and isinstance(new, (int, float))
            else new == old
            for new, old in ((self.values[n], x) for n, x in space.values(found).items())
        ]
        return found if all(same) else space.point(self.values)

    @property
    def searched(self) -> np.ndarray:
        """The losses of its replicates in the search (R,)."""
        return np.array(self._search["losses"])

    def colonies(self) -> list[FinishedColonies]:
        """The replicates at their ends, grown again: the same colonies as were scored."""
        return self.objective.colonies(self.point)

    @property
    def _search(self) -> Mapping[str, Any]:
        if "search" not in self.content:
            raise tf.InputError(
                f"{self.path} is of an earlier version, which did not save the search: its scene"
                " can be grown; for a check run the search again and save its best design."
            )
        return self.content["search"]

    def _held(self, name: str) -> Any:
        if name not in self.content:
            raise tf.InputError(f"{self.path} does not hold the {name} that Best.save writes.")
        return self.content[name]

    def _part(self, name: str, given: Any) -> Any:
        if given is not None:
            return given
        if self._search[name] is None:
            raise tf.InputError(
                f"{self.path} does not hold the {name} of its search, which need code of your own:"
                f" give load_design(…, {name}=…)."
            )
        return from_data(self._search[name])

    def __repr__(self) -> str:
        return f"SavedDesign({str(self.path)!r}, values={self.values}, loss={self.loss:.4g})"


def _data(value: Any) -> Any:
    """A value as plain data; None where it needs code of the user."""
    try:
        return to_data(value)
    except NotPlain:
        return None


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

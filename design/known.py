"""Designs that are known before a search begins."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import torchfilm as tf
from design.entries import Entry
from design.parameters import Choice, Parameter, Value
from design.saved_design import read_design
from design.study import Study
from design.task import Task, TaskOptions
from torchfilm import checks

MOST = 16  # designs of a study of another task that are grown again


class HasValues(Protocol):
    """A design, such as `Best`."""

    @property
    def values(self) -> Mapping[str, Value]: ...


Start = HasValues | Mapping[str, Value] | Sequence[Any] | Study | str | Path


@dataclass(frozen=True, eq=False)
class KnownDesigns:
    """points (n, D) from which a search starts. entry: with their losses, where these hold for the
    task of the search; None: they are grown again. why: they are, or "". known: designs of the
    study from which they come; beyond: how many of them lie beyond the bounds."""

    points: np.ndarray
    entry: Entry | None = None
    why: str = ""
    known: int = 0
    beyond: int = 0

    @property
    def remark(self) -> str:
        """What a user should know of the designs of a study: which are left out, and why."""
        words = []
        if self.beyond:
            words.append(f"{self.beyond} of its {self.known} designs lie beyond the bounds")
        if self.why:
            words.append(
                f"its losses do not hold here ({self.why}), so its {len(self.points)} best designs"
                " are grown again"
            )
        return f"start: {'; '.join(words)}." if words else ""

    def describe(self) -> str:
        """What a study says of them."""
        kept = "with their losses" if self.entry else "grown again"
        return f"{len(self.points)} designs, {kept}, {tf.digest(self.points.tolist())[:12]}"


def known_designs(given: Start, task: Task) -> KnownDesigns:
    """The designs that `Search.start` gives. Raises InputError for values that are missing, beyond
    the bounds or of no parameter, and for a file that is not one of a study or of a design."""
    if isinstance(given, str | Path):
        path = Path(given)
        if not path.is_file():
            raise checks.input_error("start", str(given), "a file that exists")
        given = (
            read_design(path)["parameters"] if path.suffix.lower() == ".json" else Study.read(path)
        )
    if isinstance(given, Study):
        return _of_study(given, task)
    designs = given if isinstance(given, Sequence) else [given]
    points = [_point(design, task) for design in designs]
    if not points:
        raise checks.input_error("start", given, "at least one design")
    return KnownDesigns(np.array(points))


def _point(design: Any, task: Task) -> np.ndarray:
    """The coordinates (D,) of one design. What it says of arguments that are not searched is left
    aside, but for names that the scene does not have."""
    values = getattr(design, "values", None)
    values = design if not isinstance(values, Mapping) else values
    if not isinstance(values, Mapping):
        raise checks.input_error(
            "start",
            design,
            "values by name, such as {'k3': 1.0}, a Best, a study, or a file; in a"
            " list values and Bests alone",
        )
    allowed = inspect.signature(task.family.function).parameters
    if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in allowed.values()):
        for name in values:
            if name not in allowed:
                raise checks.input_error(
                    "start",
                    name,
                    f"a parameter of {task.family.name}: {', '.join(allowed)}",
                    checks.suggestion(name, allowed),
                )
    space = task.space
    given = {n: values[n] if n in values else _usual(task, n) for n in space.names}
    try:
        return space.point(given)
    except checks.InputError as error:
        raise checks.InputError(f"start: {error} Widen its bounds, or leave it out.") from error


def _usual(task: Task, name: str) -> Value:
    """The value that the scene function gives to an argument that is left out."""
    found = inspect.signature(task.family.function).parameters.get(name)
    usual = inspect.Parameter.empty if found is None else found.default
    if isinstance(usual, bool | int | float | str):
        return usual
    raise checks.InputError(
        f"start has no value for {name!r}, and the scene function has no default for it. Give"
        f" start={{{name!r}: …}}."
    )


def _of_study(study: Study, task: Task) -> KnownDesigns:
    """The designs of a study within the bounds: with their losses, if a search of this task with
    the study's own parameters would be that study."""
    full = [(e, k) for e in study.full() for k in range(len(e.loss))]
    points, rows, added = [], [], {}
    fixed = _literals(study.about.get("fixed", {}))
    for name in task.space.names:
        if name not in study.names:
            added[name] = fixed[name] if name in fixed else _usual(task, name)
    for entry, k in full:
        try:
            values = {**entry.values[k], **added}
            points.append(task.space.point({name: values[name] for name in task.space.names}))
            rows.append((entry, k))
        except tf.InputError:  # beyond the bounds
            continue
    if not points:
        raise checks.input_error(
            "start", f"a study of {len(full)} designs", "one with a design within the bounds"
        )
    beyond = len(full) - len(points)
    why = _why_other(study, task, fixed, added)
    if why:
        best = np.argsort([e.loss[k] for e, k in rows], kind="stable")[:MOST]
        return KnownDesigns(np.array(points)[best], None, why, len(full), beyond)
    join = lambda name: np.array([getattr(e, name)[k] for e, k in rows])
    kept = lambda name: join(name) if all(getattr(e, name) is not None for e, _ in rows) else None
    values_of = [task.space.values(point) for point in points]
    entry = Entry(
        points=np.array(points),
        loss=join("loss"),
        losses=join("losses"),
        cells=join("cells"),
        reasons={
            (row, replicate): words
            for row, (e, k) in enumerate(rows)
            for (of, replicate), words in e.reasons.items()
            if of == k
        },
        size=1.0,
        seconds=0.0,
        values=values_of,
        streams=study.streams,
        copies=0,
        goals=kept("goals"),
        each_goals=kept("each_goals"),
    )
    return KnownDesigns(entry.points, entry, "", len(full), beyond)


def _why_other(
    study: Study, task: Task, fixed: Mapping[str, Value], added: Mapping[str, Value]
) -> str:
    """Why the losses of a study do not hold for a task; "" where they do."""
    gone = [name for name in study.names if name not in task.space.names]
    if gone:
        return f"it varies {gone[0]}, and this search does not"
    options = {f.name: getattr(task, f.name) for f in dataclasses.fields(TaskOptions)}
    stated = {n: v for n, v in added.items() if n in fixed}
    try:
        options["parameters"] = [
            _as_here(read_parameter(text), task) for text in study.about["parameters"]
        ]
        options["fixed"] = {**task.family.fixed, **stated}
        then = Task(**options).describe()
    except (tf.InputError, ValueError, KeyError) as error:
        return str(error)
    differ = [name for name, value in then.items() if study.about.get(name) != value]
    return f"another {', '.join(differ)}" if differ else ""


def _as_here(parameter: Parameter | Choice, task: Task) -> Parameter | Choice:
    """A parameter of a study; a choice reaches the scene as that of the same name in a task."""
    here = next((p for p in task.space.parameters if p.name == parameter.name), None)
    if not isinstance(parameter, Choice) or not isinstance(here, Choice):
        return parameter
    return Choice(
        parameter.name, parameter.options, per_colony=here.per_colony, resolve=here.resolve
    )


def _literals(texts: Mapping[str, str]) -> dict[str, Value]:
    """The values of arguments that a study states as text, as far as they are plain."""
    out = {}
    for name, text in texts.items():
        try:
            out[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            continue
    return out


def read_parameter(text: str) -> Parameter | Choice:
    """The parameter that `describe` has stated. Raises ValueError for another text."""
    name, _, rest = text.partition(": ")
    numbers = re.fullmatch(r"(\S+) to (\S+?)( log| whole)?", rest)
    if numbers:
        low, high, kind = numbers.groups()
        return Parameter(name, float(low), float(high), log=kind == " log", whole=kind == " whole")
    # "or" between texts, not within one
    options = ast.parse(rest, mode="eval").body
    if not isinstance(options, ast.BoolOp):
        raise ValueError(f"{text!r} is no parameter")
    return Choice(name, [ast.literal_eval(option) for option in options.values])

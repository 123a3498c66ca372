"""What a search takes over from the studies of others: designs within its bounds, and their losses
where these hold."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import torchfilm as tf
from design.entries import Entry
from design.parameters import Choice, Parameter, Value
from design.study import Study
from design.task import Task, TaskOptions
from torchfilm import checks

MOST = 16  # designs of a study of another task that are grown again


@dataclass(frozen=True, eq=False)
class KnownStudy:
    """The designs of a study within the bounds of a task: points (m, D), and where each is in the
    study. why: their losses do not hold for the task, or "". known: all designs of the study."""

    name: str
    points: np.ndarray
    rows: Sequence[tuple[Entry, int]]
    why: str
    known: int

    @property
    def chosen(self) -> list[int]:
        """Those that a search takes: all whose losses hold, or else the best."""
        if not self.why:
            return list(range(len(self.points)))
        best = np.argsort([e.loss[k] for e, k in self.rows], kind="stable")
        return [int(k) for k in best[:MOST]]

    def remark(self, taken: int) -> str:
        """What a user should know of them: which are left out, and why; "" where none is. taken:
        of those that are chosen, no other study had the rest."""
        words = []
        if beyond := self.known - len(self.points):
            words.append(f"{beyond} of its {self.known} designs lie beyond the bounds")
        if self.why and taken:
            words.append(
                f"its losses do not hold here ({self.why}), so its {taken} best designs are grown"
                " again"
            )
        return "; ".join(words)


def known_study(study: Study, task: Task) -> KnownStudy:
    """The designs of a study within the bounds of a task: with their losses, if a search of this
    task with the study's own parameters would be that study."""
    full = [(e, k) for e in study.full() for k in range(len(e.loss))]
    points, rows, added = [], [], {}
    fixed = _literals(study.about.get("fixed", {}))
    for name in task.space.names:
        if name not in study.names:
            added[name] = fixed[name] if name in fixed else usual_value(task, name)
    for entry, k in full:
        try:
            values = {**entry.values[k], **added}
            points.append(task.space.point({name: values[name] for name in task.space.names}))
            rows.append((entry, k))
        except tf.InputError:  # beyond the bounds
            continue
    name = "a study" if study.path is None else study.path.name
    why = _why_other(study, task, fixed, added)
    return KnownStudy(name, np.array(points).reshape(-1, task.space.size), rows, why, len(full))


def usual_value(task: Task, name: str) -> Value:
    """The value that the scene function gives to an argument that is left out. Raises InputError
    where it gives none."""
    found = inspect.signature(task.family.function).parameters.get(name)
    usual = inspect.Parameter.empty if found is None else found.default
    if isinstance(usual, bool | int | float | str):
        return usual
    raise checks.InputError(
        f"start has no value for {name!r}, and the scene function has no default for it. Give"
        f" start={{{name!r}: …}}."
    )


def joined(points: np.ndarray, rows: Sequence[tuple[Entry, int]], task: Task) -> Entry:
    """Designs (n, D) with losses that hold for a task as one batch, from where each is known."""
    join = lambda name: np.array([getattr(e, name)[k] for e, k in rows])
    kept = lambda name: join(name) if all(getattr(e, name) is not None for e, _ in rows) else None
    return Entry(
        points=points,
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
        values=[task.space.values(point) for point in points],
        streams=rows[0][0].streams,
        copies=0,
        goals=kept("goals"),
        each_goals=kept("each_goals"),
    )


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

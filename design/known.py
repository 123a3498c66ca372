"""Designs that are known before a search begins."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import torchfilm as tf
from design.entries import Entry
from design.known_studies import KnownStudy, joined, known_study, usual_value
from design.parameters import Value
from design.saved_design import read_design
from design.study import START_POINTS, Study
from design.task import Task
from torchfilm import checks

SAME = 1e-9  # two machines may round a coordinate in two ways
WITH_LOSSES, GROWN = "designs, with their losses", "designs, grown again"


class HasValues(Protocol):
    """A design, such as `Best`."""

    @property
    def values(self) -> Mapping[str, Value]: ...


Start = HasValues | Mapping[str, Value] | Study | str | Path | Sequence[Any]


@dataclass(frozen=True, eq=False)
class KnownDesigns:
    """Designs from which a search starts.

    entry: those with losses that hold for the task of the search; points (n, D): those that are
    grown; the first `given` of them are of no study. why: those of studies are grown again, or "".
    remark: what a user should know of them. every (m, D): all that the studies know in the bounds.
    """

    points: np.ndarray
    entry: Entry | None = None
    given: int = 0
    why: str = ""
    remark: str = ""
    every: np.ndarray | None = None

    @property
    def batches(self) -> list[np.ndarray]:
        """The points (n, D) of each batch with which the study of the search begins."""
        known = [] if self.entry is None else [self.entry.points]
        return [*known, self.points] if len(self.points) else known

    def describe(self) -> str:
        """What a study says of them."""
        kept = [] if self.entry is None else [f"{len(self.entry.points)} {WITH_LOSSES}"]
        grown = [f"{len(self.points)} {GROWN}"] if len(self.points) else []
        word = tf.digest(np.concatenate(self.batches).tolist())[:12]
        return f"{', '.join(kept + grown)}, {word}"

    def about(self) -> dict[str, Any]:
        """What the study of a search keeps of them."""
        return {"start": self.describe(), START_POINTS: self.points.tolist()}

    def begun(self, study: Study) -> KnownDesigns:
        """Those with which a study of the search began, where they are some of these: the files
        from which these come have grown since. Else these, which `Study.check` compares."""
        found = None if self.describe() == study.about.get("start") else _begun(study)
        alike = found is not None and found.points.shape[1] == self.points.shape[1]
        if found is None or self.every is None or not alike:
            return self
        began, now = (np.concatenate(of.batches) for of in (found, self))
        every = np.concatenate([self.every, now])
        if not _all_among(began, every) or not _all_among(self.points[: self.given], began):
            return self
        remark = "" if _all_among(now, began) else (
            f"start: the study began with {len(began)} of these designs, and goes on with them;"
            " those that came since are left out."
        )  # fmt: skip
        return replace(found, remark=remark)


def _begun(study: Study) -> KnownDesigns | None:
    """The designs with which a study began; None where one of an earlier version stopped within
    them."""
    said = study.about.get("start")
    entries, entry, points = list(study.entries), None, np.empty((0, len(study.names)))
    if not isinstance(said, str) or not entries:
        return None
    if WITH_LOSSES in said:
        entry = entries.pop(0)
    if GROWN in said:
        kept = study.about.get(START_POINTS)  # studies of an earlier version have none
        points = np.array(kept) if kept else points
        points = entries[0].points if entries and not kept else points
    if entry is None and not len(points):
        return None
    found = KnownDesigns(points, entry)
    return found if found.describe() == said else None


def _all_among(points: np.ndarray, every: np.ndarray) -> bool:
    """Whether each of some points (n, D) is one of others (m, D)."""
    return all(bool((np.abs(every - point) < SAME).all(1).any()) for point in points)


def known_designs(given: Start, task: Task) -> KnownDesigns:
    """The designs that `Search.start` gives. Raises InputError for values that are missing, beyond
    the bounds or of no parameter, and for a file that is not one of a study or of a design."""
    several = isinstance(given, Sequence) and not isinstance(given, str)
    sources = [_source(one, task) for one in (given if several else [given])]  # type: ignore[union-attr]
    values = [s for s in sources if isinstance(s, np.ndarray)]
    studies = [s for s in sources if isinstance(s, KnownStudy)]
    seen: set[bytes] = set()
    kept: list[np.ndarray] = []
    grown: list[np.ndarray] = list(values)
    rows: list[tuple[Entry, int]] = []
    remarks, alone = [], len(studies) == 1
    for study in sorted(studies, key=lambda s: bool(s.why)):  # stable: those that hold first
        new = [k for k in study.chosen if study.points[k].tobytes() not in seen]
        if words := study.remark(len(new)):
            remarks.append(f"start: {words}." if alone else f"start: {study.name}: {words}.")
        seen |= {study.points[k].tobytes() for k in new}
        (grown if study.why else kept).extend(study.points[k] for k in new)
        rows += [study.rows[k] for k in new if not study.why]
    if not kept and not grown:
        many = sum(s.known for s in studies)
        raise checks.input_error(
            "start",
            f"a study of {many} designs" if studies else given,
            "one with a design within the bounds" if studies else "at least one design",
        )
    return KnownDesigns(
        points=np.array(grown).reshape(-1, task.space.size),
        entry=joined(np.array(kept), rows, task) if kept else None,
        given=len(values),
        why="; ".join(dict.fromkeys(s.why for s in studies if s.why)),
        remark="\n".join(remarks),
        every=np.concatenate([s.points for s in studies]) if studies else None,
    )


def _source(given: Any, task: Task) -> KnownStudy | np.ndarray:
    """A study, or the coordinates (D,) of one design."""
    if isinstance(given, str | Path):
        path = Path(given)
        if not path.is_file():
            raise checks.input_error("start", str(given), "a file that exists")
        given = (
            read_design(path)["parameters"] if path.suffix.lower() == ".json" else Study.read(path)
        )
    return known_study(given, task) if isinstance(given, Study) else _point(given, task)


def _point(design: Any, task: Task) -> np.ndarray:
    """The coordinates (D,) of one design. What it says of arguments that are not searched is left
    aside, but for names that the scene does not have."""
    values = getattr(design, "values", None)
    values = design if not isinstance(values, Mapping) else values
    if not isinstance(values, Mapping):
        raise checks.input_error(
            "start",
            design,
            "values by name, such as {'k3': 1.0}, a Best, a study, a file, or a list of these",
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
    given = {n: values[n] if n in values else usual_value(task, n) for n in space.names}
    try:
        return space.point(given)
    except checks.InputError as error:
        raise checks.InputError(f"start: {error} Widen its bounds, or leave it out.") from error

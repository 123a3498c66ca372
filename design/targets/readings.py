"""The readings of data, one by one, for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from design.targets.base import Target
from design.targets.conditions import Conditions
from design.targets.observed_course import ObservedCourse
from design.targets.observed_measures import ObservedMeasures, as_data


@dataclass(frozen=True)
class DataPoint:
    """A number that was measured. name: of its measure; full: that of a target's measures; under:
    the arguments of its condition, `label` in words; time: h, None where it has none. low, high:
    from where to where it is as wanted, one number of data; spread: of it."""

    name: str
    full: str
    under: Mapping[str, float]
    label: str
    time: float | None
    low: float
    high: float
    spread: float


def readings_of(target: Target) -> list[DataPoint]:
    """Those of a target of measured numbers alone; none of any other."""
    conditions = isinstance(target, Conditions)
    parts = target.parts if isinstance(target, Conditions) else (target,)
    found = []
    for place, part in enumerate(map(as_data, parts)):
        course = isinstance(part, ObservedCourse)
        frames = part.frames if isinstance(part, ObservedCourse) else (part,)
        label = target.label(place)
        for frame in frames:
            if not isinstance(frame, ObservedMeasures):
                return []
            at = f" at {frame.time:g} h" if course else ""
            ending = f" ({label})" if conditions else ""
            each = zip(frame.plan.names, frame.wanted, frame.spread, strict=True)
            found += [
                DataPoint(
                    name, f"{name}{at}{ending}", target.arguments[place], label, frame.time,
                    low, high, spread,
                )
                for name, (low, high), spread in each
            ]  # fmt: skip
    return found

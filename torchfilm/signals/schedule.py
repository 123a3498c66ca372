"""Values of a medium that change at given times."""

from __future__ import annotations

import dataclasses
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from torchfilm.tools import checks

# Hours, relative to the time: what times gather by rounding, far below any step.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Schedule(metaclass=checks.KnownKeywords):
    """A value of a medium that changes at given times: `tf.Schedule({0: 0.0, 2: 1.0, 3: 0.0})` is 1
    from 2 to 3 h, and 0 before and after.

    values: by the time, h, from which each holds; one holds from 0 h. Each is what the medium would
    take in place of the schedule. period: hours after which the values begin again; None: the last
    value stays.

    A step takes the value that holds as it begins. In rates and rules, `schedule(cell.time)` is the
    value at a time.
    """

    values: Mapping[float, Any]
    period: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.values, Mapping) or not self.values:
            raise checks.input_error(
                "Schedule.values", self.values, "a dict by time, h, such as {0: 0.0, 2: 1.0}"
            )
        times = [checks.number("time of Schedule.values", t, least=0.0) for t in self.values]
        if min(times) > 0:
            raise checks.input_error(
                "Schedule.values", dict(self.values), "given from 0 h on", "Add 0: …."
            )
        for time, value in self.values.items():
            if isinstance(value, Schedule):
                raise checks.input_error(
                    f"Schedule.values, from {time:g} h", value, "a value, not a schedule of them"
                )
        ordered = sorted(zip(times, self.values.values(), strict=True), key=lambda pair: pair[0])
        object.__setattr__(self, "values", dict(ordered))
        if self.period is not None:
            last = max(times)
            hint = "The values begin again after it."
            period = checks.number("Schedule.period", self.period, above=last, hint=hint)
            object.__setattr__(self, "period", period)

    @cached_property
    def times(self) -> tuple[float, ...]:
        """When each value begins, h, ascending from 0."""
        return tuple(self.values)

    def place(self, time: float) -> int:
        """Which of the values holds at a time, h."""
        after = time + ROUNDING * max(1.0, time)
        return bisect_right(self.times, after if self.period is None else after % self.period) - 1

    def at(self, time: float) -> Any:
        """The value at a time, h."""
        return self.values[self.times[self.place(time)]]

    def __call__(self, time: Any) -> Any:
        """The value at a time, h, as rates and rules have it: a number, or a tensor."""
        if isinstance(time, (int, float)):
            return self.at(time)
        after = time + ROUNDING
        after = after if self.period is None else after % self.period
        found = self.values[0.0]
        for start in self.times[1:]:
            found = torch.where(after >= start, self.values[start], found)
        return found

    @property
    def told(self) -> str:
        """When it changes, in words."""
        times = ", ".join(f"{t:g}" for t in self.times[1:])
        again = "" if self.period is None else f" and every {self.period:g} h anew"
        return f"changes at {times} h{again}" if times else "stays as it is"


def each_value(given: Any) -> tuple[Any, ...]:
    """All values that a value of a medium takes."""
    return tuple(given.values.values()) if isinstance(given, Schedule) else (given,)


def checked_values(name: str, given: Any, check: Callable[[str, Any], Any]) -> Any:
    """A value of a medium, or a schedule of them, each as `check` returns it from a name and a
    value."""
    if not isinstance(given, Schedule):
        return check(name, given)
    values = {t: check(f"{name}, from {t:g} h", x) for t, x in given.values.items()}
    return Schedule(values, given.period)


def schedules(part: Any) -> Iterator[Schedule]:
    """All schedules in a part of a medium."""
    if isinstance(part, Schedule):
        yield part
    elif isinstance(part, Mapping):
        for item in part.values():
            yield from schedules(item)
    elif isinstance(part, (tuple, list)):
        for item in part:
            yield from schedules(item)
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        for f in dataclasses.fields(part):
            yield from schedules(getattr(part, f.name))


def at_time(part: Any, time: float) -> Any:
    """A part of a medium with the values of its schedules at a time, h."""
    if isinstance(part, Schedule):
        return part.at(time)
    if isinstance(part, Mapping):
        return {name: at_time(item, time) for name, item in part.items()}
    if isinstance(part, (tuple, list)):
        return type(part)(at_time(item, time) for item in part)
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        changed = {f.name: at_time(getattr(part, f.name), time) for f in dataclasses.fields(part)}
        copy = object.__new__(type(part))
        copy.__dict__.update({**vars(part), **changed})  # past __init__: they have been checked
        return copy
    return part

"""Values of a medium that change at given times."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import torch

from torchfilm.tools import checks
from torchfilm.tools.parts import mapped

# Hours, relative to the time: what times gather by rounding, far below any step.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Schedule(metaclass=checks.KnownKeywords):
    """A value of a medium that changes at given times: `tf.Schedule({0: 0.0, 2: 1.0, 3: 0.0})` is 1
    from 2 to 3 h, and 0 before and after.

    values: by the time, h, from which each holds; one holds from 0 h. Each is what the medium would
    take in place of the schedule. period: hours after which the values begin again; None: the last
    value stays.

    The medium takes the value that holds as a step begins. In rates and rules,
    `schedule(cell.time)` is the value at a time: rates have that of the middle of a step, rules
    that of its beginning.
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
        if isinstance(time, Real):
            return self.at(float(time))
        for value in self.values.values():
            if isinstance(value, (tuple, list)) or not hasattr(value, "__add__"):
                raise checks.input_error(
                    "value of a Schedule in rates and rules", value, "a number, or a column"
                )
        after = time + ROUNDING
        after = after if self.period is None else after % self.period
        found = self.values[0.0] + 0.0 * time  # in the type of the time
        for start in self.times[1:]:
            found = torch.where(after >= start, self.values[start] + 0.0 * time, found)
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


def schedules(part: Any) -> list[Schedule]:
    """All schedules in a part of a medium."""
    found: list[Schedule] = []

    def seen(path: str, x: Any) -> Any:
        found.extend([x] if isinstance(x, Schedule) else [])
        return x

    mapped(part, seen)
    return found


def at_time(part: Any, time: float) -> Any:
    """A part of a medium with the values of its schedules at a time, h."""
    return mapped(part, lambda path, x: x.at(time) if isinstance(x, Schedule) else x)

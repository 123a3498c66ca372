"""Values of media and circuits that change at given times."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from torchfilm.tools import checks
from torchfilm.tools.parts import mapped, parts_of
from torchfilm.tools.warn_once import warn

# Hours, relative to the time: what times gather by rounding, far below any step.
ROUNDING = 1e-9
MOST_LOOKED_AT = 100_000  # steps, to see whether each value holds in one


@dataclass(frozen=True, eq=False)
class Schedule(metaclass=checks.KnownKeywords):
    """A value that changes at given times: `tf.Schedule({0: 0.0, 2: 1.0, 3: 0.0})` is 1 from 2 to
    3 h, and 0 before and after.

    values: by the time, h, from which each holds; one holds from 0 h. Each is what might stand in
    place of the schedule. period: hours after which the values begin again, and before 0 h end;
    None: the last value stays, and the first holds before 0 h, too.

    A medium takes one in place of a source, a flow, a reservoir or the value at a face, with the
    value that holds as a step begins. A circuit takes one as a constant: `p.light` of
    `Circuit(…, light=schedule)` has the value of the middle of a step. In `Lysis`, and in rules as
    `schedule(cells.time)`, it is that of its beginning; with a dead time, `schedule(cells.time −
    delay)`.
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
        after = time + ROUNDING * max(1.0, abs(time)) if math.isfinite(time) else time
        now = max(after, 0.0) if self.period is None else after % self.period
        return bisect_right(self.times, now) - 1

    def at(self, time: float) -> Any:
        """The value at a time, h."""
        return self.values[self.times[self.place(time)]]

    def __call__(self, time: Any) -> Any:
        """The value at a time, h; an array of them for an array or list of times."""
        if isinstance(time, Real):
            return self.at(float(time))
        if isinstance(time, (list, tuple, np.ndarray)):
            each = np.asarray(time, dtype=float)
            return np.array([self.at(float(t)) for t in each.flat]).reshape(each.shape)
        raise checks.InputError(
            f"a Schedule was called with {type(time).__name__}: it takes a time, h, as rules have"
            " it. Rates take it as a constant: tf.Circuit(…, light=schedule), which they read as"
            " p.light."
        )

    def warn_of_step(self, what: str, dt: float, late: float = 0.0) -> None:
        """Warn where steps of dt hours, each with the value that holds `late` of a step after its
        beginning, do not follow the changes of `what`."""
        if lost := self._lost(dt, late):
            warn(
                f"{what} has the value of {', '.join(f'{t:g} h' for t in lost)} in no step of"
                f" {dt:g} h: it is lost. Take a shorter dt, of which the times are multiples."
            )
            return
        moments = (*self.times, self.period or 0.0)
        between = [t for t in moments if abs(t / dt - round(t / dt)) > 1e-6]
        if between:
            warn(
                f"{what} changes at {between[0]:g} h, within a step of {dt:g} h. A step takes one"
                " value, so that values hold for longer or shorter than they should. Let the"
                " times, and the period, be multiples of dt."
            )

    def _lost(self, dt: float, late: float) -> list[float]:
        """The times whose values no step of the first period takes, or of as long as it changes."""
        end = self.times[-1] + 2 * dt if self.period is None else self.period
        steps = int(end / dt - late + ROUNDING) + 1
        if steps < len(self.times) or steps < MOST_LOOKED_AT:
            seen = {self.place((k + late) * dt) for k in range(steps)}
            return [t for k, t in enumerate(self.times) if k not in seen]
        return []

    @property
    def told(self) -> str:
        """When it changes, in words."""
        times = ", ".join(f"{t:g}" for t in self.times[1:])
        again = "" if self.period is None else f" and every {self.period:g} h anew"
        return f"changes at {times} h{again}" if times else "stays as it is"


def warn_of_steps(owner: str, values: Mapping[str, Any], dt: float, late: float = 0.0) -> None:
    """Warn as `Schedule.warn_of_step` of those values of an effect, by name, that are schedules."""
    for name, value in values.items():
        if isinstance(value, Schedule):
            value.warn_of_step(f"{owner}.{name}", dt, late)


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
    return parts_of(part, lambda x: isinstance(x, Schedule))


def at_time(part: Any, time: float) -> Any:
    """A part of a medium with the values of its schedules at a time, h."""
    return mapped(part, lambda path, x: x.at(time) if isinstance(x, Schedule) else x)

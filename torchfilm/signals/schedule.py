"""Values of media and circuits that change at given times."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.parts import mapped, parts_of
from torchfilm.tools.warn_once import warn

# Hours, relative to the time: what times gather by rounding, far below any step.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Schedule(metaclass=checks.KnownKeywords):
    """A value that changes at given times: `tf.Schedule({0: 0.0, 2: 1.0, 3: 0.0})` is 1 from 2 to
    3 h, and 0 before and after.

    values: by the time, h, from which each holds; one holds from 0 h. Each is what might stand in
    place of the schedule. period: hours after which the values begin again, and before 0 h end;
    None: the last value stays, and the first holds before 0 h, too.

    Circuits, rules and `MediumReactions` take one as a constant, `p.light` of `Circuit(…,
    light=schedule)`, and so do `Lysis`, `Erosion` and `Motility`. A medium takes one in place of a
    source, a flow, a reservoir or the value at a face. Each step has the mean of what holds during
    it, so that doses are exact whenever they begin and end. `schedule(time)` is the value at a
    time, `schedule.mean(begin, end)` the mean.
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

    @cached_property
    def linear(self) -> bool:
        """Whether its values are numbers, so that what they give has the mean of theirs. That of
        flows, which carry what comes through a face, and of functions is taken piece by piece."""
        return all(isinstance(x, Real | Tensor) for x in self.values.values())

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

    def shares(self, begin: float, end: float) -> list[tuple[int, float]]:
        """Which of the values hold from one time to another, h, each with its share of that time;
        the shares are together 1."""
        hours = end - begin
        found: dict[int, float] = {}
        edge = end - ROUNDING * max(1.0, abs(end))
        if self.period is not None and hours > self.period:
            whole = math.floor(hours / self.period)
            found = {k: whole * length for k, length in enumerate(self._lengths)}
            begin += whole * self.period
        while begin < edge:
            k = self.place(begin)
            upto = min(self._next(begin, k), end)
            found[k] = found.get(k, 0.0) + (end if upto >= edge else upto) - begin
            begin = upto
        if not (held := [(k, x) for k, x in sorted(found.items()) if x > 0]):
            return [(self.place(begin), 1.0)]
        return [(k, x / hours) for k, x in held] if len(held) > 1 else [(held[0][0], 1.0)]

    @property
    def _lengths(self) -> list[float]:
        """How long each value holds, h; the last one until the period ends, or for ever."""
        ends = (*self.times[1:], math.inf if self.period is None else self.period)
        return [end - begin for begin, end in zip(self.times, ends, strict=True)]

    def _next(self, time: float, place: int) -> float:
        """When the next value begins after a time at which that of a place holds, h."""
        if self.period is None:
            return self.times[place + 1] if place + 1 < len(self.times) else math.inf
        after = time + ROUNDING * max(1.0, abs(time))
        end = self.times[place + 1] if place + 1 < len(self.times) else self.period
        return after - after % self.period + end

    def changes(self, begin: float, end: float) -> list[float]:
        """When its values change between two times, h."""
        found, near = [], ROUNDING * max(1.0, abs(end))
        while (begin := self._next(begin, self.place(begin))) < end - near:
            found.append(begin)
        return found

    def mean(self, begin: float, end: float) -> Any:
        """The mean of its numbers, or tensors, from one time to another, h, as a step from `begin`
        to `end` has it. Raises InputError for an end that is not later."""
        begin = checks.number("Schedule.mean(begin)", begin)
        end = checks.number("Schedule.mean(end)", end, above=begin)
        held = [np.array(x) if isinstance(x, list) else x for x in self.values.values()]
        shares = self.shares(begin, end)
        for k, _ in shares:
            if not isinstance(held[k], Real | np.ndarray | Tensor):
                what = f"Schedule.values, from {self.times[k]:g} h"
                raise checks.input_error(what, held[k], "numbers, of which there is a mean")
        if len(shares) == 1:
            return held[shares[0][0]]
        return sum(share * held[k] for k, share in shares)

    def warn_of_mean(self, what: str, dt: float) -> None:
        """Warn where a value of `what` holds for less than a step of dt hours, and so never in a
        whole one."""
        lengths, ramp = self._lengths, self._on_ramps()
        if self.period is None and len(lengths) > 1:  # of a ramp more than one is short
            ramp[0] &= lengths[1] < dt
        for time, length, on_ramp in zip(self.times, lengths, ramp, strict=True):
            if length < dt * (1 - 1e-6) and not on_ramp:
                warn(
                    f"{what} has the value of {time:g} h for {length:.3g} h, less than a step of"
                    f" {dt:g} h. Steps take the mean over their time: the dose is right, but what"
                    " does not answer in proportion sees another input. Take a shorter dt."
                )
                return

    def _on_ramps(self) -> np.ndarray:
        """Which values are between those before and after them, as of a ramp, (K,) bool; the first
        is, unless values begin again. None of them is where they have cell types."""
        try:
            each = [np.asarray(x, dtype=np.float64) for x in _plain(self.values.values())]
            held = np.stack(np.broadcast_arrays(*each)).reshape(len(each), -1)
        except (TypeError, ValueError):
            return np.zeros(len(self.values), dtype=bool)
        before, after = np.roll(held, 1, 0), np.roll(held, -1, 0)
        found = (np.minimum(before, after) <= held) & (held <= np.maximum(before, after))
        return found.all(1) | ((np.arange(len(held)) == 0) & (self.period is None))

    @property
    def told(self) -> str:
        """When it changes, in words."""
        times = ", ".join(f"{t:g}" for t in self.times[1:])
        again = "" if self.period is None else f" and every {self.period:g} h anew"
        return f"changes at {times} h{again}" if times else "stays as it is"


def _plain(values: Iterable[Any]) -> list[Any]:
    """Tensors as arrays, without their gradients."""
    return [x.detach().cpu().numpy() if isinstance(x, Tensor) else x for x in values]


def warn_of_means(owner: str, values: Mapping[str, Any], dt: float) -> None:
    """Warn as `Schedule.warn_of_mean` of those values of an effect, by name, that are schedules."""
    for name, value in values.items():
        if isinstance(value, Schedule):
            value.warn_of_mean(f"{owner}.{name}", dt)


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


def held_together(
    schedules: Sequence[Schedule], begin: float, end: float
) -> dict[tuple[int, ...], tuple[float, float]]:
    """Which values of some schedules hold at once from one time to another, h, by their places:
    with the share of that time, and a time, h, at which they do."""
    each: dict[tuple[int, ...], tuple[float, float]] = {}
    if end <= begin:  # a step of no time, as one that is tried
        return {tuple(x.place(begin) for x in schedules): (1.0, begin)}
    if len(schedules) == 1:
        of = schedules[0]
        each = {(k,): (share, of.times[k]) for k, share in of.shares(begin, end)}
    else:
        times = sorted({begin, end, *(t for x in schedules for t in x.changes(begin, end))})
        for low, high in pairwise(times):
            middle = 0.5 * (low + high)
            places = tuple(x.place(middle) for x in schedules)
            share, time = each.get(places, (0.0, middle))
            each[places] = share + (high - low) / (end - begin), time
    # rounded, so that a period of the schedules has the same shares as the one before
    return {places: (s, time) for places, (x, time) in each.items() if (s := round(x, 9)) > 0}


def at_time(part: Any, time: float) -> Any:
    """A part of a medium with the values of its schedules at a time, h."""
    return mapped(part, lambda path, x: x.at(time) if isinstance(x, Schedule) else x)


def mean_of(part: Any, held: Sequence[tuple[float, float]]) -> Any:
    """A part of a medium with the means of its schedules, whose values are numbers or stay as they
    are, over some times, h, each with its share."""
    whole = sum(share for share, _ in held)

    def averaged(path: str, x: Any) -> Any:
        if not isinstance(x, Schedule):
            return x
        each = [(share / whole, x.at(time)) for share, time in held]
        first = each[0][1]
        return first if all(v is first for _, v in each) else sum(share * v for share, v in each)

    return mapped(part, averaged)

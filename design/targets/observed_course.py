"""A target that is made from data of several times: colonies followed as they grow."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import ended_elsewhere, huber
from design.targets.measured import Measure, Measured
from design.targets.observed import Observed
from design.targets.observed_frames import (
    mask_frames,
    measured_frames,
    results_frames,
    state_frames,
    table_frames,
)
from design.targets.observed_measures import MeasureStatistics, ObservedMeasures, as_data
from design.targets.observed_values import warn_of_width
from design.targets.statistics import LOG_CELLS, ColonyStatistics, birth_note
from torchfilm import checks, tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOTES = 2  # columns of a birth note


class JoinedStatistics(ABC):
    """The statistics of several `plans`, each with a label in its name."""

    plans: tuple[ColonyStatistics | JoinedStatistics | MeasureStatistics, ...]

    @property
    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Of the plans."""

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The names of the statistics by what they are about, in each plan."""
        pairs = zip(self.plans, self.labels, strict=True)
        return {
            f"{group} {label}": tuple(f"{name} {label}" for name in names)
            for plan, label in pairs
            for group, names in plan.groups.items()
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Of all statistics, (K,)."""
        return tuple(name for names in self.groups.values() for name in names)

    @property
    def species(self) -> tuple[str, ...]:
        """All reporters."""
        return tuple(dict.fromkeys(n for plan in self.plans for n in plan.species))


@dataclass(frozen=True)
class CourseStatistics(JoinedStatistics):
    """The statistics of each of several `times`, h: those of `plans`."""

    plans: tuple[ColonyStatistics | MeasureStatistics, ...]
    times: tuple[float, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"at {time:g} h" for time in self.times)


@dataclass(frozen=True, init=False)
class ObservedCourse(Observed):
    """Colonies like those that were observed at several times: `ObservedCourse([one, two, three])`,
    of `Observed` with a `time` each, for a search or `infer`. Numbers that a plate reader or a
    count gives at each time are a course by `of_measures`.

    frames: in the order of their times, each an `Observed` or a `Measured`, of which two may have
    one time, in a search also one with ranges; whether each frame shows the same colonies, or as
    many, does not matter. A simulated colony is compared at each of these times, which must be
    whole numbers of steps, and ends at the last one. Ages are compared as a colony ends only. The
    statistics of frame k have its time in their names: "gfp_mean at 2 h".

    The loss is that of `Observed` with the statistics of all frames, each weighted alike. They are
    not independent: one colony is seen several times. Raises InputError for frames without a time
    or in another order.
    """

    plan: CourseStatistics  # type: ignore[assignment]
    frames: tuple[Observed, ...] = field(repr=False)

    def __init__(self, frames: Sequence[Observed | Measured]):
        self._set(_checked(frames), None)

    def _set(self, given: tuple[Observed, ...], end: float | None) -> None:
        """Frames of colonies that end at the last one, or later, at `end` h."""
        times = tuple(float(f.time or 0.0) for f in given)
        end = times[-1] if end is None else end
        widths = [f.width for f in given if f.width is not None]
        kept = tuple(
            f.without("age") if f.plan.ages and time < end else f
            for f, time in zip(map(_without_width, given), times, strict=True)
        )
        found = {
            "frames": kept,
            "values": tuple(v for f in kept for v in f.values),
            "spread": tuple(v for f in kept for v in f.spread),
            "plan": CourseStatistics(tuple(f.plan for f in kept), times),
            "colonies": max(f.colonies for f in kept),
            "cells": sum(f.cells for f in kept),
            "time": end,
            "width": sum(widths) / len(widths) if widths else None,
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @staticmethod
    @checks.known_keywords
    def from_table(
        table: str | Path | Mapping[str, Any],
        *,
        time_unit: str | None = None,
        columns: Mapping[str, str] | None = None,
        **options: Any,
    ) -> ObservedCourse:
        """Cells that were observed at several times: a table as for `Observed.from_table` with a
        column `time` beside, as time_h or time_min, or with time_unit; columns={"time": "Hours"} if
        it has another name. The rows of each time are a frame. Further keywords: options of
        `Observed.from_table`. Raises InputError as that does, and for fewer than two times, or a
        time of 0 or less."""
        if "time" in options:
            hint = "Times are in the table: columns={'time': …} names their column."
            what = "ObservedCourse.from_table(time)"
            raise checks.input_error(what, options["time"], "left out", hint)
        given, columns = tables.Table.read(table), dict(columns or {})
        units = tables.Units(time_unit=time_unit)
        used: set[tuple[str, str]] = set()
        known = given.quantity("time", "time", columns, units, used)
        if known is None:
            hint = 'Name the column of times by columns={"time": …}, or take Observed.from_table.'
            raise given.missing("time_h", hint)
        column, _, factor = known
        age = given.column("age", "time", columns)
        if age is not None and not age[1]:
            options["time_unit"] = time_unit
            used.add(("time", units.stated("time")))
        units.check_used(used)
        columns.pop("time", None)
        times = factor * given.numbers(column)
        if times.min() <= 0.0:
            raise tf.InputError(
                f"{given.place(int(times.argmin()))}, column {column!r}: {times.min():g} h is not"
                " above 0. Leave such rows out: they say how runs begin, which Scene(founders=…)"
                " does."
            )
        each = np.unique(times)
        if len(each) < 2:
            raise tf.InputError(
                f"{given.source}, column {column!r}: all rows are of {each[0]:g} h, and a course"
                " has several times. Take Observed.from_table(…, time=…)."
            )
        if 2 * len(each) > len(times):
            checks.warn(
                f"{given.source}, column {column!r}: {len(each)} times in {len(times)} rows. Cells"
                " of one frame have the same time: round those that the instrument noted."
            )
        return ObservedCourse(table_frames(given, times, columns, options))

    @staticmethod
    @checks.known_keywords
    def of_measures(
        functions: Mapping[str, Measure],
        *,
        times: Sequence[float],
        values: Mapping[str, Any],
        spread: Mapping[str, Any] | None = None,
        error: Mapping[str, Any] | None = None,
        extinct: bool = False,
        smooth: bool = False,
        colonies: int = 1,
    ) -> ObservedCourse:
        """Measures of your own at several times, such as those of a plate reader:

            ObservedCourse.of_measures({"od": volume}, times=(1, 2, 3),
                                       values={"od": (0.1, 0.2, nan)}, spread={"od": 0.01})

        functions, error, extinct, smooth, colonies: as of `Measured`. times: h, in their order.
        values: by name, as many numbers as times, NaN where one is missing; a pandas.DataFrame will
        do; or numbers by time and colony, (T, C), as of `Measured.of_colonies`, without a spread.
        spread: by name, a standard error above 0, or one for each time. Raises InputError for other
        names, lengths or times, and where fewer than two times have a value."""
        known = functions, times, values, spread, error
        return ObservedCourse(measured_frames(*known, extinct, smooth, colonies))

    @staticmethod
    @checks.known_keywords
    def from_masks(  # type: ignore[override]
        masks: Sequence[Any],
        *,
        times: Sequence[float],
        fluorescence: Mapping[str, Sequence[Any]] | None = None,
        **options: Any,
    ) -> ObservedCourse:
        """Label images of several times: for each of `times`, h, what `Observed.from_masks` takes,
        an image or a list of images, each of a colony; of a reporter as many images. Further
        keywords: options of that. Raises InputError as it does, and for other numbers of times."""
        return ObservedCourse(mask_frames(masks, times, fluorescence, options))

    @staticmethod
    def from_state(states: Sequence[tf.State], **options: Any) -> ObservedCourse:  # type: ignore[override]
        """States of several times, in their order. Further keywords: options of
        `Observed.from_state`."""
        return ObservedCourse(state_frames(states, options))

    @staticmethod
    def from_results(  # type: ignore[override]
        path: str | Path, frames: Sequence[int] | None = None, **options: Any
    ) -> ObservedCourse:
        """Frames of a results file, by default all but that of the founders. Further keywords:
        options of `Observed.from_results`."""
        return ObservedCourse(results_frames(path, frames, options))

    @property
    def times(self) -> tuple[float, ...]:
        """Of the frames, h."""
        return self.plan.times

    @property
    def wanted(self) -> tuple[tuple[float, float], ...]:
        return tuple(pair for frame in self.frames for pair in frame.wanted)

    @property
    def _noted(self) -> tuple[Observed, ...]:
        """The frames before the end."""
        return tuple(f for f in self.frames if f.time != self.time)

    @property
    def _last(self) -> tuple[Observed, ...]:
        """The frame as a colony ends, if there is one."""
        return self.frames[len(self._noted) :]

    def without(self, *groups: str) -> ObservedCourse:
        """The same data without the statistics of some groups, in all frames."""
        known = {g for f in self.frames for g in f.plan.groups}
        for group in groups:
            checks.choice("ObservedCourse.without", group, tuple(sorted(known)))
        each = (f.without(*(g for g in groups if g in f.plan.groups)) for f in self.frames)
        return _course(tuple(each), self.time)

    def check(self, state: tf.State) -> None:
        for frame in self.frames:
            frame.check(state)
        warn_of_width(self.width, state)

    @property
    def fewest(self) -> int:  # type: ignore[override]
        return max(frame.fewest for frame in self.frames)

    def unfit(self, state: tf.State) -> list[str]:
        ended = [ended_elsewhere(state, self.time)] * state.colonies
        each = [frame.unfit(state) for frame in self._last] or [ended]
        return [next(filter(None, why), "") for why in zip(*each, strict=True)]

    def why_rough(self, state: tf.State) -> str:
        return next(filter(None, (frame.why_rough(state) for frame in self.frames)), "")

    def note(self, state: tf.State) -> Tensor:
        """What tells the ages of the last frame, and the statistics of each frame before the end
        where its time has come, else NaN: (B, 2 + K')."""
        columns = [birth_note(state)]
        for frame, time in zip(self._noted, self.times, strict=False):
            if abs(state.time - time) <= 1e-6 * time:
                columns.append(frame.statistics(state))
            else:
                columns.append(columns[0].new_full((state.colonies, len(frame.values)), math.nan))
        return torch.cat(columns, 1)

    def statistics(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """The statistics of each colony in all frames, (B, K) float64; NaN where it was not seen at
        a time. history: the notes of all steps."""
        if history is None:
            raise tf.InputError(
                "statistics of several times need the notes of all steps: stack target.note(state)"
                " after each of them."
            )
        noted = history[:, :, NOTES:]
        seen = ~noted.isnan()
        # each was noted at one step
        earlier = torch.where(seen, noted, 0.0).sum(0)
        earlier = torch.where(seen.any(0), earlier, math.nan)
        return torch.cat([earlier, *(f.statistics(state, history) for f in self._last)], 1)

    def _reached(self, state: tf.State, history: Tensor) -> list[Tensor]:
        """Whether each colony was seen at the time of each frame, (B, 1) bool each; of one that
        reached none, the last frame tells most."""
        noted = history[:, :, 0]  # the time of each step
        earlier = [((noted - t).abs() <= 1e-6 * t).any(0) for t in self.times[: len(self._noted)]]
        ended = not ended_elsewhere(state, self.time)
        none = torch.zeros(len(noted[0]), dtype=torch.bool, device=noted.device)
        last = [~torch.stack([none, *earlier]).any(0) | ended for _ in self._last]
        return [reached.unsqueeze(1) for reached in (*earlier, *last)]

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """As of `Observed`; of the frames that were reached, in a colony that is grown for a part
        of its time only, as a first look of `Racing`."""
        found = self.statistics(state, history)
        assert history is not None  # statistics need it
        apart = self.apart(found)
        parts = apart.split([len(f.values) for f in self.frames], 1)
        reached = self._reached(state, history)
        kept = torch.cat([torch.where(r, x, 0.0) for r, x in zip(reached, parts, strict=True)], 1)
        count = sum((r * x.shape[1] for r, x in zip(reached, parts, strict=True)), reached[0] * 0)
        return huber(kept) / count.clamp(min=1).double().sqrt()

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """The numbers of cells, and the other statistics, by name and time, (B,) each."""
        found = zip(self.plan.names, self.statistics(state, history).unbind(1), strict=True)
        return {_plain(n): x.exp() if n.startswith(LOG_CELLS) else x for n, x in found}

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        found = {}
        ranges = self.bounds
        for name, value, spread in zip(self.plan.names, self.values, self.spread, strict=True):
            log = name.startswith(LOG_CELLS)
            size = math.exp(value) if log else 1.0
            if name not in ranges:
                found[_plain(name)] = (size, size * spread) if log else (value, spread)
        return found

    def why_undefined(self, measure: str) -> str:
        known = measure in self.evidence
        return "the colony had ended, or had no cells, or the measure was NaN" if known else ""

    @property
    def mark(self) -> str:
        return self.frames[-1].mark

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        self.frames[-1].draw(ax, state, place)

    def describe(self) -> str:
        times = ", ".join(f"{t:g}" for t in dict.fromkeys(self.times))
        if all(isinstance(f, ObservedMeasures) for f in self.frames):
            names = dict.fromkeys(n for f in self.frames for n in f.plan.names)
            return f"measured at {times} h: {', '.join(names)}"
        many = f"{self.colonies} observed colon" + ("ies" if self.colonies > 1 else "y")
        groups = dict.fromkeys(g for f in self.frames for g in f.plan.groups)
        return f"like {many} at {times} h, {self.cells} cells: {', '.join(groups)}"


def ending_at(data: Observed, end: float) -> Observed:
    """The same data of colonies that go on until `end` h."""
    if data.time in (None, end):
        return data
    if data.ragged:
        rule = f"{end:g} h, as of the others: cells are followed until the end"
        raise checks.input_error(f"time of {type(data).__name__}", data.time, rule)
    return _course(data.frames if isinstance(data, ObservedCourse) else (data,), end)


def _course(frames: tuple[Observed, ...], end: float | None) -> ObservedCourse:
    """The course of checked frames, one at least, in colonies that end at `end` h."""
    made = object.__new__(ObservedCourse)
    made._set(frames, end)
    return made


def _without_width(frame: Observed) -> Observed:
    """The frame without its width, of which the course warns once."""
    return frame if frame.width is None else replace(frame, width=None)


def _plain(name: str) -> str:
    """The name of the number of cells itself, in place of its logarithm."""
    return "cells" + name.removeprefix(LOG_CELLS) if name.startswith(LOG_CELLS) else name


def _checked(frames: object) -> tuple[Observed, ...]:
    rule = "two or more Observed(…, time=…), in the order of their times"
    if not isinstance(frames, Sequence) or len(frames) < 2:
        raise checks.input_error("ObservedCourse.frames", frames, rule)
    names = lambda frame: {_plain(name) for name in frame.plan.names}  # as tables have them
    found: list[Observed] = []
    for k, frame in enumerate(map(as_data, frames)):
        if not isinstance(frame, Observed) or isinstance(frame, ObservedCourse) or frame.ragged:
            rule = "an Observed or a Measured"
            raise checks.input_error(f"ObservedCourse.frames[{k}]", frame, rule)
        if frame.time is None:
            raise checks.input_error(
                f"ObservedCourse.frames[{k}].time", None, "the time of the frame, h",
                "Give time=… where you read it.",
            )  # fmt: skip
        there = [f for f in found if f.time == frame.time]
        beside = len(there) == 1 and type(frame) is not type(there[0])
        if k and frame.time <= (found[-1].time or 0.0) and not beside:
            raise checks.input_error(
                f"ObservedCourse.frames[{k}].time", frame.time,
                f"above that of the frame before, {found[-1].time:g} h",
                "An Observed and a Measured may have one time.",
            )  # fmt: skip
        if beside and (both := names(frame) & names(there[0])):
            rule = f"of other names than the Observed of {frame.time:g} h"
            raise checks.input_error(f"ObservedCourse.frames[{k}]", sorted(both), rule)
        found.append(frame)
    return tuple(found)

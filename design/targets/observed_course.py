"""A target that is made from data of several times: colonies followed as they grow."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.observed import FARTHEST, Observed
from design.targets.observed_measures import MeasureStatistics
from design.targets.statistics import LOG_CELLS, ColonyStatistics, birth_note
from torchfilm import checks

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

    plans: tuple[ColonyStatistics, ...]
    times: tuple[float, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"at {time:g} h" for time in self.times)


@dataclass(frozen=True, init=False)
class ObservedCourse(Observed):
    """Colonies like those that were observed at several times: `ObservedCourse([one, two, three])`,
    of `Observed` with a `time` each, for a search or `infer`.

    frames: in the order of their times, of the same number of colonies; whether each frame shows
    the same colonies does not matter. A simulated colony is compared at each of these times, which
    must be whole numbers of steps, and ends at the last one. Ages are compared in the last frame
    only. The statistics of frame k have its time in their names: "gfp_mean at 2 h".

    The loss is that of `Observed` with the statistics of all frames, each weighted alike. They are
    not independent: one colony is seen several times. Raises InputError for frames without a time,
    in another order, or of different numbers of colonies.
    """

    plan: CourseStatistics  # type: ignore[assignment]
    frames: tuple[Observed, ...] = field(repr=False)

    def __init__(self, frames: Sequence[Observed]):
        given = _checked(frames)
        kept = tuple(f.without("age") if f.plan.ages else f for f in given[:-1]) + given[-1:]
        times = tuple(float(f.time or 0.0) for f in kept)
        found = {
            "frames": kept,
            "values": tuple(v for f in kept for v in f.values),
            "spread": tuple(v for f in kept for v in f.spread),
            "plan": CourseStatistics(tuple(f.plan for f in kept), times),
            "colonies": kept[-1].colonies,
            "cells": sum(f.cells for f in kept),
            "time": times[-1],
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @property
    def times(self) -> tuple[float, ...]:
        """Of the frames, h."""
        return self.plan.times

    def without(self, *groups: str) -> ObservedCourse:
        """The same data without the statistics of some groups, in all frames."""
        known = {g for f in self.frames for g in f.plan.groups}
        for group in groups:
            checks.choice("ObservedCourse.without", group, tuple(sorted(known)))
        each = (f.without(*(g for g in groups if g in f.plan.groups)) for f in self.frames)
        return ObservedCourse(tuple(each))

    def check(self, state: tf.State) -> None:
        for frame in self.frames:
            frame.check(state)

    def note(self, state: tf.State) -> Tensor:
        """What tells the ages of the last frame, and the statistics of each frame but the last
        where its time has come, else NaN: (B, 2 + K')."""
        columns = [birth_note(state)]
        for frame, time in zip(self.frames[:-1], self.times[:-1], strict=True):
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
        return torch.cat([earlier, self.frames[-1].statistics(state, history)], 1)

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """As of `Observed`; of the frames that were reached, in a colony that is grown for a part
        of its time only, as a first look of `Racing`."""
        found = self.statistics(state, history)
        apart = (found - found.new_tensor(self.values)) / found.new_tensor(self.spread)
        parts = apart.split([len(f.values) for f in self.frames], 1)
        reached = [~x.isnan().all(1, keepdim=True) for x in parts]
        kept = torch.cat([torch.where(r, x, 0.0) for r, x in zip(reached, parts, strict=True)], 1)
        count = sum((r * x.shape[1] for r, x in zip(reached, parts, strict=True)), reached[0] * 0)
        return kept.clamp(-FARTHEST, FARTHEST) / count.clamp(min=1).double().sqrt()

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """The numbers of cells, and the other statistics, by name and time, (B,) each."""
        found = zip(self.plan.names, self.statistics(state, history).unbind(1), strict=True)
        return {_plain(n): x.exp() if n.startswith(LOG_CELLS) else x for n, x in found}

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        found = {}
        for name, value, spread in zip(self.plan.names, self.values, self.spread, strict=True):
            log = name.startswith(LOG_CELLS)
            size = math.exp(value) if log else 1.0
            found[_plain(name)] = (size, size * spread) if log else (value, spread)
        return found

    def why_undefined(self, measure: str) -> str:
        known = measure in self.evidence
        return "the colony had no cells, or ended before that time" if known else ""

    @property
    def mark(self) -> str:
        return self.frames[-1].mark

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        self.frames[-1].draw(ax, state, place)

    def describe(self) -> str:
        many = f"{self.colonies} observed colon" + ("ies" if self.colonies > 1 else "y")
        times = ", ".join(f"{t:g}" for t in self.times)
        groups = dict.fromkeys(g for f in self.frames for g in f.plan.groups)
        return f"like {many} at {times} h, {self.cells} cells: {', '.join(groups)}"


def _plain(name: str) -> str:
    """The name of the number of cells itself, in place of its logarithm."""
    return "cells" + name.removeprefix(LOG_CELLS) if name.startswith(LOG_CELLS) else name


def _checked(frames: object) -> tuple[Observed, ...]:
    rule = "two or more Observed(…, time=…), in the order of their times"
    if not isinstance(frames, Sequence) or len(frames) < 2:
        raise checks.input_error("ObservedCourse.frames", frames, rule)
    for k, frame in enumerate(frames):
        if not isinstance(frame, Observed) or isinstance(frame, ObservedCourse):
            raise checks.input_error(f"ObservedCourse.frames[{k}]", frame, "an Observed")
        if frame.time is None:
            raise checks.input_error(
                f"ObservedCourse.frames[{k}].time", None, "the time of the frame, h",
                "Give time=… where you read it.",
            )  # fmt: skip
        if k and frame.time <= (frames[k - 1].time or 0.0):
            raise checks.input_error(
                f"ObservedCourse.frames[{k}].time", frame.time,
                f"above that of the frame before, {frames[k - 1].time:g} h",
            )  # fmt: skip
        if frame.colonies != frames[0].colonies:
            raise checks.input_error(
                f"ObservedCourse.frames[{k}].colonies", frame.colonies,
                f"as many colonies as in the first frame, {frames[0].colonies}",
            )  # fmt: skip
    return tuple(frames)

"""Data of colonies that were observed under several conditions, for inference."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import Target
from design.targets.conditions import Conditions
from design.targets.observed import Observed
from design.targets.observed_course import CourseStatistics, JoinedStatistics, ObservedCourse
from design.targets.observed_measures import MeasureStatistics, ObservedMeasures, as_data
from design.targets.statistics import ColonyStatistics
from torchfilm import checks


@dataclass(frozen=True)
class ConditionStatistics(JoinedStatistics):
    """The statistics of each of several conditions, those of `plans`; `conditions` in words."""

    plans: tuple[ColonyStatistics | CourseStatistics | MeasureStatistics, ...]
    conditions: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"({words})" for words in self.conditions)


@dataclass(frozen=True, init=False)
class ObservedConditions(Observed):
    """The data of `conditions` as one: the statistics of all, each with its condition in its name,
    such as "gfp_mean (iptg = 10)".

    Raises InputError for conditions that are not all data, or where only some have a time.
    """

    plan: ConditionStatistics  # type: ignore[assignment]
    conditions: Conditions = field(repr=False)

    def __init__(self, conditions: Conditions):
        conditions = Conditions([(given, as_data(part)) for given, part in conditions.terms])
        parts = _checked(conditions)
        labels = tuple(conditions.label(k) for k in range(len(parts)))
        found = {
            "conditions": conditions,
            "values": tuple(v for part in parts for v in part.values),
            "spread": tuple(v for part in parts for v in part.spread),
            "plan": ConditionStatistics(tuple(part.plan for part in parts), labels),
            "colonies": max(part.colonies for part in parts),
            "cells": sum(part.cells for part in parts),
            "time": parts[0].time,
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @property
    def wanted(self) -> tuple[tuple[float, float], ...]:
        return tuple(pair for part in self.conditions.parts for pair in cast(Observed, part).wanted)

    def without(self, *groups: str) -> Observed:
        raise tf.InputError("leave statistics out of the data of each condition.")

    def unfit(self, state: tf.State) -> list[str]:
        return self.conditions.unfit(state)

    def note(self, state: tf.State) -> Tensor | None:
        return self.conditions.note(state)

    def statistics(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """Of each colony those of its condition, (B, K) float64, and NaN in place of others."""
        of = lambda part, own: cast(Observed, part).statistics(state, own)
        each = self.conditions.of_parts(of, state, history)
        mine = self.conditions.condition_of(state).unsqueeze(1)
        return torch.cat([x.where(mine == k, torch.nan) for k, x in enumerate(each)], 1)

    def why_undefined(self, measure: str) -> str:
        return self.conditions.why_undefined(measure)

    def describe(self) -> str:
        many = f"{self.colonies} observed colon" + ("ies" if self.colonies > 1 else "y")
        when = "" if self.time is None else f" at {self.time:g} h"
        groups = dict.fromkeys(g for plan in self.plan.plans for g in plan.groups)
        under = f"under each of {len(self.plan.labels)} conditions{when}"
        cells = f", {self.cells} cells in all" if self.cells else ""
        return f"like {many} {under}{cells}: {', '.join(groups)}"


def checked_data(observed: Any) -> Observed:
    """Data of several conditions, or measured numbers, as one; other data as they are. Raises
    InputError for what is none."""
    if isinstance(observed, (list, tuple)):
        raise tf.InputError(
            "observed is one Observed, not a list: put data of several times together as"
            " ObservedCourse([…])."
        )
    data = ObservedConditions(observed) if isinstance(observed, Conditions) else as_data(observed)
    data_of(observed)
    return cast(Observed, data)


def data_of(target: Target) -> list[Observed]:
    """The data of each condition, or of the only one. Raises InputError for what is none, and for a
    range in place of a number."""
    parts = [as_data(x) for x in (target.parts if isinstance(target, Conditions) else [target])]
    found = [part for part in parts if isinstance(part, Observed)]
    if len(found) < len(parts):
        rule = "an Observed, such as Observed.from_table(…), a Measured, or Conditions of these"
        raise checks.input_error("observed", target, rule)
    for part in found:
        for name, (low, high) in zip(part.plan.names, part.wanted, strict=True):
            if low != high:
                rule = "one number, as data have one"
                raise checks.input_error(f"Measured.wanted[{name!r}]", (low, high), rule)
    return found


def _of_one_time(observed: Observed) -> list[Observed]:
    """The data of each condition and time, in the order of their values."""
    if isinstance(observed, ObservedConditions):
        return [x for part in observed.conditions.parts for x in _of_one_time(cast(Observed, part))]
    return list(observed.frames) if isinstance(observed, ObservedCourse) else [observed]


def errors(observed: Observed) -> list[float]:
    """The standard error of measurement of each statistic, (K,), that simulations do not have."""
    return [
        error
        for part in _of_one_time(observed)
        for error in (
            part.plan.errors if isinstance(part, ObservedMeasures) else [0.0] * len(part.values)
        )
    ]


def grown(observed: Observed) -> Target:
    """The target of the task in which inference grows the colonies of some data."""
    return observed.conditions if isinstance(observed, ObservedConditions) else observed


def standard_errors(observed: Observed, replicates: int | None = None) -> np.ndarray:
    """Of the values, (K,): the spread of cells is that of single colonies, and each value a mean
    over some; that of measured numbers is their error, unless they have one beside it. replicates:
    of a simulation, for the root of half the squares of its error and that of the value."""
    spread, seen = np.array(observed.spread), np.array(_colonies(observed))
    grown = seen if replicates is None else np.array(averaged(observed, replicates))
    differ = spread * np.sqrt(0.5 / seen + 0.5 / grown)
    whole = np.array([
        isinstance(part, ObservedMeasures) and part.measured.error is None
        for part in _of_one_time(observed)
        for _ in part.values
    ])  # fmt: skip
    # simulations have the error of measurement, too
    return np.hypot(np.array(errors(observed)), np.where(whole, 0.0, differ))


def averaged(observed: Observed, replicates: int) -> list[int]:
    """Over how many of the `replicates` of a simulation each statistic is averaged, (K,): over as
    many as colonies were observed of it, where all are simulated that the best observed had."""
    return [-(-replicates * n // observed.colonies) for n in _colonies(observed)]


def _colonies(observed: Observed) -> list[int]:
    """Of how many colonies each statistic is, (K,)."""
    return [part.colonies for part in _of_one_time(observed) for _ in part.values]


def cells_each(observed: Observed) -> float:
    """How many cells of a colony were observed at the end, on average; 0 where some are not
    known, or were observed before the end alone."""
    if isinstance(observed, ObservedConditions):
        parts = [cells_each(cast(Observed, part)) for part in observed.conditions.parts]
        return sum(parts) / len(parts) if all(parts) else 0.0
    if not isinstance(observed, ObservedCourse):
        return observed.cells / observed.colonies
    at_end = [frame for frame in observed.frames if frame.time == observed.time]
    return max((frame.cells / frame.colonies for frame in at_end), default=0.0)


def places(observed: Observed) -> list[int]:
    """The condition of each statistic, (K,)."""
    parts = observed.conditions.parts if isinstance(observed, ObservedConditions) else (observed,)
    return [k for k, part in enumerate(parts) for _ in cast(Observed, part).values]


def _checked(conditions: Conditions) -> tuple[Observed, ...]:
    parts = tuple(part for part in conditions.parts if isinstance(part, Observed))
    if len(parts) < len(conditions.parts):
        other = next(part for part in conditions.parts if not isinstance(part, Observed))
        rule = "of data under every condition: Observed, ObservedCourse, or Measured"
        raise checks.input_error("Conditions.terms", other, rule)
    times = [part.time for part in parts]
    if len(set(times)) > 1:
        rule = "given under every condition, or under none"
        raise checks.input_error("time of Conditions", times, rule)
    return parts

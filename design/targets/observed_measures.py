"""Measured numbers as data, each with its error: plate readers, counts, growth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from torch import Tensor

import torchfilm as tf
from design.targets.base import Target
from design.targets.measured import Measured
from design.targets.observed import Observed


@dataclass(frozen=True)
class MeasureStatistics:
    """Measures of one's own: their names, the standard errors of measurement of the data, and a
    digest of their code."""

    names: tuple[str, ...]
    errors: tuple[float, ...]
    code: str
    species: tuple[str, ...] = ()
    ages: ClassVar[bool] = False
    positions: ClassVar[bool] = False

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The names of the statistics by what they are about."""
        return {"measures": self.names}


@dataclass(frozen=True, init=False)
class ObservedMeasures(Observed):
    """The wanted values of `measured` as data: each was measured with an error, normal, whose
    standard deviation is its spread, unless `measured` has one. Simulations get such errors, too. A
    range is no data; a search takes it all the same."""

    plan: MeasureStatistics  # type: ignore[assignment]
    measured: Measured = field(repr=False)

    def __init__(self, measured: Measured):
        ends = (measured.wanted[name] for name in measured.functions)
        # of a range an end that is a number
        values = [low if math.isfinite(low) else min(high, 1e300) for low, high in ends]  # type: ignore[misc]
        spread = tuple(float(measured.spread[name]) for name in measured.functions)
        own = measured.spread if measured.error is None else measured.error
        errors = tuple(float(own[name]) for name in measured.functions)
        code = tf.digest(dict(measured.functions))
        found = {
            "measured": measured,
            "values": tuple(values),
            "spread": spread,
            "plan": MeasureStatistics(tuple(measured.functions), errors, code),
            "colonies": measured.colonies,
            "cells": 0,
            "time": measured.time,
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @property
    def wanted(self) -> tuple[tuple[float, float], ...]:
        return tuple(self.measured.wanted[name] for name in self.plan.names)  # type: ignore[misc]

    @property
    def fewest(self) -> int:  # type: ignore[override]
        return self.measured.fewest

    def check(self, state: tf.State) -> None:
        self.measured.check(state)

    def without(self, *groups: str) -> Observed:
        raise tf.InputError("leave measures out of Measured(…).")

    def unfit(self, state: tf.State) -> list[str]:
        return self.measured.unfit(state)

    def why_rough(self, state: tf.State) -> str:
        return self.measured.why_rough(state)

    def why_undefined(self, measure: str) -> str:
        return ""  # the function says it

    def statistics(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """The measures of each colony, (B, K) float64, with their gradients."""
        return self.measured.found(state)

    def describe(self) -> str:
        return f"measured: {', '.join(self.plan.names)}"


def as_data(target: Target) -> Target:
    """Measured numbers as data; any other target as it is."""
    return ObservedMeasures(target) if isinstance(target, Measured) else target

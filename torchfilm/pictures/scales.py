"""Ranges of values, and the scales of colours that show them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from torchfilm.pictures.categories import KINDS

Beyond = Literal["neither", "both", "min", "max"]
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass
class ValueRange:
    """The range of one quantity so far: lowest and highest value.

    least: the lowest above 0. kinds: the distinct values while they are integers and at most
    `most`, else None.
    """

    most: int = len(KINDS)
    low: float = math.inf
    high: float = -math.inf
    least: float = math.inf
    kinds: set[int] | None = field(default_factory=set)

    def add(self, values: np.ndarray) -> None:
        """Extend the range by these values."""
        if self.kinds is not None:
            whole = values.dtype == bool or np.issubdtype(values.dtype, np.integer)
            self.kinds = (
                self.kinds | {int(x) for x in np.unique(values)[: self.most + 1]} if whole else None
            )
            if self.kinds is not None and len(self.kinds) > self.most:
                self.kinds = None
        finite = values[np.isfinite(values)]
        if finite.size:
            self.low, self.high = (
                min(self.low, float(finite.min())),
                max(self.high, float(finite.max())),
            )
        if (above := finite[finite > 0]).size:
            self.least = min(self.least, float(above.min()))


@dataclass(frozen=True, eq=False)
class Scale:
    """The colours of a quantity.

    name: of the quantity. label, unit: for a legend. cmap: the colour map. limits: the range of the
    map. beyond: whether values lie outside the limits ("min", "max", "both" or "neither"). kinds:
    the values of a categorical quantity, instead of a range. log: whether the colours follow the
    logarithm of values; those of 0 and below are beyond the lower end. names: of the kinds 0, 1, …,
    as far as they have some.
    """

    name: str
    label: str
    unit: str
    cmap: Any
    limits: tuple[float, float]
    beyond: Beyond = "neither"
    kinds: tuple[int, ...] = ()
    log: bool = False
    names: Sequence[str] = ()

    @property
    def words(self) -> list[str]:
        """What a legend calls the kinds: their names, or numbers."""
        return [self.names[k] if 0 <= k < len(self.names) else str(k) for k in self.kinds]

    @property
    def power(self) -> int:
        """The power of ten that a legend factors out of very small and very large numbers."""
        power = 0 if self.kinds or self.log else math.floor(math.log10(max(map(abs, self.limits))))
        return power if power < -2 or power > 3 else 0

    @property
    def title(self) -> str:
        """Name and unit, for a legend."""
        ten = "10" + str(self.power).translate(RAISED) if self.power else ""
        unit = f"{ten} {self.unit}".strip()
        return f"{self.label} ({unit})" if unit else self.label

    def level(self, values: np.ndarray) -> np.ndarray:
        """The position of values in the range, 0 … 1; NaN stays NaN."""
        values, limits = np.asarray(values, dtype=float), np.asarray(self.limits)
        if self.log:
            limits = np.log10(limits)
            values = np.log10(np.maximum(values, self.limits[0]))  # NaN stays NaN
        low, high = limits
        return np.clip((values - low) / (high - low), 0.0, 1.0)

    def paint(self, values: np.ndarray) -> np.ndarray:
        """Colours (…, 4) of values."""
        if self.kinds:
            return self.cmap(np.searchsorted(self.kinds, values))
        return self.cmap(np.ma.masked_invalid(self.level(values)))


def wide_enough(low: float, high: float, share: float) -> tuple[float, float]:
    """The range, or one of this share of the largest value around values that differ less: the
    errors of solvers are no pattern."""
    if low == high:  # in the middle of the range, since it is neither low nor high
        return (low - 0.5 * abs(low), low + 0.5 * abs(low)) if low else (0.0, 1.0)
    least = share * max(abs(low), abs(high))
    if high - low >= least:
        return low, high
    middle = 0.5 * (low + high)
    return middle - 0.5 * least, middle + 0.5 * least

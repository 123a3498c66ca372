"""A design whose parameters are all uncertain at once."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from design.loss_bands import standard_error
from design.objective import Objective
from design.parameters import Choice, Parameter

SEED = 20_261_127  # of the factors: alike for all designs, which so compare
STREAMS = 4  # of random numbers on which variants are grown, in turn


@dataclass(frozen=True, eq=False)
class Varied:
    """Variants of a design. vary: the standard deviation of the logarithm of a parameter; points:
    (M, D), of the variants; clipped: share of the values that bounds held; losses: (M,); streams:
    (M,), on which of the streams of the check each was grown."""

    vary: float
    points: np.ndarray
    clipped: float
    losses: np.ndarray
    streams: np.ndarray

    def change(self, losses: np.ndarray) -> tuple[float, float]:
        """By how much the loss of a variant exceeds that of the design on the same stream: the mean
        over the streams, and its standard error; variants on one stream share that of the design.
        losses: (S,), of the design, on each stream."""
        each = np.unique(self.streams)
        gained = np.array([(self.losses[self.streams == k] - losses[k]).mean() for k in each])
        return float(gained.mean()), standard_error(gained)


def varied(
    objective: Objective,
    point: np.ndarray,
    vary: float,
    streams: Sequence[int],
    executor: Executor | None,
    work_items: int,
) -> Varied:
    """As many variants as streams, each parameter that is a number times its own exp(vary · normal
    number), within its bounds."""
    points, clipped = _variants(objective.task.space.parameters, point, vary, len(streams))
    losses = np.full(len(points), np.nan)
    parts = min(STREAMS, len(streams))
    used = np.arange(len(points)) % parts
    for k in range(parts):
        found = objective.evaluate(
            points[k::parts], streams=(streams[k],), executor=executor, work_items=work_items
        )
        losses[k::parts] = found.losses[:, 0]
    return Varied(vary, points, clipped, losses, used)


def _variants(
    parameters: Sequence[Parameter | Choice], point: np.ndarray, vary: float, count: int
) -> tuple[np.ndarray, float]:
    """The points (count, D), and the share of the values that bounds held."""
    factors = np.exp(vary * np.random.default_rng(SEED).standard_normal((count, len(point))))
    points, held, all_values = np.tile(point, (count, 1)), 0, 0
    for k, parameter in enumerate(parameters):
        if isinstance(parameter, Choice) or parameter.whole:
            continue
        wanted = parameter.value(float(point[k])) * factors[:, k]
        used = np.clip(wanted, parameter.low, parameter.high)
        points[:, k] = [parameter.coordinate(float(value)) for value in used]
        held, all_values = held + int((used != wanted).sum()), all_values + count
    return points, held / max(all_values, 1)

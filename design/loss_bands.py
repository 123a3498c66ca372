"""Where the loss of a design lies, by its losses on some seeds."""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import binom
from scipy.stats import t as student

from design.targets.base import Target
from design.targets.goals import Goals
from design.task import Task

LEAST = 4  # fresh seeds of a finalist
HOLDS = (8, 24)  # fresh seeds of a design that may hold the wanted loss: first, then in all
BAND = 0.9  # probability of a band
RESAMPLES = 2000


def standard_error(losses: np.ndarray) -> float:
    """Of the mean of independent losses (S,); NaN of one."""
    count = len(losses)
    return float(losses.std(ddof=1)) / math.sqrt(count) if count > 1 else math.nan


def is_mean(task: Task, target: Target | None = None) -> bool:
    """Whether the loss of a design is the mean of those of its colonies. target: of which it is the
    loss; by default that of the task."""
    return task.reduce == "mean" and not _reduces_itself(target or task.target)


def goal_errors(task: Task, losses: np.ndarray) -> np.ndarray:
    """The standard error of each goal (F, G), from its losses on some seeds (F, S, G). NaN where a
    goal is not the mean of them, and of one seed."""
    assert isinstance(task.target, Goals)
    errors = np.full((len(losses), losses.shape[2]), np.nan)
    for k, part in enumerate(task.target.parts):
        if is_mean(task, part):
            errors[:, k] = [standard_error(x) for x in losses[:, :, k]]
    return errors


def seeds_of_an_end(task: Task) -> int:
    """Seeds from which on the band of a quantile has an upper end; 1 where it always has one."""
    if not _is_quantile(task):
        return 1
    return math.ceil(math.log(0.5 - BAND / 2) / math.log(float(task.reduce)))


def seeds_to_hold(task: Task) -> list[int]:
    """The fresh seeds on which a design may hold a loss: first, then in all."""
    return sorted({*HOLDS, max(HOLDS[-1], seeds_of_an_end(task))})


def _is_quantile(task: Task) -> bool:
    """Whether the loss of a design is a quantile of those of its colonies, not of the worst."""
    return isinstance(task.reduce, float) and task.reduce < 1 and not _reduces_itself(task.target)


def _reduces_itself(target: Target) -> bool:
    """Whether a target, such as a spread, makes one loss of those of the seeds."""
    return target.reduced(np.zeros((1, LEAST))) is not None


def loss_band(task: Task, losses: np.ndarray) -> tuple[float, float]:
    """Student's interval of a mean; the order statistics that enclose a quantile whatever the
    distribution (David and Nagaraja, Order Statistics, 2003, 7.1), infinite where the seeds are too
    few; else the interval of resampled losses."""
    if is_mean(task):
        wide = float(student.ppf(0.5 + BAND / 2, len(losses) - 1) * standard_error(losses))
        return float(losses.mean()) - wide, float(losses.mean()) + wide
    if _is_quantile(task):
        found = binom.ppf([0.5 - BAND / 2, 0.5 + BAND / 2], len(losses), task.reduce)
        ends = np.concatenate([[-np.inf], np.sort(losses), [np.inf]])
        return float(ends[int(found[0])]), float(ends[int(found[1]) + 1])
    drawn = np.random.default_rng(0).choice(losses, (RESAMPLES, len(losses)))
    low, high = np.quantile(task.reduced(drawn), [0.5 - BAND / 2, 0.5 + BAND / 2])
    return float(low), float(high)

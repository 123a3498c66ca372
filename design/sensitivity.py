"""Sobol' indices: how much each parameter contributes to the variance of the loss over the whole
space."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import qmc, sobol_indices

from design.objective import Objective
from design.progress import advance
from design.task import SURVIVORS

if TYPE_CHECKING:
    from tqdm import tqdm

DESIGNS = 256  # evaluated at once, so that the bar moves
RESAMPLES = 200  # for the standard errors


@dataclass(frozen=True, eq=False)
class Indices:
    """Sobol' indices of the loss over the whole space, (D,) each.

    first: the share of the loss's variance that a parameter explains alone; total: its share with
    all its interactions. first_error, total_error: standard errors of independent points, by
    resampling. Sobol points are more even, so that the errors are smaller: from two to five times
    on smooth losses. samples; colonies: how many were grown for it.
    """

    first: np.ndarray
    total: np.ndarray
    first_error: np.ndarray
    total_error: np.ndarray
    samples: int
    colonies: int


def loss_indices(
    objective: Objective,
    samples: int,
    *,
    executor: Executor | None,
    work_items: int,
    bar: tqdm | None,
) -> Indices:
    """Sobol' indices of the mean loss over the replicates, on the searched streams (Saltelli et al.
    2010; scipy.stats.sobol_indices)."""
    task = objective.task
    size, seed = task.space.size, task.seed
    engine = qmc.Sobol(2 * size, scramble=True, rng=np.random.default_rng(seed))
    one, other = np.hsplit(engine.random(samples), 2)
    points = np.concatenate(
        [one, other, *(np.where(np.arange(size) == k, other, one) for k in range(size))]
    )
    losses = np.empty(len(points))
    for begin in range(0, len(points), DESIGNS):
        part = slice(begin, begin + DESIGNS)
        found = objective.evaluate(points[part], executor=executor, work_items=work_items)
        losses[part] = found.loss if task.reduce == SURVIVORS else found.losses.mean(1)
        advance(bar, found.losses.size)
    rows = losses.reshape(size + 2, samples)
    first, total = _estimate(rows)
    random = np.random.default_rng(seed)
    drawn = np.array(
        [_estimate(rows[:, random.integers(samples, size=samples)]) for _ in range(RESAMPLES)]
    )
    first_error, total_error = drawn.std(0)
    return Indices(
        first, total, first_error, total_error, samples, len(points) * task.colonies_each
    )


def _estimate(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and total indices, (D,) each, from the losses (D + 2, n) at points A, B, and A with one
    column of B."""
    # the same output twice: scipy cannot distinguish the axes of one parameter and one output
    twice = {"f_A": rows[[0, 0]], "f_B": rows[[1, 1]], "f_AB": np.stack([rows[2:], rows[2:]], 1)}
    found = sobol_indices(func=twice, n=rows.shape[1])
    return found.first_order.reshape(2, -1)[0], found.total_order.reshape(2, -1)[0]

"""Trivial answers: the losses of colonies that were told nothing of the target."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.growing import FinishedColonies
from design.objective import Objective
from design.study import Study
from design.targets.base import OUTSIDE, Target
from design.targets.goals import Constrained
from design.targets.several import Several
from torchfilm import checks

BRIGHT = 1e3  # a lit cell, relative to the greatest level that was found, or to 1
EVERY_SECOND = "every second lit"
LEVELS = 25  # even levels that are tried, over six orders of magnitude


def _means(losses: np.ndarray) -> np.ndarray:
    return losses.mean(1)


@torch.no_grad()
def trivial_losses(
    target: Target,
    finished: Iterable[FinishedColonies],
    reduced: Callable[[np.ndarray], np.ndarray] = _means,
) -> dict[str, float]:
    """The losses of some colonies if all cells were dark, if all were lit, if every second one was,
    and at the even level that is best. reduced: how the losses of colonies become one, (n, R) to
    (n,); by default their mean."""
    found: dict[str, list[float]] = {}
    even: list[np.ndarray] = []
    ids: list[int] = []
    for part in finished:
        state, steps = part.state, 0 if part.history is None else part.history.shape[0]
        bright = BRIGHT * max(1.0, *(_greatest(state, n) for n in target.names), 0.0)
        loss = lambda level, state=state, steps=steps: _loss(target, state, steps, level)
        second = lambda count, level=bright: level * (torch.arange(count) % 2)
        for name, level in (("all dark", 0.0), ("all lit", bright), (EVERY_SECOND, second)):
            found.setdefault(name, []).extend(loss(level))
        ids += [k // len(target.arguments) for k in state.colony_id.tolist()]
        even.append(np.array([loss(x) for x in np.geomspace(1e-6, 1.0, LEVELS) * bright]))
    # under several conditions a replicate has the mean of its colonies
    several = len(target.arguments) > 1
    _, owner, counts = np.unique(ids, return_inverse=True, return_counts=True)
    mean = lambda losses: np.bincount(owner, losses) / counts if several else losses
    each = lambda rows: np.array([mean(row) for row in rows])
    answers = {name: float(reduced(each([losses]))[0]) for name, losses in found.items()}
    if even:
        answers["best even level"] = float(reduced(each(np.concatenate(even, 1))).min())
    return answers


def check_within_reach(objective: Objective, study: Study) -> bool:
    """Raise InputError where no colony of full size reaches the pattern of the target, or of one of
    several, so that all designs have the same loss of it. It looks at the first design that grew;
    where growth depends on the design, others may reach farther, and nothing is said. Returns
    whether there was a batch of full size to look at."""
    task = objective.task
    structural = any(p.structural for p in task.space.parameters)
    entry = next((e for e in study.entries if e.size == 1), None)
    if entry is None or structural or task.tried.why_regrown:
        return entry is not None
    failed = {row for row, _ in entry.reasons}
    grew = [k for k in range(len(entry.points)) if k not in failed]
    several = isinstance(task.target, Several)
    if not grew or (not several and np.ptp(entry.losses[grew]) > 1e-9):
        return True
    states = [part.state for part in objective.colonies(entry.points[grew[0]])]
    within = lambda pattern: any(bool(pattern.reaches(state).any()) for state in states)
    patterns = _patterns(task.target, states[0]) if states else []
    beyond = next((pattern for pattern in patterns if not within(pattern)), None)
    if beyond is None:
        return True
    cells = max(int(state.counts.max()) for state in states)
    reach = max(float(state.position.norm(dim=1).max()) for state in states)
    raise checks.InputError(
        f"target: colonies of {cells} cells, which reach {reach:.3g} µm from the origin, do not"
        f" reach the pattern ({beyond.describe()}), so that all designs have the same loss of it."
        " Grow larger colonies (cells, until), or move the pattern."
    )


def _patterns(target: Target, state: tf.State) -> list[Target]:
    """The target, or all of which its loss is made: not those that are only measured."""
    if isinstance(target, Constrained):
        return [found for part in (target.target, *target.bounding(state))
                for found in _patterns(part, state)]  # fmt: skip
    if isinstance(target, Several):
        return [found for part in target.parts for found in _patterns(part, state)]
    return [target]


def _greatest(state: tf.State, name: str) -> float:
    values = state.fields[name]
    return float(torch.nan_to_num(values, 0.0, 0.0, 0.0).max()) if values.numel() else 0.0


def _loss(target: Target, state: tf.State, steps: int, level: object) -> list[float]:
    """The losses of colonies whose cells, or voxels, all have these levels at all times."""
    fields: dict[str, Tensor] = {}
    for name in target.names:
        field = name if name.startswith(OUTSIDE) or name in state.fields else f"{OUTSIDE}{name}"
        old = state.fields[field]
        made = level(old.shape[0]) if callable(level) else torch.full(old.shape, float(level))  # type: ignore[arg-type]
        fields[field] = made.to(dtype=old.dtype, device=old.device)
    even = state.with_fields(**fields)
    note = target.note(even)
    history = None if note is None else note.expand(max(steps, 1), *note.shape)
    return target.loss(even, history).double().tolist()

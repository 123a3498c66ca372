"""Colonies of a batch on their way: each is measured when it is done, whoever else is in the batch,
and leaves; one that fails leaves with its reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

import torchfilm as tf

# h: a colony that has not gained a cell in so long never will
PATIENCE = 100.0


@dataclass(frozen=True)
class FinishedColonies:
    """Colonies that have reached their end in one step, as a state of them alone, and their notes
    (T, B, k), or None."""

    state: tf.State
    history: Tensor | None


@dataclass(frozen=True)
class Failed:
    """A colony, by its id, that could not go on, and why."""

    colony_id: int
    reason: str


def grow(
    step: Callable[[tf.State], tf.State],
    state: tf.State,
    *,
    cells: int | None,
    until: float | None,
    note: Callable[[tf.State], Tensor | None],
) -> Iterator[FinishedColonies | Failed]:
    """Step a batch until each of its colonies is done: at `cells` cells or at `until` h, whichever
    it reaches first.

    A colony's end depends on itself alone, so that its outcome does not depend on its batch. note:
    called after every step; see `Target.note`.
    """
    everyone, last = state.colonies, math.inf if until is None else until
    most, since = (
        state.counts.new_zeros(everyone),
        state.counts.new_zeros(everyone, dtype=torch.float64),
    )
    notes: list[Tensor] = []
    while True:
        state = step(state)
        failures = {f.place: f for f in reversed(tf.failures(state))}
        for place in sorted(failures):
            yield Failed(
                failures[place].colony_id, f"at {state.time:g} h: {failures[place].reason}"
            )
        gone = torch.zeros(state.colonies, dtype=torch.bool, device=state.device)
        gone[list(failures)] = True
        empty = (state.counts == 0) & ~gone
        for colony_id in state.colony_id[empty].tolist():
            yield Failed(colony_id, f"no cell was left at {state.time:g} h")
        gone = gone | empty
        if bool(gone.all()):
            return
        state = _keep(state, ~gone)
        found = note(state)
        if found is not None:
            row = found.new_full((everyone, *found.shape[1:]), torch.nan)
            notes.append(row.index_copy(0, state.colony_id, found))
        late = state.time >= last - 1e-9
        done = (
            torch.full_like(state.counts, late, dtype=torch.bool)
            if cells is None or (until is not None and late)
            else state.counts >= cells
        )
        if bool(done.any()):
            finished = _keep(state, done)
            yield FinishedColonies(
                finished,
                (
                    torch.stack([n.index_select(0, finished.colony_id) for n in notes])
                    if notes
                    else None
                ),
            )
        # where the end is a time, it comes by itself
        stuck = _stuck(state, most, since) & ~done if until is None else torch.zeros_like(done)
        for colony_id, count in zip(
            state.colony_id[stuck].tolist(), state.counts[stuck].tolist(), strict=True
        ):
            yield Failed(
                colony_id,
                f"it has {count} of {cells} cells at {state.time:g} h, and has had no more for"
                f" {PATIENCE:g} h",
            )
        gone = done | stuck
        if bool(gone.all()):
            return
        state = _keep(state, ~gone)


def _stuck(state: tf.State, most: Tensor, since: Tensor) -> Tensor:
    """Which colonies have gained no cell in `PATIENCE`, (B,). most, since: by colony id, cells so
    far and h of the last gain; written anew here."""
    known = most.index_select(0, state.colony_id)
    since[state.colony_id[state.counts > known]] = state.time
    most[state.colony_id] = torch.maximum(known, state.counts)
    return state.time - since.index_select(0, state.colony_id) > PATIENCE + 1e-9


def _keep(state: tf.State, which: Tensor) -> tf.State:
    """Some colonies of the batch, (B,) bool, at least one."""
    return state if bool(which.all()) else state.select(torch.nonzero(which).squeeze(1))

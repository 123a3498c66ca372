"""The run of a batch of colonies. Each colony is measured at its own end and leaves the batch; a
colony that fails leaves with its reason."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

import torchfilm as tf
from design import colonies
from design.colonies import PreparedColonies
from design.targets.measured import NO_CELLS

# h: a colony that has not gained a cell for so long is given up
PATIENCE = 100.0


@dataclass(frozen=True)
class FinishedColonies:
    """Colonies that reached their end in the same step, as a state of them alone, and their history
    (T, B, k), or None; 0 where a step had fewer columns."""

    state: tf.State
    history: Tensor | None


@dataclass(frozen=True)
class FailedColony:
    """The id of a colony that could not continue, and the reason."""

    colony_id: int
    reason: str


def grow(
    prepared: PreparedColonies,
    *,
    cells: int | None,
    until: float | None,
    note: Callable[[tf.State], Tensor | None],
    fewest: int = 1,
) -> Iterator[FinishedColonies | FailedColony]:
    """Step a batch until each colony reaches its end: `cells` cells or `until` h, whichever comes
    first.

    The end of a colony depends on that colony alone, so its result does not depend on its batch.
    note: called after every step; see `Target.note` and `Target.course`. fewest: see `Target`;
    with 0 a colony without cells goes on to its end, else it has failed.
    """
    state = prepared.first
    count = state.colonies
    most = state.counts.new_zeros(count)
    since = state.counts.new_zeros(count, dtype=torch.float64)
    notes: list[Tensor] = []
    running = tf.advance(prepared.step, state)
    state = next(running)
    while True:
        failed, gone = _failed(state, fewest)
        yield from failed
        if bool(gone.all()):
            return
        kept = _keep(state, ~gone)
        # a note may tell of births, of which a part of a state does not know
        state = kept if kept is state else kept.replace(births=state.births)
        found = note(state)
        if found is not None:
            row = found.new_full((count, *found.shape[1:]), torch.nan)
            notes.append(row.index_copy(0, state.colony_id, found))
        done = _at_end(state, cells, until)
        if until is None:  # where cells do not come again
            done = done | (state.counts == 0)
        if bool(done.any()):
            finished = _keep(state, done)
            yield FinishedColonies(finished, _history(notes, finished))
        # a time always comes, so only a number of cells may never be reached
        stuck = _stuck(state, most, since) & ~done if until is None else torch.zeros_like(done)
        yield from _given_up(state, stuck, cells)
        gone = done | stuck
        if bool(gone.all()):
            return
        state = running.send(_keep(state, ~gone))


def _failed(state: tf.State, fewest: int) -> tuple[list[FailedColony], Tensor]:
    """The colonies that failed in the last step, or have no cells where they must have some, and a
    mask of them, (B,)."""
    failures = colonies.failures(state)
    out = [
        FailedColony(colony_id, f"at {state.time:g} h: {reason}")
        for colony_id, reason in failures.values()
    ]
    gone = torch.zeros(state.colonies, dtype=torch.bool, device=state.device)
    gone[list(failures)] = True
    if fewest == 0:
        return out, gone
    empty = (state.counts == 0) & ~gone
    out += [
        FailedColony(colony_id, f"{NO_CELLS} at {state.time:g} h")
        for colony_id in state.colony_id[empty].tolist()
    ]
    return out, gone | empty


def _at_end(state: tf.State, cells: int | None, until: float | None) -> Tensor:
    """The colonies that are at their end, (B,) bool."""
    late = until is not None and state.time >= until - 1e-9
    if cells is None or late:
        return torch.full_like(state.counts, late, dtype=torch.bool)
    return state.counts >= cells


def _history(notes: list[Tensor], finished: tf.State) -> Tensor | None:
    if not notes:
        return None
    widest = max(n.shape[1] for n in notes)
    each = [n.index_select(0, finished.colony_id) for n in notes]
    return torch.stack([torch.nn.functional.pad(n, (0, widest - n.shape[1])) for n in each])


def _given_up(state: tf.State, stuck: Tensor, cells: int | None) -> Iterator[FailedColony]:
    ids, counts = state.colony_id[stuck].tolist(), state.counts[stuck].tolist()
    for colony_id, count in zip(ids, counts, strict=True):
        yield FailedColony(
            colony_id,
            f"it has {count} of {cells} cells at {state.time:g} h and gained none for {PATIENCE:g}"
            " h",
        )


def _stuck(state: tf.State, most: Tensor, since: Tensor) -> Tensor:
    """The colonies that gained no cell for `PATIENCE` h, (B,) bool.

    most, since: by colony id, the most cells so far and the time (h) of the last gain. This
    function updates both.
    """
    known = most.index_select(0, state.colony_id)
    since[state.colony_id[state.counts > known]] = state.time
    most[state.colony_id] = torch.maximum(known, state.counts)
    return state.time - since.index_select(0, state.colony_id) > PATIENCE + 1e-9


def _keep(state: tf.State, which: Tensor) -> tf.State:
    """The colonies of a mask (B,), at least one."""
    return state if bool(which.all()) else state.select(torch.nonzero(which).squeeze(1))

"""What happens to cells between the states that a recorder sees, as rows of `/lineage`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from torchfilm.io.layout import numpy_of
from torchfilm.state import FATES, State
from torchfilm.state_colonies import Arrived, Ended
from torchfilm.tools import checks

Rows = tuple[np.ndarray, ...]  # the columns of `layout.LINEAGE`, in their order


def births_of(state: State) -> list[Rows]:
    """The births of a step."""
    found: list[Rows] = []
    for b in state.births:
        parents = torch.cat([b.parents.uid, b.parents.uid])
        ids = torch.cat([b.parents.own_colony_id, b.parents.own_colony_id])
        steps, times = (np.full(parents.numel(), x) for x in (state.step, state.time))
        own = (numpy_of(x) for x in (ids, b.uid, parents))
        found.append((*own, steps, numpy_of(b.length), times))
    return found


def arrivals_of(come: Sequence[Arrived], state: State) -> list[Rows]:
    """Cells that came from outside before the step to a state, as births without a parent; without
    those that were taken out again before it."""
    found: list[Rows] = []
    if not come:
        return found
    there = _there_in_step(state)
    for a in come:
        own = zip(a.colony_id.tolist(), a.uid.tolist(), strict=True)
        kept = torch.tensor([key in there for key in own], dtype=torch.bool)
        ids, uid, length = (numpy_of(x)[kept.numpy()] for x in (a.colony_id, a.uid, a.length))
        none, steps, times = (np.full(len(uid), x) for x in (-1, a.step, a.time))
        found.append((ids, uid, none, steps, length, times))
    return found


def just_arrived(state: State, next_uid: np.ndarray | None = None) -> list[Arrived]:
    """What was added to a state since its step. next_uid: (B,), of the colonies as they are known;
    without the cells that they have."""
    found = [a for a in state.arrived if a.step == state.step]
    if next_uid is None:
        return found
    known = dict(zip(state.colony_id.tolist(), next_uid.tolist(), strict=True))
    # one call of `Model.add` after the other, so that a note is known as a whole or not at all
    return [a for a in found if int(a.uid[0]) >= known[int(a.colony_id[0])]]


def arrived_since(before: State, state: State) -> list[Arrived]:
    """What was added between two states of consecutive steps. A run may go on from a state with
    cells that were added to it: they are there before."""
    return [*state.arrived[len(just_arrived(before)) :]]


def ends_of(state: State, ended: Iterable[Ended]) -> list[Rows]:
    """Ends, which came in the step to a state; or after it, before the next, by hand."""
    found = []
    for e in ended:
        steps, fates, times = (
            np.full(e.uid.numel(), x) for x in (state.step, FATES.index(e.fate), state.time)
        )
        types = np.full_like(steps, -1) if e.cell_type is None else numpy_of(e.cell_type)
        own = (numpy_of(x) for x in (e.colony_id, e.uid))
        found.append((*own, steps, fates, numpy_of(e.length), times, types))
    return found


def removed_before(state: State, before: State) -> list[Ended]:
    """Cells that were taken out since the state before the step, by hand: they are not there, and
    did not end in the step."""
    ended = sum(e.uid.numel() for e in state.ended)
    born = sum(b.uid.numel() for b in state.births)
    come = sum(len(uid) for _, uid, *_ in arrivals_of(arrived_since(before, state), state))
    if state.cells == before.cells + born + come - ended:
        return []
    there = _there_in_step(state)
    own = zip(before.own_colony_id.tolist(), before.uid.tolist(), strict=True)
    gone = torch.tensor([key not in there for key in own], device=before.device)
    return [before.noted_end(torch.nonzero(gone).squeeze(1), "removed")]


def absent_from(state: State, frame: Mapping[str, np.ndarray], ids: np.ndarray) -> list[Ended]:
    """The cells of a recorded frame that a state of its step lacks. ids: of the colonies of the
    frame."""
    there = _keys([(state.own_colony_id, state.uid)])
    own = zip(ids[frame["colony"]].tolist(), frame["uid"].tolist(), strict=True)
    gone = np.array([key not in there for key in own], dtype=bool)
    if not gone.any():
        return []
    colony, uid, length = (
        torch.from_numpy(x[gone]) for x in (ids[frame["colony"]], frame["uid"], frame["length"])
    )
    kind = frame.get("cell_type")
    return [
        Ended(
            "removed", colony, uid, length, None if kind is None else torch.from_numpy(kind[gone])
        )
    ]


def _there_in_step(state: State) -> set[tuple[int, int]]:
    """The cells of a state, and those that ended in its step, by colony id and number."""
    return _keys([(state.own_colony_id, state.uid), *((e.colony_id, e.uid) for e in state.ended)])


def _keys(parts: Iterable[tuple[Tensor, Tensor]]) -> set[tuple[int, int]]:
    return {key for ids, uid in parts for key in zip(ids.tolist(), uid.tolist(), strict=True)}


def numbers_of(come: Iterable[Arrived], state: State) -> Tensor:
    """How many of these cells came to each colony of a state, (B,)."""
    ids = torch.cat([state.colony_id.new_empty(0), *(a.colony_id for a in come)])
    return (ids.unsqueeze(0) == state.colony_id.unsqueeze(1)).sum(1)


def check_course(before: State, state: State) -> None:
    """Raise InputError where colonies are others than a step ago, or have cells that were neither
    there, nor born in this step or added before it: the lineage would lead nowhere."""
    if not torch.equal(before.colony_id, state.colony_id):
        raise checks.InputError(
            f"the run has the colonies {_listed(state.colony_id)} at step {state.step}, and had"
            f" {_listed(before.colony_id)} before, as after state.select. All frames of a file of"
            " results have the same colonies: record what each colony does to a file of its own, or"
            " remove the cells of those that are done (state.remove)."
        )
    if before.seed != state.seed or not torch.equal(before.stream, state.stream):
        raise checks.InputError(
            f"the run draws other random numbers at step {state.step} than before: its seed or its"
            " streams were replaced. A file of results has one seed and one stream of each colony,"
            " with which it is resumed: record what follows to a file of its own."
        )
    made = sum(2 * b.parents.groups.counts for b in state.births)
    made = made + numbers_of(arrived_since(before, state), state)
    strange = state.next_uid != before.next_uid + made
    if not bool(strange.any()):
        return
    raise checks.InputError(
        f"colony {_listed(state.colony_id[strange])} has other cells at step {state.step} than a"
        " step ago and their daughters, as after state.put. A file of results knows one course of"
        " each colony: end this run, and record what follows to a file of its own."
    )


def _listed(ids: Tensor) -> str:
    found = ids.tolist()
    return ", ".join(map(str, found[:5])) + (", …" if len(found) > 5 else "")

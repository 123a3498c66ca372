"""Exchange between cells and medium: what cells find outside, and what they give to it in a step.
One service that circuits and nutrition share.

Either each cell has a pool in the medium, `MediumExchange`, and transport follows; or the two are
solved together, and circuits find concentrations that change at given rates, `Ramped`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.exchange import ULPS, write
from torchfilm.signals.stencil import Stencil
from torchfilm.state import OUTSIDE, State
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import Course, Loop

_found_outside = Course()


@dataclass(frozen=True, eq=False)
class Exchanged:
    """What the cells of a state exchanged in a step. found: the concentration of each signal at
    each cell as the step began, (N,) by name. given: what each gave to its pool, conc·µm³,
    (negative: took). pool: (N,) µm³. groups: of the cells by colony. step: its number. turns: of
    circuits and transport in it; `found` and `pool` are of the last."""

    found: Mapping[str, Tensor]
    given: Mapping[str, Tensor]
    pool: Tensor
    groups: Groups
    step: int
    turns: int = 1

    def after(self, earlier: Exchanged | None) -> Exchanged:
        """With what was given earlier in the same step."""
        assert earlier is not None
        given = {n: earlier.given[n] + x for n, x in self.given.items()}
        return replace(self, given=given, turns=earlier.turns + 1)

    @property
    def swing(self) -> Tensor:
        """How far exchange moved the pools in a turn with transport, (B,): |change| over what they
        held half way, a mean over the cells that exchange; of the signal where it is most."""
        most = torch.zeros(self.groups.size, dtype=torch.float64, device=self.pool.device)
        for name, amount in self.given.items():
            change = amount.double() / (self.turns * self.pool.double())
            half_way = self.found[name].double() + 0.5 * change
            share = torch.where(change != 0, change.abs() / half_way.abs().clamp(min=1e-300), 0.0)
            sums = self.groups.sum(torch.stack([share, (change != 0).double()], 1))
            most = torch.maximum(most, sums[:, 0] / sums[:, 1].clamp(min=1.0))
        return most


class MediumExchange:
    """The medium about the cells of a state, and what they exchange with it in this step.

    found: concentration of each signal at each cell, (N,) by name. pool: (N,) µm³, the part of the
    medium from which each cell may draw all that there is. in_reservoir: (N,) bool, cells outside
    the box, whose pool is a reservoir that nothing changes, or None. in_loops: whether loops of
    kernels find them, and may write; found and pool then have their numbers after `find`, or when
    the caller has run the loops that it took.
    """

    def __init__(self, state: State, signals: Sequence[str]):
        layout = state.layout
        assert layout is not None
        self.state, self._loops, self._meeting = state, [], None
        self.in_reservoir: Tensor | None = None
        if state.device.type == "cpu":
            values = {n: state.fields[OUTSIDE + n] for n in signals}
            self._meeting = layout.meeting(
                state.position_3d, state.colony, state.groups.ends, values, state.dtype
            )
        self.in_loops = self._meeting is not None
        if self._meeting is not None:
            self._loops = self._meeting.loops
            self.pool = torch.from_numpy(self._meeting.pool)
            self.found = {n: torch.from_numpy(x) for n, x in self._meeting.found.items()}
            self._in_voxels = self.found
        else:
            contact = state.contact(signals)
            assert contact is not None
            self._contact, self.found, self.pool = contact, contact.found, contact.pool
            self.in_reservoir, self._in_voxels = contact.in_reservoir, contact.in_voxels
        self._given: dict[str, Tensor] = {}
        self._to_reservoir: dict[str, Tensor] = {}
        self._written: dict[str, Tensor] = {}
        self._in_loops: dict[str, Tensor] = {}  # what is given by loops that write it, too

    @staticmethod
    def of(state: State, signals: Sequence[str]) -> MediumExchange | None:
        """The medium of a state, for these of its signals; None where no signal or no medium is."""
        return MediumExchange(state, signals) if signals and state.layout is not None else None

    @property
    def first(self) -> Mapping[str, Tensor]:
        """As the step begins."""
        return self.found

    @cached_property
    def stencil(self) -> Stencil:
        return self._contact.stencil if self._meeting is None else self._meeting.stencil

    def take_loops(self) -> list[Loop]:
        """The loops that have yet to be run, for the caller to run."""
        loops, self._loops = self._loops, []
        return loops

    def find(self) -> None:
        """Run the loops that have yet to be run."""
        if loops := self.take_loops():
            _found_outside(loops, self.stencil.parts)

    def give(
        self,
        name: str,
        amount: Tensor | None,
        to_reservoir: Tensor | None,
        rows: Tensor | None = None,
    ) -> None:
        """Note what cells give to a signal (negative: take), conc·µm³: to their pools `amount`
        (M,), and to the reservoir. Gifts add up.

        rows: (M,) the cells; None: all of them."""
        for noted, new in ((self._given, amount), (self._to_reservoir, to_reservoir)):
            if new is None:
                continue
            if rows is None:
                noted[name] = noted[name] + new if name in noted else new
            else:
                start = noted.get(name)
                start = torch.zeros_like(self.pool) if start is None else start
                noted[name] = start.index_add(0, rows, new)

    def write_in_loops(self, given: Mapping[str, np.ndarray]) -> list[Loop]:
        """The loops that write all that cells give to their pools, (N,) by name: what will be there
        when they are run. Only where `in_loops`, without other gifts."""
        loops, meeting = [], self._meeting
        assert meeting is not None
        for name, amount in given.items():
            self._in_loops[name] = torch.from_numpy(amount)
            self._written[OUTSIDE + name], loop = meeting.written(name, amount, ULPS)
            loops.append(loop)
        return loops

    def exchanged(self) -> Exchanged:
        """What has been given in this step, without its gradient."""
        given = {n: x.detach() for n, x in (self._given | self._in_loops).items()}
        found = {n: self.found[n].detach() for n in given}
        return Exchanged(found, given, self.pool.detach(), self.state.groups, self.state.step)

    def settle(self, **more: Tensor) -> State:
        """The state in which the medium has what was given to it. more: other fields to
        change."""
        state = self.state
        changed = self._written | {
            OUTSIDE + n: write(state.fields[OUTSIDE + n], x, self.stencil, self._in_voxels[n])
            for n, x in self._given.items()
        }
        for name, amount in self._to_reservoir.items():
            total = state.groups.sum(amount)
            changed[f"{name}_reservoir"] = state.fields[f"{name}_reservoir"] + total
        return state.with_fields(**changed, **more)


class Ramped:
    """The medium about the cells where transport is solved together with them: as `MediumExchange`,
    but that what cells give is only summed.

    found: concentration of each signal at each cell half way through the step, (N,) by name. ramp:
    of those that cells exchange, that at first, and the rate at which it changes, conc/h, (N,)
    each. released: what cells give, less what they take, (N,) conc·µm³ by name.
    """

    pool = in_reservoir = None
    in_loops = False

    def __init__(self, found: Mapping[str, Tensor], ramp: Mapping[str, tuple[Tensor, Tensor]]):
        self.found, self.ramp = found, ramp
        self.released: dict[str, Tensor] = {}

    @property
    def first(self) -> Mapping[str, Tensor]:
        """As the step begins, where that is known."""
        return {**self.found, **{n: x for n, (x, _) in self.ramp.items()}}

    def take_loops(self) -> list[Loop]:
        return []

    def find(self) -> None:
        pass

    def give(
        self, name: str, amount: Tensor | None, released: Tensor | None, rows: Tensor | None = None
    ) -> None:
        """Note what cells release, (M,); as `MediumExchange.give`."""
        assert released is not None
        before = self.released.get(name)
        if rows is not None:
            start = torch.zeros_like(self.found[name]) if before is None else before
            self.released[name] = start.index_add(0, rows, released.to(start.dtype))
        else:
            self.released[name] = released if before is None else before + released


Around = MediumExchange | Ramped


def form_of(medium: Around | None) -> str:
    """How circuits exchange with it: their equations depend on that."""
    if isinstance(medium, Ramped):
        return "ramp"
    return "pool" if medium is None or medium.in_reservoir is None else "reservoir"

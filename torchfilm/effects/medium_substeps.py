"""Reactions of signals and their transport in sub-steps of a scene's step.

Where the two balance, as in a pattern or a steep profile, each changes much by itself, and a whole
step of one after the other distorts what should rest. `Medium(steps=…)` lets them take turns more
often: R(δ/2) T(δ) R(δ) T(δ) … R(δ/2), each of second order in δ = dt/steps (Strang, SIAM J. Numer.
Anal. 5, 506, 1968).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from torchfilm.effects.medium_transport import EXACT, Transport
from torchfilm.state import State

Part = tuple[str, float]  # of a step: "react" or "carry", and for how many sub-steps
REACT, CARRY = "react", "carry"


@runtime_checkable
class Reacting(Protocol):
    """Bound reactions in the medium. sub_steps: of each step, of which `step` does half of one.
    once: signals that react, and that others than circuits move or find once in a step. whole:
    whether reactions take whole steps, whatever `Medium.steps`."""

    sub_steps: int
    once: tuple[str, ...]
    whole: bool

    @property
    def species(self) -> tuple[str, ...]:
        """The signals that react."""

    def react(self, state: State, hours: float) -> State:
        """The state after reactions alone."""


class SubSteps:
    """Sub-steps of reactions and of transport of the signals `names`, but for the reactions' own
    `step`, over half of the first one and half of the last."""

    def __init__(self, reactions: Reacting, transport: Transport, names: frozenset[str]):
        self.reactions, self.transport, self.names = reactions, transport, names

    def before(self, state: State, dt: float) -> State:
        """The state after the sub-steps before the cells act, in the middle of the step."""
        return self._done(state, dt, self._half())

    def after(self, state: State, dt: float) -> State:
        """The state after those that follow."""
        medium = self.transport.medium
        parts = self._half()[::-1] if medium.halves else _parts(medium.steps)[1:-1]
        return self._done(state, dt, parts)

    def between(self, state: State, dt: float) -> State:
        """The state after what comes between two exchanges with circuits."""
        half = [(CARRY, 0.5), (REACT, 1.0), (CARRY, 0.5)]
        parts = half if self.transport.medium.halves else [(CARRY, 1.0), (REACT, 1.0)]
        return self._done(state, dt, parts)

    def _half(self) -> list[Part]:
        """The parts up to the middle of a step, without the first."""
        steps = self.transport.medium.steps
        parts = _parts(steps)
        what, often = parts[steps]
        return [*parts[1:steps], (what, often / 2)]

    def _done(self, state: State, dt: float, parts: Sequence[Part]) -> State:
        medium, transport = self.transport.medium, self.transport
        for what, often in parts:
            hours = often * dt / medium.steps
            if what == REACT:
                state = self.reactions.react(state, hours)
                continue
            changed: dict[str, Tensor] = {}
            for name in sorted(self.names):
                exact = medium.method_of(name)[0] in EXACT
                pieces = 2 if medium.halves and often == 1.0 and not exact else 1
                changed |= transport.moved(name, state, hours, pieces)
            state = state.with_fields(**changed)
        return state


def _parts(steps: int) -> list[Part]:
    """The parts of a step: a palindrome, 2 · steps + 1 long."""
    between = [(CARRY, 1.0), (REACT, 1.0)] * steps
    return [(REACT, 0.5), *between[:-1], (REACT, 0.5)]

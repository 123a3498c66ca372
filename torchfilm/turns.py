"""Cells and transport in turns: several exchanges of signals within one step of a scene.

Exchange is of first order in its step, while most of a step's time goes to contacts. So
`Medium(steps=…)` divides exchange and transport, and leaves growth and contacts whole.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchfilm.effect import BoundEffect
from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.effects.bound_medium import BoundMedium
from torchfilm.state import State
from torchfilm.tools.timing import Timings


class Turns:
    """Circuits, and then transport, several times within a step."""

    def __init__(self, circuits: Sequence[BoundCircuit], medium: BoundMedium):
        self.circuits, self.medium = circuits, medium
        self.place, self.title = medium.place, medium.title

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state after all turns."""
        number = self.medium.effect.steps
        with self.medium.transport.one_step():
            for done in range(number):
                for circuit in self.circuits:
                    with circuit.timed(state, timings), circuit.threads(state):
                        state = circuit.turn(state, dt / number, done, number)
                with self.medium.timed(state, timings), self.medium.threads(state):
                    state = self.medium.turn(state, dt, done, number)
        return state


def in_turns(effects: Sequence[BoundEffect]) -> list[BoundEffect | Turns]:
    """The effects, in which circuits and transport act in turns where the medium asks for it."""
    circuits = [e for e in effects if isinstance(e, BoundCircuit) and e.turns > 1]
    media = [e for e in effects if isinstance(e, BoundMedium)]
    if not circuits or not media:
        return list(effects)
    # at the place of the last circuit: what comes after circuits still does
    last, members = circuits[-1], [*circuits, *media]
    kept = [e for e in effects if e is last or e not in members]
    return [Turns(circuits, media[0]) if e is last else e for e in kept]

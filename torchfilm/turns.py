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
    """Circuits that exchange signals, and then transport, several times within a step."""

    def __init__(self, circuits: Sequence[BoundCircuit], medium: BoundMedium):
        self.circuits, self.medium = circuits, medium
        self.place, self.title = medium.place, medium.title

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state after all turns."""
        number = self.medium.effect.steps
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
    others = [e for e in effects if e not in circuits]
    return [Turns(circuits, e) if circuits and isinstance(e, BoundMedium) else e for e in others]

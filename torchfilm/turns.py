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
from torchfilm.together import Together, joins
from torchfilm.tools.timing import Timings


class Turns:
    """Circuits and then transport, several times within a step."""

    def __init__(self, circuits: Sequence[BoundCircuit], medium: BoundMedium):
        self.circuits, self.medium = circuits, medium
        self.place, self.title = medium.place, circuits[0].title

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state after all turns."""
        number, medium = self.medium.effect.steps, self.medium
        with medium.transport.one_step():
            for done in range(number):
                for circuit in self.circuits:
                    with circuit.timed(state, timings), circuit.threads(state):
                        state = circuit.turn(state, dt / number, done, number)
                with medium.timed(state, timings), medium.threads(state):
                    state = (
                        medium.between(state, dt) if done < number - 1 else medium.step(state, dt)
                    )
        return state


Part = BoundEffect | Turns | Together  # of a step


def in_turns(effects: Sequence[BoundEffect]) -> list[Part]:
    """The effects, in which cells and transport act in turns or together where the medium asks for
    it."""
    media = [e for e in effects if isinstance(e, BoundMedium)]
    joint = media and media[0].solves_together
    circuits = [e for e in effects if isinstance(e, BoundCircuit)]
    circuits = [e for e in circuits if (joins(e, circuits) if joint else e.plan.turns > 1)]
    found: list[Part] = []
    for effect in effects:
        if circuits and effect is circuits[-1]:
            # at the place of the last circuit: what comes after circuits still does
            found.append((Together if joint else Turns)(circuits, media[0]))
        elif effect not in circuits and not (circuits and effect in media):
            found.append(effect)
    return found

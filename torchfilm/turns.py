"""Cells and transport in turns: several exchanges of signals within one step of a scene.

Exchange is of first order in its step, while most of a step's time goes to contacts. So
`Medium(steps=…)` divides exchange and transport, and leaves growth and contacts whole.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchfilm.effect import NUTRITION, BoundEffect
from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.effects.bound_medium import BoundMedium
from torchfilm.effects.nutrition import BoundMonod
from torchfilm.state import State
from torchfilm.tools.timing import Timings

Members = Sequence[BoundCircuit] | Sequence[BoundMonod]


class Turns:
    """Circuits and then transport, several times within a step; or nutrition, with transport only
    between its turns: growth, contacts and circuits come before the rest of it."""

    def __init__(self, members: Members, medium: BoundMedium):
        self.members, self.medium = members, medium
        own: BoundEffect = members[0]
        self.to_the_end = own.stage != NUTRITION
        self.place, self.title = (medium if self.to_the_end else own).place, own.title
        carried = medium.transport
        self.names = carried.in_turns if self.to_the_end else carried.eaten_in_turns

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state after all turns."""
        number, medium = self.medium.effect.steps, self.medium
        with medium.transport.one_step():
            for done in range(number):
                for member in self.members:
                    with member.timed(state, timings), member.threads(state):
                        state = member.turn(state, dt / number, done, number)
                if done == number - 1 and not self.to_the_end:
                    break
                with medium.timed(state, timings), medium.threads(state):
                    state = (
                        medium.between(state, dt, self.names)
                        if done < number - 1
                        else medium.step(state, dt)
                    )
        return state


def in_turns(effects: Sequence[BoundEffect]) -> list[BoundEffect | Turns]:
    """The effects, in which cells and transport act in turns where the medium asks for it."""
    circuits = [e for e in effects if isinstance(e, BoundCircuit) and e.turns > 1]
    media = [e for e in effects if isinstance(e, BoundMedium)]
    found: list[BoundEffect | Turns] = []
    for effect in effects:
        if isinstance(effect, BoundMonod) and effect.turns > 1:
            found.append(Turns([effect], media[0]))
        elif circuits and effect is circuits[-1]:
            # at the place of the last circuit: what comes after circuits still does
            found.append(Turns(circuits, media[0]))
        elif effect not in circuits and not (circuits and effect in media):
            found.append(effect)
    return found

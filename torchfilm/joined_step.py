"""Growth and contacts, one after the other, without a state in between.

In small colonies kernels take less time than what is done around them: states, checks, tensors. So
where compiled contacts follow growth, and no derivative is wanted, both are one step here, to the
same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from torchfilm.effect import BoundEffect, Effect
from torchfilm.effects.bound_mechanics import BoundMechanics
from torchfilm.effects.growth import (
    MOST_GROWN,
    Growth,
    doubling_matters,
    of_size,
    wanted_elongation,
)
from torchfilm.effects.mechanics import Mechanics
from torchfilm.state import State
from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.tangents import tracked
from torchfilm.tools.timing import Timings
from torchfilm.turns import Part


class JoinedStep:
    """Growth by a law, and compiled contacts right after it."""

    def __init__(self, growth: BoundEffect, mechanics: BoundMechanics):
        assert isinstance(growth.effect, Growth)
        self.growth, self.law, self.mechanics = growth, growth.effect.law, mechanics

    def run_step(self, state: State, dt: float, timings: Timings | None) -> State:
        """The state after growth and contacts."""
        with self.growth.timed(state, timings):
            found = self._lengthened(state, dt)
            if found is None:
                state = self.growth.run_step(state, dt)
        with self.mechanics.timed(state, timings):
            if found is None:
                return self.mechanics.run_step(state, dt)
            return self.mechanics.parted(state, dt, *found)

    def _lengthened(self, state: State, dt: float) -> tuple[np.ndarray, np.ndarray] | None:
        """How much longer cells become and how long they then are, (N,), as `Growth` has it; None
        where there are no cells, a derivative is wanted, numbers are not of one type, or a cell
        would grow too far."""
        fields, dtype = state.fields, state.dtype
        rate = fields["growth_rate"]
        one_type = rate.dtype == state.radius.dtype == dtype
        if not state.cells or not one_type or "elongation" not in fields:
            return None
        if tracked(rate) or self.mechanics.derivatives_wanted(state):
            return None
        wanted = rate * dt
        relative = as_array(wanted if self.law == "linear" else torch.expm1(wanted), dtype)
        length, radius = as_array(state.length, dtype), as_array(state.radius, dtype)
        with np.errstate(all="ignore"):
            growth = wanted_elongation(self.law, relative, length, radius)
            after = length + growth
            good = after.max() < math.inf
            if doubling_matters(self.law, state):
                size = of_size(self.law, relative, growth, length, radius)
                good = good and size.max() <= MOST_GROWN
        return (growth, after) if good else None


def joined(effects: Sequence[Part]) -> list[Part | JoinedStep]:
    """The effects, in which growth and contacts right after it are joined where they can be."""
    found: list[Part | JoinedStep] = []
    for effect in effects:
        before = found[-1] if found else None
        if (
            isinstance(before, BoundEffect)
            and _grows_plainly(before.effect)
            and isinstance(effect, BoundMechanics)
            and (type(effect), type(effect.effect)) == (BoundMechanics, Mechanics)
            and effect.compiled
        ):
            found[-1] = JoinedStep(before, effect)
        else:
            found.append(effect)
    return found


def _grows_plainly(effect: Effect) -> bool:
    """Whether the field growth_rate alone tells how cells grow. Subclasses may do as they like."""
    return type(effect) is Growth and effect.is_plain

"""Derivatives of losses by the parameters of a search.

Exact ones come from tangents (`torchfilm.tools.tangents`): a design is grown once for each
parameter, on recorded growth, and each copy carries the derivative along its parameter through
circuits and medium to the target. Where growth depends on the design, or the circuits are
stochastic, there are differences between runs on the same random numbers instead.
"""

from __future__ import annotations

import numpy as np
import torch

import torchfilm as tf
from design.growing import FinishedColonies
from design.parameters import Parameter, Space
from design.slopes import Slopes
from design.targets.base import Target

# Coordinates: of a central difference. Less than this, and the tolerance of a circuit's own steps
# shows; more, and the curve of the loss.
STEP = 0.01


class Gathered:
    """Tangents of finished colonies, put together from the copies of each."""

    def __init__(self, space: Space, count: int):
        self.directions, self.slopes = space.moving, Slopes.none(count, space.size)

    def forget(self, colonies: list[int]) -> None:
        """Colonies that have failed, whose loss has no slope."""
        self.slopes.gradient[colonies], self.slopes.curvature[colonies] = 0.0, np.nan

    def add(
        self, target: Target, finished: FinishedColonies, colony: list[int], places: np.ndarray
    ) -> None:
        """The copies of colonies, at these places of the batch, (n, copies). colony: the number of
        each colony."""
        loss = tf.tangents.both(target.loss(finished.state, finished.history))[1]
        if loss is not None:
            slopes = loss.double().cpu().numpy()[places]
            self.slopes.gradient[np.ix_(colony, self.directions)] = slopes
        found = target.residuals(finished.state, finished.history)
        if found is None:
            return
        value, tangent = tf.tangents.both(found)
        turned = torch.zeros_like(value) if tangent is None else tangent
        of_colonies = turned.double().cpu().numpy()[places]
        for k, padded in zip(colony, of_colonies, strict=True):
            # zeros stand beyond a colony's own cells, as many as its batch needs: with them the
            # product would have other bits in another batch
            rows = padded[:, padded.any(0)]
            self.slopes.curvature[k] = 0.0
            self.slopes.curvature[np.ix_([k], self.directions, self.directions)] = 2 * rows @ rows.T


def along(space: Space, point: np.ndarray) -> list[dict[str, float]]:
    """For each copy of a design, the derivative of every value by that copy's coordinate."""
    out = []
    for chosen in space.moving:
        parameter = space.parameters[chosen]
        assert isinstance(parameter, Parameter)  # a choice has levels
        out.append({parameter.name: parameter.slope(float(point[chosen]))})
    return out


def neighbours(space: Space, point: np.ndarray) -> np.ndarray:
    """Points two steps apart along each dimension without levels, (2 C, D), within [0, 1]."""
    out = []
    for k in space.moving:
        middle = min(max(point[k], STEP), 1.0 - STEP)
        for side in (-STEP, STEP):
            other = point.copy()
            other[k] = middle + side
            out.append(other)
    return np.array(out)


def differences(space: Space, losses: np.ndarray) -> Slopes:
    """Slopes from losses (n, 2 C) at `neighbours`; there are no residuals to compare."""
    found = Slopes.none(len(losses), space.size)
    pairs = losses.reshape(len(losses), -1, 2)
    found.gradient[:, space.moving] = (pairs[:, :, 1] - pairs[:, :, 0]) / (2 * STEP)
    return found

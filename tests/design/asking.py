"""Functions to minimise, spaces as methods see them, and loops of ask and tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from design.methods import Batch


@dataclass(frozen=True)
class Room:
    """A space as methods see it."""

    levels: tuple[int | None, ...]

    @property
    def size(self) -> int:
        return len(self.levels)


SPACES = {
    "line": Room((None,)),
    "cube": Room((None, None, None)),
    "mixed": Room((None, 5, None, 2, 1)),
    "levels": Room((3, 4)),
    "one level": Room((7,)),
    "nothing to choose": Room((1,)),
}


def ellipsoid(points: np.ndarray, centre: float = 0.3) -> np.ndarray:
    """An ellipsoid with axes of length 1 … 10 and its minimum, 0, where all coordinates are
    `centre`."""
    weight = 100.0 ** np.linspace(0, 1, points.shape[1]) if points.shape[1] > 1 else np.ones(1)
    return (weight * (points - centre) ** 2).sum(1) / weight.mean() / 2


def sphere(points: np.ndarray) -> np.ndarray:
    return ((points - 0.3) ** 2).sum(1)


def failing(points: np.ndarray) -> np.ndarray:
    """A third of the space fails."""
    return np.where(points[:, 0] > 2 / 3, 1.5, ellipsoid(points))


def begun(given, space: Room, seed: int = 0, replicates: int = 4):
    given.start(space, seed, replicates)
    return given


def follow(given, function: Callable, batches: int) -> list[tuple[Batch, np.ndarray]]:
    """Ask and tell; returns the batches and their losses."""
    history = []
    for _ in range(batches):
        batch = given.ask()
        loss = function(batch.points)
        given.tell(batch, loss)
        history.append((batch, loss))
    return history


def evaluate(given, function: Callable, budget: int) -> np.ndarray:
    """The losses of the first `budget` points."""
    found: list[float] = []
    while len(found) < budget:
        batch = given.ask()
        loss = function(batch.points)
        given.tell(batch, loss)
        found += loss.tolist()
    return np.array(found[:budget])

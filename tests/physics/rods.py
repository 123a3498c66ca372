"""Shared by the tests of walls: rods at random, and their rows of the contact problem."""

from __future__ import annotations

import numpy as np
import torch
from helpers import unit

from torchfilm.physics.wall_contacts import find_wall_contacts


class Rods:
    """Rods at random around the origin, and the rows that a wall gives them."""

    def __init__(
        self, dim: int, count: int = 300, dtype=torch.float64, device="cpu", seed: int = 1
    ):
        rng = np.random.default_rng(seed)
        t = lambda x, kind: torch.as_tensor(x, dtype=kind, device=device)
        self.position = t(rng.uniform(-2, 2, (count, dim)), torch.float64)
        self.axis, self.length = (
            t(unit(rng, count, dim), dtype),
            t(rng.uniform(0.5, 3, count), dtype),
        )
        self.radius = torch.full_like(self.length, 0.5)
        self.colony = torch.zeros(count, dtype=torch.int64, device=device)

    def rows(self, wall):
        return find_wall_contacts(
            wall.surfaces(self.position.shape[1]),
            self.position,
            self.axis,
            self.length,
            self.radius,
            self.colony,
        )

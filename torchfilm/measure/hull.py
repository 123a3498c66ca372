"""The convex hull of a colony as seen from above."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from torchfilm.colony_edge import check_flat_space
from torchfilm.measure.of_a_state import of_a_state
from torchfilm.state import State

CORNERS = 64  # of a disc, where cells differ in their radius
THIN = 1e-9  # across, relative to the extent, from which points are not on a line


@dataclass(frozen=True)
class Hull:
    """The convex hull of each colony as seen from above, (B,) float64 each; NaN without cells.

    area: µm². perimeter: µm. circularity: 4π area / perimeter², 1 for a disc. solidity: the area of
    the cells over that of the hull; where cells lie over each other, both count."""

    area: Tensor
    perimeter: Tensor
    circularity: Tensor
    solidity: Tensor


@of_a_state
@torch.no_grad()
def hull(state: State) -> Hull:
    """The convex hull of each colony's cells, caps included, in the x–y plane: its area, perimeter
    and circularity, and how much of it cells fill, as programs of image analysis have them. Where
    cells differ in their radius, to a part of 1e-3 of it. Raises InputError in a space that is
    periodic along x or y."""
    check_flat_space("hull", state)
    half = (0.5 * state.length.double()).unsqueeze(1) * state.axis[:, :2].double()
    place, radius = state.position[:, :2].double(), state.radius.double()
    ends = torch.stack([place - half, place + half], 1).cpu().numpy()
    size = 2.0 * radius * 2.0 * half.square().sum(1).sqrt() + math.pi * radius.square()
    covered = state.groups.sum(size)
    counts = state.counts.tolist()
    parts = zip(np.split(ends, np.cumsum(counts)[:-1]), radius.cpu().split(counts), strict=True)
    found = np.array([_of_discs(own, wide.numpy()) for own, wide in parts]).reshape(-1, 2)
    area, perimeter = (covered.new_tensor(x) for x in found.T)
    return Hull(area, perimeter, 4.0 * math.pi * area / perimeter.square(), covered / area)


def _of_discs(ends: np.ndarray, radius: np.ndarray) -> tuple[float, float]:
    """Area and perimeter of the hull of the discs at both ends of each cell, (n, 2, 2)."""
    if not len(ends):
        return math.nan, math.nan
    # that of discs smaller by the least radius, with a margin of it all around
    least = float(radius.min())
    points = ends.reshape(-1, 2)
    if (more := np.repeat(radius - least, 2)).any():
        angle = 2.0 * math.pi * np.arange(CORNERS) / CORNERS
        corners = np.stack([np.cos(angle), np.sin(angle)], 1)
        points = (points[:, None] + more[:, None, None] * corners).reshape(-1, 2)
    area, perimeter = _of_points(points)
    return area + perimeter * least + math.pi * least**2, perimeter + 2.0 * math.pi * least


def _of_points(points: np.ndarray) -> tuple[float, float]:
    """Area and perimeter of the hull of points, (m, 2); there and back again of those on a line."""
    apart = points - points.mean(0)
    _, _, ways = np.linalg.svd(apart.T @ apart)
    along, across = (apart @ way for way in ways)
    if np.ptp(across) <= THIN * max(np.ptp(along), 1.0):
        return 0.0, 2.0 * float(np.ptp(along))
    found = ConvexHull(apart)
    return float(found.volume), float(found.area)

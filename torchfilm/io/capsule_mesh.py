"""Surfaces of capsules as polygons, for viewers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIDES, RINGS = 12, 2  # around a capsule, and from the rim of a cap towards its pole


@dataclass(frozen=True, eq=False)
class Mesh:
    """One capsule along z: of points (P, 3), `end` (P,) says at which end each is, −½ or ½ of the
    centreline, and `offset` (P, 3) where it is from there, in radii. offsets (Q + 1,) and
    connectivity give its Q polygons or lines as VTK does."""

    end: np.ndarray
    offset: np.ndarray
    offsets: np.ndarray
    connectivity: np.ndarray

    def points(self, centre: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray):
        """The points (N, P, 3) of capsules (N, 3), µm."""
        across, other = _frames(axis)
        turned = (
            self.offset[None, :, 0, None] * across[:, None]
            + self.offset[None, :, 1, None] * other[:, None]
            + self.offset[None, :, 2, None] * axis[:, None]
        )
        along = self.end[None, :, None] * (length[:, None] * axis)[:, None]
        return centre[:, None] + along + radius[:, None, None] * turned


def capsule() -> Mesh:
    """The surface of a capsule: quadrangles, and triangles about the poles."""
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    rise = 0.5 * np.pi * np.arange(RINGS) / RINGS
    cap = [
        np.stack([np.cos(a) * np.cos(turn), np.cos(a) * np.sin(turn), np.full(SIDES, np.sin(a))], 1)
        for a in rise
    ]
    # rings from the lower pole to the upper one
    rings = [c * (1, 1, -1) for c in reversed(cap)] + cap
    offset = np.concatenate([[[0, 0, -1]], *rings, [[0, 0, 1]]])
    end = np.where(np.arange(len(offset)) < 1 + RINGS * SIDES, -0.5, 0.5)
    ring = lambda k: 1 + k * SIDES + np.arange(SIDES)
    following = np.roll(np.arange(SIDES), -1)
    count, last = 2 * RINGS, len(offset) - 1
    zero = np.zeros(SIDES, int)
    bottom = np.stack([zero, ring(0)[following], ring(0)], 1)
    top = np.stack([zero + last, ring(count - 1), ring(count - 1)[following]], 1)
    bands = [
        np.stack([ring(k), ring(k)[following], ring(k + 1)[following], ring(k + 1)], 1)
        for k in range(count - 1)
    ]
    parts = [bottom, *bands, top]
    sizes = np.concatenate([np.full(len(p), p.shape[1]) for p in parts])
    connectivity = np.concatenate([p.reshape(-1) for p in parts])
    return Mesh(end, offset, np.concatenate([[0], np.cumsum(sizes)]), connectivity)


def centreline() -> Mesh:
    """The centreline of a capsule, one line."""
    return Mesh(np.array([-0.5, 0.5]), np.zeros((2, 3)), np.array([0, 2]), np.array([0, 1]))


def _frames(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (N, 3) across each axis and across each other, right-handed with it."""
    least = np.eye(3)[np.abs(axis).argmin(1)]
    across = np.cross(axis, least)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.cross(axis, across)

"""Label images of known capsules, for tests of what is read from micrographs."""

from __future__ import annotations

import numpy as np


def rasterised(x, y, angle, length, radius, shape) -> np.ndarray:
    """Capsules in pixels: a pixel belongs to the last one that has its centre. x: columns; y: rows,
    down; angle: from +x towards the rows; labels from 1. Returns (rows, columns) int."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    mask = np.zeros(shape, dtype=np.uint16)
    for k, (cx, cy, a, size, r) in enumerate(zip(x, y, angle, length, radius, strict=True), 1):
        dx, dy = columns - cx, rows - cy
        s = np.clip(dx * np.cos(a) + dy * np.sin(a), -size / 2, size / 2)
        mask[np.hypot(dx - s * np.cos(a), dy - s * np.sin(a)) <= r] = k
    return mask


def bent(shape, centre, arc: float, length: float, radius: float) -> np.ndarray:
    """One cell along an arc of `arc` radians, in pixels."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    s, bend = np.linspace(-length / 2, length / 2, 200), length / arc
    x, y = centre[0] + bend * np.sin(s / bend), centre[1] + bend * (1 - np.cos(s / bend))
    away = np.hypot(columns[..., None] - x, rows[..., None] - y).min(-1)
    return (away <= radius).astype(np.uint16)

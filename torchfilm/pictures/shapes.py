"""Geometry of pictures: outlines of capsules, extents in a view, sections of signals; in µm."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from torchfilm.tools import checks
from torchfilm.tools.images import images_seen

# The axes of space to the right and up in each view.
VIEWS = {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
CAP_POINTS = 7  # points on each half circle of an outline

Window = tuple[float, float, float, float]  # left, right, bottom, top


def along(view: str) -> int:
    """The axis of space along the line of sight."""
    u, v = VIEWS[view]
    return 3 - u - v


def outlines(
    position: np.ndarray,
    axis: np.ndarray,
    length: np.ndarray,
    radius: np.ndarray,
    *,
    points: int = CAP_POINTS,
) -> np.ndarray:
    """Outline polygons (N, 2·points, 2) of capsules in projection.

    position, axis: (N, 2) of the projection, µm. The projection of a capsule is a capsule with a
    shorter centreline, so an upright cell is a circle.
    """
    size = np.hypot(axis[:, 0], axis[:, 1])
    way = np.where(size[:, None] > 1e-9, axis / np.maximum(size, 1e-9)[:, None], (1.0, 0.0))
    side = np.stack([-way[:, 1], way[:, 0]], 1)
    half = 0.5 * length * size
    turn = np.linspace(-math.pi / 2, math.pi / 2, points)
    parts = []
    for sign in (1.0, -1.0):
        end = position + sign * half[:, None] * way
        around = sign * (
            np.cos(turn)[None, :, None] * way[:, None] + np.sin(turn)[None, :, None] * side[:, None]
        )
        parts.append(end[:, None] + radius[:, None, None] * around)
    return np.concatenate(parts, 1)


def with_images(
    cells: Mapping[str, np.ndarray], faces: Mapping[str, tuple[float, float]], view: str,
    window: Window,
) -> Mapping[str, np.ndarray]:  # fmt: skip
    """The cells of a periodic space, and those images of them that reach into a window."""
    for k, left, right in zip(VIEWS[view], window[0::2], window[1::2], strict=True):
        if "xyz"[k] not in faces:
            continue
        low, high = faces["xyz"[k]]
        reach = 0.5 * cells["length"] * np.abs(cells["axis"][:, k]) + cells["radius"]
        seen = min(left, right), max(left, right)
        more, away = images_seen(cells["position"][:, k], reach, high - low, *seen)
        which = np.concatenate([np.arange(len(reach)), more])
        cells = {name: value[which] for name, value in cells.items()}
        cells["position"][len(reach) :, k] += away
    return cells


def span_of_faces(
    faces: Mapping[str, tuple[float, float]], covered: np.ndarray, view: str
) -> np.ndarray:
    """A box (2, 2) of a view, from face to face of a periodic space, µm."""
    covered = covered.copy()
    for column, k in enumerate(VIEWS[view]):
        if "xyz"[k] in faces:
            covered[:, column] = faces["xyz"[k]]
    return covered


def span(cells: Mapping[str, np.ndarray], view: str) -> np.ndarray | None:
    """Lower and upper corner (2, 2) of some cells in a view, µm; None without cells."""
    if len(cells["length"]) == 0:
        return None
    seen = list(VIEWS[view])
    reach = (
        0.5 * cells["length"][:, None] * np.abs(cells["axis"][:, seen]) + cells["radius"][:, None]
    )
    return np.stack(
        [(cells["position"][:, seen] - reach).min(0), (cells["position"][:, seen] + reach).max(0)]
    )


def box(origin: np.ndarray, spacing: np.ndarray, shape: tuple[int, ...], view: str) -> np.ndarray:
    """Lower and upper corner (2, 2) of a grid in a view, µm."""
    seen = list(VIEWS[view])
    low = np.asarray(origin, dtype=float)[seen]
    return np.stack([low, low + np.asarray(spacing, dtype=float)[seen] * np.asarray(shape)[seen]])


def window(shown: np.ndarray, size: np.ndarray, within: np.ndarray | None) -> Window:
    """A window of the given size (2,) around `shown`, a box (2, 2) that fits into it.

    It is moved into the box `within` as far as possible.
    """
    low = shown.mean(0) - 0.5 * size
    if within is not None:
        room = within[1] - within[0] - size
        low = np.where(
            room >= 0,
            np.clip(low, within[0], within[0] + np.maximum(room, 0)),
            within[0] + 0.5 * room,
        )
        low = np.clip(low, shown[1] - size, shown[0])
    return float(low[0]), float(low[0] + size[0]), float(low[1]), float(low[1] + size[1])


def section(
    values: np.ndarray, origin: np.ndarray, spacing: np.ndarray, *, view: str, at: float | None
) -> np.ndarray:
    """A signal (nx, ny, nz) in a view, (nu, nv).

    at: the coordinate of the section along the line of sight, µm, or None for the mean along it.
    Between the centres of voxels it is interpolated linearly, as cells read it.
    """
    k = along(view)
    count = values.shape[k]
    if at is None or count == 1:
        return values.mean(k)
    low, high = float(origin[k]), float(origin[k] + spacing[k] * count)
    if not low <= at <= high:
        raise checks.input_error(
            "section",
            at,
            f"within the box of the signal, from {low:g} to {high:g} µm along {'xyz'[k]}, or"
            ' "mean"',
        )
    place = min(max((at - low) / float(spacing[k]) - 0.5, 0.0), count - 1.0)
    first = min(int(place), count - 2)
    part = place - first
    return (1.0 - part) * values.take(first, k) + part * values.take(first + 1, k)

"""The columns of programs that measure cells, with their units and conventions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ColumnSet:
    """The table of a program that gives the ellipse with the second moments of each region.

    Each entry has the names of a column, of which a table has one; it may lack area, label and
    frame. angle_unit: "rad" or "deg".
    widest: the greatest angle that there is, rad. first: the number of the first row and column of
    the image. pixel: the second moment of a pixel, which the program adds; 0, or 1/12. axis: the
    direction of the major axis, x to the right and y up, by the angle, rad. Lengths are in pixels,
    and y goes down.
    """

    program: str
    x: tuple[str, ...]
    y: tuple[str, ...]
    major: tuple[str, ...]
    minor: tuple[str, ...]
    angle: tuple[str, ...]
    area: tuple[str, ...]
    label: tuple[str, ...]
    frame: tuple[str, ...]
    angle_unit: str
    first: int
    pixel: float
    axis: Callable[[np.ndarray], np.ndarray]
    widest: float = 0.5 * math.pi

    @property
    def needed(self) -> tuple[tuple[str, ...], ...]:
        return self.x, self.y, self.major, self.minor, self.angle


COLUMN_SETS = {
    # skimage.measure.regionprops_table: the orientation is the angle from the axis of the rows
    # (downwards) to the major axis, counter-clockwise
    "skimage": ColumnSet(
        "scikit-image",
        x=("centroid-1", "centroid_1"),
        y=("centroid-0", "centroid_0"),
        major=("axis_major_length", "major_axis_length"),
        minor=("axis_minor_length", "minor_axis_length"),
        angle=("orientation",),
        area=("area",),
        label=("label",),
        frame=("frame",),
        angle_unit="rad",
        first=0,
        pixel=0.0,
        axis=lambda angle: np.stack([np.sin(angle), -np.cos(angle)], 1),
    ),
    # struct2table(regionprops(…)) and writetable of MATLAB: the orientation is the angle from the
    # horizontal, counter-clockwise as seen
    "matlab": ColumnSet(
        "MATLAB",
        x=("Centroid_1",),
        y=("Centroid_2",),
        major=("MajorAxisLength",),
        minor=("MinorAxisLength",),
        angle=("Orientation",),
        area=("Area",),
        label=("Label", "label"),
        frame=("Frame", "frame"),
        angle_unit="deg",
        first=1,
        pixel=1.0 / 12.0,
        axis=lambda angle: np.stack([np.cos(angle), np.sin(angle)], 1),
    ),
}


def matching(columns: tuple[str, ...]) -> list[str]:
    """The sets whose columns a table has."""
    return [
        name
        for name, known in COLUMN_SETS.items()
        if all(any(n in columns for n in names) for names in known.needed)
    ]

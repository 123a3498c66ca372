"""How cells lie in the image that they were read from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.initial_cells import Cells


WIDTHS = 0.2, 5.0  # µm, of bacteria
LONGEST = 100.0  # µm, a median, filaments aside
LEAST = 0.01  # µm; overlaps below it are not worth a word


@dataclass(frozen=True, eq=False)
class Micrograph:
    """The image that cells were read from.

    source: the file, or a word for it. pixel_size: µm a pixel. shift: (N, 2) µm, by how much cells
    were moved from their places in the image, whose first pixel has its centre at the origin.
    y_down: whether that pixel is at the top (else at the bottom). label: (N,) texts, or None.
    image: (rows, columns), where known. left_out: the labels that were dropped, by the reason.
    background: what was subtracted from the pixels of a field, by field. moved: (N,) µm, how far
    `Cells.relaxed` moved each cell, or None.
    """

    source: str
    pixel_size: float
    shift: np.ndarray
    y_down: bool = True
    label: np.ndarray | None = None
    image: tuple[int, int] | None = None
    left_out: Mapping[str, Sequence[str]] = field(default_factory=dict)
    background: Mapping[str, float] = field(default_factory=dict)
    moved: np.ndarray | None = None

    def name(self, cell: int) -> str:
        """The name of a cell for messages."""
        return f"cell {cell}" if self.label is None else f"label {self.label[cell]}"

    def pixels(self, position: np.ndarray, rows: int) -> np.ndarray:
        """Where positions (N, 2), µm, lie in an image of so many rows: (N, 2), column and row."""
        place = (position - self.shift) / self.pixel_size
        row = -place[:, 1] if self.y_down else rows - 1 - place[:, 1]
        return np.stack([place[:, 0], row], 1)


def listed(labels: Sequence[str], most: int = 8) -> str:
    """Some labels as text."""
    return ", ".join(labels[:most]) + (f", … ({len(labels)} in all)" if len(labels) > most else "")


def with_usual_sizes(cells: Cells) -> Cells:
    """The same cells; warns where their median width or length is not that of bacteria."""
    if not cells.count:
        return cells
    width, seen = float(np.median(2 * cells.radius)), cells.micrograph
    whole = float(np.median(cells.length + 2 * cells.radius))
    hint = (
        "Are the columns in µm? For pixels give pixel_size, in µm."
        if seen is None
        else f"Is pixel_size = {seen.pixel_size:g} µm right? It is not in nm."
    )
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        warn(
            f"the cells are {width:.3g} µm wide (median); bacteria are {WIDTHS[0]:g} to"
            f" {WIDTHS[1]:g} µm wide. {hint}"
        )
    elif not WIDTHS[0] <= whole <= LONGEST:
        warn(
            f"the cells are {whole:.3g} µm long with their caps (median); bacteria are"
            f" {WIDTHS[0]:g} to {LONGEST:g} µm long. {hint}"
        )
    return cells


def summarise(cells: Cells) -> str:
    """What cells are, in lines for a reader."""
    seen = cells.micrograph
    if not cells.count:
        return "no cells"
    name = (lambda k: f"cell {k}") if seen is None else seen.name
    span = lambda values: f"{values.min():.3g} to {values.max():.3g}"
    places = ", ".join(
        f"{axis} {span(column)}" for axis, column in zip("xyz", cells.position.T, strict=False)
    )
    lines = [
        f"{cells.count} cells"
        + ("" if seen is None else f" from {seen.source}, {seen.pixel_size:g} µm a pixel"),
        f"centres: {places} µm",
        f"length without caps: {span(cells.length)} µm, median {np.median(cells.length):.3g}",
        f"width: {span(2 * cells.radius)} µm, median {np.median(2 * cells.radius):.3g}",
    ]
    if seen is not None:
        lines += [
            f"left out, {reason}: {len(labels)}, label {listed(labels)}"
            for reason, labels in seen.left_out.items()
        ]
        lines += [
            f"{channel}: {span(cells.extra[channel])}, median {np.median(cells.extra[channel]):.3g}"
            f" (mean of the pixels, less {dark:.4g} of background)"
            for channel, dark in seen.background.items()
        ]
    found = cells.overlaps(LEAST)
    lines.append(
        f"overlaps over {LEAST} µm: {len(found)} pair{'s' * (len(found) != 1)}"
        + (
            f", the deepest {found[0][2]:.3g} µm ({name(found[0][0])} and {name(found[0][1])})"
            if found
            else ""
        )
    )
    if seen is not None and seen.moved is not None:
        far = int(np.argmax(seen.moved))
        lines.append(
            f"relaxed: cells moved by {seen.moved.mean():.3g} µm on average, {name(far)} by"
            f" {seen.moved[far]:.3g} µm"
        )
    return "\n".join(lines)

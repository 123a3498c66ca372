"""Checks of the box of a medium and of its flow, as a user gives them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from torchfilm.signals.boundary_conditions import Open
from torchfilm.signals.schedule import Schedule, each_value
from torchfilm.tools import checks
from torchfilm.tools.warn_once import warn

# The most voxels of a colony's grid, 0.27 GB per signal in float32. Where the grid grows, one cell
# that moves far away must not take all memory.
MOST_VOXELS = 2**26
# µm: faces that differ by less are the same.
SAME = 1e-6
# µm²/h, far below any diffusion in water, gels or cells.
SLOWEST = 1e-5


def checked_box(
    box: Any, spacing: Any, depth: float | None, height: float
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Returns the lower corner, the upper corner and the size of voxels, checked."""
    try:
        corners = [tuple(corner) for corner in box]
        if any(isinstance(x, str) for corner in corners for x in corner):
            raise TypeError("texts")
        low, high = (tuple(float(x) for x in corner) for corner in corners)
    except (TypeError, ValueError) as error:
        raise checks.input_error(
            "Medium.box", box, "two corners, such as ((-64, -64), (64, 64))"
        ) from error
    if (
        len(low) != len(high)
        or len(low) not in (2, 3)
        or not all(
            math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(low, high, strict=True)
        )
    ):
        raise checks.input_error(
            "Medium.box",
            (low, high),
            "two corners of 2 or 3 finite numbers, the first below the second along every axis",
        )
    voxel = checks.vector(
        "Medium.spacing",
        (spacing,) * len(low) if isinstance(spacing, (int, float)) else spacing,
        len(low),
    )
    if min(voxel) <= 0:
        raise checks.input_error("Medium.spacing", spacing, "above 0")
    for letter, a, b, h in zip("xyz", low, high, voxel, strict=False):
        count = (b - a) / h
        if abs(count - round(count)) > 1e-6:
            whole = max(1, round(count)) * h
            raise checks.input_error(
                f"Medium.box along {letter}",
                (a, b),
                f"a whole number of voxels of {h:g} µm",
                f"It is {count:g}; make it {whole:g} µm long.",
            )
    voxels = math.prod(round((b - a) / h) for a, b, h in zip(low, high, voxel, strict=True))
    if voxels > MOST_VOXELS:
        hint = f"It has {voxels / 1e6:,.0f} million; give a larger spacing or a smaller box."
        raise checks.input_error(
            "Medium.box",
            (low, high),
            f"of at most {MOST_VOXELS / 1e6:.0f} million voxels of {spacing} µm per colony",
            hint,
        )
    if depth is not None:
        checks.number("Medium.depth", depth, above=0.0)
        if len(low) == 3:
            raise checks.input_error("Medium.depth", depth, "omitted for a box of three dimensions")
    checks.number("Medium.height", height)
    if len(low) == 3 and not low[2] <= height <= high[2]:
        raise checks.input_error(
            "Medium.height", height, f"within the box, from {low[2]:g} to {high[2]:g} µm"
        )
    return low, high, voxel


def checked_flow(name: str, given: Any) -> Any:
    """Returns a checked velocity: None, a function, or a tuple of numbers.

    Each component is one number or one per colony.
    """
    if given is None or callable(given):
        return given
    if not isinstance(given, (tuple, list, Tensor)) or len(given) not in (2, 3):
        raise checks.input_error(name, given, "two or three numbers, or a function of positions")
    if isinstance(given, Tensor) and given.dim() == 2:
        raise checks.input_error(
            name,
            tuple(given.shape),
            "two or three components",
            "For one velocity per colony give (vx, vy), each a tensor with one number per colony.",
        )
    return tuple(checks.value(f"{name}[{k}]", v) for k, v in enumerate(given))


def check_growing(periodic: Sequence[bool], outside: str, grows: str) -> None:
    """Raise InputError for a box that would grow along an axis that is periodic."""
    along = [a for a, wraps in zip("xyz", periodic, strict=True) if wraps]
    if outside == "grow" and any(a in grows for a in along):
        left = "".join(a for a in "xyz" if a not in along)
        raise checks.input_error(
            "Medium.grows",
            grows,
            f"without {' and '.join(along)}: a periodic box cannot grow there",
            f"The others may: grows={left!r}." if left else 'Take outside="error".',
        )


def check_margin(
    margin: float, grows: str, box: tuple[Sequence[float], Sequence[float]],
    spacing: Sequence[float],
) -> None:  # fmt: skip
    """Raise InputError for a margin with which no box has as few voxels as one may have."""
    voxels = 1.0
    for axis, low, high, step in zip("xyz", *box, spacing, strict=False):
        faces = 2 if f"+{axis}" not in grows and f"-{axis}" not in grows else 1
        least = faces * margin if axis in grows and high - low > step else 0.0
        voxels *= max(high - low, least) / step
    if voxels > MOST_VOXELS:
        rule = f"so small that a box has at most {MOST_VOXELS / 1e6:.0f} million voxels"
        raise checks.input_error("Medium.margin", margin, rule, "Or take a greater spacing.")


def check_same_faces(
    faces: Mapping[str, tuple[float, float]], periodic: Sequence[bool],
    box: tuple[Sequence[float], Sequence[float]],
) -> None:  # fmt: skip
    """Raise InputError where space is periodic for cells and not for signals. faces: of the cells,
    (low, high) µm by axis. periodic: of the signals. box: of the medium."""
    for axis, (low, high) in faces.items():
        k = "xyz".index(axis)
        own = tuple(corner[k] for corner in box) if k < len(box[0]) else None
        if periodic[k] and own is not None and max(abs(own[0] - low), abs(own[1] - high)) < SAME:
            continue
        is_so = f"ends at {own}" if periodic[k] else "is not"
        raise checks.InputError(
            f"Medium: cells are periodic along {axis}, from {low!r} to {high!r} µm"
            f" (Mechanics.periodic), and the medium {is_so}. Give it the same faces: box from"
            f" {low:g} to {high:g} along {axis}, and"
            f" boundary=tf.BoundaryConditions({axis}=tf.Periodic())."
        )


def check_used(medium: Any) -> None:
    """Warn of what a medium is given and nothing reads, and of a diffusion that looks like one in
    other units."""
    if medium.grows != "xyz" and medium.outside != "grow":
        warn(f"Medium(grows={medium.grows!r}) does nothing: boxes grow with outside='grow'.")
    for name, signal in medium.signals.items():
        if _given(signal.reservoir) and medium.outside != "reservoir":
            warn(
                f"the reservoir of the signal {name!r} does nothing: cells find it with"
                " Medium(outside='reservoir')."
            )
        faces = [face for pair in medium.boundary_of(name).pairs for face in pair]
        carried = any(isinstance(face, Open) and _given(face.outside_value()) for face in faces)
        if carried and medium.flow_of(name) is None:
            warn(
                f"Open(outside=…) of the signal {name!r} does nothing, since no flow carries it in."
                " Dirichlet(…) holds a concentration at a face."
            )
        if isinstance(signal.diffusion, (int, float)) and 0 < signal.diffusion < SLOWEST:
            warn(
                f"the signal {name!r} diffuses at {signal.diffusion:g} µm²/h: hardly at all. Is it"
                " in m²/s? 1e-10 m²/s are 360,000 µm²/h."
            )


def _given(value: float | Tensor | Schedule) -> bool:
    """Whether some of a value is not 0."""
    return any(bool((x != 0).any()) if isinstance(x, Tensor) else x != 0 for x in each_value(value))

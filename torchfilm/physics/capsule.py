"""The capsule: a cylinder of length l with hemispherical caps of radius r; lengths in µm."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def total_length(length: Tensor, radius: Tensor) -> Tensor:
    """L = l + 2r, µm."""
    return length + 2.0 * radius


def volume(length: Tensor, radius: Tensor) -> Tensor:
    """V = π r² (l + 4r/3), µm³."""
    return math.pi * radius * radius * (length + radius * (4.0 / 3.0))


def area(length: Tensor, radius: Tensor) -> Tensor:
    """A = 2π r L, µm²."""
    return 2.0 * math.pi * radius * total_length(length, radius)


def drag(
    length: Tensor, radius: Tensor, viscosity: Tensor | float
) -> tuple[Tensor, Tensor, Tensor]:
    """Overdamped drag of one cell, in translation and in rotation across and about its axis.

    They are μL, μL³/12 and μLr²/2.

    The slender rod has no resistance about its own axis. The last term is that of a rod of finite
    radius; it makes the tensor positive definite. Each (N,), in units of μ times µm, µm³ and µm³.
    """
    whole = total_length(length, radius)
    along = viscosity * whole
    return along, along * whole * whole / 12.0, along * radius * radius / 2.0


def rotate(axis: Tensor, turn: Tensor) -> Tensor:
    """Rotate unit axes (N, d) exactly by a rotation vector, rad: (N, 3), or (N, 1) in 2-D.

    Returns unit axes, (N, d). sin θ/θ and (1 − cos θ)/θ² are summed as series in θ², accurate to
    1e-16 for θ ≤ 1. The series have no singular gradient at zero, and they avoid a library sine,
    whose last bit may depend on an element's place in the tensor.
    """
    t2 = (turn * turn).sum(1, keepdim=True)
    sinc = 1 - t2 / 6 * (
        1
        - t2
        / 20
        * (
            1
            - t2
            / 42
            * (1 - t2 / 72 * (1 - t2 / 110 * (1 - t2 / 156 * (1 - t2 / 210 * (1 - t2 / 272)))))
        )
    )
    versine = 0.5 * (
        1
        - t2
        / 12
        * (
            1
            - t2
            / 30
            * (1 - t2 / 56 * (1 - t2 / 90 * (1 - t2 / 132 * (1 - t2 / 182 * (1 - t2 / 240)))))
        )
    )
    if axis.shape[1] == 2:
        first = turn * torch.stack([-axis[:, 1], axis[:, 0]], 1)
        second = -t2 * axis
    else:
        first = torch.linalg.cross(turn, axis)
        second = torch.linalg.cross(turn, first)
    new = axis + sinc * first + versine * second
    return new / (new * new).sum(1, keepdim=True).sqrt()

"""The stretch along which two capsules lie side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.tools.vectors import dot, safe_norm

if TYPE_CHECKING:
    from torchfilm.physics.contacts import Capsules


@dataclass(frozen=True)
class Stretch:
    """The common part of the two segments of each of P pairs, along the mean axis.

    length: (P,) µm, above 0 where the cells lie side by side. points: of its two ends, each (2, P),
    the arc lengths on a and on b, and the part of ½ l of a and of b with which the point moves when
    the cell grows.
    """

    length: Tensor
    points: tuple[Tensor, Tensor, Tensor, Tensor]


def stretch_of(a: Capsules, b: Capsules) -> Stretch:
    """The stretch of each pair."""
    cosine, between = dot(a.axis, b.axis), b.centre - a.centre
    # measured along the mean axis so that neither cell is preferred
    sign = torch.where(cosine < 0, -1.0, 1.0).to(a.half.dtype)
    mean = a.axis + sign * b.axis
    mean = mean / safe_norm(mean)
    project = dot(a.axis, mean)
    offset = dot(between, mean)
    low = torch.maximum(-a.half * project, offset - b.half * project)
    high = torch.minimum(a.half * project, offset + b.half * project)
    s, t, end_a, end_b = [], [], [], []
    for at, side in ((low, -1.0), (high, 1.0)):
        s.append(_clamp(at / project, a.half))
        t.append(_clamp(sign * (at - offset) / project, b.half))
        # the stretch ends where the first of the two cells ends; the further the other cell
        # continues, the less its own end matters
        beyond = (
            side * (at - a.half * project * side),
            side * (at - offset - b.half * project * side),
        )
        mark_a, mark_b = ((1.0 + x / (0.5 * (a.radius + b.radius))).clamp(min=0.0) for x in beyond)
        end_a.append(side * mark_a)
        end_b.append(sign * side * mark_b)
    points = torch.stack(s), torch.stack(t), torch.stack(end_a), torch.stack(end_b)
    return Stretch(high - low, points)


def _clamp(x: Tensor, half: Tensor) -> Tensor:
    """x, limited to −half … half."""
    return torch.minimum(torch.maximum(x, -half), half)

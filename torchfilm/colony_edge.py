"""The edge of a colony as an ellipse, and how far below it each cell lies."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.state import State
from torchfilm.tools import checks

ITERATIONS = 4  # to the nearest point of an ellipse: to 0.005 µm where it is 12 µm by 4


@dataclass(frozen=True)
class Outline:
    """The edges of B colonies seen from above, as ellipses, float64 without gradient; NaN without
    cells.

    centre: (B, 2) µm. half_axes: (B, 2) µm, the longer first. direction: of the longer, (B, 2)."""

    centre: Tensor
    half_axes: Tensor
    direction: Tensor

    def below_edge(self, places: Tensor, colony: Tensor) -> Tensor:
        """The distance of places (N, 2) from the edge of the colonies (N,), µm; negative beyond
        it."""
        x = places - self.centre.index_select(0, colony)
        d = self.direction.index_select(0, colony)
        along, across = (x * d).sum(1).abs(), (x[:, 1] * d[:, 0] - x[:, 0] * d[:, 1]).abs()
        a, b = self.half_axes.index_select(0, colony).unbind(1)
        inside = (along / a).square() + (across / b).square() < 1.0
        u, v = _nearest(along, across, a, b)
        distance = _length(along - u, across - v)
        return torch.where(inside, distance, -distance)


def _nearest(x: Tensor, y: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest point of an ellipse with half-axes a and b to a place in its first quadrant.

    From a point of the edge, its centre of curvature and the radius there give a better one (A.
    Stephens, "Simple method for distance to ellipse", 2017); it needs no start near the solution.
    """
    s = t = torch.full_like(x, 0.5**0.5)
    for _ in range(ITERATIONS):
        middle = (a * a - b * b) * s**3 / a, (b * b - a * a) * t**3 / b
        radius = _length(a * s - middle[0], b * t - middle[1])
        away = x - middle[0], y - middle[1]
        far = _length(*away)
        scale = radius / far.clamp(min=1e-12)
        # at the centre of curvature, as in the middle of a circle, no direction is better
        s = torch.where(far > 0, (away[0] * scale + middle[0]) / a, s).clamp(0.0, 1.0)
        t = torch.where(far > 0, (away[1] * scale + middle[1]) / b, t).clamp(0.0, 1.0)
        unit = _length(s, t).clamp(min=1e-12)
        s, t = s / unit, t / unit
    return a * s, b * t


def _length(x: Tensor, y: Tensor) -> Tensor:
    return (x * x + y * y).sqrt()


def check_flat_space(measure: str, state: State) -> None:
    """Raise InputError where a colony may go on beyond a face along x or y."""
    if state.space is not None and {"x", "y"} & {*state.space.faces}:
        text = f"{measure} goes by places, and this space is periodic along x or y."
        raise checks.InputError(text)


@torch.no_grad()
def outline_of(measure: str, state: State) -> Outline:
    """See `measure.outline`. measure: the name for messages.

    A filled ellipse with half-axes a and b has the variances a²/4 and b²/4 of places along them.
    The covariance is that of all points of the cells: that of their centres, weighted by volume,
    plus that of each capsule, whose cylinder has ℓ²/12 along it and r²/4 across, and whose caps
    have ℓ²/4 + 3ℓr/8 + r²/5 and r²/5.
    """
    check_flat_space(measure, state)
    w, groups = state.volume.double().unsqueeze(1), state.groups
    mean_of = lambda x: groups.sum(w * x) / groups.sum(w)
    centre = mean_of(state.position[:, :2].double())
    x = state.position[:, :2].double() - centre.index_select(0, state.colony)
    axis, radius = state.axis[:, :2].double(), state.radius.double()
    length, caps = state.length.double(), 4 / 3 * radius  # volumes over π r²
    across = (length / 4 + caps / 5) * radius.square() / (length + caps)
    end = length.square() / 4 + 3 / 8 * length * radius + radius.square() / 5
    along = (length * length.square() / 12 + caps * end) / (length + caps) - across
    pairs = lambda v: torch.stack([v[:, 0] * v[:, 0], v[:, 0] * v[:, 1], v[:, 1] * v[:, 1]], 1)
    each = pairs(x) + along.unsqueeze(1) * pairs(axis)
    each = each + across.unsqueeze(1) * each.new_tensor([1.0, 0.0, 1.0])
    xx, xy, yy = mean_of(each).unbind(1)
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = _length(half, xy)
    half_axes = 2.0 * torch.stack([mean + spread, mean - spread], 1).sqrt()
    # of the two forms of the eigenvector, the one that does not cancel
    u = torch.where(half >= 0, half + spread, xy)
    v = torch.where(half >= 0, xy, spread - half)
    size = _length(u, v)
    direction = torch.stack([torch.where(size > 0, u, 1.0), v], 1)
    return Outline(centre, half_axes, direction / torch.where(size > 0, size, 1.0).unsqueeze(1))


def below_edge_of(state: State) -> Tensor:
    """See `measure.below_edge`."""
    found = outline_of("below_edge", state)
    return found.below_edge(state.position.detach()[:, :2].double(), state.colony)

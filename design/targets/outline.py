"""The edge of a colony as an ellipse, and how far below it each cell lies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import total, weights

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GRID = 121  # points a side, on which a line below the edge is drawn
ITERATIONS = 4  # to the nearest point of an ellipse: to 0.005 µm where it is 12 µm by 4


@dataclass(frozen=True)
class Ellipses:
    """The outlines of B colonies, float64 without gradient: centre (B, 2) µm, half_axes (B, 2) µm,
    the longer first, and its direction (B, 2)."""

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


def ellipses(state: tf.State) -> Ellipses:
    """The colonies seen from above.

    A filled ellipse with half-axes a and b has the variances a²/4 and b²/4 of places along them.
    The covariance is that of all points of the cells, each a rod of length ℓ + 2r: that of the
    cells' centres, weighted by volume, plus (ℓ + 2r)²/12 along each cell and r²/4 across.
    """
    w = weights(state).unsqueeze(1)
    centre = tf.measure.colony_centre(state)[:, :2].detach()
    x = state.position.detach()[:, :2] - centre.index_select(0, state.colony)
    axis, radius = state.axis.detach()[:, :2].double(), state.radius.detach().double()
    along = (state.length.detach().double() + 2 * radius).square() / 12 - radius.square() / 4
    pairs = lambda v: torch.stack([v[:, 0] * v[:, 0], v[:, 0] * v[:, 1], v[:, 1] * v[:, 1]], 1)
    each = pairs(x) + along.unsqueeze(1) * pairs(axis)
    each = each + (radius.square() / 4).unsqueeze(1) * each.new_tensor([1.0, 0.0, 1.0])
    xx, xy, yy = (total(state, w * each) / total(state, w)).unbind(1)
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = _length(half, xy)
    half_axes = 2.0 * torch.stack([mean + spread, mean - spread], 1).sqrt()
    # of the two forms of the eigenvector, the one that does not cancel
    u = torch.where(half >= 0, half + spread, xy)
    v = torch.where(half >= 0, xy, spread - half)
    size = _length(u, v)
    direction = torch.stack([torch.where(size > 0, u, 1.0), v], 1)
    return Ellipses(centre, half_axes, direction / torch.where(size > 0, size, 1.0).unsqueeze(1))


def below_edge(state: tf.State) -> Tensor:
    """How far each cell lies below the edge of its colony, (N,) float64 µm; negative beyond the
    edge."""
    return ellipses(state).below_edge(state.position.detach()[:, :2], state.colony)


def draw_below_edge(
    ax: Axes, state: tf.State, place: int, depths: tuple[float, ...], colour: str, style: str
) -> None:
    """Draw the lines at some depths, µm, below the edge of the colony at `place` of the batch, and
    keep the limits of the axes."""
    window = ax.get_xlim(), ax.get_ylim()
    found = ellipses(state)
    (x, y), reach = found.centre[place].tolist(), 1.1 * float(found.half_axes[place, 0])
    reach += max((-d for d in depths if math.isfinite(d)), default=0.0)
    side = torch.linspace(-reach, reach, GRID, dtype=torch.float64)
    places = torch.cartesian_prod(x + side, y + side).to(found.centre.device)
    depth = found.below_edge(places, torch.full_like(places[:, 0], place, dtype=torch.int64))
    there = [d for d in sorted(depths) if math.isfinite(d) and d < float(depth.max())]
    if there:
        height = depth.cpu().reshape(GRID, GRID).T.numpy()
        grid = (x + side).numpy(), (y + side).numpy()
        ax.contour(*grid, height, there, colors=colour, linestyles=style, linewidths=1.0, zorder=3)
    ax.set(xlim=window[0], ylim=window[1])

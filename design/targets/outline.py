"""The edge of a colony as an ellipse, and how far below it each cell lies."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import total, weights

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINTS = 181  # of a drawn edge


def ellipse(state: tf.State) -> tuple[Tensor, Tensor]:
    """The colony seen from above as an ellipse: its centre (B, 2) µm and the matrix M (B, 2, 2),
    1/µm², with (x − centre)ᵀ M (x − centre) = 1 at the edge, float64 without gradient.

    A filled ellipse has the covariance C = M⁻¹/4 of places. C is that of all points of the cells,
    each a rod of length ℓ + 2r: that of the cells' centres, weighted by volume, plus
    (ℓ + 2r)²/12 along each cell and r²/4 across.
    """
    w = weights(state).unsqueeze(1)
    centre = tf.measure.colony_centre(state)[:, :2].detach()
    x = state.position.detach()[:, :2] - centre.index_select(0, state.colony)
    axis, radius = state.axis.detach()[:, :2].double(), state.radius.detach().double()
    along = (state.length.detach().double() + 2 * radius).square() / 12 - radius.square() / 4
    pairs = lambda v: torch.stack([v[:, 0] * v[:, 0], v[:, 0] * v[:, 1], v[:, 1] * v[:, 1]], 1)
    each = pairs(x) + along.unsqueeze(1) * pairs(axis)
    across = (radius.square() / 4).unsqueeze(1)
    each = each + across * each.new_tensor([1.0, 0.0, 1.0])
    a, b, c = (total(state, w * each) / total(state, w)).unbind(1)
    four = 4.0 * (a * c - b * b)
    rows = [torch.stack([c, -b], 1), torch.stack([-b, a], 1)]
    return centre, torch.stack(rows, 1) / four[:, None, None]


def below_edge(state: tf.State) -> Tensor:
    """How far each cell lies below the edge of its colony, towards the centre, (N,) float64 µm;
    negative beyond the edge."""
    centre, matrix = ellipse(state)
    x = state.position.detach()[:, :2] - centre.index_select(0, state.colony)
    # at the very centre any direction will do
    x = torch.where((x * x).sum(1, keepdim=True) > 1e-18, x, x.new_tensor([1e-9, 0.0]))
    m = matrix.index_select(0, state.colony)
    u, v = x.unbind(1)
    share = (m[:, 0, 0] * u * u + 2 * m[:, 0, 1] * u * v + m[:, 1, 1] * v * v).sqrt()
    return (u * u + v * v).sqrt() * (1.0 / share - 1.0)


def draw_below_edge(
    ax: Axes, state: tf.State, place: int, depths: tuple[float, ...], colour: str, style: str
) -> None:
    """Draw the lines at some depths, µm, below the edge of the colony at `place` of the batch, and
    keep the limits of the axes."""
    window = ax.get_xlim(), ax.get_ylim()
    centre, matrix = ellipse(state)
    angle = torch.linspace(0, 2 * math.pi, POINTS, dtype=torch.float64)
    ray = torch.stack([angle.cos(), angle.sin()], 1)
    edge = ((ray @ matrix[place].cpu()) * ray).sum(1).rsqrt()
    for depth in (d for d in depths if math.isfinite(d)):
        x, y = (centre[place].cpu() + (edge - depth).clamp(min=0.0).unsqueeze(1) * ray).unbind(1)
        ax.plot(x.numpy(), y.numpy(), color=colour, linestyle=style, linewidth=1.0, zorder=3)
    ax.set(xlim=window[0], ylim=window[1])

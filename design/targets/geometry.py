"""Coordinates of cells from a centre, soft edges, and how they are drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from torch import Tensor

import torchfilm as tf
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Centre = Literal["colony"] | tuple[float, float]
ALONG = ("x", "y", "z", "radius", "edge", "top")
COLOURS = ("#c2185b", "#1976d2", "#388e3c", "#f57c00", "#7b1fa2", "#5d4037")  # of the species

GRID = 121  # points a side, on which a line below the edge is drawn
PIXEL, MOST_PIXELS = 0.25, 500  # of an outline: a side, µm, at least; and how many


def check_profile(kind: str, floor: object, edge_width: object = 1.0) -> None:
    """Raises `tf.InputError` for a floor or an edge width that is not allowed."""
    checks.number(f"{kind}.floor", floor, least=0.0)
    checks.number(f"{kind}.edge_width", edge_width, above=0.0, hint="For a sharp edge give 0.01.")


def checked_centre(name: str, given: object) -> Centre:
    """A centre: "colony" or (x, y) µm. Raises `tf.InputError` for anything else."""
    if isinstance(given, str):
        checks.choice(name, given, ("colony",))
        return "colony"
    x, y = checks.vector(name, given, 2)
    return x, y


def between(x: Tensor, low: float, high: float, edge_width: float) -> Tensor:
    """1 between the edges and 0 beyond: σ((x − low)/edge_width) − σ((x − high)/edge_width), with
    the logistic function σ, so that adjacent bands add up to 1."""
    # tanh, because the last bit of torch's sigmoid depends on the place in the tensor
    return 0.5 * (
        torch.tanh((x - low) / (2 * edge_width)) - torch.tanh((x - high) / (2 * edge_width))
    )


def half(width: float, edge_width: float) -> float:
    """Half of the greatest value of `between` for a band of this width."""
    return 0.5 * math.tanh(width / (4 * edge_width))


def in_words(along: str) -> str:
    """A coordinate in a description, such as "along x"."""
    return {"edge": "below the edge", "top": "below the top"}.get(along, f"along {along}")


def check_along(target: str, along: str, centre: Centre, state: tf.State) -> None:
    """Raises `tf.InputError` where the colonies of a first state have no such coordinate."""
    if along == "z" and state.dim == 2:
        hint = 'A film in the plane grows along "y".'
        raise checks.input_error(f"{target}.along", along, "one that the plane has", hint)
    if along == "top":
        ground = "xyz"[: state.dim - 1]
        if state.space is None or any(a not in state.space.faces for a in ground):
            faces = ", ".join(f"{a!r}: (0, 40)" for a in ground)
            hint = f"Write tf.Mechanics(periodic={{{faces}}}), as the scene biofilm does."
            rule = f"another one, as space is not periodic along {' and '.join(ground)}"
            raise checks.input_error(f"{target}.along", along, rule, hint)
        tf.measure.below_top(state)  # says where there is no floor
    axes = {"x": "x", "y": "y", "radius": "xy", "edge": "xy"}.get(along, "")
    around = periodic_along(state, axes)
    if around and along == "edge":
        raise checks.input_error(
            f"{target}.along", along, f"no edge, as space is periodic along {around}",
            'Where a film grows from a floor, along="top" is the distance below its top.',
        )  # fmt: skip
    if around and centre == "colony":
        raise checks.input_error(
            f"{target}.centre", centre, f"(x, y) µm, as space is periodic along {around}"
        )


def periodic_along(state: tf.State, axes: str) -> str:
    """Along which of these axes space is periodic, such as "x and y"; "" along none."""
    return " and ".join(a for a in axes if state.space is not None and a in state.space.faces)


def offset(state: tf.State, centre: Centre) -> Tensor:
    """The position of each cell relative to the centre, (N, 2) float64 µm, without gradient; of a
    cell in a periodic space that of its image that is nearest to the centre."""
    place = state.position.detach()[:, :2]
    if centre == "colony":
        return place - tf.measure.colony_centre(state)[:, :2].index_select(0, state.colony)
    apart = place - place.new_tensor(centre)
    return apart if state.space is None else apart + state.space.shift(apart.T).T


def coordinate(state: tf.State, along: str, centre: Centre) -> Tensor:
    """The coordinate of each cell along "x", "y" or "radius", from the centre, its "z", or how far
    it lies below the "edge" of its colony or the "top" of its film, (N,) float64 µm."""
    if along == "edge":
        return tf.measure.below_edge(state)
    if along == "top":
        return tf.measure.below_top(state)
    if along == "z":
        return state.position.detach()[:, 2]
    x, y = offset(state, centre).unbind(1)
    return x if along == "x" else y if along == "y" else (x * x + y * y).sqrt()


def centre_at(state: tf.State, centre: Centre, place: int) -> tuple[float, float]:
    """The centre of the colony at `place` of the batch, µm."""
    if centre == "colony":
        x, y = tf.measure.colony_centre(state)[place, :2].tolist()
        return x, y
    return centre


def lines(
    ax: Axes,
    along: str,
    centre: tuple[float, float],
    edges: Sequence[float],
    colour: str,
    style: str = "--",
) -> None:
    """Draw lines, or circles, at the edges, µm from the centre, and keep the limits of the axes."""
    from matplotlib.patches import Circle

    window = ax.get_xlim(), ax.get_ylim()
    for edge in (e for e in edges if math.isfinite(e)):
        if along == "radius":
            ax.add_patch(
                Circle(
                    centre, edge, fill=False, color=colour, linestyle=style, linewidth=1.0, zorder=3
                )
            )
        elif along == "x":
            ax.axvline(centre[0] + edge, color=colour, linestyle=style, linewidth=1.0, zorder=3)
        else:
            ax.axhline(centre[1] + edge, color=colour, linestyle=style, linewidth=1.0, zorder=3)
    ax.set(xlim=window[0], ylim=window[1])


def draw_edges(
    ax: Axes,
    state: tf.State,
    place: int,
    along: str,
    centre: Centre,
    edges: Sequence[float],
    colour: str,
    style: str = "--",
) -> None:
    """Draw edges along a coordinate in the picture of the colony at `place` of the batch, if they
    can be seen there: a picture of a colony in space shows it from above."""
    if along == "edge":
        draw_below_edge(ax, state, place, tuple(edges), colour, style)
    elif along == "top" and state.dim == 2:
        draw_below_top(ax, state, place, edges, colour, style)
    elif along not in ("z", "top"):
        lines(ax, along, centre_at(state, centre, place), edges, colour, style)


def draw_below_edge(
    ax: Axes, state: tf.State, place: int, depths: tuple[float, ...], colour: str, style: str
) -> None:
    """Draw the lines at some depths, µm, below the edge of the colony at `place` of the batch, and
    keep the limits of the axes."""
    window = ax.get_xlim(), ax.get_ylim()
    found = tf.measure.outline(state)
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


def draw_below_top(
    ax: Axes, state: tf.State, place: int, depths: Sequence[float], colour: str, style: str
) -> None:
    """Draw the lines at some depths, µm, below the top of the film of the colony at `place` of the
    batch, and keep the limits of the axes."""
    window = ax.get_xlim(), ax.get_ylim()
    mine = state.colony == place
    x, y = state.position[mine, :2].T
    top = y + tf.measure.below_top(state)[mine]
    order = torch.argsort(x)
    for depth in (d for d in depths if math.isfinite(d)):
        line = x[order].cpu().numpy(), (top - depth)[order].cpu().numpy()
        ax.plot(*line, color=colour, linestyle=style, linewidth=1.0, zorder=3)
    ax.set(xlim=window[0], ylim=window[1])


def draw_region(ax: Axes, state: tf.State, place: int, level: Tensor, colour: str) -> None:
    """Draw the outline of where the cells of the colony at `place` of the batch should be lit, by
    their level (N,) from 0 to 1, and keep the limits of the axes. In space, of the cells as they
    are seen from above, where layers mix."""
    mine = state.colony == place
    if not bool(mine.any()):
        return
    window = ax.get_xlim(), ax.get_ylim()
    # each pixel is of the cell whose centreline is nearest, if that is near
    radius, length = state.radius[mine].max(), state.length[mine]
    many = 2 + torch.ceil(length / radius).long()  # points on a centreline
    row = torch.repeat_interleave(many)
    within = torch.arange(len(row), device=row.device) - (many.cumsum(0) - many)[row]
    along = ((within / (many[row] - 1) - 0.5) * length[row]).unsqueeze(1)
    lines = state.position[mine, :2][row] + along * state.axis[mine, :2][row]
    points, levels = lines.cpu().numpy(), level[mine].detach()[row].cpu().numpy()
    for name, (low, high) in ({} if state.space is None else state.space.faces).items():
        if name in "xy":  # with the images beyond both faces
            period = (high - low) * np.eye(2)["xy".index(name)]
            points = np.concatenate([points, points - period, points + period])
            levels = np.tile(levels, 3)
    step = max(PIXEL, *(abs(high - low) / MOST_PIXELS for low, high in window))
    reach = 1.5 * float(radius) + step
    near = [
        (points[:, k] > min(w) - reach) & (points[:, k] < max(w) + reach)
        for k, w in enumerate(window)
    ]
    points, levels = points[near[0] & near[1]], levels[near[0] & near[1]]
    if not len(points):
        return
    x, y = (np.arange(min(ends), max(ends) + step, step) for ends in window)
    grid = np.stack(np.meshgrid(x, y), -1)
    apart, nearest = cKDTree(points).query(grid.reshape(-1, 2))
    lit = np.where(apart < reach, levels[nearest], 0.0).reshape(grid.shape[:2])
    lit = gaussian_filter(lit, 0.5 * reach / step)  # the ends of single cells are of no interest
    if lit.min() < 0.5 < lit.max():
        ax.contour(x, y, lit, levels=[0.5], colors=colour, linewidths=0.8)
    ax.set(xlim=window[0], ylim=window[1])

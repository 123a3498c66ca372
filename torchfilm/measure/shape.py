"""The place, size and shape of colonies, and the directions of their cells."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchfilm.colony_edge import Outline, below_edge_of, check_flat_space, outline_of
from torchfilm.film_shape import Film, below_top_of, film_of
from torchfilm.measure.of_a_state import of_a_state
from torchfilm.micrographs.capsule_fit import moments_of_capsule
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.vectors import safe_norm, safe_sqrt


@of_a_state
def colony_centre(state: State) -> Tensor:
    """Centre of volume of each colony, (B, d) µm; NaN for a colony without cells."""
    volume = state.volume.double().unsqueeze(1)
    return state.groups.sum(state.position * volume) / state.groups.sum(volume)


@of_a_state
def colony_radius(state: State) -> Tensor:
    """Radius of the disc with the same second moment as the cells, (B,) µm: √2 · RMS distance.

    The distance is from the colony's centre in the x–y plane, and cells count by their volume, in
    both; each as if all of it were in its middle.
    """
    from_centre = (state.position - colony_centre(state).index_select(0, state.colony))[:, :2]
    volume = state.volume.double()
    square = (from_centre * from_centre).sum(1) * volume
    sums = state.groups.sum(torch.stack([square, volume], 1))
    mean = 2.0 * sums[:, 0] / sums[:, 1]
    return torch.where(state.counts == 0, torch.nan, safe_sqrt(mean))


@of_a_state
def aspect_ratio(state: State) -> Tensor:
    """The long over the short axis of each colony as seen from above, (B,) float64: of the ellipse
    with the second moments of the area of its cells, caps included, as programs of image analysis
    have it. 1 for a disc; NaN for a colony without cells. Raises InputError in a space that is
    periodic along x or y."""
    check_flat_space("aspect_ratio", state)
    flat = state.axis[:, :2].double()
    along_floor = safe_norm(flat.T)
    size, along, across = moments_of_capsule(
        state.length.double() * along_floor, state.radius.double()
    )
    # of a cell that stands upright any direction will do
    way = flat / torch.where(along_floor > 0, along_floor, 1.0).unsqueeze(1)
    total = state.groups.sum(size)
    mean = lambda x: state.groups.sum(size * x) / total
    x, y = state.position[:, 0], state.position[:, 1]
    x, y = (v - mean(v).index_select(0, state.colony) for v in (x, y))
    (cos, sin), more = way.unbind(1), along - across
    xx, yy = mean(x * x + across + more * cos * cos), mean(y * y + across + more * sin * sin)
    xy = mean(x * y + more * cos * sin)
    middle, half = 0.5 * (xx + yy), safe_norm(torch.stack([0.5 * (xx - yy), xy]))
    found = safe_sqrt((middle + half) / (middle - half))
    return torch.where(state.counts == 0, torch.nan, found)


@of_a_state
def depth(state: State) -> Tensor:
    """Extent of each colony along z, caps included, (B,) µm; one cell diameter in 2-D, 0 without
    cells."""
    if state.dim == 2:
        return 2.0 * state.groups.max(state.radius)
    half = 0.5 * state.length * state.axis[:, 2].abs() + state.radius
    z = state.position[:, 2]
    return state.groups.max(z + half) + state.groups.max(half - z)


@of_a_state
@torch.no_grad()
def film(
    state: State,
    spacing: float = 1.0,
    *,
    floor: float = 0.0,
    across: Mapping[str, tuple[float, float]] | None = None,
) -> Film:
    """The shape of a biofilm that grows upwards, along y in the plane and along z in space: its
    height above each column of a floor, thickness, roughness and coverage. See `Film`.

    spacing: width of a column, µm, or the next smaller one that divides the floor. floor: its y or
    z, µm. across: from where to where it is measured, µm, such as {"x": (0, 60)}. By default
    between the faces of a periodic space, else over the box of the medium, if it is as wide in all
    colonies.
    """
    spacing = checks.number("film(spacing)", spacing, above=0.0)
    return film_of(state, spacing, checks.number("film(floor)", floor), across)


@of_a_state
@torch.no_grad()
def below_top(
    state: State,
    spacing: float = 1.0,
    *,
    floor: float = 0.0,
    across: Mapping[str, tuple[float, float]] | None = None,
) -> Tensor:
    """How far the centre of each cell lies below the top of the film above it, (N,) float64 µm:
    the highest cell of its column, or its own upper end. NaN for cells that lie beyond `across`.
    The parameters are those of `film`."""
    spacing = checks.number("below_top(spacing)", spacing, above=0.0)
    return below_top_of(state, spacing, checks.number("below_top(floor)", floor), across)


@of_a_state
def outline(state: State) -> Outline:
    """The edge of each colony as seen from above: the ellipse with the second moments of its cells,
    caps included, which count by their volume. `outline.below_edge(places, colony)` is how far
    places lie below it. Raises InputError in a space that is periodic along x or y."""
    return outline_of("outline", state)


@of_a_state
def below_edge(state: State) -> Tensor:
    """How far the centre of each cell lies below the edge of its colony as seen from above, (N,)
    float64 µm: its distance to the nearest point of the `outline`, negative beyond it. In a colony
    that is far from an ellipse, as between walls, an edge by height does: `below_top`. Raises
    InputError in a space that is periodic along x or y."""
    return below_edge_of(state)


@of_a_state
def nematic_order(state: State) -> Tensor:
    """Alignment of the axes of each colony in the x–y plane, (B,): 0 for many random ones, about
    √(π/4n) for n, 1 for parallel; NaN without cells.

    In space it is that of their projections, weighted by cos² of the tilt: a cell that stands
    upright does not count, and where all do it is NaN. `tilt` says how far they stand up."""
    x, y = state.axis[:, 0].double(), state.axis[:, 1].double()
    q = torch.stack([x * x - y * y, 2 * x * y, x * x + y * y], 1)
    total = state.groups.sum(q)
    return safe_sqrt(total[:, 0] ** 2 + total[:, 1] ** 2) / total[:, 2]


@of_a_state
def tilt(state: State) -> Tensor:
    """Angle between each cell's axis and the x–y plane, (N,) rad, 0 … π/2."""
    if state.dim == 2:
        return torch.zeros_like(state.length)
    # not an arc sine, whose slope is infinite where a cell stands upright
    return torch.atan2(state.axis[:, 2].abs(), safe_norm(state.axis[:, :2].T))

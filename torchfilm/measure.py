"""Measures of a state: overlaps, forces on walls, radius, depth, alignment and strains per colony,
pressure on cells, growth rates and neighbour pairs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from torch import Tensor

from torchfilm.contact_forces import bonds_of, pushed_by_cells, pushed_by_walls, softness
from torchfilm.film_shape import Film, below_top_of, film_of
from torchfilm.physics.nearby import gaps_nearby, pairs_within
from torchfilm.physics.surfaces import FlatSurface
from torchfilm.physics.walls import Wall, depth_in_walls
from torchfilm.spatial import binned_mean, checked_edges, kinds_of, pair_correlation, quantity
from torchfilm.state import State
from torchfilm.tools import checks, row_checks
from torchfilm.tools.connected import components
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread
from torchfilm.tools.vectors import safe_norm, safe_sqrt

if TYPE_CHECKING:
    from torchfilm.scene import Scene

F = TypeVar("F", bound=Callable[..., Any])


def of_a_state(function: F) -> F:
    """Let a measure raise InputError for a keyword that it does not take, and for what is no
    state."""

    @checks.known_keywords
    @functools.wraps(function)
    def checked(state: State, *args: Any, **given: Any) -> Any:
        if not isinstance(state, State):
            hint = "Such as the last one of tf.simulate(…), or scene.bind().start()."
            raise checks.input_error(f"{function.__name__}(state)", state, "a tf.State", hint)
        return function(state, *args, **given)

    return cast(F, checked)


@dataclass(frozen=True)
class Overlap:
    """The overlaps in each colony; every field is (B,).

    mean, worst: overlap of the pairs that overlap, µm (0 without such pairs). count: the number of
    such pairs. walls: the worst overlap with a wall, µm.
    """

    mean: Tensor
    worst: Tensor
    count: Tensor
    walls: Tensor


def _check_walls(name: str, walls: object) -> None:
    if not isinstance(walls, (list, tuple)) or not all(isinstance(w, Wall) for w in walls):
        raise checks.input_error(f"{name}(walls)", walls, "a list of walls, such as [tf.Plane(…)]")


@of_a_state
@one_torch_thread()  # or its others wait in a loop while the next step is computed
@torch.no_grad()
def overlaps(state: State, walls: Sequence[Wall] = ()) -> Overlap:
    """Overlaps between cells and with the given walls, in float64.

    An overlap with a wall is measured where the cell is deepest.
    """
    _check_walls("overlaps", walls)
    axis, length, radius = state.axis.double(), state.length.double(), state.radius.double()
    i, _, gap = gaps_nearby(
        state.position, axis, length, radius, state.colony, state.colonies, space=state.space
    )
    depth = -gap
    deep = depth > 0
    pairs = Groups(state.colony.index_select(0, i[deep]), state.colonies)
    count = pairs.counts
    mean = pairs.sum(depth[deep]) / count.clamp(min=1)
    placed = (state.position, axis, length, radius, state.own_colony_id)
    at_walls = depth_in_walls(walls, *placed)
    return Overlap(mean, pairs.max(depth[deep]), count, state.groups.max(at_walls))


@dataclass(frozen=True)
class WallForces:
    """The forces of each colony's cells on walls. force: (B, S) μ·µm²/h, at right angles to each of
    S surfaces, in the order of the walls: a plane and a sphere have one, a Box two for each axis
    (low, high), a Channel its two sides and its ends. facing: for each surface the direction
    towards the cells, as numbers, or None of a sphere."""

    force: Tensor
    facing: tuple[tuple[float | Tensor, ...] | None, ...]


@of_a_state
@torch.no_grad()
def wall_forces(state: State, walls: Sequence[Wall] | Scene) -> WallForces:
    """The forces on walls in the last step, by one-sided contacts.

    A contact pushes with its overlap / (α Δt), on a soft wall with its overlap × stiffness. Divide
    by the length of a wall (2-D) or its area for the pressure, averaged over steps: one step's is
    as exact as its solve. walls: the scene; or the walls of its Mechanics, whose stiffness is not
    drawn. Only with the scene the pull of `tf.Adhesion` to walls counts, a force below 0; that of
    bonds that broke in this step does not. Raises InputError as `pressure` does.
    """
    from torchfilm.scene import Scene  # it imports rooms that measure

    if isinstance(walls, Scene):
        bonds, surfaces = bonds_of(state, walls), walls.wall_surfaces()
    else:
        _check_walls("wall_forces", walls)
        bonds, surfaces = None, [s for wall in walls for s in wall.surfaces(state.dim)]
    soft = softness("wall_forces", state)
    pushes = pushed_by_walls(state, surfaces, soft, bonds)
    assert pushes.surface is not None
    at = state.colony.index_select(0, pushes.cell) * len(surfaces) + pushes.surface
    force = Groups(at, state.colonies * len(surfaces)).sum(pushes.force.unsqueeze(1))
    facing = tuple(s.normal if isinstance(s, FlatSurface) else None for s in surfaces)
    return WallForces(force.view(state.colonies, len(surfaces)), facing)


@of_a_state
@one_torch_thread()
@torch.no_grad()
def pressure(state: State, scene: Scene) -> Tensor:
    """The pressure on each cell in the last step, (N,) float64, by one-sided contacts.

    It is that of the stress in the cell: the sum of force times the distance of the contact from
    the cell's centre along the force, over d times the cell's volume; in a strictly two-dimensional
    scene d = 2 and its area as seen from above, μ·µm/h, else d = 3, μ/h. Cells carry what the gaps
    between them do not: in a full chamber the mean, weighted by size, is the pressure on the walls
    over the share of the chamber that the cells fill. Overlaps give the forces with an error of
    second order in dt, since cells grow and are pushed back within a step: in a full chamber they
    are 3 to 5 % too small at 0.025 h, 0.5 % at 0.00625 h. Adhesion pulls: where it does so more
    than contacts push, the pressure is below 0. Bonds that broke in this step do not count.

    Raises InputError for bilateral contacts, and for a state that is not as a step returned it: it
    lacks the step and the number of sub-steps.
    """
    from torchfilm.scene import Scene  # it imports rooms that measure

    if not isinstance(scene, Scene):
        raise checks.input_error("pressure(scene)", scene, "the tf.Scene of the state")
    soft = softness("pressure", state)
    surfaces = scene.wall_surfaces()
    soft_cells = any(e.soft_contacts for e in scene.effects)
    total = torch.zeros_like(soft)
    bonds = bonds_of(state, scene)
    at_walls = pushed_by_walls(state, surfaces, soft, bonds)
    for pushes in (*pushed_by_cells(state, soft, soft_cells, bonds), at_walls):
        virial = (pushes.force * pushes.arm).unsqueeze(1)
        total = total + Groups(pushes.cell, state.cells).sum(virial).squeeze(1)
    length, radius = state.length.double(), state.radius.double()
    from_above = 2 * radius * length + torch.pi * radius**2
    return total / (2 * from_above if state.dim == 2 else 3 * state.volume.double())


@of_a_state
def growth_rates(state: State, earlier: State) -> Tensor:
    """How fast each cell has grown since an earlier state of the same run, (N,) 1/h: the change of
    ln(volume) over time. NaN for cells born since, which are those that grow: take states a few
    steps apart, or the mean is too low. Pressure makes it less than the field `growth_rate`."""
    known, before = _known_before("growth_rates", state, earlier)
    now, before = state.volume.double()[known], earlier.volume.double()[before]
    rates = torch.full_like(state.volume.detach().double(), torch.nan)
    return rates.index_copy(0, known, (now / before).log() / (state.time - earlier.time))


@of_a_state
def displacement(state: State, earlier: State) -> Tensor:
    """How far each cell's centre has moved since an earlier state of the same run, (N, d) float64
    µm; NaN for cells that were born since. In a periodic space it is the way to the nearest image:
    take states between which no cell goes half of the way between the faces, and add up several."""
    known, before = _known_before("displacement", state, earlier)
    moved = torch.full_like(state.position.detach(), torch.nan)
    way = (state.position[known] - earlier.position[before]).T
    way = way if state.space is None else way + state.space.shift(way)
    return moved.index_copy(0, known, way.T)


def _known_before(measure: str, state: State, earlier: State) -> tuple[Tensor, Tensor]:
    """The cells (M,) that an earlier state of the run has, too, and their places there, (M,).
    Raises InputError for a state that is not earlier."""
    if not isinstance(earlier, State) or not earlier.time < state.time:
        shown = f"a state at {earlier.time:g} h" if isinstance(earlier, State) else earlier
        rule = f"a state of the same run before {state.time:g} h"
        raise checks.input_error(f"{measure}(earlier)", shown, rule)
    key = lambda s: torch.stack([s.own_colony_id, s.uid], 1)
    names, which = torch.unique(torch.cat([key(earlier), key(state)]), dim=0, return_inverse=True)
    place = torch.full((len(names),), -1, device=state.device)
    place[which[: earlier.cells]] = torch.arange(earlier.cells, device=state.device)
    before = place[which[earlier.cells :]]
    known = torch.nonzero(before >= 0).squeeze(1)
    return known, before[known]


@of_a_state
def colony_centre(state: State) -> Tensor:
    """Centre of volume of each colony, (B, d) µm; NaN for a colony without cells."""
    volume = state.volume.double().unsqueeze(1)
    return state.groups.sum(state.position * volume) / state.groups.sum(volume)


@of_a_state
def colony_radius(state: State) -> Tensor:
    """Radius of the disc with the same second moment as the cells, (B,) µm: √2 · RMS distance.

    The distance is from the colony's centre in the x–y plane.
    """
    from_centre = (state.position - colony_centre(state).index_select(0, state.colony))[:, :2]
    square = (from_centre * from_centre).sum(1, keepdim=True)
    mean = 2.0 * state.groups.sum(square).squeeze(1) / state.counts
    return torch.where(state.counts == 0, torch.nan, safe_sqrt(mean))


@of_a_state
def depth(state: State) -> Tensor:
    """Extent of each colony along z, caps included, (B,) µm; one cell diameter in 2-D."""
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
def nematic_order(state: State) -> Tensor:
    """Alignment of the axes of each colony in the x–y plane, (B,): 0 for random, 1 for parallel;
    NaN without cells.

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


@of_a_state
@torch.no_grad()
def strains(
    state: State, name: str = "cell_type", *, kinds: row_checks.Numbers | None = None
) -> dict[int, Tensor]:
    """How many cells of each kind a colony has: (B,) int64 by the values of a field of whole
    numbers, such as the cell type or a neutral label that daughters inherit. kinds: of which to
    tell; None: of all that some colony has, so that one that has died out everywhere is not
    among them."""
    kind = kinds_of("strains", state, name)
    count = lambda k: torch.bincount(state.colony[kind == k], minlength=state.colonies)
    wanted = kind.unique().tolist() if kinds is None else kinds
    return {checks.integer("kinds", k, least=-(2**63)): count(k) for k in wanted}


@of_a_state
@torch.no_grad()
def heterozygosity(
    state: State,
    name: str = "cell_type",
    *,
    edges: row_checks.Numbers | None = None,
    along: str | Tensor = "radius",
) -> Tensor:
    """The probability that two cells drawn at random, with replacement, are of different kinds,
    1 − Σ p², of each colony: (B,) float64. 0 where one kind is fixed; NaN without cells.

    name: as for `strains`. edges: of bins, µm, ascending, R + 1 of them: then it is that of each
    bin, (B, R), NaN in one without cells (as in Hallatschek et al., PNAS 104, 19926, 2007). along:
    as for `profile`, such as "y" for a front that runs along y, or (N,) distances from where the
    colony began."""
    kind = kinds_of("heterozygosity", state, name)
    rings, ring = 1, torch.zeros_like(state.colony)
    if edges is not None:
        limits = checked_edges("heterozygosity", edges)
        place = _place("heterozygosity", state, along).contiguous()
        rings = len(limits) - 1
        ring = torch.bucketize(place, place.new_tensor(limits), right=True) - 1
    inside = (ring >= 0) & (ring < rings)
    bins = (state.colony * rings + ring)[inside]
    count = lambda x: torch.bincount(x, minlength=state.colonies * rings).double()
    total, kept = count(bins), kind[inside]
    squares = torch.zeros_like(total)
    for k in kept.unique().tolist():
        squares += (count(bins[kept == k]) / total) ** 2
    found = torch.where(total > 0, 1.0 - squares, torch.nan).reshape(state.colonies, rings)
    return found[:, 0] if edges is None else found


@of_a_state
def profile(
    state: State, name: str | Tensor, edges: row_checks.Numbers, *, along: str | Tensor = "x"
) -> Tensor:
    """The mean of a quantity over the cells of each colony in bins along a coordinate, (B, K)
    float64; NaN in a bin without cells.

    name: a field of the cells, a signal at them as "out.NAME", or numbers, (N,). edges: of the
    bins, K + 1 of them, µm, ascending. along: "x", "y", "z", "radius" from the colony's centre (of
    volume) in the x–y plane, "top" as `below_top` has it, or a coordinate of your own, (N,)."""
    value, limits = quantity("profile", state, name), checked_edges("profile", edges)
    return binned_mean(state.groups, value, _place("profile", state, along), limits)


def _place(measure: str, state: State, along: str | Tensor) -> Tensor:
    """The coordinate of each cell, (N,) µm, as `profile` has it."""
    if isinstance(along, Tensor):
        return quantity(measure, state, along)
    checks.choice(f"{measure}(along)", along, (*"xyz"[: state.dim], "radius", "top"))
    if along != "radius":
        return below_top(state) if along == "top" else state.position[:, "xyz".index(along)]
    apart = state.position - colony_centre(state).index_select(0, state.colony)
    return safe_norm(apart[:, :2].double().T)


@of_a_state
@torch.no_grad()
def correlation(state: State, name: str | Tensor, edges: row_checks.Numbers) -> Tensor:
    """How alike a quantity y is in two cells of a colony by the distance of their centres, (B, K)
    float64: the mean of (yᵢ − ȳ)(yⱼ − ȳ) over the pairs in each bin of distances, over the variance
    of y. 1 for pairs as alike as a cell is itself, 0 where nothing is shared (−1/(n − 1) of n
    cells); its first maximum beyond 0 is the wavelength of patterns. NaN without pairs or variance.

    name: as for `profile`. edges: of the bins, K + 1 of them, µm, ascending from 0 or more. In a
    periodic space distances are those to the nearest image."""
    value = quantity("correlation", state, name)
    return pair_correlation(state, value, checked_edges("correlation", edges, 0.0))


@of_a_state
@one_torch_thread()
@torch.no_grad()
def neighbours(state: State, gap: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of cells of one colony whose surfaces are at most `gap` µm apart, each pair once.

    Returns first and second, (P,) int64, and the distance of their centres, (P,) float64 µm. A
    colony's pairs and their order do not depend on the rest of the batch. In a periodic space cells
    at opposite faces are neighbours, too.
    """
    checks.number("neighbours(gap)", gap, least=0.0)
    cells = state.position, state.axis, state.length, state.radius
    i, j = pairs_within(*cells, state.groups, gap, state.space)
    between = (state.position.index_select(0, j) - state.position.index_select(0, i)).T
    if state.space is not None:
        between = between + state.space.shift(between)
    return i, j, safe_norm(between)


@of_a_state
@torch.no_grad()
def clusters(state: State, gap: float, name: str | None = None) -> Tensor:
    """Which cluster each cell belongs to, (N,) int64: cells hang together where their surfaces are
    less than `gap` µm apart. Clusters are numbered from 0 in each colony, the largest first, and of
    equal ones that with the first cell.

    name: a field of whole numbers, as for `strains`: then only cells of one kind hang together.
    """
    first, second, _ = neighbours(state, gap)
    if name is not None:
        kind = kinds_of("clusters", state, name)
        alike = kind[first] == kind[second]
        first, second = first[alike], second[alike]
    of = components(first, second, state.cells)
    sizes = torch.bincount(of)
    # their first cells: of several writes to one place torch keeps any, of a minimum the least
    number = torch.arange(state.cells, device=state.device)
    begin = number.new_full((len(sizes),), state.cells).scatter_reduce(0, of, number, "amin")
    order = torch.argsort(begin, stable=True)
    order = order[torch.argsort(sizes[order], descending=True, stable=True)]
    order = order[torch.argsort(state.colony[begin[order]], stable=True)]
    colony = state.colony[begin[order]]
    place = torch.arange(len(order), device=state.device)
    rank = torch.empty_like(place)
    rank[order] = place - torch.searchsorted(colony, colony)
    return rank[of]


@of_a_state
@torch.no_grad()
def alike_neighbours(state: State, gap: float, name: str = "cell_type") -> Tensor:
    """The share of a colony's pairs of neighbours, at most `gap` µm apart, that are of one kind:
    (B,) float64, NaN without pairs. Kinds of one size that are well mixed come to 1 −
    `heterozygosity`, but for 1/N, and kinds that have sorted to nearly 1; large cells beside small
    ones have more neighbours each. name: a field of whole numbers, as for `strains`.
    """
    kind = kinds_of("alike_neighbours", state, name)
    first, second, _ = neighbours(state, gap)
    where = state.colony[first]
    count = lambda x: torch.bincount(x, minlength=state.colonies).double()
    return count(where[kind[first] == kind[second]]) / count(where)

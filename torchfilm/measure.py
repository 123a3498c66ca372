"""Measures of a state: overlaps, forces on walls, radius, depth, alignment and strains per colony,
pressure on cells, growth rates and neighbour pairs."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from torch import Tensor

from torchfilm.physics.adhesion import Bonds, levels_of
from torchfilm.physics.contacts import CandidateContacts, Capsules, gaps_nearby
from torchfilm.physics.near_rows import near_rows
from torchfilm.physics.surfaces import FlatSurface
from torchfilm.physics.wall_contacts import find_wall_contacts
from torchfilm.physics.walls import Wall, depth_in_walls
from torchfilm.state import CELL, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread
from torchfilm.tools.vectors import cross, safe_norm
from torchfilm.values import ByType, PerColony, Rule, checked, is_drawn

if TYPE_CHECKING:
    from torchfilm.scene import Scene

END_ON = 1e-4  # squared sine of the angle between a cell and a force on its end

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
    i, _, gap = gaps_nearby(state.position, axis, length, radius, state.colony, state.colonies)
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
def wall_forces(state: State, walls: Sequence[Wall], dt: float) -> WallForces:
    """The forces on walls in the last step, of dt hours, by one-sided contacts.

    A contact pushes with its overlap / (α Δt), on a soft wall with its overlap × stiffness. Divide
    by the length of a wall (2-D) or its area for the pressure, averaged over steps: one step's is
    as exact as its solve. walls: those of the scene's Mechanics, whose stiffness is not drawn.
    """
    _check_walls("wall_forces", walls)
    soft = _softness("wall_forces", state, checks.number("wall_forces(dt)", dt, above=0.0))
    surfaces = [s for wall in walls for s in wall.surfaces(state.dim)]
    pushes = _pushed_by_walls(state, surfaces, soft)
    assert pushes.surface is not None
    at = state.colony.index_select(0, pushes.cell) * len(surfaces) + pushes.surface
    force = Groups(at, state.colonies * len(surfaces)).sum(pushes.force.unsqueeze(1))
    facing = tuple(s.normal if isinstance(s, FlatSurface) else None for s in surfaces)
    return WallForces(force.view(state.colonies, len(surfaces)), facing)


def _softness(measure: str, state: State, dt: float) -> Tensor:
    """α Δt of each cell's contacts in a step of dt hours, or in its sub-steps, (N,): a contact
    pushes with its overlap over this."""
    if "contact_alpha" not in state.fields:
        raise checks.InputError(
            f"{measure}: the state has no contact_alpha, the softness of one-sided contacts:"
            " simulate with tf.Mechanics(contacts='one-sided'), the default."
        )
    report: Any = state.reports.get("mechanics")
    if report is None:
        raise checks.InputError(
            f"{measure}: the state does not say in how many sub-steps its contacts were solved."
            " Give it as a step returns it: not a first one, nor one from a file or by select."
        )
    steps = state.groups.spread(report.substeps.clamp(min=1))
    return state.contact_alpha.double() * dt / steps


@dataclass(frozen=True)
class _Pushes:
    """Forces on cells at contacts. cell: (K,) whom each pushes. force: (K,) μ·µm²/h. arm: (K,) µm,
    how far the contact is from the cell's centre, along the force. surface: (K,) of which wall, or
    None of pushes between cells."""

    cell: Tensor
    force: Tensor
    arm: Tensor
    surface: Tensor | None = None


def _pushed_by_walls(state: State, surfaces: Sequence[Any], soft: Tensor) -> _Pushes:
    """soft: as `_softness` says, (N,)."""
    if not surfaces:
        none = state.uid.new_empty(0)
        return _Pushes(none, soft.new_empty(0), soft.new_empty(0), none)
    length, radius = state.length.double(), state.radius.double()
    placed = state.position, state.axis.double(), length, radius
    rows = find_wall_contacts(surfaces, *placed, state.own_colony_id)
    # D² / (α Δt) of each cell at each surface: a stiffness
    hold = torch.stack([_held(s.wall, soft, state) for s in surfaces])
    root = rows.row[:, : state.dim].norm(dim=1)
    force = root * -rows.gap * hold[rows.surface, rows.cell]
    arm = radius[rows.cell] + (length[rows.cell] * rows.row[:, -1] + rows.gap) / root
    return _Pushes(rows.cell, force, arm, rows.surface)


@of_a_state
@one_torch_thread()
@torch.no_grad()
def pressure(state: State, scene: Scene, dt: float | None = None) -> Tensor:
    """The pressure on each cell in the last step, (N,) float64, by one-sided contacts.

    It is that of the stress in the cell: the sum of force times the distance of the contact from
    the cell's centre along the force, over d times the cell's volume; in a strictly two-dimensional
    scene d = 2 and its area as seen from above, μ·µm/h, else d = 3, μ/h. Cells carry what the gaps
    between them do not: in a full chamber the mean, weighted by size, is the pressure on the walls
    over the share of the chamber that the cells fill. Overlaps give the forces with an error of
    second order in dt: in a full chamber, where cells still shift, 5 % at 0.025 h, 0.5 % at
    0.00625 h. Adhesion pulls: where it does so more than contacts push, the pressure is below 0.
    dt: of the last step, h; by default that of the scene.

    Raises InputError for bilateral contacts, and for a state that is not as a step returned it: it
    lacks the number of sub-steps.
    """
    from torchfilm.scene import Scene  # it imports rooms that measure

    if not isinstance(scene, Scene):
        raise checks.input_error("pressure(scene)", scene, "the tf.Scene of the state")
    dt = checks.number("pressure(dt)", scene.dt if dt is None else dt, above=0.0)
    soft = _softness("pressure", state, dt)
    surfaces = [s for e in scene.effects for s in e.wall_surfaces()]
    soft_cells = any(e.soft_contacts for e in scene.effects)
    total = torch.zeros_like(soft)
    at_walls = _pushed_by_walls(state, surfaces, soft)
    bonds = _bonds(state, scene)
    for pushes in (*_pushed_by_cells(state, soft, soft_cells, bonds), at_walls):
        virial = (pushes.force * pushes.arm).unsqueeze(1)
        total = total + Groups(pushes.cell, state.cells).sum(virial).squeeze(1)
    length, radius = state.length.double(), state.radius.double()
    from_above = 2 * radius * length + torch.pi * radius**2
    return total / (2 * from_above if state.dim == 2 else 3 * state.volume.double())


def _pushed_by_cells(
    state: State, soft: Tensor, soft_cells: bool, bonds: Bonds | None
) -> tuple[_Pushes, _Pushes]:
    """The pushes of a contact on its first cell and on its second, below 0 where they pull. soft:
    as `_softness` says, (N,)."""
    axis, length, radius = state.axis.double(), state.length.double(), state.radius.double()
    apart = 0.0 if bonds is None else max(bonds.reaches)
    first, second, gap = gaps_nearby(
        state.position, axis, length, radius, state.colony, state.colonies, apart
    )
    near = torch.nonzero(gap < apart).squeeze(1)
    first, second = first.index_select(0, near), second.index_select(0, near)
    start = state.position.index_select(0, state.groups.begin[:-1].index_select(0, state.colony))
    capsules = Capsules((state.position - start).T, axis.T, 0.5 * length, radius)
    margin = None if soft_cells else torch.zeros_like(gap.index_select(0, near))
    rows = near_rows(CandidateContacts.all_of(capsules, first, second), margin)
    force = rows.weight * (-rows.gap).clamp(min=0) / soft.index_select(0, rows.first)
    if bonds is not None:
        stiffness = bonds.stiffness(rows.first, rows.second, rows.gap)
        force = force - rows.weight * stiffness * rows.gap.clamp(min=0)

    def on(cell: Tensor, row: Tensor) -> _Pushes:
        normal, turn = row[:, : state.dim], row[:, state.dim : -1]
        own = axis.index_select(0, cell)
        # the turn is the arc length of the contact times this
        across = cross(own.T, normal.T).T
        square = across.square().sum(1)
        along = (own * normal).sum(1) * (turn * across).sum(1) / square.clamp(min=1e-9)
        # the end of a cell that is met head on
        along = torch.where(square < END_ON, length[cell] * row[:, -1], along)
        return _Pushes(cell, force, radius[cell] + along + 0.5 * rows.gap)

    return on(rows.first, rows.row_first), on(rows.second, rows.row_second)


def _bonds(state: State, scene: Scene) -> Bonds | None:
    """What holds the cells together as they now are."""
    from torchfilm.effects.mechanics import Mechanics  # it imports rooms that measure

    for effect in scene.effects:
        if isinstance(effect, Mechanics) and effect.adhesion:
            names = [f"adhesion[{k}].strength" for k in range(len(effect.adhesion))]
            values, drawn = effect.physical_values(), effect.kept_values()
            strengths = [
                state.fields[drawn[n].name] if n in drawn else _of_cells(values[n][0], state)
                for n in names
            ]
            levels = levels_of(effect.adhesion, strengths, state.fields, state.cells)
            cells = state.position.T, state.axis.double().T, 0.5 * state.length.double()
            begin = Capsules(*cells, state.radius.double())
            return Bonds(levels, tuple(kind.reach for kind in effect.adhesion), begin)
    return None


def _of_cells(value: Any, state: State) -> Tensor:
    """A value that is not drawn, one number, one for each colony or cell type, of each cell."""
    if isinstance(value, ByType):
        own = torch.zeros_like(state.length, dtype=torch.float64)
        for kind, of_kind in value.values.items():
            own = torch.where(state.cell_type == kind, _of_cells(of_kind, state), own)
        return own
    given = value.values if isinstance(value, PerColony) else value
    each = torch.as_tensor(given, dtype=torch.float64, device=state.device)
    own = each.index_select(0, state.own_colony_id) if each.dim() else each
    return own.expand(state.cells)


def _held(wall: Wall, soft: Tensor, state: State) -> Tensor:
    given = wall.weight if wall.stiffness is None else wall.stiffness
    if given is None:
        return 1.0 / soft
    name = f"{type(wall).__name__}.{'weight' if wall.stiffness is None else 'stiffness'}"
    if is_drawn(given := checked(name, given, Rule(above=0.0))):
        rule = "one number or one for each colony or cell type, to measure forces"
        raise checks.input_error(name, given, rule)
    own = _of_cells(given, state)
    return own if wall.stiffness is not None else own * own / soft


@of_a_state
@torch.no_grad()
def growth_rates(state: State, earlier: State) -> Tensor:
    """How fast each cell has grown since an earlier state of the same run, (N,) 1/h: the change of
    ln(volume) over time. NaN for cells that were born since. Pressure makes it less than the field
    `growth_rate`, which is the rate without it."""
    if not isinstance(earlier, State) or not earlier.time < state.time:
        shown = f"a state at {earlier.time:g} h" if isinstance(earlier, State) else earlier
        rule = f"a state of the same run before {state.time:g} h"
        raise checks.input_error("growth_rates(earlier)", shown, rule)
    key = lambda s: torch.stack([s.own_colony_id, s.uid], 1)
    both = torch.cat([key(earlier), key(state)])
    _, which = torch.unique(both, dim=0, return_inverse=True)
    before = torch.full((int(which.max()) + 1,) if len(which) else (0,), torch.nan).double()
    before = before.to(state.device)
    before[which[: earlier.cells]] = earlier.volume.double()
    now = state.volume.double()
    return (now / before[which[earlier.cells :]]).log() / (state.time - earlier.time)


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
    return (2.0 * state.groups.sum(square).squeeze(1) / state.counts).sqrt()


@of_a_state
@torch.no_grad()
def depth(state: State) -> Tensor:
    """Extent of each colony along z, caps included, (B,) µm; one cell diameter in 2-D."""
    if state.dim == 2:
        return 2.0 * state.groups.max(state.radius)
    half = 0.5 * state.length * state.axis[:, 2].abs() + state.radius
    z = state.position[:, 2]
    return state.groups.max(z + half) + state.groups.max(half - z)


@of_a_state
@torch.no_grad()
def nematic_order(state: State) -> Tensor:
    """Alignment of the axes of each colony in the x–y plane, (B,): 0 for random, 1 for parallel;
    NaN without cells.

    In space it is that of their projections, weighted by cos² of the tilt: a cell that stands
    upright does not count, and where all do it is NaN. `tilt` says how far they stand up."""
    x, y = state.axis[:, 0].double(), state.axis[:, 1].double()
    q = torch.stack([x * x - y * y, 2 * x * y, x * x + y * y], 1)
    total = state.groups.sum(q)
    return (total[:, 0] ** 2 + total[:, 1] ** 2).sqrt() / total[:, 2]


@of_a_state
@torch.no_grad()
def tilt(state: State) -> Tensor:
    """Angle between each cell's axis and the x–y plane, (N,) rad, 0 … π/2."""
    if state.dim == 2:
        return torch.zeros_like(state.length)
    return torch.asin(state.axis[:, 2].abs().clamp(max=1))


@of_a_state
@torch.no_grad()
def strains(
    state: State, name: str = "cell_type", *, kinds: Sequence[int] | None = None
) -> dict[int, Tensor]:
    """How many cells of each kind a colony has: (B,) int64 by the values of a field of whole
    numbers, such as the cell type or a neutral label that daughters inherit. kinds: of which to
    tell; None: of all that some colony has, so that one that has died out everywhere is not
    among them."""
    kind = _kinds("strains", state, name)
    count = lambda k: torch.bincount(state.colony[kind == k], minlength=state.colonies)
    wanted = kind.unique().tolist() if kinds is None else kinds
    return {checks.integer("kinds", k, least=-(2**63)): count(k) for k in wanted}


@of_a_state
@torch.no_grad()
def heterozygosity(
    state: State, name: str = "cell_type", *, edges: Sequence[float] | None = None
) -> Tensor:
    """The probability that two cells drawn at random, with replacement, are of different kinds,
    1 − Σ p², of each colony: (B,) float64. 0 where one kind is fixed; NaN without cells.

    name: as for `strains`. edges: of rings around the colony's centre, µm, ascending, R + 1 of
    them: then it is that of each ring, (B, R), NaN in a ring without cells, as in range expansions
    (Hallatschek et al., PNAS 104, 19926, 2007)."""
    kind = _kinds("heterozygosity", state, name)
    rings, ring = 1, torch.zeros_like(state.colony)
    if edges is not None:
        limits = [checks.number("edges", e, least=0.0) for e in edges]
        if len(limits) < 2 or any(b <= a for a, b in itertools.pairwise(limits)):
            raise checks.input_error("edges", list(edges), "two radii or more, µm, ascending")
        apart = state.position - colony_centre(state).index_select(0, state.colony)
        radius = safe_norm(apart[:, :2].double().T)
        rings = len(limits) - 1
        ring = torch.bucketize(radius, radius.new_tensor(limits), right=True) - 1
    inside = (ring >= 0) & (ring < rings)
    place = (state.colony * rings + ring)[inside]
    count = lambda x: torch.bincount(x, minlength=state.colonies * rings).double()
    total, kept = count(place), kind[inside]
    squares = torch.zeros_like(total)
    for k in kept.unique().tolist():
        squares += (count(place[kept == k]) / total) ** 2
    found = torch.where(total > 0, 1.0 - squares, torch.nan).reshape(state.colonies, rings)
    return found[:, 0] if edges is None else found


def _kinds(measure: str, state: State, name: object) -> Tensor:
    """A field of whole numbers of the cells, (N,) int64. Raises InputError for other fields."""
    known = [n for n, f in state.declared.items() if f.scope == CELL and not f.internal]
    if not isinstance(name, str) or name not in known:
        hint = (
            "" if name != "cell_type" else "Give the first cells a type: Cells(…, cell_type=[0])."
        )
        raise checks.input_error(f"{measure}(name)", name, f"a field of the cells: {known}", hint)
    value = state.fields[name]
    if value.dim() != 1 or not bool((value == value.round()).all()):
        raise checks.input_error(f"{measure}(name)", name, "a field of one whole number for a cell")
    return value.long()


@of_a_state
@one_torch_thread()
@torch.no_grad()
def neighbours(state: State, gap: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of cells of one colony whose surfaces are less than `gap` µm apart, each pair once.

    Returns first and second, (P,) int64, and the distance of their centres, (P,) float64 µm. A
    colony's pairs and their order do not depend on the rest of the batch.
    """
    checks.number("neighbours(gap)", gap, least=0.0)
    i, j, apart = gaps_nearby(
        state.position,
        state.axis,
        state.length,
        state.radius,
        state.colony,
        state.colonies,
        within=gap,
    )
    near = torch.nonzero(apart < gap).squeeze(1)
    i, j = i.index_select(0, near), j.index_select(0, near)
    between = state.position.index_select(0, j) - state.position.index_select(0, i)
    return i, j, safe_norm(between.T)

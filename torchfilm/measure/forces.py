"""Overlaps, forces on walls, and pressure on cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.contact_forces import acted_on, bonds_of, kept_by, pushed_by_cells, pushed_by_walls
from torchfilm.measure.of_a_state import of_a_state
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.physics.surfaces import FlatSurface
from torchfilm.physics.walls import Wall, depth_in_walls
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread

if TYPE_CHECKING:
    from torchfilm.scene import Scene


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
    (low, high), a Channel those of its ends that are closed, then its sides. facing: the direction
    from each surface to the cells, as numbers, or None of a sphere."""

    force: Tensor
    facing: tuple[tuple[float | Tensor, ...] | None, ...]


@of_a_state
@torch.no_grad()
def wall_forces(state: State, walls: Sequence[Wall] | Scene) -> WallForces:
    """The forces on walls in the last step, by one-sided contacts, of cells as they were before
    some divided, burst or left at its end.

    A contact pushes with its overlap / (α Δt), on a soft wall with its overlap × stiffness. Divide
    by the length of a wall (2-D) or its area for the pressure, averaged over steps: one step's is
    as exact as its solve. walls: the scene; or the walls of its Mechanics, whose stiffness is not
    drawn. Only with the scene the pull of `tf.Adhesion` to walls counts, a force below 0; that of
    bonds that broke in this step does not. Raises InputError as `pressure` does.
    """
    from torchfilm.scene import Scene  # it imports rooms that measure

    if not isinstance(walls, Scene):
        _check_walls("wall_forces", walls)
    left, soft = acted_on("wall_forces", state)
    if isinstance(walls, Scene):
        bonds, surfaces = bonds_of(left, walls), walls.wall_surfaces()
    else:
        bonds, surfaces = None, [s for wall in walls for s in wall.surfaces(state.dim)]
    pushes = pushed_by_walls(left, surfaces, soft, bonds)
    assert pushes.surface is not None
    at = left.colony.index_select(0, pushes.cell) * len(surfaces) + pushes.surface
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
    over the share of the chamber that the cells fill. Overlaps give the forces with an error that
    falls with dt, since cells grow, are pushed back and slide past one another within a step: in a
    full chamber they are 3 to 5 % too small at 0.025 h, 0.5 % at 0.00625 h; in a colony that
    expands 10 to 16 % and 2 to 5 %. A cell that was born in this step has its mother's, on which
    the forces acted; one that was added since, NaN. Adhesion pulls: where it does so more than
    contacts push, the pressure is below 0. Bonds that broke in this step do not count.

    Raises InputError for bilateral contacts, and for a state that is not as a step returned it: it
    lacks the step and the number of sub-steps.
    """
    from torchfilm.scene import Scene  # it imports rooms that measure

    if not isinstance(scene, Scene):
        raise checks.input_error("pressure(scene)", scene, "the tf.Scene of the state")
    left, soft = acted_on("pressure", state)
    surfaces = scene.wall_surfaces()
    soft_cells = any(e.soft_contacts for e in scene.effects)
    total = torch.zeros_like(soft)
    bonds = bonds_of(left, scene)
    at_walls = pushed_by_walls(left, surfaces, soft, bonds)
    for pushes in (*pushed_by_cells(left, soft, soft_cells, bonds), at_walls):
        virial = (pushes.force * pushes.arm).unsqueeze(1)
        total = total + Groups(pushes.cell, left.cells).sum(virial).squeeze(1)
    length, radius = left.length.double(), left.radius.double()
    from_above = 2 * radius * length + torch.pi * radius**2
    found = total / (2 * from_above if state.dim == 2 else 3 * left.volume.double())
    return kept_by(state, left, found)

"""The forces on cells at one-sided contacts with other cells and with walls, in the last step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.physics.adhesion import Bonds, holds_of, levels_of
from torchfilm.physics.contacts import CandidateContacts, Capsules
from torchfilm.physics.near_rows import near_rows
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.physics.wall_contacts import find_wall_contacts
from torchfilm.physics.walls import Wall
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.vectors import cross
from torchfilm.values import ByType, PerColony, Rule, checked, is_drawn

if TYPE_CHECKING:
    from torchfilm.scene import Scene

END_ON = 1e-4  # squared sine of the angle between a cell and a force on its end


def acted_on(measure: str, state: State) -> tuple[State, Tensor]:
    """The cells on which the contacts of the last step acted, as these left them, and α Δt of each
    one's contacts in the step, or in its sub-steps, (N,): a contact pushes with its overlap over
    this."""
    if "contact_alpha" not in state.fields:
        raise checks.InputError(
            f"{measure}: the state has no contact_alpha, the softness of one-sided contacts:"
            " simulate with tf.Mechanics(contacts='one-sided'), the default."
        )
    report: Any = state.reports.get("mechanics")
    if report is None:
        raise checks.InputError(
            f"{measure}: the state does not say in which steps its contacts were solved."
            " Give it as a step returns it: not a first one, nor one from a file or by select."
        )
    left: State = report.left
    steps, solved = (left.groups.spread(x) for x in (report.substeps.clamp(min=1), report.alpha))
    # the field is for the next step, which follows the force; where α is given it is that
    alpha = torch.where(solved > 0, solved, left.contact_alpha.double())
    return left, alpha * report.dt / steps


def kept_by(now: State, then: State, values: Tensor) -> Tensor:
    """What cells had earlier in a step, (M,), as its last cells have it, (N,): a daughter has her
    mother's, and a cell that was added since, NaN."""
    size = 1 + int(torch.cat([then.uid, now.uid, now.parent]).max()) if then.cells else 1
    key = lambda uid: now.colony * size + uid.clamp(min=0)
    known, order = (then.colony * size + then.uid).sort()
    out = torch.full_like(now.length, torch.nan, dtype=values.dtype)
    for uid in (now.parent, now.uid) if then.cells else ():
        at = torch.searchsorted(known, key(uid)).clamp(max=len(known) - 1)
        there = (known.index_select(0, at) == key(uid)) & (uid >= 0)
        out = torch.where(there, values.index_select(0, order.index_select(0, at)), out)
    return out


@dataclass(frozen=True)
class Pushes:
    """Forces on cells at contacts. cell: (K,) whom each pushes. force: (K,) μ·µm²/h. arm: (K,) µm,
    how far the contact is from the cell's centre, along the force. surface: (K,) of which wall, or
    None of pushes between cells."""

    cell: Tensor
    force: Tensor
    arm: Tensor
    surface: Tensor | None = None


def pushed_by_walls(
    state: State, surfaces: Sequence[Any], soft: Tensor, bonds: Bonds | None
) -> Pushes:
    """The pushes of walls on cells, below 0 where they pull. soft: as `acted_on` says, (N,)."""
    if not surfaces:
        none = state.uid.new_empty(0)
        return Pushes(none, soft.new_empty(0), soft.new_empty(0), none)
    length, radius = state.length.double(), state.radius.double()
    placed = state.position, state.axis.double(), length, radius
    apart = 0.0 if bonds is None else max(bonds.reaches)
    reach = torch.full_like(radius, apart)
    rows = find_wall_contacts(surfaces, *placed, state.own_colony_id, reach=reach)
    # D² / (α Δt) of each cell at each surface: a stiffness
    hold = torch.stack([_held(s.wall, soft, state) for s in surfaces])
    root = rows.row[:, : state.dim].norm(dim=1)
    force = root * (-rows.gap).clamp(min=0) * hold[rows.surface, rows.cell]
    if bonds is not None:
        stiffness = bonds.wall_stiffness(rows, rows.gap / root)
        force = force - root * rows.gap.clamp(min=0) * stiffness
    arm = radius[rows.cell] + (length[rows.cell] * rows.row[:, -1] + rows.gap) / root
    return Pushes(rows.cell, force, arm, rows.surface)


def pushed_by_cells(
    state: State, soft: Tensor, soft_cells: bool, bonds: Bonds | None
) -> tuple[Pushes, Pushes]:
    """The pushes of a contact on its first cell and on its second, below 0 where they pull. soft:
    as `acted_on` says, (N,)."""
    axis, length, radius = state.axis.double(), state.length.double(), state.radius.double()
    apart = 0.0 if bonds is None else max(bonds.reaches)
    first, second, gap = gaps_nearby(
        state.position, axis, length, radius, state.colony, state.colonies, apart, state.space
    )
    near = torch.nonzero(gap < apart).squeeze(1)
    first, second = first.index_select(0, near), second.index_select(0, near)
    start = state.position.index_select(0, state.groups.begin[:-1].index_select(0, state.colony))
    capsules = Capsules((state.position - start).T, axis.T, 0.5 * length, radius, state.space)
    margin = None if soft_cells else torch.zeros_like(gap.index_select(0, near))
    rows = near_rows(CandidateContacts.all_of(capsules, first, second), margin)
    force = rows.weight * (-rows.gap).clamp(min=0) / soft.index_select(0, rows.first)
    if bonds is not None:
        stiffness = bonds.stiffness(rows.first, rows.second, rows.gap)
        force = force - rows.weight * stiffness * rows.gap.clamp(min=0)

    def on(cell: Tensor, row: Tensor) -> Pushes:
        normal, turn = row[:, : state.dim], row[:, state.dim : -1]
        own = axis.index_select(0, cell)
        # the turn is the arc length of the contact times this
        across = cross(own.T, normal.T).T
        square = across.square().sum(1)
        along = (own * normal).sum(1) * (turn * across).sum(1) / square.clamp(min=1e-9)
        # the end of a cell that is met head on
        along = torch.where(square < END_ON, length[cell] * row[:, -1], along)
        return Pushes(cell, force, radius[cell] + along + 0.5 * rows.gap)

    return on(rows.first, rows.row_first), on(rows.second, rows.row_second)


def bonds_of(state: State, scene: Scene) -> Bonds | None:
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
            begin = Capsules(*cells, state.radius.double(), state.space)
            holds = holds_of(effect.adhesion, effect.walls, effect.dim)
            return Bonds(levels, tuple(kind.reach for kind in effect.adhesion), begin, holds)
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

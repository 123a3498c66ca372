"""One step of contact mechanics: find what touches, assemble rows, solve, move; then the same for
what is still too deep.

| paper                                 | here                                           |
|---------------------------------------|------------------------------------------------|
| growth, then displacement (eq. 1–4)   | `contact_step`: one sub-step of all cells      |
| contacts and their Jacobian           | `find_contacts`, `assemble`                    |
| (JᵀD²J + αM) x = JᵀD² g               | `torchfilm.physics.solve_contacts`             |
| Δc, Δθ, Δl carried out                | `move_cells`                                   |

All functions take tensors and return tensors; nothing here knows of a state.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import PENALTY, TOLERANCE
from torchfilm.kernels.scheme import MAX_TURN
from torchfilm.physics import capsule
from torchfilm.physics.contact_records import CellProperties, ContactReport, Moved
from torchfilm.physics.contact_search import (
    find_contacts,
    note_deeply_overlapping,
    unresolved_contacts,
    wall_weights,
)
from torchfilm.physics.contacts import CandidateContacts, Contacts, contacts_of
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.physics.problem import NOT_FINITE, ContactProblem, SolveReport
from torchfilm.physics.solve import solve_contacts
from torchfilm.physics.wall_contacts import WallContacts, poses_along, reach_of, share_to_wall
from torchfilm.tools.reads import known_rows_where, numbers, rows_where
from torchfilm.tools.vectors import safe_sqrt


def contact_step(
    cells: CellProperties,
    at: Moved,
    report: ContactReport,
    growth: Tensor,
    active: Tensor,
    passes: Tensor,
) -> tuple[Moved, ContactReport]:
    """Grow by `growth` (N,) µm and part what overlaps, in up to `passes` (B,) passes, in the active
    colonies (B,) bool.

    at.length: before growth. A cell may give up growth to pressure, but never becomes shorter than
    before.
    """
    base, rigid = at.length, growth.detach() <= 0
    moving = active.index_select(0, cells.colony)
    most, count = numbers((passes * active).max(), moving.sum())
    which = rows = known_rows_where(moving, count)
    at = replace(at, length=torch.where(moving, base + growth, base))
    pairs: CandidateContacts | None = None
    for number in range(most):
        active = active & (number < passes)
        include_near = cells.settings.sees_near[number > 0]
        if pairs is None:
            pairs, walls = find_contacts(cells, at, rows, include_near)
            report = note_deeply_overlapping(cells, pairs, report, active)
        else:
            pairs, walls, moving = unresolved_contacts(cells, at, active, rows, pairs)
            active = cells.groups.any(moving)
            which, rows = rows_where(moving, active.index_select(0, cells.colony))
            if not which.numel():
                break
        contacts = contacts_of(pairs, include_near)
        problem = assemble(cells, at, contacts, walls, base, rigid, number == 0)
        start = cells.start if number == 0 else None
        move, solved = solve_among(cells, problem, moving, which, start)
        at = move_cells(cells, at, move, base, moving, solved)
        clipped = cells.groups.sum(at.clipped.to(base.dtype)).long()
        report = report.with_solve(solved, clipped, active)
        if number == 0:
            first = torch.where(moving.unsqueeze(1), move.detach(), at.first_move)
            at = replace(at, first_move=first)
    return at, report


# --- assemble, solve ------------------------------------------------------------------------------


def assemble(
    cells: CellProperties,
    at: Moved,
    contacts: Contacts,
    walls: WallContacts,
    base: Tensor,
    rigid: Tensor,
    first_pass: bool,
) -> ContactProblem:
    """The linear problem of one pass: rows D J M^(−½), gaps D g, and what limits each length."""
    settings = cells.settings
    across, turning, _ = capsule.drag(at.length, cells.radius, cells.viscosity)
    turns = settings.degrees - settings.dim - 1
    drag = [across] * settings.dim + [turning] * turns + [cells.length_drag.expand(base.shape[0])]
    scale = torch.stack(drag, 1).rsqrt()
    root = contacts.weight.sqrt().unsqueeze(1)
    wall_root, wall_soft = wall_weights(cells, walls)
    rows = ContactJacobian(
        contacts.first,
        contacts.second,
        contacts.row_first * scale.index_select(0, contacts.first) * root,
        contacts.row_second * scale.index_select(0, contacts.second) * root,
        walls.cell,
        walls.row * scale.index_select(0, walls.cell) * wall_root.unsqueeze(1),
        base.shape[0],
    )
    gap = torch.cat([contacts.gap * root.squeeze(1), walls.gap * wall_root])
    # A soft row's force acts once a step: later passes only correct it. Hard rows are numerics,
    # each pass a closer limit.
    soft = torch.cat([torch.full_like(contacts.first, settings.soft, dtype=torch.bool), wall_soft])
    applied = torch.zeros_like(gap) if first_pass else torch.where(soft, gap.clamp(max=0), 0.0)
    lower = (base - at.length) / scale[:, -1]
    alpha = cells.alpha.unsqueeze(1).expand_as(scale).contiguous()
    return ContactProblem(rows, gap, applied, alpha, lower, scale, rigid, cells.groups)


def solve_among(
    cells: CellProperties,
    problem: ContactProblem,
    moving: Tensor,
    which: Tensor,
    start: Tensor | None,
) -> tuple[Tensor, SolveReport]:
    """The move of the cells that are moving, (N,) bool and their places, as (N, D), while the
    others stay where they are."""
    tolerance, most = _tolerance(cells), cells.settings.max_iterations
    ids = cells.groups.max(cells.colony_ids)
    if which.numel() == moving.numel():
        return solve_contacts(problem, start, tolerance, most, ids)
    some = None if start is None else start.index_select(0, which)
    move, report = solve_contacts(problem.among(moving, which), some, tolerance, most, ids)
    return torch.zeros_like(problem.scale).index_copy(0, which, move), report


def _tolerance(cells: CellProperties) -> Tensor:
    """Of the solve in each colony, (B,)."""
    count = cells.groups.size
    if cells.settings.tolerance is not None:
        return cells.radius.new_full((count,), cells.settings.tolerance)
    with torch.no_grad():
        hardest = -cells.groups.max(-cells.alpha * cells.length_drag, empty=-PENALTY)
        return TOLERANCE * (hardest / PENALTY).clamp(max=1.0).sqrt().sqrt()


# --- move -----------------------------------------------------------------------------------------


def move_cells(
    cells: CellProperties,
    at: Moved,
    move: Tensor,
    base: Tensor,
    moving: Tensor,
    solved: SolveReport,
) -> Moved:
    """Carry out the solve's move (N, D) for the cells that are moving, in part where a cell would
    turn too far, or go through a wall."""
    dim = cells.settings.dim
    sound = (moving & (solved.status != NOT_FINITE).index_select(0, cells.colony)).unsqueeze(1)
    move = torch.where(sound, move, 0.0)
    reach, share = _share(cells, at, move)
    move = move * share.unsqueeze(1)
    position = at.position + move[:, :dim].to(at.position.dtype)
    axis = torch.where(sound, capsule.rotate(at.axis, move[:, dim:-1]), at.axis)
    length = at.length + move[:, -1]
    # unlike a maximum, the whole gradient at a tie
    length = torch.where(length >= base, length, base)
    return Moved(position, axis, length, share < 1, share.detach() * reach, at.first_move)


def _share(cells: CellProperties, at: Moved, move: Tensor) -> tuple[Tensor, Tensor]:
    """How far the surface of each cell would come with the whole of its move, (N,) µm, and which
    share of it the cell makes, (N,): it turns by MAX_TURN at most, beyond which the linearised
    contacts mean nothing, and then takes part in the next pass; and it comes no farther than its
    radius behind a wall that it may not have touched before.
    """
    radius = cells.radius
    turn = safe_sqrt(move[:, cells.settings.dim : -1].square().sum(1))
    reach = reach_of(at.length.detach(), move.detach())
    too_far = turn > MAX_TURN
    share = torch.where(too_far, MAX_TURN / torch.where(too_far, turn, 1.0), 1.0)
    placed = poses_along(at.position, at.axis, at.length, share.unsqueeze(1) * move)
    within, cut = share.detach() * reach, torch.ones_like(radius)
    for surface, (kind, weight) in zip(cells.surfaces, cells.walls, strict=True):
        gives = kind == "stiffness" if weight is None or kind == "stiffness" else weight < 1
        own = share_to_wall(surface, placed, radius, cells.colony_ids, within, gives)
        cut = torch.minimum(cut, own)
    return reach, share * cut

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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfilm.physics import capsule
from torchfilm.physics.contacts import (
    NEAR,
    CandidateContacts,
    Capsules,
    Contacts,
    contact_gaps,
    contacts_of,
)
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.problem import NOT_FINITE, ContactProblem, SolveReport
from torchfilm.physics.solve import solve_contacts
from torchfilm.physics.surfaces import Surface
from torchfilm.physics.wall_contacts import WallContacts, find_wall_contacts, share_to_walls
from torchfilm.tools.ragged import Groups

# No cell turns by more than this in one solve, rad: beyond it the linearised contacts mean nothing.
# A cell that would turn further makes a part of its move, and takes part in the next pass.
MAX_TURN = 0.5
# What a pass leaves overlapping by more than DEEP radii is solved again in the next one, among all
# the others at rest. It is a few cells in a hundred, which slip or turn. For the others one solve
# already reaches the overlap that the penalty allows, and solving for them again takes twice the
# time.
DEEP = 0.2
# The overlap, µm, that colonies which take sub-steps are solved to: their steps are coarse.
CLOSE = 0.02
COARSE_PASSES = 6
# Tolerance of the solve at the default penalty α γ. Overlaps hardly depend on it, growth under
# pressure does: at 0.2 a twentieth of what a colony grows is wrong, at 0.05 less than a hundredth.
# The harder contacts are, the farther from rest is what moves with none of them at the same
# residual: a tolerance that falls as (α γ)^¼ is enough from 0.1 down to 1e-6 (0.02 is needed at
# 0.01), and one that falls faster is out of reach of float32.
PENALTY, TOLERANCE = 0.1, 0.05


@dataclass(frozen=True)
class ContactSettings:
    """How contacts are solved, every default filled in: a default that is given explicitly is the
    default.

    dim: 2 or 3. unilateral: contacts only push. soft: cells have a physical stiffness. passes: at
    most this many a step; coarse_passes: for colonies that take sub-steps. overlap: µm, that later
    passes solve to; None: DEEP radii, CLOSE for colonies that take sub-steps. tolerance: of the
    solve; None: by the penalty. max_iterations: of CG a solve.
    """

    dim: int
    unilateral: bool
    soft: bool
    passes: int
    coarse_passes: int
    overlap: float | None
    tolerance: float | None
    max_iterations: int

    @staticmethod
    def resolve(
        dim: int,
        *,
        unilateral: bool,
        soft: bool,
        passes: int | None,
        overlap: float | None,
        tolerance: float | None,
        max_iterations: int,
    ) -> ContactSettings:
        """From what a user gave, None for a default: one pass in the plane, two in space, twice as
        many one-sided."""
        usual = (dim - 1) * (2 if unilateral else 1) if passes is None else passes
        return ContactSettings(
            dim,
            unilateral,
            soft,
            usual,
            max(usual, COARSE_PASSES),
            overlap,
            tolerance,
            max_iterations,
        )

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a cell: 4 in strict 2-D, 7 in 3-D."""
        return 4 if self.dim == 2 else 7

    @property
    def sees_near(self) -> tuple[bool, bool]:
        """Whether the first pass, and a later one, see what nearly touches. Rows that hold would
        glue what growth takes apart; soft cells have no later pass that could push what nearly
        touches together."""
        return self.unilateral and not self.soft, not self.soft


@dataclass(frozen=True)
class CellProperties:
    """What the contact step needs of N cells in B colonies and does not change, for one step.

    radius (N,) µm; viscosity, length_drag, alpha (N,) or 0-dim; dt (N,) h, of each cell's sub-step;
    overlap (N,) µm, how deep a contact may be left; colony_ids (N,); reference (N, d), a point near
    each cell's colony. walls: for each surface its kind ("hard", "stiffness", "weight") and its
    stiffness · α · Δt or weight by cell.
    """

    settings: ContactSettings
    radius: Tensor
    viscosity: Tensor
    length_drag: Tensor
    alpha: Tensor
    overlap: Tensor
    colony_ids: Tensor
    reference: Tensor
    start: Tensor
    groups: Groups
    surfaces: Sequence[Surface]
    walls: Sequence[tuple[str, Tensor | None]]

    @property
    def colony(self) -> Tensor:
        return self.groups.owner


@dataclass(frozen=True)
class Moved:
    """Where cells are, and what one solve hands to the next: position (N, d) float64 µm, axis (N,
    d), length (N,) µm; clipped (N,) bool, whether the last move was cut short; reach (N,) µm, how
    far the surface came at most; first_move (N, D), of the first solve, from which the next step
    starts."""

    position: Tensor
    axis: Tensor
    length: Tensor
    clipped: Tensor
    reach: Tensor
    first_move: Tensor


@dataclass(frozen=True)
class ContactReport:
    """What the contact solves of a step did, per colony (B,). `status` of the worst solve,
    `iterations` of CG in all, and the worst true `residual`; `passes` taken; `clipped`: cells whose
    last move was cut short; `deeply_overlapping`: cells that were deeper in another than a radius
    when the step, or its last sub-step, began (0 of soft cells, which may be).
    """

    status: Tensor
    iterations: Tensor
    residual: Tensor
    passes: Tensor
    clipped: Tensor
    deeply_overlapping: Tensor

    def with_solve(self, new: SolveReport, clipped: Tensor, active: Tensor) -> ContactReport:
        """The report after one more pass in the colonies that are active, (B,) bool."""
        return ContactReport(
            torch.where(active, torch.maximum(self.status, new.status), self.status),
            self.iterations + torch.where(active, new.iterations, 0),
            torch.where(active, torch.maximum(self.residual, new.residual), self.residual),
            self.passes + active,
            torch.where(active, clipped, self.clipped),
            self.deeply_overlapping,
        )


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
    at = replace(at, length=torch.where(moving, base + growth, base))
    pairs: CandidateContacts | None = None
    for number in range(int(passes.max())):
        active = active & (number < passes)
        if not bool(active.any()):
            break
        include_near = cells.settings.sees_near[number > 0]
        if pairs is None:
            pairs, walls = find_contacts(cells, at, active, include_near)
            report = note_deeply_overlapping(cells, pairs, report, active)
        else:
            pairs, walls, moving = unresolved_contacts(cells, at, active, pairs)
            active = cells.groups.any(moving)
            if not bool(active.any()):
                break
        contacts = contacts_of(pairs, cells.settings.unilateral, include_near)
        problem = assemble(cells, at, contacts, walls, base, rigid, number == 0)
        start = cells.start if number == 0 else None
        move, solved = solve_among(cells, problem, moving, start)
        at = move_cells(cells, at, move, base, moving, solved)
        clipped = cells.groups.sum(at.clipped.to(base.dtype).unsqueeze(1)).squeeze(1).long()
        report = report.with_solve(solved, clipped, active)
        if number == 0:
            first = torch.where(moving.unsqueeze(1), move.detach(), at.first_move)
            at = replace(at, first_move=first)
    return at, report


# --- find -----------------------------------------------------------------------------------------


def find_contacts(
    cells: CellProperties, at: Moved, active: Tensor, include_near: bool
) -> tuple[CandidateContacts, WallContacts]:
    """All that touches in the active colonies, (B,) bool; include_near: also what nearly
    touches."""
    near, rows, capsules = _neighbourhood(cells, at, active, include_near)
    first, second = (rows.index_select(0, side) for side in near.pairs())
    walls = _at_walls(cells, at, active.index_select(0, cells.colony), include_near)
    return CandidateContacts.among(capsules, first, second, include_near), walls


def unresolved_contacts(
    cells: CellProperties, at: Moved, active: Tensor, pairs: CandidateContacts
) -> tuple[CandidateContacts, WallContacts, Tensor]:
    """After a move, in the active colonies (B,) bool: what touches the cells whose move was clipped
    or left them too deep, and these cells, (N,) bool. pairs: what touched before the move.

    Only there is it looked for: of two cells that did not touch, one must have moved by half of
    what may be left, and two that did must have come nearer by what was missing to it.
    """
    include_near = cells.settings.sees_near[1]
    near, rows, capsules = _neighbourhood(cells, at, active, include_near)
    of_active = active.index_select(0, cells.colony)
    walls = _at_walls(cells, at, of_active, include_near)
    overlap = cells.overlap
    with torch.no_grad():
        count = torch.arange(rows.numel(), device=rows.device)
        number = torch.full_like(cells.colony, -1).index_copy(0, rows, count)
        pairs_of = lambda which: [
            rows.index_select(0, side) for side in near.pairs_of(number[which])
        ]
        sum_of = lambda x, one, other: x.index_select(0, one) + x.index_select(0, other)
        far = (2 * at.reach > overlap) & of_active
        nearer = sum_of(at.reach, pairs.first, pairs.second) - pairs.gap
        come = nearer > 0.5 * sum_of(overlap, pairs.first, pairs.second)
        come = torch.nonzero(come & of_active.index_select(0, pairs.first)).squeeze(1)
        first, second = pairs_of(far)
        left = at.clipped & of_active
        # soft cells, and cells at a soft wall or one of little weight, are pressed as deep as these
        # let them
        if not cells.settings.soft:
            known = pairs.first.index_select(0, come), pairs.second.index_select(0, come)
            for one, other in (known, (first, second)):
                gap = contact_gaps(capsules, one, other)
                deep = torch.nonzero(gap < -0.5 * sum_of(overlap, one, other)).squeeze(1)
                left[torch.cat([one.index_select(0, deep), other.index_select(0, deep)])] = True
        root, soft = _wall_weights(cells, walls)
        too_deep = root * root * walls.gap < -overlap.index_select(0, walls.cell)
        left[walls.cell[~soft & too_deep]] = True
        more = pairs_of(left & ~far)
        # the others are known by now
        new = torch.nonzero(~far.index_select(0, more[1])).squeeze(1)
        first, second = (
            torch.cat([a, b.index_select(0, new)])
            for a, b in zip((first, second), more, strict=True)
        )
        theirs = left.index_select(0, first) | left.index_select(0, second)
        theirs = torch.nonzero(theirs).squeeze(1)
    found = CandidateContacts.among(
        capsules, first.index_select(0, theirs), second.index_select(0, theirs), include_near
    )
    return found, walls.take(torch.nonzero(left.index_select(0, walls.cell)).squeeze(1)), left


@torch.no_grad()
def note_deeply_overlapping(
    cells: CellProperties, pairs: CandidateContacts, report: ContactReport, active: Tensor
) -> ContactReport:
    """The report with the number of cells that lie deeper than a radius in another."""
    if cells.settings.soft:
        return report
    deep = torch.nonzero(pairs.gap < -0.5 * (pairs.a.radius + pairs.b.radius)).squeeze(1)
    marked = torch.zeros_like(cells.radius)
    marked[torch.cat([pairs.first.index_select(0, deep), pairs.second.index_select(0, deep)])] = 1.0
    found = cells.groups.sum(marked.unsqueeze(1)).squeeze(1).long()
    return replace(report, deeply_overlapping=torch.where(active, found, report.deeply_overlapping))


def _neighbourhood(
    cells: CellProperties, at: Moved, active: Tensor, include_near: bool
) -> tuple[Neighbourhood, Tensor, Capsules]:
    """The cells of the active colonies (others may be too far gone to be stepped), which those are
    (M,), and the capsules of all cells."""
    local = (at.position - cells.reference).to(at.length.dtype)
    capsules = Capsules(local.T.contiguous(), at.axis.T.contiguous(), 0.5 * at.length, cells.radius)
    rows = torch.nonzero(active.index_select(0, cells.colony)).squeeze(1)
    everyone = rows.numel() == cells.colony.numel()
    pick = lambda x: x.detach() if everyone else x.detach().index_select(0, rows)
    radius = pick(cells.radius)
    margin = NEAR * radius if include_near else 0.0
    near = Neighbourhood(
        pick(local),
        pick(at.axis),
        pick(at.length),
        radius,
        pick(cells.colony),
        cells.groups.size,
        margin,
    )
    return near, rows, capsules


def _at_walls(cells: CellProperties, at: Moved, which: Tensor, include_near: bool) -> WallContacts:
    """What touches walls among the marked cells, (N,) bool."""
    parts = (at.position, at.axis, at.length, cells.radius, cells.colony_ids)
    unilateral = cells.settings.unilateral
    if bool(which.all()):
        return find_wall_contacts(cells.surfaces, *parts, unilateral, include_near)
    rows = torch.nonzero(which).squeeze(1)
    parts = tuple(x.index_select(0, rows) for x in parts)  # type: ignore[assignment]
    found = find_wall_contacts(cells.surfaces, *parts, unilateral, include_near)
    return replace(found, cell=rows.index_select(0, found.cell))


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
    wall_root, wall_soft = _wall_weights(cells, walls)
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
    return ContactProblem(
        rows, gap, applied, alpha, lower, scale, rigid, cells.groups, settings.unilateral
    )


def solve_among(
    cells: CellProperties, problem: ContactProblem, moving: Tensor, start: Tensor | None
) -> tuple[Tensor, SolveReport]:
    """The move of the cells that are moving (N,) bool, as (N, D), while the others stay where they
    are."""
    tolerance, most = _tolerance(cells), cells.settings.max_iterations
    if bool(moving.all()):
        return solve_contacts(problem, start, tolerance, most)
    some = None if start is None else start[moving]
    move, report = solve_contacts(problem.among(moving), some, tolerance, most)
    which = torch.nonzero(moving).squeeze(1)
    return torch.zeros_like(problem.scale).index_copy(0, which, move), report


def _tolerance(cells: CellProperties) -> Tensor:
    """Of the solve in each colony, (B,)."""
    count = cells.groups.size
    if cells.settings.tolerance is not None:
        return cells.radius.new_full((count,), cells.settings.tolerance)
    with torch.no_grad():
        hardest = -cells.groups.max(-cells.alpha * cells.length_drag, empty=-PENALTY)
        return TOLERANCE * (hardest / PENALTY).clamp(max=1.0).sqrt().sqrt()


def _wall_weights(cells: CellProperties, walls: WallContacts) -> tuple[Tensor, Tensor]:
    """D of each wall row (W,), and whether the wall is soft, (W,) bool."""
    root = torch.ones_like(walls.gap)
    soft = torch.zeros_like(walls.cell, dtype=torch.bool)
    for number, (kind, value) in enumerate(cells.walls):
        here = walls.surface == number
        if kind == "stiffness" and value is not None:
            root = torch.where(here, value.index_select(0, walls.cell).sqrt(), root)
            soft = soft | here
        elif kind == "weight" and value is not None:
            root = torch.where(here, value.index_select(0, walls.cell), root)
    return root, soft


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
    reach, share = _share(cells, at, move.detach())
    move = move * share.unsqueeze(1)
    position = at.position + move[:, :dim].to(at.position.dtype)
    axis = torch.where(sound, capsule.rotate(at.axis, move[:, dim:-1]), at.axis)
    length = at.length + move[:, -1]
    # unlike a maximum, the whole gradient at a tie
    length = torch.where(length >= base, length, base)
    return Moved(position, axis, length, share < 1, share * reach, at.first_move)


@torch.no_grad()
def _share(cells: CellProperties, at: Moved, move: Tensor) -> tuple[Tensor, Tensor]:
    """How far the surface of each cell would come with the whole of its move, (N,) µm, and which
    share of it the cell makes, (N,): see MAX_TURN; and no farther than its radius behind a wall
    that it may not have touched before.
    """
    dim, radius = cells.settings.dim, cells.radius
    turn, way = (x.square().sum(1).sqrt() for x in (move[:, dim:-1], move[:, :dim]))
    share = (MAX_TURN / turn).clamp(max=1.0)
    reach = way + 0.5 * turn * at.length + 0.5 * move[:, -1].clamp(min=0.0)
    far = torch.nonzero(share * reach > radius).squeeze(1)
    if far.numel() and cells.surfaces:
        pick = lambda x: x.index_select(0, far)
        position, axis, length = pick(at.position), pick(at.axis), pick(at.length)
        part = pick(move) * pick(share).unsqueeze(1)

        def placed(s):
            return (
                position + s * part[:, :dim].to(position.dtype),
                capsule.rotate(axis, s * part[:, dim:-1]),
                0.5 * (length + s * part[:, -1]),
            )

        share[far] *= share_to_walls(cells.surfaces, placed, pick(radius), pick(cells.colony_ids))
    return reach, share

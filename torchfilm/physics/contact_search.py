"""Which cells touch which, and which walls: all before a first pass, the unresolved ones after."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import NEAR
from torchfilm.physics.contact_records import CellProperties, ContactReport, Moved
from torchfilm.physics.contacts import CandidateContacts, Capsules, contact_gaps
from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.wall_contacts import WallContacts, find_wall_contacts
from torchfilm.tools.ragged import marked
from torchfilm.tools.reads import rows_where


def find_contacts(
    cells: CellProperties, at: Moved, rows: Tensor, include_near: bool
) -> tuple[CandidateContacts, WallContacts]:
    """All that touches of the cells `rows` (M,); include_near: also what nearly touches."""
    near, capsules = _neighbourhood(cells, at, rows, include_near)
    first, second = (rows.index_select(0, side) for side in near.pairs())
    walls = _at_walls(cells, at, rows, include_near)
    return CandidateContacts.among(capsules, first, second, include_near), walls


def unresolved_contacts(
    cells: CellProperties, at: Moved, active: Tensor, rows: Tensor, pairs: CandidateContacts
) -> tuple[CandidateContacts, WallContacts, Tensor]:
    """After a move, in the active colonies (B,) bool: what touches the cells whose move was clipped
    or left them too deep, and these cells, (N,) bool. rows: at least the cells of these colonies.
    pairs: what touched before the move.

    Only there is it looked for: of two cells that did not touch, one must have moved by half of
    what may be left, and two that did must have come nearer by what was missing to it.
    """
    include_near = cells.settings.sees_near[1]
    near, capsules = _neighbourhood(cells, at, rows, include_near)
    of_active = active.index_select(0, cells.colony)
    walls = _at_walls(cells, at, rows, include_near)
    overlap = cells.overlap
    with torch.no_grad():
        count = torch.arange(rows.numel(), device=rows.device)
        number = torch.full_like(cells.colony, -1).index_copy(0, rows, count)
        pairs_of = lambda which: [
            rows.index_select(0, side) for side in near.pairs_of(number.index_select(0, which))
        ]
        sum_of = lambda x, one, other: x.index_select(0, one) + x.index_select(0, other)
        far = (2 * at.reach > overlap) & of_active
        nearer = sum_of(at.reach, pairs.first, pairs.second) - pairs.gap
        come = nearer > 0.5 * sum_of(overlap, pairs.first, pairs.second)
        come, fast = rows_where(come & of_active.index_select(0, pairs.first), far)
        first, second = pairs_of(fast)
        left = at.clipped & of_active
        # soft cells, and cells at a soft wall or one of little weight, are pressed as deep as these
        # let them
        if not cells.settings.soft:
            known = pairs.first.index_select(0, come), pairs.second.index_select(0, come)
            for one, other in (known, (first, second)):
                gap = contact_gaps(capsules, one, other)
                deep = gap < -0.5 * sum_of(overlap, one, other)
                left = left | marked(left.numel(), torch.cat([one, other]), deep.repeat(2))
        root, soft = wall_weights(cells, walls)
        too_deep = root * root * walls.gap < -overlap.index_select(0, walls.cell)
        left = (left | marked(left.numel(), walls.cell, ~soft & too_deep)) & of_active
        more = pairs_of(*rows_where(left & ~far))
        # the others are known by now
        (new,) = rows_where(~far.index_select(0, more[1]))
        first, second = (
            torch.cat([a, b.index_select(0, new)])
            for a, b in zip((first, second), more, strict=True)
        )
        theirs = left.index_select(0, first) | left.index_select(0, second)
        theirs, at_wall = rows_where(theirs, left.index_select(0, walls.cell))
    found = CandidateContacts.among(
        capsules, first.index_select(0, theirs), second.index_select(0, theirs), include_near
    )
    return found, walls.take(at_wall), left


@torch.no_grad()
def note_deeply_overlapping(
    cells: CellProperties, pairs: CandidateContacts, report: ContactReport, active: Tensor
) -> ContactReport:
    """The report with the number of cells that lie deeper than a radius in another."""
    if cells.settings.soft:
        return report
    deep = (pairs.gap < -0.5 * (pairs.a.radius + pairs.b.radius)).repeat(2)
    mark = marked(cells.radius.numel(), torch.cat([pairs.first, pairs.second]), deep)
    found = cells.groups.sum(mark.to(cells.radius.dtype)).long()
    return replace(report, deeply_overlapping=torch.where(active, found, report.deeply_overlapping))


def _neighbourhood(
    cells: CellProperties, at: Moved, rows: Tensor, include_near: bool
) -> tuple[Neighbourhood, Capsules]:
    """The cells `rows` (others may be too far gone to be stepped), and the capsules of all."""
    local = (at.position - cells.reference).to(at.length.dtype)
    capsules = Capsules(local.T.contiguous(), at.axis.T.contiguous(), 0.5 * at.length, cells.radius)
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
    return near, capsules


def _at_walls(cells: CellProperties, at: Moved, rows: Tensor, include_near: bool) -> WallContacts:
    """What touches walls among the cells `rows`."""
    parts = (at.position, at.axis, at.length, cells.radius, cells.colony_ids)
    if rows.numel() == cells.colony.numel():
        return find_wall_contacts(cells.surfaces, *parts, include_near)
    parts = tuple(x.index_select(0, rows) for x in parts)  # type: ignore[assignment]
    found = find_wall_contacts(cells.surfaces, *parts, include_near)
    return replace(found, cell=rows.index_select(0, found.cell))


def wall_weights(cells: CellProperties, walls: WallContacts) -> tuple[Tensor, Tensor]:
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

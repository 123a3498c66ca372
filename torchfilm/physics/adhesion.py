"""Adhesion: cells that touch, or nearly, hold on to each other, or to walls.

Two cells whose surfaces are g apart pull each other with the force S g / reach, up to S where they
part: beyond `reach` nothing holds them. S is the strength that both give the pair. What pulls is a
row of the contact problem like that of a soft wall, turned round: with D² = (S / reach) · α · Δt it
acts where the gap after the move is above 0: the pull is that at the end of the step, so that
strong bonds are stable. Which pairs hold each other is decided where a step begins, so that a pair
parts between steps. A wall holds an end of a cell in the same way.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchfilm.physics.contacts import CandidateContacts, Capsules, Contacts
from torchfilm.physics.wall_contacts import WallContacts
from torchfilm.physics.walls import Wall
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups
from torchfilm.tools.reads import rows_where
from torchfilm.tools.row_checks import check_names
from torchfilm.tools.vectors import cross, dot, safe_norm, safe_sqrt


@dataclass(frozen=True)
class Adhesion(metaclass=checks.KnownKeywords):
    """Cells stick together, or to walls: `tf.Mechanics(adhesion=[tf.Adhesion(strength=100.0)])`.

    strength: μ·µm²/h, the greatest pull between two cells, where they are about to part. (A cell
    with a centreline of 4 µm, 1 µm wide, that moves at v µm/h has a drag of μ · 5 µm · v.) One
    number, one per colony, one per cell type, or a distribution drawn at birth. Where two cells
    differ, the pair has the geometric mean: a cell of strength 0 sticks to none. reach: µm, at most
    5, the gap between surfaces at which a pair parts; cells between the two do not matter. The pull
    is in proportion to the gap: cells that touch are not pulled, and may slide along each other.
    Nearly parallel cells hold on at two places, each with half of the strength.

    adhesin: name of a species of a circuit, or of a variable of rules, that makes cells stick: the
    pull of a pair is strength · a₁ · a₂, their levels. partner: name of another one, to which the
    adhesin binds instead of to itself: strength · (a₁ · p₂ + p₁ · a₂). Where that is more than a
    strength may be, a colony fails.

    to: "cells"; "walls" for all walls of the same Mechanics; or one of them by its number, from 0.
    Each end of a cell sticks to a wall by itself, with the cell's own strength and level: one that
    lies on a wall is held twice as strongly as one that stands on it. It may slide along the wall.

    Raises InputError for a strength below 0, a reach that is not above 0, a partner without an
    adhesin or of walls, and for walls that are not there.
    """

    strength: Any
    reach: float = 0.1
    adhesin: str | None = None
    partner: str | None = None
    to: str | int = "cells"

    def __post_init__(self) -> None:
        given = checks.part_value("Adhesion.strength", self.strength, least=0.0)
        object.__setattr__(self, "strength", given)
        reach = checks.number("Adhesion.reach", self.reach, above=0.0, most=MOST_REACH)
        object.__setattr__(self, "reach", reach)
        check_names("Adhesion", adhesin=self.adhesin, partner=self.partner)
        if self.partner is not None and self.adhesin in (None, self.partner):
            raise checks.input_error(
                "Adhesion.partner", self.partner, "another name than the adhesin, which is given",
                "Leave it out where the adhesin binds to itself.",
            )  # fmt: skip
        if self.to not in ("cells", "walls"):
            hint = 'The number of a wall in Mechanics(walls=[…]), else "cells" or "walls".'
            found = checks.integer("Adhesion.to", self.to, least=0, hint=hint)
            object.__setattr__(self, "to", found)
        if self.partner is not None and self.to != "cells":
            raise checks.input_error(
                "Adhesion.partner", self.partner, "left out: a wall has no species",
                "The pull is in proportion to the adhesin.",
            )  # fmt: skip

    @property
    def levels(self) -> tuple[str, ...]:
        """What it reads of the cells, beside their strength."""
        return tuple(name for name in (self.adhesin, self.partner) if name is not None)


def check_walls_of(kinds: Sequence[Adhesion], walls: int) -> None:
    """Raise InputError for adhesion to walls that are not there."""
    for kind in kinds:
        if kind.to != "cells" and (walls == 0 or (kind.to != "walls" and int(kind.to) >= walls)):
            bound = (
                f"below {walls}, the number of walls" if walls else '"cells": there are no walls'
            )
            raise checks.input_error(
                "Adhesion.to", kind.to, bound, "Mechanics(walls=[…]) lists them, from 0."
            )


def holds_of(
    kinds: Sequence[Adhesion], walls: Sequence[Wall], dim: int
) -> tuple[tuple[bool, ...], ...]:
    """Of each kind whether it is between cells, and of which surfaces of the walls: see `Bonds`."""
    of_wall = [k for k, wall in enumerate(walls) for _ in wall.surfaces(dim)]
    return tuple(
        (kind.to == "cells", *(kind.to in ("walls", k) for k in of_wall)) for kind in kinds
    )


# µm: pairs that are farther apart have other cells between them.
MOST_REACH = 5.0


@dataclass(frozen=True)
class Bonds:
    """What holds cells together, or to S surfaces, in a step, of K kinds.

    levels: (N, 2 K) float64. A pair (i, j) that is nearer than the reach of kind k as the step
    begins has the stiffness levels[i, 2k] · levels[j, 2k+1] + levels[i, 2k+1] · levels[j, 2k],
    μ·µm/h; an end of a cell at a wall has levels[i, 2k] · levels[i, 2k+1]. In the input of contact
    steps they are times Δt. reaches: (K,) µm. begin: (N,) the cells as the step begins: before they
    move by themselves, which would else part them unhindered. holds: K × (1 + S), whether a kind is
    between cells, and of which surfaces.
    """

    levels: Tensor
    reaches: tuple[float, ...]
    begin: Capsules
    holds: tuple[tuple[bool, ...], ...]

    def over(self, dt: Tensor) -> Bonds:
        """The same with stiffness · dt; dt: (N,) h, alike in a colony."""
        return replace(self, levels=self.levels * dt.to(self.levels.dtype).sqrt().unsqueeze(1))

    def stiffness(self, first: Tensor, second: Tensor, gap: Tensor) -> Tensor:
        """Of pairs of cells, (P,), in rows with these gaps as the step begins."""
        a, b = self.levels.index_select(0, first), self.levels.index_select(0, second)
        pairs = a[:, 0::2] * b[:, 1::2] + a[:, 1::2] * b[:, 0::2]
        with torch.no_grad():
            nearest = CandidateContacts.all_of(self.begin, first, second).gap
            widest = torch.maximum(nearest, gap)
        near = [widest < (reach if held[0] else -math.inf) for reach, held in self._kinds()]
        return _sum_where(near, pairs)

    def wall_stiffness(self, walls: WallContacts, gap: Tensor) -> Tensor:
        """Of rows of cells and walls with these gaps as the step begins, (W,)."""
        own = self.levels.index_select(0, walls.cell)
        reaches = [[reach if h else -math.inf for h in held[1:]] for reach, held in self._kinds()]
        reach = self.levels.new_tensor(reaches).index_select(1, walls.surface)
        return _sum_where((gap < reach).unbind(0), own[:, 0::2] * own[:, 1::2])

    @torch.no_grad()
    def apart(self, drift: Tensor | None, groups: Groups) -> tuple[Tensor, Tensor]:
        """The gaps, µm, up to which pairs of each colony may hold each other, and walls may hold
        cells, (B,), also where they have drifted apart."""
        cells = max((r for r, h in self._kinds() if h[0]), default=0.0)
        walls = max((r for r, h in self._kinds() if any(h[1:])), default=0.0)
        own = self.levels.new_zeros(groups.size)
        if drift is not None:
            dim = self.begin.centre.shape[0]
            move, turn = (safe_norm(x.T.double()) for x in (drift[:, :dim], drift[:, dim:]))
            own = groups.max(move + self.begin.half * turn)
        return (cells + 2.0 * own) * (cells > 0), (walls + own) * (walls > 0)

    def _kinds(self) -> list[tuple[float, tuple[bool, ...]]]:
        """Reach of each kind, and what it holds."""
        return list(zip(self.reaches, self.holds, strict=True))


def _sum_where(near: Sequence[Tensor], values: Tensor) -> Tensor:
    """The sum of the columns of values (P, K) where near (P,), in this order whatever the batch."""
    parts = (torch.where(x, v, 0.0) for x, v in zip(near, values.unbind(1), strict=True))
    return functools.reduce(torch.add, parts)


@torch.no_grad()
def most_of_limits(
    levels: Tensor, holds: Sequence[Sequence[bool]], limits: Sequence[float], groups: Groups
) -> Tensor:
    """A bound of the stiffness between two cells, or at a surface, of each colony, (B,), over its
    limit; that of several kinds adds up. levels, holds: as of `Bonds`. limits: of each kind."""
    at = [torch.zeros_like(levels[:, 0]) for _ in holds[0]]  # of cells, and of each surface
    for k, (held, limit) in enumerate(zip(holds, limits, strict=True)):
        first, second = levels[:, 2 * k] / limit, levels[:, 2 * k + 1]
        if held[0]:
            most = [groups.max(x).index_select(0, groups.owner) for x in (first, second)]
            at[0] = at[0] + first * most[1] + second * most[0]
        for surface, holding in enumerate(held[1:], 1):
            at[surface] = at[surface] + first * second if holding else at[surface]
    return groups.max(functools.reduce(torch.maximum, at))


@torch.no_grad()
def _gap_at_begin(contacts: Contacts, now: Capsules, begin: Capsules) -> Tensor:
    """The gap of each row as the step began, (K,) µm, to first order in what has moved since."""
    moved = _moved(now, begin)
    closed = (
        dot(row.T, moved.index_select(1, cell))
        for row, cell in (
            (contacts.row_first, contacts.first),
            (contacts.row_second, contacts.second),
        )
    )
    return contacts.gap + sum(closed)


def _moved(now: Capsules, begin: Capsules) -> Tensor:
    """How each cell has moved, turned and grown since the step began, (D, N)."""
    grown = 2.0 * (now.half - begin.half).unsqueeze(0)
    return torch.cat([now.centre - begin.centre, cross(begin.axis, now.axis), grown])


def levels_of(
    kinds: Sequence[Adhesion], strengths: Sequence[Tensor], fields: Mapping[str, Tensor], cells: int
) -> Tensor:
    """The levels of `Bonds`, (N, 2 K). strengths: of each kind, 0-dim or (N,). fields: of the
    cells, by name."""
    levels: list[Tensor] = []
    for kind, strength in zip(kinds, strengths, strict=True):
        root = safe_sqrt(strength.double() / kind.reach).expand(cells)
        adhesin, partner = (
            root if name is None else root * fields[name].double()
            for name in (kind.adhesin, kind.partner or kind.adhesin)
        )
        if kind.to != "cells":  # a wall has a level of 1
            levels += [adhesin, root]
        else:
            levels += [adhesin if kind.partner else 0.5 * adhesin, partner]
    return torch.stack(levels, 1)


def with_bonds(contacts: Contacts, bonds: Bonds, now: Capsules) -> Contacts:
    """The rows of contacts, and after them those that pull: one for each row at a contact. now:
    (N,) the cells."""
    assert contacts.beside is not None
    if not any(between for between, *_ in bonds.holds):
        return contacts
    gap = _gap_at_begin(contacts, now, bonds.begin)
    stiffness = bonds.stiffness(contacts.first, contacts.second, gap)
    (held,) = rows_where((stiffness.detach() != 0) & ~contacts.beside)
    pick = lambda x: x.index_select(0, held)
    both = lambda x, sign=1: torch.cat([x, sign * pick(x)])
    return replace(
        contacts,
        first=both(contacts.first), second=both(contacts.second), weight=both(contacts.weight),
        gap=both(contacts.gap, -1), row_first=both(contacts.row_first, -1),
        row_second=both(contacts.row_second, -1),
        normal=torch.cat([contacts.normal, -contacts.normal.index_select(1, held)], 1),
        beside=torch.cat([contacts.beside, torch.ones_like(pick(contacts.beside))]),
        pull=torch.cat([torch.zeros_like(stiffness), pick(stiffness)]),
    )  # fmt: skip


def with_wall_bonds(walls: WallContacts, bonds: Bonds, now: Capsules) -> WallContacts:
    """The rows of cells at walls, and after them those that pull. now: (N,) the cells."""
    if not any(any(of_walls) for _, *of_walls in bonds.holds):
        return walls
    with torch.no_grad():
        share = walls.row[:, : now.centre.shape[0]].norm(dim=1)  # of the row in its contact
        moved = _moved(now, bonds.begin).index_select(1, walls.cell)
        gap = (walls.gap + dot(walls.row.T, moved)) / share
    stiffness = bonds.wall_stiffness(walls, gap)
    (held,) = rows_where(stiffness.detach() != 0)
    pulling = walls.take(held)
    return WallContacts(
        torch.cat([walls.cell, pulling.cell]), torch.cat([walls.gap, -pulling.gap]),
        torch.cat([walls.row, -pulling.row]), torch.cat([walls.surface, pulling.surface]),
        torch.cat([torch.zeros_like(stiffness), stiffness.index_select(0, held)]),
    )  # fmt: skip


def roots_of(contacts: Contacts, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """D of each row of two cells, (K, 1), and whether it pulls, (K,) bool. alpha: (N,)."""
    root, pull = contacts.weight.sqrt(), contacts.pull
    if pull is None:
        return root.unsqueeze(1), torch.zeros_like(contacts.first, dtype=torch.bool)
    pulls = pull.detach() != 0
    first, second = (alpha.index_select(0, x) for x in (contacts.first, contacts.second))
    held = safe_sqrt(0.5 * pull * (first + second)) + 0.0 * pull  # also what is not a number
    return torch.where(pulls, root * held, root).unsqueeze(1), pulls


def wall_roots_of(
    walls: WallContacts, root: Tensor, soft: Tensor, alpha: Tensor
) -> tuple[Tensor, Tensor]:
    """The same D and softness of rows at walls, (W,), with those of rows that pull. alpha: (N,)."""
    if walls.pull is None:
        return root, soft
    pulls = walls.pull.detach() != 0
    held = safe_sqrt(walls.pull * alpha.index_select(0, walls.cell)) + 0.0 * walls.pull
    return torch.where(pulls, held, root), soft | pulls

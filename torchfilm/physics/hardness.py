"""How hard one-sided contacts are, in tensors: see `kernels.hardness`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.kernels.scheme import HARDEST, MOST_FORCE, OVERLAP, PEAK, PEAKED, SOFTEST, UNMOVED
from torchfilm.physics.problem import ContactProblem
from torchfilm.physics.step_records import StepInput
from torchfilm.tools.vectors import nearest_root, safe_norm


class Limits:
    """What the contacts of each colony may be, (B,), of cells that grow to this length (N,).

    wide: the mean radius, µm. target: the overlap that is wanted, µm. deep: how deep is too deep,
    `deep` radii. softest, hardest: α. held: the greatest force times Δt that growth may exert; ∞
    where cells stick or walls are soft, which push as well.
    """

    def __init__(self, given: StepInput, length: Tensor, growth: Tensor, deep: Tensor):
        groups, settings = given.groups, given.settings
        count = groups.counts.clamp(min=1)
        mean = lambda x: groups.sum(x.double()) / count
        self.wide = mean(given.radius)
        self.target = settings.contact_overlap * self.wide
        whole = length + 2 * given.radius
        self.softest = SOFTEST * settings.contact_overlap / OVERLAP / mean(given.viscosity * whole)
        forces = given.length_drag * growth.clamp(min=0.0)
        held = mean(forces)
        some = held > 0  # a division by 0 would spoil gradients
        least = torch.where(some, UNMOVED * self.target / torch.where(some, held, 1.0), torch.inf)
        self.hardest = torch.minimum(HARDEST * self.softest, least)
        with torch.no_grad():
            own = settings.overlap
            self.deep = deep * self.wide if own is None else torch.full_like(self.wide, own)
        self.held = groups.max(forces).double()
        if given.bonds is not None:
            sticks = torch.maximum(*given.bonds.apart(given.drift, groups)) > 0
            self.held = torch.where(sticks, torch.inf, self.held)
        if any(kind == "stiffness" for kind, _ in given.walls):
            self.held = torch.full_like(self.held, torch.inf)


@dataclass(frozen=True)
class Following:
    """α of the colonies of a pass that moves all cells.

    hard: (R,) bool, the rows that count, those of `pairs` contacts between cells first. radius:
    (n,) of the cells, µm.
    """

    limits: Limits
    hard: Tensor
    pairs: int
    radius: Tensor
    dim: int

    def alpha(self, hardness: Tensor, part: ContactProblem, y: Tensor, after: Tensor) -> Tensor:
        """α (B,) after a solve with α `hardness`, from its scaled moves y (n, D) and the gap of
        each row after them (R,): see `kernels.hardness.following`."""
        limits, of_rows = self.limits, part.of_rows
        overlap = torch.where(self.hard, -after, 0.0).clamp(min=0.0).double()
        most = torch.maximum(PEAK * limits.deep, PEAKED * limits.target)
        powers = overlap / most.index_select(0, of_rows.owner)
        for _ in range(3):
            powers = powers * powers
        of_pairs = torch.cat([overlap[: self.pairs], torch.zeros_like(overlap[self.pairs :])])
        counted = ((x > 0).double() for x in (overlap, of_pairs))
        each = torch.stack([overlap, of_pairs, *counted, powers], 1)
        total, between, count, pairs, peaks = of_rows.sum(each).unbind(1)
        several, some_pairs = count.clamp(min=1), pairs.clamp(min=1)
        mean = torch.maximum(total / several, between / some_pairs)
        pushes = mean > 0
        mean = torch.where(pushes, mean, 1.0)
        peak = torch.where(pushes, peaks / several, 1.0).clamp(min=1e-300)
        for _ in range(3):
            peak = nearest_root(peak)
        wanted = torch.minimum(hardness * limits.target / mean, hardness / peak)
        bound = MOST_FORCE * (limits.held + self._needed(part, y))
        some = bound > 0
        in_vain = mean / torch.where(some, bound, 1.0)
        wanted = torch.where(some, torch.maximum(wanted, in_vain), limits.softest)
        wanted = torch.minimum(torch.where(pushes, wanted, limits.softest), limits.softest)
        return torch.maximum(torch.minimum(wanted, 2 * hardness), limits.hardest)

    def _needed(self, part: ContactProblem, y: Tensor) -> Tensor:
        """The forces that the moves of all cells need together, (B,)."""
        forces = y.double()[:, :-1] / part.scale.double()[:, :-1]
        push, turn = safe_norm(forces[:, : self.dim].T), safe_norm(forces[:, self.dim :].T)
        return part.colonies.sum(push + turn / self.radius)

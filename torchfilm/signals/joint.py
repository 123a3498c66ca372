"""Transport of one signal over a step in which cells give to it and take from it.

What a cell gives over the step, it gives evenly. What it takes is taken in proportion to what is
there, at the rate at which it takes the wanted amount if the mean concentration about it is as
guessed: so nothing becomes negative, whatever the guess, and at the right one the cell gets what it
wanted. With both given, transport is linear (`signals.transport_uptake`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfilm.signals import compiled_uptake
from torchfilm.signals.compiled import may_run
from torchfilm.signals.compiled_uptake import CompiledUptake
from torchfilm.signals.exchange import read, write
from torchfilm.signals.grid import Grid
from torchfilm.signals.stencil import Stencil
from torchfilm.signals.transport_uptake import UptakeTransport
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import both, has_tangent, no_derivatives, only_forward, with_tangent

TINY = 1e-300
# Of the rate at which a cell takes, times the step: it then takes all there is. At a smaller one
# cells that eat faster than diffusion brings would get more than that: a law such as s/(K + s) asks
# for as much at 1e-10 of what there was.
EMPTY = 1e15
# What all cells of a colony may take of a signal by one step of backward Euler: in a closed box
# half of that is left too much, so that what is left after a fall by e is 1 % off.
COARSE = 0.02
# What may leave a colony's grid in such a step, to cells, by decay and through faces, where the
# content changes by as much: a colony's own growth is less, and its signal late by half of that.
LATE = 0.04
SLIGHT = 1e-4  # a share whose exponential is 1 less the share
MANY = 500.0  # falls by e, after which nothing is left


class JointMove(NamedTuple):
    """end: (voxels,) float64, the signal at the end. at_end, mean: (N,) float64, what each cell
    finds of it then, and in the mean over the step. taken: (N,), what the medium gave to each."""

    end: Tensor
    at_end: Tensor
    mean: Tensor
    taken: Tensor


def _parted(released: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """What is given and what is taken, (N,) each. At 0 their derivatives add up to that of what is
    released: half each, but where there is nothing to take all of it is given."""
    half = torch.where(mean > 0, 0.5, 0.0) * released
    none = released == 0
    given = torch.where(none, released - half, released.clamp(min=0.0))
    return given, torch.where(none, -half, (-released).clamp(min=0.0))


@dataclass(frozen=True, eq=False)
class JointTransport:
    """Transport of a signal over `dt` hours about cells in given places.

    carried: on each of `grid.batches`. pool: (N,) µm³, of which each cell may draw all that there
    is. field: (voxels,). found: (N,) float64, what each cell finds of it at the start; `fed` (N,)
    bool: cells in the box, the others meet a reservoir of that concentration. groups: of the cells
    by colony. finest: concentrations that matter no more.
    """

    grid: Grid
    carried: Sequence[UptakeTransport]
    stencil: Stencil
    pool: Tensor
    groups: Groups
    field: Tensor
    found: Tensor
    fed: Tensor
    finest: float
    dt: float

    @cached_property
    def _far(self) -> list[Any]:
        """Of each of `grid.batches`, (b,), the colonies that needed backward Euler: they keep to
        it, or the two would alternate. An array where kernels took the last pass, else a tensor."""
        return [None] * len(self.carried)

    @cached_property
    def turned(self) -> Tensor:
        """Colonies that have begun to take backward Euler after the first time, (B,) bool: their
        equation has changed. Whoever looks clears it."""
        return torch.zeros(self.groups.size, dtype=torch.bool, device=self.field.device)

    @cached_property
    def operators(self) -> list[CompiledUptake]:
        """What kernels take of each of `grid.batches`; nothing where they may not run."""
        found = [x.compiled for x in self.carried if x.compiled is not None]
        return found if len(found) == len(self.carried) and may_run(self.stencil.weight) else []

    @property
    def by_kernels(self) -> bool:
        """Whether kernels may run it, without derivatives by what there was."""
        return bool(self.operators) and may_run(self.field, self.found)

    def moved(self, released: Tensor, mean: Tensor) -> JointMove:
        """A step. released: (N,), what each cell gives, or takes, conc·µm³. mean: (N,), the guess
        of the mean concentration about it."""
        released = released.double()
        numbers = self.field, self.found, released, mean
        if self.operators and (may_run(*numbers) or only_forward(*numbers)):
            return self._by_kernels(released, mean)
        per_volume = torch.where(self.fed, released / (self.stencil.voxel_volume * self.dt), 0.0)
        gift, wanted = _parted(per_volume, mean)
        given = self._spread(gift)
        rate = wanted / mean.clamp(min=TINY)
        rate = rate.clamp(max=EMPTY / self.dt)
        losses = self._spread(rate)
        ends, means, found = [], [], []
        for k, (one, batch) in enumerate(zip(self.carried, self.grid.batches, strict=True)):
            before = None if self._far[k] is None else torch.as_tensor(self._far[k])
            end, average, self._far[k] = one.step(
                batch.of(self.field), batch.of(losses), self.dt, before, batch.of(given)
            )
            if before is not None:
                self.turned[batch.colonies] |= self._far[k] & ~before
            ends.append(end)
            means.append(average)
            # backward Euler ends at its mean, but for a residual that may be more than what a cell
            # finds
            found.append(torch.where(self._far[k].reshape(-1, 1, 1, 1), average, end))
        end = self.grid.join(ends)
        at_end, average = (
            torch.where(self.fed, self._read(self.grid.join(x)), self.found) for x in (found, means)
        )
        taken = rate * average * (self.stencil.voxel_volume * self.dt)
        return JointMove(end, at_end, average, taken)

    def _by_kernels(self, released: Tensor, mean: Tensor) -> JointMove:
        if not has_tangent(self.field, self.found, released, mean):
            return JointMove(*compiled_uptake.move(self, released, mean, self._far))
        with no_derivatives():
            plain = self._known(both(released)[0], both(mean)[0])
        average, moved = plain[2], both(self.found)[1]
        end, at_end, there, taken = compiled_uptake.move_turned(
            self, released, mean, average, self._far
        )
        still = torch.zeros_like(at_end) if moved is None else moved
        at_end, there = (torch.where(self.fed, x, still) for x in (at_end, there))
        turns = end, at_end, there, taken
        return JointMove(*(with_tangent(x, turn) for x, turn in zip(plain, turns, strict=True)))

    def _known(self, released: Tensor, mean: Tensor) -> JointMove:
        """What kernels make of these numbers, kept for the next call: an iteration for tangents
        always asks for the same."""
        before = vars(self).get("_last")
        if before is None or not (
            torch.equal(before[0], released) and torch.equal(before[1], mean)
        ):
            made = JointMove(*compiled_uptake.move(self, released, mean, self._far))
            before = vars(self)["_last"] = released, mean, made
        return before[2]

    def settled(self, moved: JointMove, released: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The signal at the end, (voxels,), to which cells have given exactly what they released,
        up to rounding; what they took beyond what there was, (B,), conc·µm³; and by how much each
        took more than transport gave it, (N,).

        The iteration leaves a difference within its tolerance. It is written where the cell is; and
        what is not there, is taken from all voxels of the colony in proportion to what they hold.
        """
        wanted = -_parted(torch.where(self.fed, released.double(), 0.0), moved.mean)[1]
        left, there = wanted + moved.taken, read(moved.end, self.stencil)
        most = -0.5 * there * self.pool
        # not maximum, whose derivative is the mean of both where they are equal, as where all is 0
        here = torch.where(left < most, most, left)
        end, missing = write(moved.end, here, self.stencil, there), here - left
        if not bool((missing > 0).any()):
            return end, missing.new_zeros(self.groups.size), left
        of_grids = Groups(self.grid.owner, self.groups.size, ordered=True)
        content = of_grids.sum(end) * self.grid.voxel_volume
        missing = self.groups.sum(missing)
        kept = (1 - missing / content.clamp(min=TINY)).clamp(min=0.0)
        kept = torch.where(missing > 0, kept, 1.0)
        end = end * kept.index_select(0, self.grid.owner)
        return end, (missing - content).clamp(min=0.0), left

    def coarse(self, moved: JointMove, released: Tensor) -> Tensor:
        """The colonies, (B,) bool, for which the step is too long: they took backward Euler, whose
        error is half the share that left times the share by which the content changed, a step.
        Of what cells took both are more than COARSE, in the geometric mean; or of all that left,
        by decay and through faces too, each is more than LATE, but for what is within reach of its
        steady state in any case. released: (N,), conc·µm³."""
        far = torch.zeros(self.groups.size, dtype=torch.bool, device=self.field.device)
        for batch, own in zip(self.grid.batches, self._far, strict=True):
            far[batch.colonies] = torch.as_tensor(own, device=far.device)
        if not bool(far.any()):
            return far
        of_grids = Groups(self.grid.owner, self.groups.size, ordered=True)
        fields = torch.stack([both(x.detach())[0].double() for x in (self.field, moved.end)], 1)
        before, after = (of_grids.sum(fields) * self.grid.voxel_volume).unbind(1)
        taken = self.groups.sum(both(moved.taken.detach())[0])
        nothing = self.finest * self.grid.voxel_volume * of_grids.counts
        change = (after - before).abs()
        given = torch.where(self.fed, both(released.detach())[0].double().clamp(min=0.0), 0.0)
        left = self.groups.sum(given) + self._entered() - (after - before)
        eaten = taken * change > COARSE**2 * after * before
        lesser = torch.minimum(left, change).clamp(min=0.0)
        late = lesser * _astray(left, after) > LATE * (after * before).sqrt()
        return far & (eaten | late) & (before > nothing)

    def _entered(self) -> Tensor:
        """What came from sources and through faces, (B,), conc·µm³."""
        found = torch.zeros(self.groups.size, dtype=torch.float64, device=self.field.device)
        for one, batch in zip(self.carried, self.grid.batches, strict=True):
            if (gain := one.operator.gain) is not None:
                total = both(gain.detach())[0].sum((1, 2, 3))
                found[batch.colonies] = total.expand(len(batch.colonies))
        return found * (self.grid.voxel_volume * self.dt)

    def _spread(self, per_cell: Tensor) -> Tensor:
        """(N,) to the voxels."""
        return self.stencil.sum(self.stencil.weight.double() * per_cell.unsqueeze(1))

    def _read(self, field: Tensor) -> Tensor:
        """What each cell finds of a field (voxels,), (N,)."""
        return (self.stencil.weight.double() * self.stencil.gather(field)).sum(1)


def _astray(left: Tensor, after: Tensor) -> Tensor:
    """By how much a step of backward Euler is off the exponential, as a share of what it is where
    little leaves, (B,): with x = left/after it goes (1 − (1 + x) exp(−x))/x of its way too far or
    not far enough, against x/2. What is lost within a step is close to its steady state then."""
    x = (left.clamp(min=0.0) / after.clamp(min=TINY)).clamp(max=MANY)
    off = -torch.expm1(-x) - x * torch.exp(-x)
    small = x < SLIGHT
    return torch.where(small, 1.0, 2.0 * off / torch.where(small, 1.0, x * x.clamp(max=1.0)))

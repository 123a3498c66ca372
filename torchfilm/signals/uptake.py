"""Uptake and transport of one signal, solved together.

A cell of volume V that finds the concentration s takes up g(s) V / yield per hour, with its growth
rate g = rate · s/(half + s). Over a step of Δt hours it grows at g of the mean concentration s̄ that
it finds, so that it takes V (exp(g Δt) − 1)/yield: per hour and unit of s̄ the volume

    k(s̄) = V (exp(g Δt) − 1) / (yield · s̄ · Δt)

Each voxel loses weight · k / (volume of a voxel) of its content per hour to each cell. With these
losses given, transport is linear and no content becomes negative (`signals.transport_uptake`); and
s̄ follows from its mean. The equation s̄ = F(s̄) is solved by Anderson's mixing. What
cells take is what voxels lose after any number of iterations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.signals import compiled_uptake
from torchfilm.signals.compiled import may_run
from torchfilm.signals.grid import Grid
from torchfilm.signals.stencil import Stencil
from torchfilm.signals.transport_uptake import UptakeTransport
from torchfilm.tools.fixed_point import fixed_point, with_derivative
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import both, tracked

# Of the mean concentration, relative to half + s̄, where iteration ends. MOST: iterations; hard
# cases take some twenty.
CLOSE = 1e-8
MOST = 100


@dataclass(frozen=True, eq=False)
class Eaters:
    """The cells that take up a signal in one step of `dt` hours.

    volume, greatest, half, gain: (N,) float64, V, rate, half and yield. fed: (N,) bool, cells in
    the box; the others meet the reservoir. groups: of the cells by colony.
    """

    volume: Tensor
    greatest: Tensor
    half: Tensor
    gain: Tensor
    fed: Tensor
    stencil: Stencil
    groups: Groups
    dt: float

    def grown(self, mean: Tensor) -> Tensor:
        """(exp(g Δt) − 1), (N,), for the mean concentrations s̄ (N,)."""
        return torch.expm1(self.greatest * mean / (self.half + mean) * self.dt)

    def taking(self, mean: Tensor) -> Tensor:
        """k, (N,) µm³/h; 0 for cells outside the box."""
        g = self.greatest / (self.half + mean)  # g / s̄
        x = g * mean * self.dt
        ratio = torch.where(x.abs() > 1e-300, torch.expm1(x) / torch.where(x == 0, 1.0, x), 1.0)
        return torch.where(self.fed, self.volume / self.gain * g * ratio, 0.0)

    def losses(self, taking: Tensor) -> Tensor:
        """The rate at which each voxel loses, (voxels,) 1/h."""
        share = (taking / self.stencil.voxel_volume).unsqueeze(1)
        return self.stencil.sum(self.stencil.weight.double() * share)

    def read(self, field: Tensor) -> Tensor:
        """What each cell finds of a float64 field (voxels,), (N,)."""
        return (self.stencil.weight.double() * self.stencil.gather(field)).sum(1)


@dataclass(frozen=True, eq=False)
class Taken:
    """end: (voxels,). amount: (N,) float64, what each cell took, conc·µm³, also from a reservoir.
    iterations: (B,). failed: (B,) bool."""

    end: Tensor
    amount: Tensor
    iterations: Tensor
    failed: Tensor


def solve(
    eaters: Eaters, grid: Grid, carried: Sequence[UptakeTransport], field: Tensor, found: Tensor
) -> Taken:
    """A step. carried: transport on each of `grid.batches`. field: (voxels,), the signal. found:
    (N,), what each cell finds of it at the start, which in a reservoir is constant."""
    found = found.double()
    numbers = eaters.volume, eaters.greatest, eaters.half, eaters.gain, eaters.stencil.weight
    kernels = [x.compiled for x in carried if x.compiled is not None]
    if len(kernels) == len(carried) and may_run(field, found, *numbers):
        return Taken(*compiled_uptake.eat(eaters, grid, kernels, field, found, CLOSE, MOST))
    step = _Step(eaters, grid, carried, field, found)
    half = both(eaters.half)[0].detach()
    with torch.no_grad():
        fixed = fixed_point(
            lambda x: both(step(x)[1])[0], both(found)[0],
            lambda x, new: half + torch.maximum(x, new), eaters.groups, CLOSE, MOST, positive=True,
            turned=step.turned,
        )  # fmt: skip
    mean = fixed.x
    if tracked(field, found, *numbers, *(x for one in carried for x in one.numbers())):
        mean = with_derivative(
            lambda x: step(x)[1], mean, eaters.groups, CLOSE, MOST, "uptake of a nutrient"
        )
    taking = eaters.taking(mean)
    end, new = step(mean)
    amount = torch.where(
        eaters.fed, taking * new * eaters.dt, eaters.volume / eaters.gain * eaters.grown(found)
    )
    return Taken(end, amount, fixed.iterations, fixed.failed)


class _Step:
    """The function from s̄ to the field at the end (voxels,) and F(s̄)."""

    def __init__(
        self, eaters: Eaters, grid: Grid, carried: Sequence[UptakeTransport], field: Tensor,
        found: Tensor,
    ):  # fmt: skip
        self.eaters, self.grid, self.carried = eaters, grid, carried
        self.field, self.found = field, found
        # once a colony needs backward Euler it keeps to it, or the two would alternate
        self.far: list[Tensor | None] = [None] * len(carried)
        self._turned = torch.zeros(eaters.groups.size, dtype=torch.bool, device=field.device)

    def turned(self) -> Tensor:
        """The colonies whose equation has changed in the last call, (B,) bool."""
        return self._turned

    def __call__(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        eaters, grid = self.eaters, self.grid
        losses = eaters.losses(eaters.taking(mean))
        ends, means = [], []
        for k, (one, batch) in enumerate(zip(self.carried, grid.batches, strict=True)):
            before = self.far[k]
            end, average, far = one.step(batch.of(self.field), batch.of(losses), eaters.dt, before)
            if before is not None:
                self._turned[batch.colonies] = far & ~before
            self.far[k] = far
            ends.append(end)
            means.append(average)
        read = eaters.read(grid.join(means))
        return grid.join(ends), torch.where(eaters.fed, read, self.found)

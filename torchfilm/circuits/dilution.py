"""Cells that grow dilute what they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.expressions import derivatives
from torchfilm.circuits.graph import CircuitGraph
from torchfilm.physics import capsule
from torchfilm.tools.numba_calls import as_array, unavailable
from torchfilm.tools.tangents import scaled, tracked
from torchfilm.tools.vectors import nearest_root


@dataclass(frozen=True, eq=False)
class HalfWay:
    """N cells half way, in time, between the volume that their concentrations refer to and their
    own. length: µm, volume: µm³, area: µm². before, after: by which growth up to there, and from
    there on, multiplies concentrations. end: their own volume, µm³. (N,) each."""

    length: Tensor
    volume: Tensor
    area: Tensor
    before: Tensor
    after: Tensor
    end: Tensor


def half_way(length: Tensor, radius: Tensor, volume: Tensor) -> HalfWay:
    """length, radius: (N,) µm, of the cells now. volume: (N,) µm³, that their concentrations refer
    to."""
    given = length, radius, volume
    if length.device.type == "cpu" and not tracked(*given) and not unavailable():
        from torchfilm.kernels.columns import half_way as put

        arrays = [as_array(x, length.dtype) for x in given]
        out = np.empty((6, len(arrays[0])), arrays[0].dtype)
        put(*arrays, out)
        return HalfWay(*torch.from_numpy(out).unbind())
    end = capsule.volume(length, radius)
    middle = nearest_root(volume * end)
    longer = middle / (torch.pi * radius * radius) - radius * (4.0 / 3.0)
    own = _valued(longer, torch.where(volume == end, length, longer.clamp(min=0.0)))
    middle = capsule.volume(own, radius)
    return HalfWay(own, middle, capsule.area(own, radius), volume / middle, middle / end, end)


def part_way(length: Tensor, radius: Tensor, volume: Tensor, share: float) -> Tensor:
    """The lengths at which cells have come this share of the way from `volume`, (N,) µm³, to the
    volume that they have at their `length`, (N,) µm. Only sums, products and quotients: these have
    the same bits in any batch."""
    now = volume + (capsule.volume(length, radius) - volume) * share
    part = now / (torch.pi * radius * radius) - radius * (4.0 / 3.0)
    return _valued(part, torch.where(now == volume, length, part.clamp(min=0.0)))


def _valued(x: Tensor, value: Tensor) -> Tensor:
    """These values with the derivatives of x."""
    return value.detach() + (x - x.detach()) if tracked(x) else value


@dataclass(frozen=True, eq=False)
class Start:
    """What N cells begin a step with. fields: concentrations of the species by name, (N,), before
    growth has diluted them. diluted: those that it dilutes."""

    fields: Mapping[str, Tensor]
    diluted: Sequence[str]
    half: HalfWay

    @cached_property
    def _half_way(self) -> dict[str, Tensor]:
        by, own = self.half.before, self.diluted
        return {n: scaled(x, by) if n in own else x for n, x in self.fields.items()}

    def concentrations(self, rows: Tensor) -> Tensor:
        """Half way, of the cells `rows` (M,): (M, S)."""
        return torch.stack([x.index_select(0, rows) for x in self._half_way.values()], 1)

    def kept(self) -> dict[str, Tensor]:
        """In cells that nothing but growth changes, (N,)."""
        by, own = self.half.after, self.diluted
        return {n: scaled(x, by) if n in own else x for n, x in self._half_way.items()}


def written_dilution(graph: CircuitGraph, known: Mapping[str, float]) -> list[str]:
    """The species whose rates lose cell.growth_rate times their own level: ∂²rate/∂rate of growth
    ∂level is −1 everywhere. known: constants that have one value."""
    make, found = graph.builder, []
    by_growth = derivatives(make, graph.rates.values(), make.name("cell.growth_rate"))
    for name, rate in graph.rates.items():
        slope = by_growth.get(rate)
        both = derivatives(make, [slope], make.name(f"u.{name}")).get(slope) if slope else None
        if both is not None:
            only = replace(graph, rates={name: both}, releases={})
            slopes = only.at_random(0, 0.2, 2.0, known)
            if len(slopes) and np.allclose(slopes, -1.0, rtol=1e-9, atol=0.0):
                found.append(name)
    return found

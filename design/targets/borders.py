"""The border of two populations of cells, and how far from it each cell lies."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torchfilm as tf

TOUCHING = 1e-9  # µm: the least distance between cells of two types, also where they overlap
BLOCK = 2048  # cells whose distances to all others are in memory at once


def on_axis(state: tf.State, along: str) -> Tensor:
    """The coordinate of each cell along x or y, (N,) float64 µm, without gradient."""
    return state.position.detach()[:, "xy".index(along)].double()


def _images(state: tf.State, place: Tensor) -> list[Tensor]:
    """Places (N, 2) and, in a periodic space, their images in the periods around."""
    images = [place]
    for k, period in enumerate(() if state.space is None else state.space.period[:2]):
        if period:
            step = place.new_zeros(2)
            step[k] = period
            images = [image + side * step for image in images for side in (-1, 0, 1)]
    return images


@torch.no_grad()
def from_border(state: tf.State, low_type: Tensor) -> Tensor:
    """The distance of each cell to the nearest cell of the other type, (N,) float64 µm: seen from
    above, centre to centre less a diameter. It is negative for `low_type` (B,), the type that lies
    lower on the axis, and NaN where there is no other type."""
    position, kind = state.position.detach()[:, :2], state.cell_type
    found = torch.full((state.cells,), math.nan, dtype=torch.float64, device=state.device)
    of_one = kind == (-state.groups.max(-kind)).index_select(0, state.colony)
    # the cells of each colony, those of its first type first
    order = torch.argsort(2 * state.colony + (~of_one).long(), stable=True)
    firsts = state.groups.sum(of_one.double().unsqueeze(1)).squeeze(1).long()
    sizes = torch.stack([firsts, state.counts - firsts], 1)
    parts = order.split(sizes.flatten().tolist())  # the one read
    for one, other in zip(parts[::2], parts[1::2], strict=True):
        if not other.numel():
            continue
        for these, those in ((one, other), (other, one)):
            for some in these.split(BLOCK):
                apart = torch.full_like(found[some], math.inf)
                for image in _images(state, position[those]):
                    distance = torch.cdist(
                        position[some], image, compute_mode="donot_use_mm_for_euclid_dist"
                    )
                    apart = torch.minimum(apart, distance.amin(1))
                found[some] = apart
    found = (found - 2.0 * state.radius.detach().double()).clamp(min=TOUCHING)
    return torch.where(kind == low_type.index_select(0, state.colony), -found, found)


@torch.no_grad()
def border(state: tf.State, along: str = "x") -> tuple[Tensor, Tensor]:
    """The border of the two types of cells of each colony, (B,) float64 µm, and the type that lies
    before it, (B,) int64.

    It is the place along x or y with the fewest cells on the wrong side, half-way between two cells
    (the first of several such places). The type with the lower mean place belongs before it. NaN
    where a colony has one type only; of more than two types, the lowest and the highest number
    count.
    """
    groups, colony, x = state.groups, state.colony, on_axis(state, along)
    if not state.cells:
        return x.new_full((state.colonies,), math.nan), colony.new_zeros(state.colonies)
    one, other = -groups.max(-state.cell_type), groups.max(state.cell_type)
    is_one, is_other = (state.cell_type == t.index_select(0, colony) for t in (one, other))
    sums = groups.sum(
        torch.stack([is_one * x, is_one.double(), is_other * x, is_other.double()], 1)
    )
    straight = sums[:, 0] * sums[:, 3] <= sums[:, 2] * sums[:, 1]
    before = torch.where(straight, one, other)
    # cells on the wrong side for a border after each cell, less those for a border before all cells
    order = torch.argsort(x, stable=True)
    order = order.index_select(0, torch.argsort(colony.index_select(0, order), stable=True))
    step = (is_other.long() - is_one.long()) * torch.where(straight, 1, -1).index_select(0, colony)
    wrong = torch.cumsum(step.index_select(0, order), 0)
    least = (-groups.max(-wrong)).index_select(0, colony)
    row = torch.arange(state.cells, device=state.device)
    first = -groups.max(torch.where(wrong == least, -row, -state.cells))
    last = groups.max(row)
    x = x.index_select(0, order)
    place = 0.5 * (
        x.index_select(0, first.clamp(max=state.cells - 1))
        + x.index_select(0, torch.minimum(first + 1, last))
    )
    return torch.where((state.counts > 0) & (one < other), place, math.nan), before

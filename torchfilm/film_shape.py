"""The shape of a biofilm on a floor: its height above each place of the floor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.physics.space import checked_spans
from torchfilm.state import State
from torchfilm.tools import checks

AXES = "xyz"
# A cell is a row of spheres, this share of its radius apart: its top is found to a few nanometres.
APART = 0.25


@dataclass(frozen=True)
class Film:
    """The film of each colony. height: (B, C) float64 µm, of the highest cell above the middle of
    each of C columns of the floor, 0 where there is none; in space (B, CX, CY). thickness: (B,)
    their mean. roughness: (B,) the mean of |height − thickness| over the thickness, 0 for a flat
    film (Heydorn et al., Microbiology 146, 2395, 2000); NaN without cells on the floor. coverage:
    (B,) the share of the columns in which there is a cell."""

    height: Tensor
    thickness: Tensor
    roughness: Tensor
    coverage: Tensor


def film_of(
    state: State, spacing: float, floor: float, across: Mapping[str, tuple[float, float]] | None
) -> Film:
    """See `measure.film`."""
    ground, upward = AXES[: state.dim - 1], AXES[state.dim - 1]
    if state.space is not None and upward in state.space.faces:
        raise checks.InputError(
            f"film measures height along {upward}, and space is periodic there: there is no floor."
        )
    spans = _spans(state, ground, across)
    counts = [max(1, math.ceil((high - low) / spacing - 1e-9)) for low, high in spans]
    steps = [(high - low) / count for (low, high), count in zip(spans, counts, strict=True)]
    points, radius, colony = _spheres(state)
    spread = [int((float(radius.max()) if len(radius) else 0.0) / step) + 1 for step in steps]
    nearest = [
        torch.floor((points[:, k] - low) / step).long()
        for k, ((low, _), step) in enumerate(zip(spans, steps, strict=True))
    ]
    periodic = [state.space is not None and a in state.space.faces for a in ground]
    columns = torch.cartesian_prod(*[torch.arange(-s, s + 1, device=state.device) for s in spread])
    size = state.colonies * math.prod(counts)
    height = points.new_zeros(size)
    for offset in columns.reshape(-1, len(counts)):
        place, apart = colony, torch.zeros_like(radius)
        inside = torch.ones_like(colony, dtype=torch.bool)
        for k, ((low, _), step, count) in enumerate(zip(spans, steps, counts, strict=True)):
            column = nearest[k] + offset[k]
            apart = apart + (low + (column + 0.5) * step - points[:, k]) ** 2
            if not periodic[k]:
                inside &= (column >= 0) & (column < count)
            place = place * count + column % count
        rise = radius * radius - apart
        meets = inside & (rise >= 0)
        top = points[meets, state.dim - 1] + rise[meets].sqrt() - floor
        height = height.scatter_reduce(0, place[meets], top, "amax")
    height = height.reshape(state.colonies, *counts)
    flat = height.flatten(1)
    thickness = flat.mean(1)
    roughness = (flat - thickness.unsqueeze(1)).abs().mean(1) / thickness
    return Film(height, thickness, roughness, (flat > 0).double().mean(1))


def _spans(
    state: State, ground: str, across: Mapping[str, tuple[float, float]] | None
) -> list[tuple[float, float]]:
    """From where to where the floor is measured, along each of its axes, µm."""
    found: dict[str, tuple[float, float]] = {}
    if state.layout is not None:
        grid = state.layout.grid
        step = torch.tensor(grid.spacing, dtype=torch.float64, device=state.device)
        low, high = grid.origin, grid.origin + grid.shape * step
        for k, axis in enumerate(ground):
            if bool((low[:, k] == low[0, k]).all() & (high[:, k] == high[0, k]).all()):
                found[axis] = float(low[0, k]), float(high[0, k])
    found |= {} if state.space is None else state.space.faces
    for axis, span in checked_spans(
        "film(across)", {} if across is None else across, ground
    ).items():
        faces = {} if state.space is None else state.space.faces
        if faces.get(axis, span) != span:
            rule = f"left out along {axis}, where space is periodic"
            raise checks.input_error("film(across)", across, rule)
        found[axis] = span
    if missing := [a for a in ground if a not in found]:
        raise checks.InputError(
            f"film does not know how far the floor reaches along {' and '.join(missing)}: space is"
            " not periodic there, and there is no medium that is as wide in all colonies. Give it,"
            f" such as across={{{missing[0]!r}: (0, 40)}}."
        )
    return [found[a] for a in ground]


def _spheres(state: State) -> tuple[Tensor, Tensor, Tensor]:
    """Spheres in a row that make up the cells: places (P, d), radii (P,), colonies (P,)."""
    length, radius = state.length.double(), state.radius.double()
    parts = torch.ceil(length / (APART * radius)).long() + 1
    owner = torch.repeat_interleave(torch.arange(state.cells, device=state.device), parts)
    first = torch.cumsum(parts, 0) - parts
    rank = torch.arange(len(owner), device=state.device) - first.index_select(0, owner)
    share = rank / (parts.index_select(0, owner) - 1).clamp(min=1) - 0.5
    along = (share * length.index_select(0, owner)).unsqueeze(1)
    pick = lambda x: x.index_select(0, owner)
    return (
        pick(state.position) + along * pick(state.axis.double()),
        pick(radius),
        pick(state.colony),
    )

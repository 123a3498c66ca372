"""The rows of pairs that are near, for one-sided contacts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfilm.kernels.scheme import BEYOND
from torchfilm.physics.contacts import (
    CandidateContacts,
    Contacts,
    end_of,
    gap_at,
    line_points,
    rows_at,
)
from torchfilm.physics.stretches import stretch_of
from torchfilm.tools.reads import rows_where


def near_rows(pairs: CandidateContacts, margin: Tensor) -> Contacts:
    """The rows of all pairs, gaps as they are: one at the closest points, or, where two cells touch
    along a line, two of weight ½ at its ends. And one of weight ½ at each end of the stretch along
    which two cells lie side by side, where it is far from those and nearer than `margin` (K,)."""
    a, b, s, t = pairs.a, pairs.b, pairs.s, pairs.t
    flat = pairs.flat
    *of_lines, line = line_points(
        a.take(flat), b.take(flat), s.index_select(0, flat), t.index_select(0, flat)
    )
    points = [
        torch.stack([x, x]).index_copy(1, flat, two)
        for x, two in zip((s, t, end_of(s, a.half), end_of(t, b.half)), of_lines, strict=True)
    ]
    along = stretch_of(a, b)
    with torch.no_grad():
        two = torch.zeros_like(s, dtype=torch.bool).index_copy(0, flat, line)
        far = _far(pairs, along.length, along.points, points, margin)
        kept = rows_where(torch.ones_like(two), two, *far)
        none, all_ = torch.zeros_like(two), torch.ones_like(two)
    weight = torch.full_like(s, 0.5)
    weights = [torch.where(two, weight, 1.0), weight, weight, weight]
    keep = torch.cat(kept)
    order = torch.argsort(keep, stable=True)  # the rows of a pair side by side
    picked = lambda rows: torch.cat(
        [x.index_select(0, k) for x, k in zip(rows, kept, strict=True)]
    ).index_select(0, order)
    weight = picked(weights)
    at = [picked([*x, *ends]) for x, ends in zip(points, along.points, strict=True)]
    keep = keep.index_select(0, order)
    gap, row_first, row_second, normal = rows_at(a.take(keep), b.take(keep), *at)
    pick = lambda x: x.index_select(0, keep)
    return Contacts(
        pick(pairs.first), pick(pairs.second), gap, weight, row_first, row_second, normal,
        picked([none, none, all_, all_]),
    )  # fmt: skip


def _far(
    pairs: CandidateContacts, length: Tensor, ends: Sequence[Tensor], points: Sequence[Tensor],
    margin: Tensor,
) -> list[Tensor]:  # fmt: skip
    """Whether each of the two ends of the stretch, of this length, has a row, (K,) bool each: where
    its arc lengths, (2, K), are far from those of the contact's rows."""
    (s, t, *_), (s0, t0, *_), a, b = ends, points, pairs.a, pairs.b
    touching = a.radius + b.radius
    arm = (s - s0).abs() + (t - t0).abs()
    far = (length > 0) & (arm > BEYOND * touching)
    for k in range(2):
        gap = gap_at(a, b, s[k], t[k])
        far[k] &= (gap < margin) & (gap + touching > 1e-5 * touching)
    return list(far)

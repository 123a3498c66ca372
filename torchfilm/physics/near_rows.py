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


def near_rows(pairs: CandidateContacts, margin: Tensor | None) -> Contacts:
    """The rows of all pairs, gaps as they are: one at the closest points, or, where two cells touch
    along a line, two of weight ½ at its ends. And in space one of weight ½ at each end of the
    stretch along which two cells lie side by side, where it is far from those and nearer than
    `margin` (K,); None: nowhere, for soft cells, which more rows would make stiffer."""
    a, b, s, t = pairs.a, pairs.b, pairs.s, pairs.t
    flat = pairs.flat
    *of_lines, line = line_points(
        a.take(flat), b.take(flat), s.index_select(0, flat), t.index_select(0, flat)
    )
    points = [
        torch.stack([x, x]).index_copy(1, flat, two)
        for x, two in zip((s, t, end_of(s, a.half), end_of(t, b.half)), of_lines, strict=True)
    ]
    one = torch.ones_like(s, dtype=torch.bool)
    two = torch.zeros_like(one).index_copy(0, flat, line)
    marks, ends = [one, two], [x.new_empty(0, x.shape[1]) for x in points]
    if margin is not None and a.axis.shape[0] == 3:
        along = stretch_of(a, b)
        ends = list(along.points)
        with torch.no_grad():
            marks += _far(pairs, along.length, ends, points, margin)
    kept = rows_where(*marks)
    half = torch.full_like(s, 0.5)
    weights = [torch.where(two, half, 1.0), half, half, half]
    far = [~one, ~one, one, one]
    keep = torch.cat(kept)
    order = torch.argsort(keep, stable=True)  # the rows of a pair side by side
    picked = lambda rows: torch.cat(
        [x.index_select(0, k) for x, k in zip(rows, kept, strict=False)]
    ).index_select(0, order)
    weight = picked(weights)
    at = [picked([*x, *e]) for x, e in zip(points, ends, strict=True)]
    keep = keep.index_select(0, order)
    gap, row_first, row_second, normal = rows_at(a.take(keep), b.take(keep), *at)
    pick = lambda x: x.index_select(0, keep)
    return Contacts(
        pick(pairs.first), pick(pairs.second), gap, weight, row_first, row_second, normal,
        picked(far),
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

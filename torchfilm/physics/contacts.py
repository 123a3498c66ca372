"""Narrow phase: where two capsules touch, and how the gap changes with each degree of freedom.

A cell has seven degrees of freedom, or four in 2-D. Tensors are component first: a vector over P
pairs is (d, P).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.kernels.bilateral_scheme import CANDIDATE, NEAR
from torchfilm.physics.space import PeriodicSpace
from torchfilm.physics.stretches import Stretch, stretch_of
from torchfilm.tools.reads import rows_where
from torchfilm.tools.vectors import cross, dot, perpendicular, safe_norm, safe_sqrt

# Sine of the angle between two axes at which a line of contact has shrunk to a point (see
# `line_points`).
LINE_CONTACT_SINE = 0.4
# Where centrelines cross, the nearer end of a line of contact lies to the side of the crossing by
# at most CROSSED times their distance, so that cells are there at most 2 % farther apart. Where it
# was as far aside as they are apart, nothing parted rods of 12 µm that were 0.15 µm deep.
CROSSED = 0.2


@dataclass(frozen=True)
class Capsules:
    """Capsules, component first.

    centre: (d, N) µm. axis: (d, N) unit. half: (N,) half the centreline length, µm. radius: (N,)
    µm. space: where they are, if it is periodic.
    """

    centre: Tensor
    axis: Tensor
    half: Tensor
    radius: Tensor
    space: PeriodicSpace | None = None

    def take(self, index: Tensor) -> Capsules:
        """The capsules at `index`."""
        return Capsules(
            self.centre.index_select(1, index),
            self.axis.index_select(1, index),
            self.half.index_select(0, index),
            self.radius.index_select(0, index),
            self.space,
        )

    def pairs(self, first: Tensor, second: Tensor) -> tuple[Capsules, Capsules]:
        """The capsules of pairs (P,), the second one where it is nearest to the first."""
        a, b = self.take(first), self.take(second)
        if self.space is not None:
            b = replace(
                b, centre=b.centre + self.space.shift(b.centre.detach() - a.centre.detach())
            )
        return a, b


@dataclass(frozen=True)
class Contacts:
    """K rows of the contact problem, each of a pair of cells.

    first, second: (K,) the cells. gap: (K,) µm. weight: D², (K,). `row_first`, `row_second`: (K, 4)
    in 2-D [n, q×n, ∂] and (K, 7) in 3-D. The gap after moves x is gap − row_first·x_first −
    row_second·x_second. `normal`: (d, K) from first to second. beside: (K,) bool, rows of
    one-sided contacts that do not count for α: at the ends of stretches, not at the contact, and
    those that pull; None if there are none. pull: (K,) stiffness · Δt of rows that pull (see
    `adhesion`), 0 of others; None if there are none.
    """

    first: Tensor
    second: Tensor
    gap: Tensor
    weight: Tensor
    row_first: Tensor
    row_second: Tensor
    normal: Tensor
    beside: Tensor | None = None
    pull: Tensor | None = None


def closest_points(a: Capsules, b: Capsules) -> tuple[Tensor, Tensor]:
    """Arc lengths (s, t), each (P,) µm from its centre, of the closest points of two centrelines.

    The result is the nearest of five candidates: each of the four ends against the other segment,
    and the common perpendicular of the two lines. The common perpendicular alone loses all accuracy
    as the lines become parallel; the nearest of the five never does.
    """
    between = b.centre - a.centre
    cosine = dot(a.axis, b.axis)
    on_a, on_b = dot(between, a.axis), dot(between, b.axis)
    normal = cross(a.axis, b.axis)
    sine2 = dot(normal, normal)
    parallel = sine2 < 1e-12
    divisor = torch.where(parallel, 1.0, sine2)
    s = torch.where(parallel, 0.0, (on_a - cosine * on_b) / divisor)
    s = torch.minimum(torch.maximum(s, -a.half), a.half)
    t = _clamp(cosine * s - on_b, b.half)
    s = _clamp(cosine * t + on_a, a.half)
    best_s, best_t = s, t
    best = _distance2(between, a.axis, b.axis, s, t)
    for sign in (1.0, -1.0):
        for end_of_a in (True, False):
            if end_of_a:
                s = sign * a.half
                t = _clamp(cosine * s - on_b, b.half)
            else:
                t = sign * b.half
                s = _clamp(cosine * t + on_a, a.half)
            d2 = _distance2(between, a.axis, b.axis, s, t)
            closer = d2 < best
            best = torch.where(closer, d2, best)
            best_s, best_t = torch.where(closer, s, best_s), torch.where(closer, t, best_t)
    return best_s, best_t


def _clamp(x: Tensor, half: Tensor) -> Tensor:
    """x, limited to −half … half."""
    return torch.minimum(torch.maximum(x, -half), half)


def _distance2(between: Tensor, axis_a: Tensor, axis_b: Tensor, s: Tensor, t: Tensor) -> Tensor:
    """Squared distance of the points s and t of two centrelines."""
    d = between + t * axis_b - s * axis_a
    return dot(d, d)


def slide_of(sine2: Tensor) -> Tensor:
    """How far the ends of a line of contact are from meeting, (P,). sine2: of the axes' angle.

    1 for parallel axes; 0 or less where there is no line.
    """
    return 1.0 - sine2 / LINE_CONTACT_SINE**2


def line_points(
    a: Capsules, b: Capsules, s0: Tensor, t0: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """One or two contact points of each pair, from its `closest_points` (s0, t0).

    Returns s (2, P), t (2, P), end of a (2, P), end of b (2, P), and whether the contact is a line
    (P,).

    Two parallel capsules touch along a line, two at an angle touch at a point. In between, the ends
    of the line slide towards the closest point as the sine of the angle grows to
    `LINE_CONTACT_SINE`, where they meet and the line ends. Each end of the line carries half the
    weight (D = 1/√2), so neither force nor torque jumps. An `end` is −1, 0 or +1, or in between
    while it slides: the part of ½ l with which the point moves when the cell grows.
    """
    turn, cosine, between = cross(a.axis, b.axis), dot(a.axis, b.axis), b.centre - a.centre
    sine2 = dot(turn, turn)
    slide = slide_of(sine2)
    along = stretch_of(a, b)
    line = (slide > 0) & (along.length > 0)
    # a line shorter than the cells' thickness counts as less of a line, so that it vanishes
    # smoothly as cells slide apart, as it does when they turn
    share = (along.length / (0.5 * (a.radius + b.radius))).clamp(max=1.0)
    # so does the line of two centrelines that cross, whose ends lie on opposite sides: the contact
    # is near the crossing
    swing = 0.5 * along.length * safe_sqrt(sine2)
    crossed = swing > 1e-6 * a.radius
    apart = safe_sqrt(_distance2(between, a.axis, b.axis, s0, t0))
    share = share * torch.where(crossed, apart / torch.where(crossed, swing, 1.0), 1.0).clamp(
        max=1.0
    )
    if len(between) == 3:
        aside = _inner(along, s0, t0, cosine) * safe_sqrt(sine2)
        crossed = aside > CROSSED * apart
        share = share * torch.where(
            crossed, CROSSED * apart / torch.where(crossed, aside, 1.0), 1.0
        )
    slide = torch.where(line, slide * slide * share, 0.0)
    end_a0 = _end_while_sliding(s0, cosine * t0 + dot(between, a.axis), a, slide)
    end_b0 = _end_while_sliding(t0, cosine * s0 - dot(between, b.axis), b, slide)
    start = s0, t0, end_a0, end_b0
    s, t, end_a, end_b = (x0 + slide * (x - x0) for x, x0 in zip(along.points, start, strict=True))
    return s, t, end_a, end_b, line


def _inner(along: Stretch, s0: Tensor, t0: Tensor, cosine: Tensor) -> Tensor:
    """How far the closest points are from the nearer end of the stretch, (P,) µm; 0 beyond it."""
    (s_low, s_high), (t_low, t_high) = along.points[:2]
    sign = torch.where(cosine < 0, -1.0, 1.0).to(s0.dtype)
    ways = s0 - s_low, s_high - s0, sign * (t0 - t_low), sign * (t_high - t0)
    return torch.stack(ways).amin(0).clamp(min=0.0)


def _end_while_sliding(s: Tensor, free: Tensor, cell: Capsules, slide: Tensor) -> Tensor:
    """`_end` of a closest point s, for contacts that may be lines.

    free: where the point would be on a line without ends. Where the point of a line has slid away
    from the closest point, the normal there is not perpendicular to the cell when the point leaves
    the end. So the value of the end falls to 0 with the distance of the end from `free`.
    """
    missing = (free.abs() - cell.half) / (slide * cell.radius + 1e-9)
    return torch.where(
        slide > 0, torch.sign(free) * missing.clamp(min=0.0, max=1.0), end_of(s, cell.half)
    )


def end_of(s: Tensor, half: Tensor) -> Tensor:
    """The end of the centreline at which a point is: +1, −1, or 0 for neither.

    For a sphere the two ends coincide, and the result is 0.
    """
    slack = 1e-6 * half + 1e-9
    return (s >= half - slack).to(s.dtype) - (s <= slack - half).to(s.dtype)


@dataclass(frozen=True)
class CandidateContacts:
    """K pairs of cells that overlap at their closest points, or are near there.

    first, second: (K,) the cells. a, b: their capsules. s, t: (K,) the points of `closest_points`.
    """

    first: Tensor
    second: Tensor
    a: Capsules
    b: Capsules
    s: Tensor
    t: Tensor

    @cached_property
    def flat(self) -> Tensor:
        """The pairs that may touch along a line, (F,): only nearly parallel ones may."""
        return rows_where(self._parallel)[0]

    @property
    def _parallel(self) -> Tensor:
        turn = cross(self.a.axis, self.b.axis).detach()
        return slide_of(dot(turn, turn)) > 0

    @staticmethod
    def all_of(capsules: Capsules, first: Tensor, second: Tensor) -> CandidateContacts:
        """The given pairs, each (P,)."""
        a, b = capsules.pairs(first, second)
        return CandidateContacts(first, second, a, b, *closest_points(a, b))

    @staticmethod
    def among(
        capsules: Capsules, first: Tensor, second: Tensor, include_near: bool = False
    ) -> CandidateContacts:
        """The given pairs, each (P,), that overlap; with include_near also those within NEAR."""
        found = CandidateContacts.all_of(capsules, first, second)
        most = max(CANDIDATE, 0.5 * NEAR * include_near) * (found.a.radius + found.b.radius)
        return found.nearer_than(most)

    @property
    def gap(self) -> Tensor:
        """The gap at the closest points, (K,) µm."""
        return gap_at(self.a, self.b, self.s, self.t)

    def nearer_than(self, most: Tensor) -> CandidateContacts:
        """The pairs with a smaller gap than `most` (K,)."""
        with torch.no_grad():
            near = self.gap < most
            index, flat = rows_where(near, near & self._parallel)
        pick = lambda x: x.index_select(0, index)
        made = CandidateContacts(
            pick(self.first),
            pick(self.second),
            self.a.take(index),
            self.b.take(index),
            pick(self.s),
            pick(self.t),
        )
        made.__dict__["flat"] = torch.searchsorted(index, flat)
        return made


def contacts_of(pairs: CandidateContacts, include_near: bool = False) -> Contacts:
    """The rows of all pairs that overlap (gap < 0).

    A line of contact that overlaps at one end only gets a row at the other end too, with gap 0.
    This row keeps that end from swinging in. Its weight falls from that of the line to 0, where the
    other end is as far apart as the first end overlaps. Without it a cell that is squeezed between
    two others rocks from step to step, and they close in on it.

    include_near: for a later pass, which moves cells again. It adds rows for pairs within NEAR,
    with gap 0 and weight that falls to 0 at that distance. Half of the pairs that a pass separates
    are slightly apart afterwards. A next pass without these rows pushed them together again, deeper
    with every pass where contacts are hard, until a full channel became a heap.
    """
    first, second, a, b, s, t = pairs.first, pairs.second, pairs.a, pairs.b, pairs.s, pairs.t
    flat = pairs.flat  # all others touch at the closest point
    flat_a, flat_b = a.take(flat), b.take(flat)
    *of_lines, line = line_points(flat_a, flat_b, s.index_select(0, flat), t.index_select(0, flat))
    points = [
        x.index_copy(0, flat, ends[0])
        for x, ends in zip((s, t, end_of(s, a.half), end_of(t, b.half)), of_lines, strict=True)
    ]
    ends = [gap_at(flat_a, flat_b, of_lines[0][k], of_lines[1][k]) for k in (0, 1)]
    point, margin = (
        gap_at(a, b, points[0], points[1]),
        0.5 * NEAR * include_near * (a.radius + b.radius),
    )
    # select again without a gradient: a first row for every pair, a second one where there is a
    # line
    with torch.no_grad():
        deep0, deep1 = point < margin, line & (ends[1] < margin.index_select(0, flat))
        either = line & (deep0.index_select(0, flat) | deep1) & (ends[0] + ends[1] < 0)
        deep0[flat] |= either
        keep0, keep1 = rows_where(deep0, deep1 | either)
    of_ends = _end_weights(ends, line, flat, point, margin, include_near)
    weight = torch.cat(
        [of_ends[0].index_select(0, keep0), of_ends[1].index_select(0, flat).index_select(0, keep1)]
    )
    keep = torch.cat([keep0, flat.index_select(0, keep1)])
    s, t, end_a, end_b = (
        torch.cat([x.index_select(0, keep0), two[1].index_select(0, keep1)])
        for x, two in zip(points, of_lines, strict=True)
    )
    a, b = a.take(keep), b.take(keep)
    gap, row_first, row_second, normal = rows_at(a, b, s, t, end_a, end_b)
    gap = gap.clamp(max=0.0)
    pick = lambda x: x.index_select(0, keep)
    return Contacts(pick(first), pick(second), gap, weight, row_first, row_second, normal)


def _end_weights(
    ends: list[Tensor],
    line: Tensor,
    flat: Tensor,
    point: Tensor,
    margin: Tensor,
    include_near: bool,
) -> list[Tensor]:
    """D² of the two rows that each pair may have, (K,) each.

    ends: the gaps at the two ends of the lines, which are the pairs `flat` where `line` is set.
    point: (K,) the gap of the first row. margin: (K,) see NEAR.
    """
    share = 0.5 * _weight_of_held_end(*ends)
    whole = torch.ones_like(point)
    if include_near:
        whole, of_each = (
            _weight_near(point, margin),
            [0.5 * _weight_near(end, margin.index_select(0, flat)) for end in ends],
        )
    else:
        of_each = [torch.where(end < 0, 0.5, 0.0) for end in ends]
    return [
        whole.index_copy(
            0, flat, torch.where(line, torch.maximum(each, share), whole.index_select(0, flat))
        )
        for each in of_each
    ]


def _weight_near(gap: Tensor, margin: Tensor) -> Tensor:
    """The weight of a row that keeps a gap: 1 for an overlap, 0 at a distance of `margin`.

    Its root falls linearly.
    """
    return (1.0 - gap / margin).clamp(min=0.0, max=1.0).square()


def _weight_of_held_end(one: Tensor, other: Tensor) -> Tensor:
    """The weight of a line's held end, from the gaps of the two ends, of which one is negative.

    1 while neither end is apart; 0 where one end is as far apart as the other overlaps.
    """
    deepest = torch.minimum(one, other)
    return ((one + other) / torch.where(deepest < 0, deepest, -1.0)).clamp(min=0.0, max=1.0)


def gap_at(a: Capsules, b: Capsules, s: Tensor, t: Tensor) -> Tensor:
    """The gap of each pair at the points s and t of the centrelines, (P,) µm."""
    return safe_sqrt(_distance2(b.centre - a.centre, a.axis, b.axis, s, t)) - a.radius - b.radius


def contact_gaps(capsules: Capsules, first: Tensor, second: Tensor) -> Tensor:
    """Signed gap of each pair at its closest points, (P,) µm; negative where they overlap."""
    a, b = capsules.pairs(first, second)
    return gap_at(a, b, *closest_points(a, b))


def rows_at(a: Capsules, b: Capsules, s: Tensor, t: Tensor, end_a: Tensor, end_b: Tensor):
    """Gap, the two cells' rows and the normal at points s and t of the centrelines."""
    lever_a, lever_b = s * a.axis, t * b.axis
    between = b.centre - a.centre + lever_b - lever_a
    distance = safe_norm(between)
    touching = distance <= 1e-5 * (a.radius + b.radius)
    normal = between / torch.where(touching, 1.0, distance)
    # rare, but to ask whether there is any costs a read
    normal = torch.where(touching, _fallback_normal(a, b), normal)
    gap = distance - a.radius - b.radius
    along_a, along_b = dot(normal, a.axis), dot(normal, b.axis)
    # a sphere grows at both ends at once: the end nearer to the contact counts
    end_a = torch.where(a.half <= 1e-9, torch.sign(along_a), end_a)
    end_b = torch.where(b.half <= 1e-9, -torch.sign(along_b), end_b)
    row_a = torch.cat([normal, cross(lever_a, normal), (0.5 * end_a * along_a).unsqueeze(0)])
    row_b = torch.cat([-normal, -cross(lever_b, normal), (-0.5 * end_b * along_b).unsqueeze(0)])
    return gap, row_a.T.contiguous(), row_b.T.contiguous(), normal


def _fallback_normal(a: Capsules, b: Capsules) -> Tensor:
    """A direction that separates two cells whose centrelines cross.

    It is the common perpendicular of the axes, or any perpendicular if they are parallel or in 2-D.
    """
    if a.axis.shape[0] == 2:
        # of both axes alike: which cell is the first of the two must not matter
        mean = a.axis + torch.where(dot(a.axis, b.axis) < 0, -1.0, 1.0) * b.axis
        way = perpendicular(mean / safe_norm(mean))
    else:
        way = perpendicular(a.axis)
        common = cross(a.axis, b.axis)
        size = safe_norm(common)
        parallel = size < 1e-6
        way = torch.where(parallel, way, common / torch.where(parallel, 1.0, size))
    # the sign that moves the centres apart
    return torch.where(dot(way, b.centre - a.centre) < 0, -way, way)

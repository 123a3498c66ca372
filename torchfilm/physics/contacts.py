"""Narrow phase: where two capsules touch, and how the gap there changes with each cell's seven (or
four) degrees of freedom.

Everything is component first: a vector over P pairs is (d, P).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.tools.vectors import cross, dot, perpendicular, safe_norm, safe_sqrt

# Sine of the angle between two axes at which a line of contact has shrunk to a point (see
# `contact_points`).
LINE_CONTACT_SINE = 0.4
# How near two surfaces are, in radii, that a pass which moves cells again keeps as far apart as
# they are (see `contacts_of`).
NEAR = 0.1


@dataclass(frozen=True)
class Capsules:
    """Capsules, component first: centre (d, N) µm, axis (d, N) unit, half (N,) half centreline µm,
    radius (N,) µm."""

    centre: Tensor
    axis: Tensor
    half: Tensor
    radius: Tensor

    def take(self, index: Tensor) -> Capsules:
        return Capsules(
            self.centre.index_select(1, index),
            self.axis.index_select(1, index),
            self.half.index_select(0, index),
            self.radius.index_select(0, index),
        )


@dataclass(frozen=True)
class Contacts:
    """Rows of the contact problem, K pairs' rows; first and second cell (K,), gap (K,) µm, weight
    D² (K,).

    `row_first`, `row_second`: (K, 4) in 2-D [n, q×n, ∂] and (K, 7) in 3-D: the gap after moves x is
    gap − row_first·x_first − row_second·x_second. `normal` (d, K) from first to second.
    """

    first: Tensor
    second: Tensor
    gap: Tensor
    weight: Tensor
    row_first: Tensor
    row_second: Tensor
    normal: Tensor


def closest_points(a: Capsules, b: Capsules) -> tuple[Tensor, Tensor]:
    """Arc lengths (s, t), each (P,) µm from its centre, of the closest points of two centrelines.

    The least of five candidates: each of the four ends against the other segment, and the common
    perpendicular of the two lines. The last one alone loses all accuracy as the lines become
    parallel; the least of the five never does.
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
    return torch.minimum(torch.maximum(x, -half), half)


def _distance2(between: Tensor, axis_a: Tensor, axis_b: Tensor, s: Tensor, t: Tensor) -> Tensor:
    d = between + t * axis_b - s * axis_a
    return dot(d, d)


def contact_points(a: Capsules, b: Capsules) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """One or two touching points of each pair: ((2, P) s, (2, P) t, (2, P) end of a, (2, P) end of
    b, (P,) is a line).

    Two capsules side by side touch along a line, two at an angle at a point. Between the two the
    ends of the line slide towards the closest point as the sine of the angle grows to
    `LINE_CONTACT_SINE`, and have met there when the line is given up; each carries half the weight
    (D = 1/√2), so neither force nor torque jumps. An `end` is −1, 0 or +1, or between while it
    slides: how much of ½ l the point moves with when the cell grows.
    """
    return _line_points(a, b, *closest_points(a, b))


def _slide(turn: Tensor) -> Tensor:
    """How far the ends of a line of contact are from having met, by the cross product of the axes
    alone, (P,): 1 where parallel, 0 or less where there is no line."""
    return 1.0 - dot(turn, turn) / LINE_CONTACT_SINE**2


def _line_points(
    a: Capsules, b: Capsules, s0: Tensor, t0: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What `contact_points` gives, from the closest points (s0, t0)."""
    turn = cross(a.axis, b.axis)
    slide = _slide(turn)
    # the common part of the two segments, measured along the mean axis so that neither cell is
    # preferred
    sign = torch.where(dot(a.axis, b.axis) < 0, -1.0, 1.0).to(a.half.dtype)
    mean = a.axis + sign * b.axis
    mean = mean / safe_norm(mean)
    project = dot(a.axis, mean)
    offset = dot(b.centre - a.centre, mean)
    low = torch.maximum(-a.half * project, offset - b.half * project)
    high = torch.minimum(a.half * project, offset + b.half * project)
    line = (slide > 0) & (high > low)
    # a line shorter than the cells are thick counts as less of one, so that it ends as smoothly as
    # it turns away
    share = ((high - low) / (0.5 * (a.radius + b.radius))).clamp(max=1.0)
    # nor do two that cross, so that the line's ends lie on opposite sides: all of it is near the
    # crossing
    swing = 0.5 * (high - low) * safe_sqrt(dot(turn, turn))
    crossed = swing > 1e-6 * a.radius
    apart = safe_sqrt(_distance2(b.centre - a.centre, a.axis, b.axis, s0, t0))
    share = share * torch.where(crossed, apart / torch.where(crossed, swing, 1.0), 1.0).clamp(
        max=1.0
    )
    slide = torch.where(line, slide * slide * share, 0.0)
    cosine, between = dot(a.axis, b.axis), b.centre - a.centre
    end_a0 = _leaving(s0, cosine * t0 + dot(between, a.axis), a, slide)
    end_b0 = _leaving(t0, cosine * s0 - dot(between, b.axis), b, slide)
    s_all, t_all, end_a, end_b = [], [], [], []
    for at, side in ((low, -1.0), (high, 1.0)):
        s1 = _clamp(at / project, a.half)
        t1 = _clamp(sign * (at - offset) / project, b.half)
        s_all.append(s0 + slide * (s1 - s0))
        t_all.append(t0 + slide * (t1 - t0))
        # the line ends where the first of the two cells does; the farther the other goes on, the
        # less does its end matter
        beyond = (
            side * (at - a.half * project * side),
            side * (at - offset - b.half * project * side),
        )
        mark_a, mark_b = ((1.0 + x / (0.5 * (a.radius + b.radius))).clamp(min=0.0) for x in beyond)
        end_a.append(end_a0 + slide * (side * mark_a - end_a0))
        end_b.append(end_b0 + slide * (sign * side * mark_b - end_b0))
    return torch.stack(s_all), torch.stack(t_all), torch.stack(end_a), torch.stack(end_b), line


def _leaving(s: Tensor, free: Tensor, cell: Capsules, slide: Tensor) -> Tensor:
    """`_end` of a closest point s that would be at `free` on a line without ends. Where a line's
    point has slid away from it, the normal there is not across the cell as the end is left: then
    the less of an end, the less is missing to `free`."""
    missing = (free.abs() - cell.half) / (slide * cell.radius + 1e-9)
    return torch.where(
        slide > 0, torch.sign(free) * missing.clamp(min=0.0, max=1.0), _end(s, cell.half)
    )


def _end(s: Tensor, half: Tensor) -> Tensor:
    """Which end of the centreline a point is: +1, −1, or 0 for neither (or for a sphere, whose ends
    are one)."""
    slack = 1e-6 * half + 1e-9
    return (s >= half - slack).to(s.dtype) - (s <= slack - half).to(s.dtype)


@dataclass(frozen=True)
class CandidateContacts:
    """K pairs of cells that overlap at their closest points, or are near there: first and second
    cell (K,), their bodies a and b, the points s and t of `closest_points`."""

    first: Tensor
    second: Tensor
    a: Capsules
    b: Capsules
    s: Tensor
    t: Tensor

    @staticmethod
    def among(
        bodies: Capsules, first: Tensor, second: Tensor, near: bool = False
    ) -> CandidateContacts:
        """Those of the pairs (P,), (P,); near: with those that come within NEAR."""
        a, b = bodies.take(first), bodies.take(second)
        found = CandidateContacts(first, second, a, b, *closest_points(a, b))
        with torch.no_grad():
            # no point of a line is nearer than the closest one, but for rounding, of which this is
            # many times more
            keep = torch.nonzero(
                found.gap < max(1e-3, 0.5 * NEAR * near) * (a.radius + b.radius)
            ).squeeze(1)
        return found.take(keep)

    @property
    def gap(self) -> Tensor:
        """(K,) µm, at the closest points."""
        return _gap(self.a, self.b, self.s, self.t)

    def take(self, index: Tensor) -> CandidateContacts:
        """The pairs at `index`."""
        pick = lambda x: x.index_select(0, index)
        return CandidateContacts(
            pick(self.first),
            pick(self.second),
            self.a.take(index),
            self.b.take(index),
            pick(self.s),
            pick(self.t),
        )


def contacts_of(pairs: CandidateContacts, push: bool = False, near: bool = False) -> Contacts:
    """All rows of pairs that overlap (gap < 0), and of a line of contact that overlaps at one end
    what keeps the other from swinging in: a row of gap 0, whose weight falls from that of the line
    to nothing as its end parts as far as the first overlaps. Without it a cell that is squeezed
    between two rocks from step to step, and they close in on it.

    push: for a solve in which contacts only push, which sees by itself what it would push into
    what: with the gaps as they are, both ends of a line if one of them overlaps. near: for a pass
    that moves cells again, rows of what is within NEAR too, of gap 0 unless `push`, whose weight
    falls to nothing on the way there. Half of what a pass has parted is a hair apart: the next one,
    blind to it, pushed it together again, deeper with every pass where contacts are hard, until a
    full channel was a heap.
    """
    first, second, a, b, s, t = pairs.first, pairs.second, pairs.a, pairs.b, pairs.s, pairs.t
    # only the nearly parallel may have a line; all others touch at the closest point
    flat = torch.nonzero(_slide(cross(a.axis, b.axis)).detach() > 0).squeeze(1)
    flat_a, flat_b = a.take(flat), b.take(flat)
    *of_lines, line = _line_points(flat_a, flat_b, s.index_select(0, flat), t.index_select(0, flat))
    points = [
        x.index_copy(0, flat, ends[0])
        for x, ends in zip((s, t, _end(s, a.half), _end(t, b.half)), of_lines, strict=True)
    ]
    ends = [_gap(flat_a, flat_b, of_lines[0][k], of_lines[1][k]) for k in (0, 1)]
    point, margin = _gap(a, b, points[0], points[1]), 0.5 * NEAR * near * (a.radius + b.radius)
    # cull again without a gradient: a first row for every pair, a second one where there is a line
    with torch.no_grad():
        deep0, deep1 = point < margin, line & (ends[1] < margin.index_select(0, flat))
        either = line & (deep0.index_select(0, flat) | deep1) & (push | (ends[0] + ends[1] < 0))
        deep0[flat] |= either
        keep0, keep1 = torch.nonzero(deep0).squeeze(1), torch.nonzero(deep1 | either).squeeze(1)
    share = torch.full_like(ends[0], 0.5) if push else 0.5 * _held_share(*ends)
    whole = torch.ones_like(s)
    if near and not push:
        whole, of_each = (
            _near_share(point, margin),
            [0.5 * _near_share(end, margin.index_select(0, flat)) for end in ends],
        )
    else:
        of_each = [torch.where(end < 0, 0.5, 0.0) for end in ends]
    of_ends = [
        whole.index_copy(
            0, flat, torch.where(line, torch.maximum(each, share), whole.index_select(0, flat))
        )
        for each in of_each
    ]
    weight = torch.cat(
        [of_ends[0].index_select(0, keep0), of_ends[1].index_select(0, flat).index_select(0, keep1)]
    )
    keep = torch.cat([keep0, flat.index_select(0, keep1)])
    s, t, end_a, end_b = (
        torch.cat([x.index_select(0, keep0), two[1].index_select(0, keep1)])
        for x, two in zip(points, of_lines, strict=True)
    )
    a, b = a.take(keep), b.take(keep)
    gap, row_first, row_second, normal = _rows(a, b, s, t, end_a, end_b)
    gap = gap if push else gap.clamp(max=0.0)
    pick = lambda x: x.index_select(0, keep)
    return Contacts(pick(first), pick(second), gap, weight, row_first, row_second, normal)


def _near_share(gap: Tensor, margin: Tensor) -> Tensor:
    """1 for what overlaps, 0 for what is `margin` apart: the weight of a row that keeps a gap,
    whose root falls evenly."""
    return (1.0 - gap / margin).clamp(min=0.0, max=1.0).square()


def _held_share(one: Tensor, other: Tensor) -> Tensor:
    """Of two ends of a line with gaps of which one is negative: 1 while neither parts, 0 once one
    parts as far as the other overlaps."""
    deepest = torch.minimum(one, other)
    return ((one + other) / torch.where(deepest < 0, deepest, -1.0)).clamp(min=0.0, max=1.0)


def _gap(a: Capsules, b: Capsules, s: Tensor, t: Tensor) -> Tensor:
    return safe_sqrt(_distance2(b.centre - a.centre, a.axis, b.axis, s, t)) - a.radius - b.radius


def contact_gaps(bodies: Capsules, first: Tensor, second: Tensor) -> Tensor:
    """Signed gap of each pair at its closest points, (P,) µm; negative where they overlap."""
    a, b = bodies.take(first), bodies.take(second)
    return _gap(a, b, *closest_points(a, b))


@torch.no_grad()
def gaps_nearby(
    position: Tensor,
    axis: Tensor,
    length: Tensor,
    radius: Tensor,
    colony: Tensor,
    colonies: int,
    within: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of one colony that may be within `within` µm, and their gaps, in float64: (first,
    second, gap), each (P,).

    position, axis (N, d); length, radius (N,); colony (N,) int64.
    """
    position, axis, length, radius = (
        position.double(),
        axis.double(),
        length.double(),
        radius.double(),
    )
    first, second = Neighbourhood(position, axis, length, radius, colony, colonies, within).pairs()
    bodies = Capsules(position.T.contiguous(), axis.T.contiguous(), 0.5 * length, radius)
    return first, second, contact_gaps(bodies, first, second)


def _rows(a: Capsules, b: Capsules, s: Tensor, t: Tensor, end_a: Tensor, end_b: Tensor):
    """Gap, the two cells' rows and the normal at points s and t of the centrelines."""
    lever_a, lever_b = s * a.axis, t * b.axis
    between = b.centre - a.centre + lever_b - lever_a
    distance = safe_norm(between)
    touching = distance <= 1e-5 * (a.radius + b.radius)
    normal = between / torch.where(touching, 1.0, distance)
    if bool(touching.any()):  # rare, and dear to ask of every pair
        normal = torch.where(touching, _fallback_normal(a, b), normal)
    gap = distance - a.radius - b.radius
    along_a, along_b = dot(normal, a.axis), dot(normal, b.axis)
    # a sphere grows from both ends at once: the one nearer the contact counts
    end_a = torch.where(a.half <= 1e-9, torch.sign(along_a), end_a)
    end_b = torch.where(b.half <= 1e-9, -torch.sign(along_b), end_b)
    row_a = torch.cat([normal, cross(lever_a, normal), (0.5 * end_a * along_a).unsqueeze(0)])
    row_b = torch.cat([-normal, -cross(lever_b, normal), (-0.5 * end_b * along_b).unsqueeze(0)])
    return gap, row_a.T.contiguous(), row_b.T.contiguous(), normal


def _fallback_normal(a: Capsules, b: Capsules) -> Tensor:
    """A direction to part two cells whose centrelines cross: both axes' common perpendicular; any
    perpendicular when parallel or in 2-D."""
    way = perpendicular(a.axis)
    if a.axis.shape[0] == 3:
        common = cross(a.axis, b.axis)
        size = safe_norm(common)
        parallel = size < 1e-6
        way = torch.where(parallel, way, common / torch.where(parallel, 1.0, size))
    # whichever of the two ways takes the centres apart
    return torch.where(dot(way, b.centre - a.centre) < 0, -way, way)

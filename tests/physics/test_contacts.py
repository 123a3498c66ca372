"""The narrow phase: gaps, and how they change with each cell's degrees of freedom."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array, bodies, rows_of, segment_distance, unit
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfilm.physics import capsule
from torchfilm.physics.contacts import (
    CandidateContacts,
    Capsules,
    closest_points,
    contact_gaps,
    line_points,
)
from torchfilm.physics.near_rows import near_rows

DIMS = pytest.mark.parametrize("dim", [2, 3])


def contact_points(cells: Capsules, first: torch.Tensor, second: torch.Tensor):
    """As `line_points` gives them."""
    a, b = cells.take(first), cells.take(second)
    return line_points(a, b, *closest_points(a, b))


def halves(cells: Capsules) -> tuple[torch.Tensor, torch.Tensor]:
    """The pairs (k, k + count/2) of the cells."""
    first = torch.arange(cells.half.numel() // 2, device=cells.half.device)
    return first, first + first.numel()


def side_by_side(
    rng: np.random.Generator, count: int, dim: int, tilt: float, **options
) -> Capsules:
    """Pairs of parallel rods that overlap along their length, up to `tilt` from parallel.

    The second rod has either direction.
    """
    axis = unit(rng, count, dim)
    across = (
        np.stack([-axis[:, 1], axis[:, 0]], 1)
        if dim == 2
        else np.cross(axis, unit(rng, count, dim))
    )
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = axis + tilt * rng.uniform(-1, 1, (count, 1)) * unit(rng, count, dim)
    other *= rng.choice([-1, 1], (count, 1)) / np.linalg.norm(other, axis=1, keepdims=True)
    centre = 0.75 * across + rng.uniform(-1, 1, (count, 1)) * axis
    place = rng.uniform(-3, 3, (count, dim))
    return bodies(
        np.concatenate([place, place + centre]),
        np.concatenate([axis, other]),
        rng.uniform(2, 3, 2 * count),
        **options,
    )


@settings(deadline=None, derandomize=True, max_examples=100)
@given(
    seed=st.integers(0, 2**32 - 1),
    dim=st.sampled_from([2, 3]),
    lengths=st.lists(st.sampled_from([0.0, 1e-9, 0.01, 2.0, 40.0]), min_size=1, max_size=3),
    tilt=st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 0.1, 3.0]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_distance_is_the_least_and_the_same_when_swapped(seed, dim, lengths, tilt, dtype):
    """Against the search of the helpers, for mixed lengths and angles, with parallel and coincident
    cells.

    float32 has an error of 1.2e-7 for positions up to 20 µm. Where centrelines cross at a sine s,
    the crossing is known to ε/s, at worst √(ε·20) = 1.5e-3. Such pairs penetrate each other, and
    are tested only to that.
    """
    rng, count = np.random.default_rng(seed), 40
    axis = unit(rng, 2 * count, dim)
    other = axis[:count] + tilt * unit(rng, count, dim)
    axis[count:] = (
        other / np.linalg.norm(other, axis=1, keepdims=True) * rng.choice([-1, 1], (count, 1))
    )
    centre = rng.uniform(-2, 2, (2 * count, dim))
    centre[count : count + 5] = centre[:5]
    cells = bodies(centre, axis, rng.choice(lengths, 2 * count), dtype=dtype)
    first, second = halves(cells)
    gap, swapped = (
        array(contact_gaps(cells, first, second)),
        array(contact_gaps(cells, second, first)),
    )
    c, a, h = array(cells.centre.T), array(cells.axis.T), array(cells.half)
    distance = segment_distance(c[:count], a[:count], h[:count], c[count:], a[count:], h[count:])
    usual, crossing = {torch.float32: (2e-5, 1.5e-3), torch.float64: (1e-8, 1e-6)}[dtype]
    allowed = np.where(distance > 1e-2, usual, crossing)
    assert (np.abs(gap + 1.0 - distance) <= allowed).all()
    assert (np.abs(gap - swapped) <= allowed).all()
    s, t = closest_points(cells.take(first), cells.take(second))
    assert bool((s.abs() <= cells.half[first]).all() and (t.abs() <= cells.half[second]).all())


def moved(cells: Capsules, which: torch.Tensor, dof: int, by: float) -> Capsules:
    """The cells `which`, moved by `by` in one degree of freedom (position, rotation, length)."""
    dim = cells.centre.shape[0]
    turns = 1 if dim == 2 else 3
    centre, axis, half = cells.centre.clone(), cells.axis.clone(), cells.half.clone()
    if dof < dim:
        centre[dof, which] += by
    elif dof < dim + turns:
        turn = torch.zeros(which.numel(), turns, dtype=half.dtype)
        turn[:, dof - dim] = by
        axis[:, which] = capsule.rotate(axis[:, which].T, turn).T
    else:
        half[which] += 0.5 * by
    return Capsules(centre, axis, half, cells.radius)


@DIMS
def test_rows_are_the_derivative_of_the_gap(dim):
    """For point contacts, the gap after a small move x is gap − row · x, for every degree of
    freedom.

    Central differences in float64 with h = 1e-6: rounding gives 1e-10, curvature h² = 1e-12. At a
    kink (where the closest point reaches an end) no derivative exists. The few pairs whose two
    one-sided differences disagree are excluded, and counted.
    """
    rng, count, h = np.random.default_rng(1), 2000, 1e-6
    cells = bodies(
        rng.uniform(-1, 1, (2 * count, dim)),
        unit(rng, 2 * count, dim),
        rng.uniform(0.5, 4, 2 * count),
    )
    first, second = halves(cells)
    gap = contact_gaps(cells, first, second)
    line = contact_points(cells, first, second)[-1]
    keep = (gap < -0.01) & (gap > -0.95) & ~line
    first, second = first[keep], second[keep]
    found = rows_of(cells, first, second)
    assert torch.equal(found.first, first) and bool((found.weight == 1).all()) and len(first) > 300
    assert torch.equal(found.gap, gap[keep])
    for which, row in ((first, found.row_first), (second, found.row_second)):
        for dof in range(row.shape[1]):
            up = (contact_gaps(moved(cells, which, dof, h), first, second) - found.gap) / h
            down = (found.gap - contact_gaps(moved(cells, which, dof, -h), first, second)) / h
            smooth = (up - down).abs() < 1e-4
            assert smooth.double().mean() > 0.99
            assert float((row[:, dof] + 0.5 * (up + down))[smooth].abs().max()) <= 1e-6


def gap_at(
    cells: Capsules, first, second, s, t, end_a, end_b, from_half: torch.Tensor
) -> torch.Tensor:
    """The gap between two marked points, which move with the cells' rotation and growth."""
    grown = cells.half - from_half
    a = cells.centre[:, first] + (s + end_a * grown[first]) * cells.axis[:, first]
    b = cells.centre[:, second] + (t + end_b * grown[second]) * cells.axis[:, second]
    return (b - a).norm(dim=0) - cells.radius[first] - cells.radius[second]


@DIMS
@pytest.mark.parametrize("tilt", [1e-3, 0.09])
def test_rows_of_a_line_of_contact(dim, tilt):
    """Two rows per pair, D² = ½, each the exact derivative of the gap between two marked points.

    Differences as above.
    """
    cells, h = side_by_side(np.random.default_rng(2), 300, dim, tilt), 1e-6
    first, second = halves(cells)
    s, t, end_a, end_b, line = contact_points(cells, first, second)
    points = [(s[k], t[k], end_a[k], end_b[k]) for k in range(2)]
    both = (
        line
        & (gap_at(cells, first, second, *points[0], cells.half) < 0)
        & (gap_at(cells, first, second, *points[1], cells.half) < 0)
    )
    first, second, points = first[both], second[both], [tuple(x[both] for x in p) for p in points]
    found = rows_of(cells, first, second)
    assert (
        len(first) > 250
        and found.gap.numel() == 2 * len(first)
        and bool((found.weight == 0.5).all())
    )
    for k, point in enumerate(points):
        part = slice(k * len(first), (k + 1) * len(first))
        for which, row in ((first, found.row_first[part]), (second, found.row_second[part])):
            for dof in range(row.shape[1]):
                up, down = (
                    gap_at(moved(cells, which, dof, x), first, second, *point, cells.half)
                    for x in (h, -h)
                )
                assert float((row[:, dof] + (up - down) / (2 * h)).abs().max()) <= 1e-6


def any_pairs(dim: int, dtype: torch.dtype) -> Capsules:
    """Pairs of all lengths at all angles, a quarter of them nearly parallel."""
    rng, count = np.random.default_rng(4), 8000
    axis = unit(rng, 2 * count, dim)
    tilt = rng.choice([1e-8, 1e-3, 0.08, 0.12], (count // 2, 1))
    axis[count : count + count // 2] = axis[: count // 2] + tilt * unit(rng, count // 2, dim)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return bodies(
        rng.uniform(-0.9, 0.9, (2 * count, dim)),
        axis,
        rng.choice([0.0, 0.5, 2.0, 3.0], 2 * count),
        dtype=dtype,
    )


def gaps_of_both(cells: Capsules) -> tuple[torch.Tensor, torch.Tensor]:
    """The gaps at the two points of `contact_points`, (2, P), and which contacts are lines."""
    first, second = halves(cells)
    s, t, end_a, end_b, line = contact_points(cells, first, second)
    gaps = [
        gap_at(cells, first, second, s[k], t[k], end_a[k], end_b[k], cells.half) for k in range(2)
    ]
    return torch.stack(gaps), line


@DIMS
def test_no_row_is_lost_before_it_is_looked_at(dtype, dim):
    """All rows of `contact_points` for every pair that overlaps or is held, and no others.

    Gaps and weights agree to rounding, and the order is exact.
    """
    cells = any_pairs(dim, dtype)
    first, second = halves(cells)
    gap, line = gaps_of_both(cells)
    # for the others rounding may decide whether they overlap, or are held
    clear = (gap.abs() > 1e-5).all(0) & (gap.sum(0).abs() > 1e-5)
    first, second, gap, line = first[clear], second[clear], gap[:, clear], line[clear]
    deep = (gap < 0) & torch.stack([torch.ones_like(line), line])
    assert (
        deep[1].sum() > 500 and (~deep[0]).sum() > 500 and (line & (deep[0] != deep[1])).sum() > 3
    )
    weight = torch.where(line, 0.5, 1.0).expand(2, -1).clone()
    # the end without overlap is held, with less weight the farther it is
    held = line & (deep[0] != deep[1]) & (gap.sum(0) < 0)
    weight = torch.where(held & (gap > 0), (0.5 * gap.sum(0) / gap.amin(0)).float(), weight)
    deep, gap = deep | held, gap.clamp(max=0.0)
    assert held.sum() > 3
    found = rows_of(cells, first, second)
    all_of = lambda both: torch.cat([x[d] for x, d in zip(both, deep, strict=True)])
    assert torch.equal(found.first, all_of((first, first)))
    assert torch.equal(found.second, all_of((second, second)))
    assert float((found.weight - all_of(weight)).abs().max()) <= 1e-3
    assert float((found.gap - all_of(gap)).abs().max()) <= 1e-5


@DIMS
def test_one_sided_contacts_have_a_row_at_every_point(dtype, dim):
    """One row for each pair that is near, overlapping or not; for a line two of weight ½, side by
    side.

    Gaps are those of `contact_points`, to rounding.
    """
    cells = any_pairs(dim, dtype)
    first, second = halves(cells)
    gap, line = gaps_of_both(cells)
    assert line.sum() > 500 and (~line).sum() > 500 and (gap > 0).sum() > 500 < (gap < 0).sum()
    none = torch.full_like(gap[0], -torch.inf)
    found = near_rows(CandidateContacts.all_of(cells, first, second), none)
    pair = torch.repeat_interleave(first, 1 + line.long())
    other = torch.cat([pair.new_zeros(1), (pair[1:] == pair[:-1]).long()])
    assert torch.equal(found.first, pair) and torch.equal(found.second, second[pair])
    assert torch.equal(found.weight, torch.where(line, 0.5, 1.0).to(dtype)[pair])
    assert float((found.gap - gap[other, pair]).abs().max()) <= 1e-5


@DIMS
def test_rows_foresee_what_a_turn_brings_together(dim):
    """Rods that overlap, up to 0.3 rad from parallel, of which one turns by 0.2 rad.

    Rows are linear: a point at a lever of up to 1.5 µm comes off its line by 1.5 · 0.2²/2 = 0.03
    µm. In space the part of a stretch that has no row of its own is 0.5 radii long, and turns by
    0.05 µm; with rows at the contact only, nobody would foresee overlaps deeper than 0.1. In the
    plane the rows of the contact are enough.
    """
    rng, count = np.random.default_rng(3), 4000
    cells = side_by_side(rng, count, dim, 0.3, dtype=torch.float64)
    first, second = halves(cells)
    turn = 0.2 * (unit(rng, count, 3) if dim == 3 else rng.choice([-1, 1], (count, 1)))
    turned = cells.axis.clone()
    turned[:, second] = capsule.rotate(cells.axis[:, second].T, torch.as_tensor(turn)).T
    after = contact_gaps(Capsules(cells.centre, turned, cells.half, cells.radius), first, second)
    worst = {}
    for margin in (-np.inf, 0.3):
        near = torch.full_like(after, margin)
        rows = near_rows(CandidateContacts.all_of(cells, first, second), near)
        told = rows.gap - (
            rows.row_second[:, dim:-1] * torch.as_tensor(turn).index_select(0, rows.first)
        ).sum(1)
        least = torch.full_like(after, torch.inf).scatter_reduce(0, rows.first, told, "amin")
        worst[margin] = float((least - after).max())
    assert worst[0.3] < 0.08
    assert worst[-np.inf] > 0.1 if dim == 3 else worst[-np.inf] == worst[0.3]


def forces(cells: Capsules) -> np.ndarray:
    """Force, torque and elongation JᵀD²g on the first cell of each pair, (P, 4 or 7)."""
    first, second = halves(cells)
    found = rows_of(cells, first, second)
    out = np.zeros((len(first), found.row_first.shape[1]))
    np.add.at(
        out, array(found.first), array((found.weight * found.gap).unsqueeze(1) * found.row_first)
    )
    return out


def sweep(dim: int, angle, shift, apart) -> Capsules:
    """Pairs that differ slightly from one to the next, in an angle, a shift along the axis or a
    distance.

    One of the three is an array.
    """
    angle, shift, apart = np.broadcast_arrays(*map(np.asarray, (angle, shift, apart)))
    zero, one = np.zeros(angle.shape), np.ones(angle.shape)
    if dim == 2:
        axis, centre = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([shift, apart], 1)
    else:  # out of the common plane and in it
        axis, centre = (
            np.stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)], 1),
            np.stack([shift, apart, zero], 1),
        )
    lie = np.stack([one] + [zero] * (dim - 1), 1)
    return bodies(
        np.concatenate([0 * centre, centre]),
        np.concatenate([lie, axis]),
        np.repeat([2.0, 2.4], len(angle)),
    )


FINE = 5e-5


@DIMS
@pytest.mark.parametrize(
    "name, path",
    [
        *[
            (
                f"angle at shift {x}",
                {"angle": np.arange(-0.3, 0.3, FINE), "shift": x, "apart": 0.85},
            )
            for x in (0.0, 0.4, 1.5)
        ],
        *[
            (
                f"antiparallel at shift {x}",
                {"angle": math.pi + np.arange(-0.3, 0.3, FINE), "shift": x, "apart": 0.85},
            )
            for x in (0.0, 0.7)
        ],
        *[
            (f"shift at angle {x}", {"angle": x, "shift": np.arange(-4, 4, FINE), "apart": 0.8})
            for x in (0.0, 0.03, 0.0999, 0.2)
        ],
        *[
            (
                f"distance at angle {x}",
                {"angle": x, "shift": 0.3, "apart": np.arange(0.3, 1.2, FINE)},
            )
            for x in (0.0, 0.05, 0.15)
        ],
    ],
)
def test_forces_never_jump(dim, name, path):
    """Force, torque and elongation are continuous as a cell turns, slides or approaches.

    This includes the transitions from two rows to one and from end to middle. Jumps are ≤ 1e-3, the
    guide's limit for one row against two. Steps are 5e-5 rad or µm. The fastest continuous change
    is the sliding of a line's ends with the angle, at most 15 per rad for an overlap of 1 and
    levers of 1 µm, which is 8e-4 per step.
    """
    found = forces(sweep(dim, **path))
    jump = np.abs(np.diff(found, axis=0)).max(0)
    assert jump.max() <= 1e-3, f"{name}: {jump} at {np.abs(np.diff(found, axis=0)).argmax(0)}"
    assert np.abs(found).max() > 0.05


@DIMS
def test_swapping_a_pair_swaps_its_rows(dtype, device, dim):
    """The same gaps, weights and rows, with first and second exchanged, to rounding.

    Where two axes cross at a sine s, the nearest point is known to ε/s² times the size of the
    cells, and s is at least 0.1 wherever that point matters. In float32 this is 1e-7 · 100 · 2 µm.
    """
    rng = np.random.default_rng(3)
    cells = side_by_side(rng, 200, dim, 0.3, dtype=dtype, device=device)
    first, second = halves(cells)
    one, other = rows_of(cells, first, second), rows_of(cells, second, first)

    def rows(found, cell, row):
        """Gap, weight and row, (P, 2, …), of each pair's one or two rows; zeros for a missing
        row.
        """
        out, seen = np.zeros((len(first), 2, 2 + row.shape[1])), np.zeros(len(first), dtype=int)
        for k, values in zip(
            array(cell) % len(first),
            array(torch.cat([found.gap.unsqueeze(1), found.weight.unsqueeze(1), row], 1)),
            strict=True,
        ):
            out[k, seen[k]] = values
            seen[k] += 1
        return out

    for x, y in (
        (rows(one, one.first, one.row_first), rows(other, other.second, other.row_second)),
        (rows(one, one.second, one.row_second), rows(other, other.first, other.row_first)),
    ):
        # the two rows of a line may have either order
        either = np.minimum(np.abs(x - y).max((1, 2)), np.abs(x - y[:, ::-1]).max((1, 2)))
        assert either.max() <= {torch.float32: 2e-5, torch.float64: 4e-14}[dtype]


@DIMS
def test_action_is_reaction(dtype, device, dim):
    """The two rows of a contact balance: forces exactly, torques about a common point to
    rounding.
    """
    cells = side_by_side(np.random.default_rng(4), 200, dim, 0.5, dtype=dtype, device=device)
    found = rows_of(cells, *halves(cells))
    a, b = found.row_first, found.row_second
    assert torch.equal(a[:, :dim], -b[:, :dim])
    between = array((cells.centre[:, found.second] - cells.centre[:, found.first]).T)
    n, turning = array(a[:, :dim]), array(a[:, dim:-1] + b[:, dim:-1])
    arm = (
        (between[:, :1] * n[:, 1:] - between[:, 1:] * n[:, :1])
        if dim == 2
        else np.cross(between, n)
    )
    # b's centre is `between` from a's, so its force has that lever arm about a's centre
    assert np.abs(turning - arm).max() <= {torch.float32: 2e-6, torch.float64: 1e-14}[dtype]
    assert np.abs(np.linalg.norm(n, axis=1) - 1).max() <= 1e-6


@DIMS
@pytest.mark.parametrize("length", [0.0, 2.0])
def test_cells_in_one_place_still_have_a_normal(dtype, device, dim, length):
    """Cells with one centre, at any angle, and spheres: finite rows and a unit normal.

    The normal is perpendicular to both axes; in the plane, to the mean of both, so that it does
    not matter which cell is the first.
    """
    rng = np.random.default_rng(6)
    axis = unit(rng, 20, dim)
    axis[15:] = axis[5:10]  # five pairs parallel
    cells = bodies(np.zeros((20, dim)), axis, np.full(20, length), dtype=dtype, device=device)
    found = rows_of(cells, *halves(cells))
    assert bool(torch.isfinite(found.row_first).all() and torch.isfinite(found.row_second).all())
    n = array(found.normal.T)
    assert np.abs(np.linalg.norm(n, axis=1) - 1).max() <= 1e-6
    one, other = (array(cells.axis.T)[array(k)] for k in (found.first, found.second))
    sign = np.where((one * other).sum(1) < 0, -1.0, 1.0)[:, None]
    for way in (one, other) if dim == 3 else (one + sign * other,):
        assert np.abs((n * way).sum(1)).max() <= 1e-6
    assert set(array(found.first)) == set(range(10))


def test_gradient_of_gaps_is_finite_where_cells_coincide(dtype):
    cells = bodies(np.zeros((2, 3)), np.eye(3)[:2], [2.0, 2.0], dtype=dtype)
    centre = cells.centre.clone().requires_grad_()
    gap = contact_gaps(
        Capsules(centre, cells.axis, cells.half, cells.radius), torch.tensor([0]), torch.tensor([1])
    )
    gap.sum().backward()
    assert bool(torch.isfinite(centre.grad).all())

"""Contact steps with bilateral rows, each colony by itself: as in `physics.contact_step`."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.batch import put_back
from torchfilm.kernels.bilateral_moves import make_moves
from torchfilm.kernels.bilateral_scheme import CANDIDATE, CLOSE, DEEP, NEAR, PENALTY
from torchfilm.kernels.bilateral_scheme import TOLERANCE as USUAL_TOLERANCE
from torchfilm.kernels.bilateral_solve import minimise
from torchfilm.kernels.colonies import (
    CLIPPED,
    DEEPLY,
    ERROR,
    ITERATIONS,
    PASSES,
    STATUS,
    SUBSTEPS,
    alphas_of,
    closed,
    opened,
    taken_out,
)
from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.contacts import near_contacts, pair_rows
from torchfilm.kernels.memory import TOP, give_back, zeros
from torchfilm.kernels.moves import drags
from torchfilm.kernels.neighbours import near_pairs, spatial_order
from torchfilm.kernels.rows import (
    STIFF,
    deeply_overlapping,
    degrees,
    room_for_rows,
    rows_among,
    wall_rows,
)
from torchfilm.kernels.scheme import NOT_FINITE
from torchfilm.kernels.team import next_of

# Places in the settings. OVERLAP, TOLERANCE: below 0 where they are not given.
OVERLAP, TOLERANCE, MOST_PASSES, COARSE_PASSES, LIMIT, SOFT = range(6)


@kernel
def _keep(rows, r, new, root, soft):
    """Row r becomes row `new`, its weight multiplied by `root`, its gap at most 0."""
    H, gaps, one, two, stiff = rows
    for k in range(H.shape[1]):
        H[2 * new, k] = root * H[2 * r, k]
        H[2 * new + 1, k] = root * H[2 * r + 1, k]
    gaps[new] = root * min(gaps[r], 0 * gaps[r])
    one[new], two[new] = one[r], two[r]
    if soft:
        stiff[new] = STIFF
    return new + 1


@kernel
def _root(gap, margin):
    """The root of a row's weight: 1 for an overlap, 0 from a distance of `margin`."""
    if gap < 0:
        return 1.0
    return max(1.0 - gap / margin, 0.0) if margin > 0 else 0.0


@kernel
def _holding_rows(rows, walls, m, radius, hold, soft):
    """Of the rows after the first `walls` ones, keep those that overlap, and hold what else
    `physics.contacts.contacts_of` holds: the other end of a line, and with `hold` what is near.
    Returns how many are left."""
    _, gaps, one, two, _ = rows
    half, r, new = math.sqrt(0.5), walls, walls
    while r < m:
        margin = 0.5 * NEAR * (radius[one[r]] + radius[two[r]]) if hold else 0.0
        if r + 1 == m or one[r + 1] != one[r] or two[r + 1] != two[r]:
            if gaps[r] < margin:
                new = _keep(rows, r, new, _root(gaps[r], margin), soft)
            r += 1
            continue
        low, high = gaps[r] / half, gaps[r + 1] / half  # a line has two rows of weight ½
        touches = (low < margin or high < margin) and low + high < 0
        deepest = min(low, high)
        held = min(max((low + high) / deepest, 0.0), 1.0) if deepest < 0 else 0.0
        for k in range(2):
            end = high if k else low
            if end < margin or touches:
                new = _keep(rows, r + k, new, max(_root(end, margin), math.sqrt(held)), soft)
        r += 2
    return new


@kernel
def _contacts(memory, x, axis, half, radius, hold, dof):
    """Pairs that overlap, with `hold` also those that are near, and some more: see
    `near_contacts`."""
    margin = 2.0 * max(CANDIDATE, 0.5 * NEAR * hold) * radius.max()
    none = zeros(memory, (3,), np.float64)  # no axis is periodic
    first, second = near_pairs(memory, x, axis, half, radius, none, margin, dof)
    keep, points, gap = near_contacts(
        memory, x, axis, half, radius, none, first, second, margin, dof
    )
    return first, second, keep, points, gap


@kernel
def _wall_contacts(memory, x, axis, half, radius, scale, alpha, kinds, places, sizes, roots,
                   is_soft, hold, overlap, found, left, like, dof):  # fmt: skip
    """Rows of cells at walls, with room for those of the contacts `found`; how many there are.
    Marks in `left` the cells that lie too deep in a wall."""
    n, number = x.shape[0], 0
    most = 2 * found[2].shape[0] + 3 * kinds.shape[0] * n
    H, gaps, one, two, soft = room_for_rows(memory, most, like, dof)
    for w in range(kinds.shape[0]):
        root = np.sqrt(roots[w] * alpha) if is_soft[w] else roots[w].copy()
        reach = NEAR * radius * (hold and not is_soft[w])
        rows = H[2 * number :], gaps[number:], one[number:], two[number:], soft[number:]
        of, root_of = slice(w, w + 1), root.reshape(1, n)
        more, _ = wall_rows(
            x, axis, half, radius, scale, kinds[of], places[of], sizes[of], root_of, reach, rows,
            is_soft[of], hold, dof,
        )  # fmt: skip
        for r in range(number, number + more):
            i = one[r]
            if not is_soft[w] and root[i] * gaps[r] < -overlap[i]:
                left[i] = 1
        number += more
    return (H, gaps, one, two, soft), number


@kernel
def _mark_deep(found, overlap, left):
    """Mark in `left` the cells of contacts that are too deep."""
    first, second, keep, _, gap = found
    for k in range(keep.shape[0]):
        i, j = first[keep[k]], second[keep[k]]
        if gap[k] < -0.5 * (overlap[i] + overlap[j]):
            left[i] = left[j] = 1


@kernel
def _contacts_of(found, left):
    """The contacts of marked cells."""
    first, second, keep, points, gap = found
    which = (left[first[keep]] | left[second[keep]]) > 0
    return first, second, keep[which], points[which], gap[which]


@kernel
def _solved(memory, rows, m, left, count, start, growth, alpha, low, tolerance, limit, again, dof):
    """The scaled move (n, len(dof)) of the `count` marked cells among the others at rest, by the
    first m of the rows. again: whether soft rows have already pushed. Also iterations, error and
    status."""
    H, gaps, one, two, soft = rows
    numbers = np.where(left > 0, np.cumsum(left), 0).astype(np.int32) - 1
    if count < left.shape[0]:
        m = rows_among(H, gaps, one, two, soft, m, numbers)
    pushed = np.zeros(m, H.dtype)
    for r in range(m):
        if again and soft[r] == STIFF:
            pushed[r] = -min(gaps[r], 0 * gaps[r])
    which = np.flatnonzero(left)
    part, rigid = start[which], growth[which] <= 0
    iterations, error, status = minimise(
        memory, H, one, two, m, gaps, pushed, alpha[which], low[which], rigid, part, tolerance,
        limit, dof,
    )  # fmt: skip
    y = np.zeros_like(start)
    for p in range(count):
        for k in range(y.shape[1]):
            y[which[p], k] = part[p, k]
    return y, iterations, error, status


@kernel
def step_colony(memory, x, axis, base, growth, radius, viscosity, length_drag, alpha, start, last,
                overlap, kinds, places, sizes, roots, is_soft, passes, tolerance, limit, soft,
                report, dof):  # fmt: skip
    """Grow one colony by `growth` and part what overlaps, in up to `passes` passes; x and axis in
    place. Returns lengths.

    x, axis: (n, d) float64. base, growth, radius, viscosity, length_drag, overlap: (n,) float64.
    alpha: (n,). start: (n, len(dof)) the move from which the first pass starts; last: the move that
    it solves for.
    """
    n, end = base.shape[0], degrees(dof) - 1
    length, scale, grows = base + growth, np.zeros(last.shape), np.ones(n)
    left, clipped, y = np.ones(n, np.uint8), np.zeros(n, np.uint8), np.zeros_like(start)
    top = memory[1][TOP]
    for number in range(passes):
        give_back(memory, top)
        again = number > 0
        hold, half = again and not soft, 0.5 * length
        drags(length, radius, viscosity, length_drag, grows, 1.0, scale, dof)
        found = _contacts(memory, x, axis, half, radius, hold, dof)
        if again:
            for i in range(n):
                left[i] = clipped[i]
            if not soft:
                _mark_deep(found, overlap, left)
        elif not soft:
            report[DEEPLY] = deeply_overlapping(memory, found, radius)
        rows, walls = _wall_contacts(
            memory, x, axis, half, radius, scale, alpha, kinds, places, sizes, roots, is_soft, hold,
            overlap, found, left, last, dof,
        )  # fmt: skip
        count = int(left.sum())
        if count == 0:
            break
        if again:
            found, y[:] = _contacts_of(found, left), 0
        else:
            for i in range(n):
                for k in range(degrees(dof)):
                    y[i, k] = start[i, k] / scale[i, k]
        none = zeros(memory, (3,), np.float64)
        m = pair_rows(memory, x, axis, half, radius, none, scale, found, walls, rows, 0.0, dof)
        m = _holding_rows(rows, walls, m, radius, hold, soft)
        low = ((base - length) / scale[:, end]).astype(last.dtype)
        y, iterations, error, status = _solved(
            memory, rows, m, left, count, y, growth, alpha, low, tolerance, limit, again, dof
        )
        report[ITERATIONS] += iterations
        report[PASSES] += 1
        report[ERROR] = error if not error <= report[ERROR] else report[ERROR]
        report[STATUS] = max(report[STATUS], status)
        if not again:
            for i in range(n):
                for k in range(degrees(dof)):
                    last[i, k] = y[i, k] * scale[i, k]
        if status == NOT_FINITE:
            y[:] = 0
        report[CLIPPED] = make_moves(
            x, axis, length, radius, y, scale, base, kinds, places, sizes, roots, is_soft, clipped,
            dof,
        )  # fmt: skip
    return length


@kernel(entry=True)
def step_colonies(memory, taken, which, begin, dt, longest, cells, drags, alphas, walls, settings,
                  out, reports, dof):  # fmt: skip
    """Steps of the colonies `which`, each by itself: `kernels.colonies` describes the arguments."""
    soft, limit, x, radius = settings[SOFT] > 0, int(settings[LIMIT]), cells[0], cells[4]
    kinds, places, sizes, _, is_soft = walls
    while True:
        give_back(memory, 0)
        b = next_of(which, taken)
        if b < 0:
            return
        first, end, report = begin[b], begin[b + 1], reports[b]
        if first == end:
            continue
        if opened(first, end, longest, cells, drags, out, report):
            steps = int(report[SUBSTEPS])
            of = spatial_order(memory, x[first:end], 6.0 * radius[first]) + first
            own_x, own_axis, start, roots, length, share, own_radius, viscosity, drag = taken_out(
                memory, of, steps, dt / steps, cells, drags, walls, dof
            )
            own_alpha, last = alphas_of(memory, of, dt / steps, alphas), start.copy()
            if own_alpha.shape[0] == 0:
                own_alpha = (PENALTY / drag).astype(own_alpha.dtype)
            overlap, tolerance = _asked(settings, own_alpha * drag, own_radius, steps > 1)
            passes = int(settings[COARSE_PASSES] if steps > 1 else settings[MOST_PASSES])
            top = memory[1][TOP]
            for _ in range(steps):
                give_back(memory, top)
                length = step_colony(
                    memory, own_x, own_axis, length, share, own_radius, viscosity, drag, own_alpha,
                    start, last, overlap, kinds, places[:, b], sizes[:, b], roots, is_soft, passes,
                    tolerance, limit, soft, report, dof,
                )  # fmt: skip
            put_back(of, own_x, own_axis, last, length, out[0], out[1], out[3], out[2], dof)
        closed(first, end, cells, 0.0, out, report)


@kernel
def _asked(settings, weight, radius, coarse):
    """How deep contacts may be left, (n,) µm, and the tolerance of the solve. weight: α γ, (n,)."""
    penalty = np.minimum(weight / PENALTY, 1.0)
    overlap, tolerance = np.full(radius.shape[0], settings[OVERLAP]), settings[TOLERANCE]
    if settings[OVERLAP] < 0:
        overlap = (np.full_like(radius, CLOSE) if coarse else DEEP * radius) * penalty
    if tolerance < 0:
        tolerance = USUAL_TOLERANCE * math.sqrt(math.sqrt(penalty.min()))
    return overlap, tolerance

"""One contact step of some colonies, each by itself: detect, solve, move, and again where cells lie
deep."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.batch import put, put_back
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
    shortest_of,
    taken_out,
)
from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.contacts import deepest_of, most_rows, near_contacts, pair_rows
from torchfilm.kernels.moves import approach, drags, move_cells
from torchfilm.kernels.neighbours import near_pairs, near_pairs_of, spatial_order
from torchfilm.kernels.rows import HARD, STIFF, deeply_overlapping, degrees, rows_among, wall_rows
from torchfilm.kernels.scheme import (
    DEEP_IN_SUBSTEPS,
    HARDEST,
    HOPS,
    ITERATION_LIMIT,
    LAG,
    MARGIN,
    MOST_SOFTER,
    NOT_FINITE,
    OVERLAP,
    SHRINK,
    SOFTER,
    SOFTEST,
    TOO_DEEP,
)
from torchfilm.kernels.solve import minimise
from torchfilm.kernels.team import next_of

# A search of all pairs takes no longer than one of the pairs of so many of the cells.
MOST_SOME = 0.3
# Places in the settings. DEEP ≤ 0: TOO_DEEP radii. YIELD: mean overlap
# of contacts, radii.
DEEP, TOLERANCE, MOST_PASSES, LIMIT, SOFT, YIELD = range(6)


@kernel
def _deep_cells(found, rows, walls, deep, n):
    """Numbers of those of n cells that lie deeper than `deep` in others, of those up to HOPS
    contacts away, and of those so deep in a hard wall; −1 for the others; how many; and their
    contacts, as others make no row that counts. n is 0: all contacts."""
    first, second, keep, _, gap = found
    _, gaps, one, _, soft = rows
    if n == 0:
        return np.empty(0, np.int32), 0, found
    mark = np.zeros(n, np.int64)
    for k in range(keep.shape[0]):
        if gap[k] < -deep:
            mark[first[keep[k]]] = mark[second[keep[k]]] = 1
    for hop in range(1, HOPS + 1):
        for k in range(keep.shape[0]):
            i, j = first[keep[k]], second[keep[k]]
            if gap[k] < 0.1 * deep:
                if mark[i] == hop and mark[j] == 0:
                    mark[j] = hop + 1
                elif mark[j] == hop and mark[i] == 0:
                    mark[i] = hop + 1
    numbers, count = np.full(n, -1, np.int32), 0
    for i in range(n):
        if mark[i] > 0:
            numbers[i] = count
            count += 1
    for r in range(walls):
        if soft[r] == HARD and gaps[r] < -deep and numbers[one[r]] < 0:
            numbers[one[r]] = count
            count += 1
    return numbers, count, _found_by(numbers, found)


@kernel
def _found_by(numbers, found):
    """The contacts `found` of numbered cells."""
    first, second, keep, points, gap = found
    some, new = (np.empty_like(keep), np.empty_like(points), np.empty_like(gap)), 0
    for k in range(keep.shape[0]):
        some[0][new], some[2][new] = keep[k], gap[k]
        some[1][new, 0], some[1][new, 1] = points[k, 0], points[k, 1]
        new += numbers[first[keep[k]]] >= 0 or numbers[second[keep[k]]] >= 0
    return first, second, some[0][:new], some[1][:new], some[2][:new]


@kernel
def _contacts(x, axis, half, radius, margin, dof):
    """Near pairs (first, second), and the contacts among them: see `near_contacts`."""
    pairs = near_pairs(x, axis, half, radius, margin, dof)
    return _contacts_of(x, axis, half, radius, margin, pairs, dof)


@kernel
def _contacts_of(x, axis, half, radius, margin, pairs, dof):
    """The contacts among pairs, which are the first two of `pairs`."""
    first, second = pairs[0], pairs[1]
    keep, points, gap = near_contacts(x, axis, half, radius, first, second, margin, dof)
    return first, second, keep, points, gap


@kernel
def _after(x, axis, length, radius, y, margin, deep, found, dof):
    """The contacts after the move y, and whether one of them is deeper than `deep`. Where none is,
    they may be those before it, `found`."""
    half = 0.5 * length
    if deepest_of(x, axis, half, radius, found, dof) >= -deep:
        # others were farther than margin: of those that met, one has come half of the way
        together, own = approach(x, length, radius, y, dof)
        some, count = np.zeros(own.shape[0], np.uint8), 0
        for i in range(own.shape[0]):
            some[i] = own[i] > 0.5 * (margin + deep - together)
            count += some[i]
        if count == 0:
            return found, False
        if count <= MOST_SOME * own.shape[0]:
            pairs = near_pairs_of(x, axis, half, radius, 0.0, some, dof)
            met = _contacts_of(x, axis, half, radius, 0.0, pairs, dof)
            if _deepest(met[4]) >= -deep:
                return found, False
    found = _contacts(x, axis, half, radius, margin, dof)
    return found, _deepest(found[4]) < -deep


@kernel
def _deepest(gap):
    deepest = 0.0
    for k in range(gap.shape[0]):
        deepest = min(deepest, gap[k])
    return deepest


@kernel
def _wall_contacts(x, axis, half, radius, scale, at, found, like, dof):
    """Rows (H, gaps, one, two, soft) of cells at walls, with room for those of the contacts
    `found`; how many there are, and the deepest gap. at: kinds, places and sizes of walls and
    which are soft, and weight and reach by cell."""
    (kinds, places, sizes, is_soft), root, reach = at
    room = most_rows(dof) * found[4].shape[0] + 3 * kinds.shape[0] * x.shape[0]
    H, gaps = np.empty((2 * room, len(dof)), like.dtype), np.empty(room, like.dtype)
    one, two = np.empty(room, np.int32), np.empty(room, np.int32)
    rows = H, gaps, one, two, np.zeros(room, np.uint8)
    walls, deepest = wall_rows(
        x, axis, half, radius, scale, kinds, places, sizes, root, reach, rows, is_soft, False, dof,
    )  # fmt: skip
    return rows, walls, deepest


@kernel
def _numbers(x, length, scale, growth, least, last, first_pass, hardness, softer, roots, is_soft,
             alphas, margin, alpha, low, reach, root, dof):  # fmt: skip
    """α, the least scaled Δl, reach of walls and weight of walls of each cell."""
    end = degrees(dof) - 1
    for i in range(x.shape[0]):
        alpha[i] = softer * (alphas[i] if alphas.shape[0] > 0 else hardness)
        low[i] = min((least[i] - length[i]) / scale[i, end], 0.0) if growth[i] > 0 else 0.0
        way = 0.0
        for k in range(x.shape[1]):
            way += last[i, k] * last[i, k]
        reach[i] = margin + (math.sqrt(way) if first_pass else 0.0)
        for w in range(roots.shape[0]):
            root[w, i] = math.sqrt(roots[w, i] * alpha[i]) if is_soft[w] else roots[w, i]


@kernel
def _put_start(y, last, scale, first_pass, rising):
    """Puts the scaled move from which a pass starts into y: the last one, or that of a repeated
    pass, 0. A solve with harder contacts than the one before starts from that: not `rising`."""
    for i in range(y.shape[0] if rising else 0):
        for k in range(y.shape[1]):
            y[i, k] = last[i, k] / scale[i, k] if first_pass and scale[i, k] > 0 else 0.0


@kernel
def _minimise_some(rows, m, numbers, count, alpha, low, y, cap, settings, report, team, dof):
    """Minimise from y with the first m of the rows: for all cells, where no numbers are given; or,
    in a later pass, in which soft walls have already pushed, for the numbered cells among the
    others at rest. Puts the move into y, 0 for cells at rest. Returns
    the error, and each row's gap after the move."""
    H, gaps, one, two, soft = rows
    tolerance, limit = settings[TOLERANCE], int(settings[LIMIT])
    if numbers.shape[0] == 0:
        none = np.empty(0, y.dtype)
        iterations, error, e = minimise(
            H, one, two, m, gaps, none, alpha, low, y, tolerance, cap, limit, team, dof
        )
        report[ITERATIONS] += iterations
        return error, e
    m = rows_among(H, gaps, one, two, soft, m, numbers)
    pushed, part = np.zeros(m, y.dtype), np.zeros((count, len(dof)), y.dtype)
    for r in range(m):
        if soft[r] == STIFF and gaps[r] < 0:
            pushed[r] = -gaps[r]
    some_alpha, some_low = np.empty(count, y.dtype), np.empty(count, y.dtype)
    for i in range(y.shape[0]):
        if numbers[i] >= 0:
            some_alpha[numbers[i]], some_low[numbers[i]] = alpha[i], low[i]
            for k in range(y.shape[1]):
                part[numbers[i], k] = y[i, k]
    iterations, error, e = minimise(
        H, one, two, m, gaps, pushed, some_alpha, some_low, part, tolerance, cap, limit, team, dof
    )
    for i in range(y.shape[0]):
        for k in range(degrees(dof)):
            y[i, k] = part[numbers[i], k] if numbers[i] >= 0 else 0.0
    report[ITERATIONS] += iterations
    return error, e


@kernel
def step_colony(x, axis, base, growth, radius, viscosity, length_drag, shortest, last, hardness,
                walls, roots, alphas, settings, report, team, dof):  # fmt: skip
    """Grow one colony by `growth` and part what overlaps; x, axis, last and hardness in place.

    x, axis (n, d) float64. base to shortest: (n,). last: (n, D) the first move before, from which
    this one starts. hardness: (1,) α. walls: kinds, places, sizes, which are soft; roots: (S, n)
    their D, or stiffness · Δt. alphas: (n,), or (0,). Returns lengths.
    """
    margin, target, deep, softest, passes = _of_colony(base, growth, radius, viscosity, settings)
    tolerance, given = settings[TOLERANCE], alphas.shape[0] > 0
    hardness[0] = hardness[0] if hardness[0] > 0 else softest
    length, scale = base + growth, np.zeros(last.shape)
    least = np.maximum(base - SHRINK * np.maximum(growth, 0.0), shortest)
    half, reach, root = 0.5 * length, np.empty_like(base), np.empty(roots.shape)
    alpha, low, y = np.empty_like(last[:, 0]), np.empty_like(last[:, 0]), np.empty_like(last)
    at, is_soft, far = (walls, root, reach), walls[3], margin * (settings[SOFT] <= 0)
    number, deeply, softer, rising, kept, held, kept_alpha = 0, False, 1.0, True, y, 0.0, 0.0
    found = _contacts(x, axis, half, radius, margin, dof)
    report[DEEPLY] = 0 if settings[SOFT] > 0 else deeply_overlapping(found, radius)
    while number < passes:
        drags(length, radius, viscosity, length_drag, growth, scale, dof)
        _put_start(y, last, scale, number == 0, rising)
        _numbers(
            x, length, scale, growth, least, last, number == 0, hardness[0], softer, roots,
            is_soft, alphas, margin, alpha, low, reach, root, dof,
        )  # fmt: skip
        rows, at_walls, deepest = _wall_contacts(x, axis, half, radius, scale, at, found, last, dof)
        if number > 0 and not deeply:  # cells do not lie deep in others; but in a wall?
            if deepest >= -deep:
                break
            found, deeply = _contacts(x, axis, half, radius, margin, dof), True
            continue
        numbers, count, mine = _deep_cells(found, rows, at_walls, deep, len(y) * (number > 0))
        m = pair_rows(x, axis, half, radius, scale, mine, at_walls, rows, far, dof)
        error, e = _minimise_some(
            rows, m, numbers, count, alpha, low, y, 2 * target, settings, report, team, dof
        )
        failed = error > tolerance and error < np.inf
        if failed and rising and softer < MOST_SOFTER:
            softer *= SOFTER
            continue
        if softer > 1.0 and not failed:  # back towards the α that is wanted
            kept, held, kept_alpha = y.copy(), error, hardness[0] * softer
            softer, rising = softer / SOFTER, False
            continue
        if failed and not rising and not given:
            y, error = kept, held
        if not _noted(report, error, tolerance):
            break
        if error <= tolerance and number == 0 and not given:
            before = hardness[0]
            hardness[0] = kept_alpha if failed else _following(e, rows[4], before, target, softest)
            if hardness[0] < LAG * before and not failed:  # the force has grown: solve again
                kept, held, kept_alpha, rising = y.copy(), error, before, False
                report[PASSES] -= 1  # it is the same pass
                continue
        about = last * (number == 0 and np.any(rows[1][:m] < 0))  # without a push nothing moves
        report[CLIPPED] = move_cells(x, axis, length, y, scale, about, margin, least, dof)
        put(y if number == 0 else last, last)
        number, softer, rising = number + 1, 1.0, True
        if number < passes:
            found, deeply = _after(x, axis, length, radius, y, margin, deep, found, dof)
        if not deeply and is_soft.shape[0] == 0:
            break
        half = 0.5 * length
    return length


@kernel
def _noted(report, error, tolerance):
    """Report a pass. Returns whether its move is a number."""
    report[PASSES] += 1
    report[ERROR] = max(report[ERROR], error)
    if not error < np.inf:
        report[STATUS] = NOT_FINITE
    elif error > tolerance:
        report[STATUS] = max(report[STATUS], ITERATION_LIMIT)
    return error < np.inf


@kernel
def _of_colony(base, growth, radius, viscosity, settings):
    """The margin, the overlap that is wanted, how deep is too deep, all µm, the α of the softest
    contacts, and the most passes."""
    wide, drag, n = 0.0, 0.0, base.shape[0]
    for i in range(n):
        wide += radius[i] / n
        drag += viscosity[i] * (base[i] + growth[i] + 2 * radius[i]) / n
    deep = settings[DEEP] if settings[DEEP] > 0 else TOO_DEEP * wide
    softest = SOFTEST * settings[YIELD] / OVERLAP / drag
    passes = 1.0 if settings[SOFT] > 0 else settings[MOST_PASSES]
    return MARGIN * wide, settings[YIELD] * wide, deep, softest, passes


@kernel
def _following(e, soft, hardness, target, softest):
    """α at which the mean overlap of the contacts that push, with cells and with hard walls, is
    `target`, µm: harder at once, softer by a factor of two a step. Rows at the ends of stretches do
    not count: they push little, and would make the mean of the others larger."""
    total, count = 0.0, 0
    for r in range(e.shape[0]):
        if e[r] < 0 and soft[r] == HARD:
            total -= e[r]
            count += 1
    wanted = softest
    if count:
        force = total / count / hardness
        if force > 0:
            wanted = min(wanted, target / force)
    return max(min(wanted, 2.0 * hardness), HARDEST * softest)


@kernel(entry=True)
def step_colonies(team, taken, which, begin, dt, longest, cells, drags, alphas, walls, settings,
                  out, reports, dof):  # fmt: skip
    """Steps of the colonies `which`, each by itself: `kernels.colonies` describes the arguments.
    team: a board of threads that assist, or (0,)."""
    x, radius, contact_alpha = cells[0], cells[4], cells[7]
    kinds, places, sizes, _, is_soft = walls
    while True:
        b = next_of(which, taken)
        if b < 0:
            return
        first, end, report = begin[b], begin[b + 1], reports[b]
        if first == end:
            continue
        hardness = np.array([contact_alpha[first:end].max()], np.float64)
        if opened(first, end, longest, cells, drags, out, report):
            steps = int(report[SUBSTEPS])
            of = spatial_order(x[first:end], 6.0 * radius[first]) + first
            own_x, own_axis, last, roots, length, share, own_radius, viscosity, drag = taken_out(
                of, steps, dt / steps, cells, drags, walls, dof
            )
            shortest = shortest_of(of, length, own_radius, cells)
            own_alphas = alphas_of(of, dt / steps, alphas)
            own_settings = settings.copy()
            if steps > 1 and settings[DEEP] <= 0:
                own_settings[DEEP] = DEEP_IN_SUBSTEPS * radius[first:end].mean()
            for _ in range(steps):
                length = step_colony(
                    own_x, own_axis, length, share, own_radius, viscosity, drag, shortest, last,
                    hardness, (kinds, places[:, b], sizes[:, b], is_soft), roots, own_alphas,
                    own_settings, report, team, dof,
                )  # fmt: skip
                if report[STATUS] == NOT_FINITE:
                    break
            if report[STATUS] != NOT_FINITE:
                put_back(of, own_x, own_axis, last, length, out[0], out[1], out[3], out[2], dof)
        closed(first, end, cells, hardness[0], out, report)

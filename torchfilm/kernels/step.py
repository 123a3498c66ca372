"""One contact step of some colonies, each by itself: detect, solve, move, and again where cells lie
deep."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.batch import put, put_back
from torchfilm.kernels.bonds import (
    add_bonds,
    add_wall_bonds,
    bonds_of,
    drift_of,
    move_along,
    reach_of,
    room_of_bonds,
)
from torchfilm.kernels.colonies import (
    ALPHA,
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
from torchfilm.kernels.compiling import lean
from torchfilm.kernels.contact_pieces import shared_pair_rows, shares
from torchfilm.kernels.contacts import most_rows, pair_rows
from torchfilm.kernels.found import deep_cells, found_after, found_contacts
from torchfilm.kernels.hardness import (
    DEEP,
    LIMIT,
    PERIODS,
    SOFT,
    TOLERANCE,
    following,
    most_force,
    of_colony,
)
from torchfilm.kernels.memory import TOP, copied, give_back, room, zeros
from torchfilm.kernels.moves import drags, still_moving
from torchfilm.kernels.neighbours import spatial_order
from torchfilm.kernels.rows import (
    STIFF,
    deeply_overlapping,
    degrees,
    room_for_rows,
    rows_among,
    wall_rows,
)
from torchfilm.kernels.scheme import (
    DEEP_AFTER_MANY,
    HOPS,
    ITERATION_LIMIT,
    LAG,
    LONG_MOVES,
    MANY_SUBSTEPS,
    MOST_HOPS,
    MOST_SOFTER,
    NOT_FINITE,
    SHORTER,
    SHRINK,
    SLOWER,
    SLOWEST,
    SOFTER,
)
from torchfilm.kernels.solve import minimise
from torchfilm.kernels.solve_parts import overlaps
from torchfilm.kernels.team import next_of
from torchfilm.kernels.wall_moves import move_cells


@lean
def _wall_contacts(memory, x, axis, half, radius, scale, at, found, reached, like, dof):
    """Rows (H, gaps, one, two, soft) of cells at walls, with room for those of the contacts
    `found` and of bonds; how many there are, and the deepest gap. at: the walls, and weight and
    reach by cell. reached: the reaches of bonds."""
    (kinds, places, sizes, is_soft, _), root, reach = at
    most = room_of_bonds(
        reached, most_rows(dof) * found[4].shape[0], 3 * kinds.shape[0] * x.shape[0]
    )
    rows = room_for_rows(memory, most, like, dof)
    walls, deepest = wall_rows(
        x, axis, half, radius, scale, kinds, places, sizes, root, reach, rows, is_soft, False, dof,
    )  # fmt: skip
    return rows, walls, deepest


@lean
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


@lean
def _put_start(y, last, scale, first_pass, rising):
    """Puts the scaled move from which a pass starts into y: the last one, or that of a repeated
    pass, 0. A solve with harder contacts than the one before starts from that: not `rising`."""
    for i in range(y.shape[0] if rising else 0):
        for k in range(y.shape[1]):
            y[i, k] = last[i, k] / scale[i, k] if first_pass and scale[i, k] > 0 else 0.0


@lean
def _minimise_some(
    memory, rows, m, numbers, count, alpha, low, y, cap, settings, report, team, dof
):
    """Minimise from y with the first m of the rows: for all cells, where no numbers are given; or,
    in a later pass, in which soft walls have already pushed, for the numbered cells among the
    others at rest. Puts the move into y, 0 for cells at rest. Returns
    the error, and each row's gap after the move."""
    H, gaps, one, two, soft = rows
    tolerance, limit = settings[TOLERANCE], int(settings[LIMIT])
    if numbers.shape[0] == 0:
        none = room(memory, (0,), y.dtype)
        iterations, error, e = minimise(
            memory, H, one, two, m, gaps, none, alpha, low, y, tolerance, cap, limit, team, dof
        )
        report[ITERATIONS] += iterations
        return error, e
    m = rows_among(H, gaps, one, two, soft, m, numbers)
    pushed = zeros(memory, (m,), y.dtype)
    part = zeros(memory, (count, len(dof)), y.dtype)
    for r in range(m):
        if soft[r] == STIFF and gaps[r] < 0:
            pushed[r] = -gaps[r]
    some_alpha = room(memory, (count,), y.dtype)
    some_low = room(memory, (count,), y.dtype)
    for i in range(y.shape[0]):
        if numbers[i] >= 0:
            some_alpha[numbers[i]], some_low[numbers[i]] = alpha[i], low[i]
            for k in range(y.shape[1]):
                part[numbers[i], k] = y[i, k]
    iterations, error, e = minimise(
        memory, H, one, two, m, gaps, pushed, some_alpha, some_low, part, tolerance, cap, limit,
        team, dof,
    )  # fmt: skip
    for i in range(y.shape[0]):
        for k in range(degrees(dof)):
            y[i, k] = part[numbers[i], k] if numbers[i] >= 0 else 0.0
    report[ITERATIONS] += iterations
    return error, e


@lean
def _arrays(memory, length, growth, shortest, last, roots):
    """Lengths after growth, in place, the least that pressure leaves, and half lengths, (n,); then
    arrays for a pass: reach of walls, their weights, α, least scaled Δl, scale, the move, one that
    is kept, and the move about which a pass is bounded."""
    n, moves, kind = length.shape[0], last.shape, last.dtype
    least, half = room(memory, (n,), np.float64), room(memory, (n,), np.float64)
    for i in range(n):
        least[i] = max(length[i] - SHRINK * max(growth[i], 0.0), shortest[i])
        length[i] += growth[i]
        half[i] = 0.5 * length[i]
    of_walls = room(memory, (n,), np.float64), room(memory, roots.shape, np.float64)
    of_cells = room(memory, (n,), kind), room(memory, (n,), kind)
    scale = zeros(memory, moves, np.float64)
    y, kept, about = room(memory, moves, kind), room(memory, moves, kind), room(memory, moves, kind)
    return length, least, half, of_walls, of_cells, scale, y, kept, about


@lean
def _prepared(memory, x, axis, growth, radius, drag, last, number, rising, hardness, softer,
              walls, alphas, reached, margin, limits, found, arrays, dof):  # fmt: skip
    """Puts what a pass starts from into its arrays. Returns rows of cells at walls, with room for
    those of `found`, how many there are, and the deepest gap."""
    length, least, half, (reach, root), (alpha, low), scale, y, _, _ = arrays
    most = max(SLOWEST * limits[0] / hardness, 1.0)
    slower = min(SLOWER ** max(number - LONG_MOVES, 0), most)
    drags(length, radius, drag[0], drag[1], growth, slower, scale, dof)
    _put_start(y, last, scale, number == 0, rising)
    _numbers(
        x, length, scale, growth, least, last, number == 0, hardness, softer, walls[4], walls[3],
        alphas, margin, alpha, low, reach, root, dof,
    )  # fmt: skip
    at = walls, root, reach
    return _wall_contacts(memory, x, axis, half, radius, scale, at, found, reached, last, dof)


@lean
def step_colony(memory, x, axis, length, growth, radius, drag, shortest, last, hardness, walls,
                alphas, bonds, reach, settings, report, team, dof):  # fmt: skip
    """Grow one colony by `growth` and part what overlaps; x, axis, length, last, hardness in place.

    x, axis (n, d) float64. length to shortest: (n,). last: (n, D) the move from which to start.
    hardness: (1,) α. walls: kinds, places, sizes, which are soft, and (S, n) their D, or
    stiffness · Δt. alphas: (n,), or (0,). bonds and their reaches, µm: see `kernels.bonds`.
    """
    own = of_colony(length, growth, radius, drag, hardness, settings)
    margin, target, deep, limits, passes = own
    tolerance, given, near = settings[TOLERANCE], alphas.shape[0] > 0, margin + reach[0]
    arrays = _arrays(memory, length, growth, shortest, last, walls[4])
    periods, half, y, kept = settings[PERIODS:], arrays[2], arrays[6], arrays[7]
    number, deeply, softer, rising, held, kept_alpha = 0, False, 1.0, True, 0.0, 0.0
    found = found_contacts(memory, team, x, axis, half, radius, periods, near, dof)
    report[DEEPLY] = 0 if settings[SOFT] > 0 else deeply_overlapping(memory, found, radius)
    top = memory[1][TOP]
    while number < passes:
        give_back(memory, top)  # the contacts are kept, not what was made of them
        rows, at_walls, deepest = _prepared(
            memory, x, axis, growth, radius, drag, last, number, rising, hardness[0], softer,
            walls, alphas, reach, margin + reach[1], limits, found, arrays, dof,
        )  # fmt: skip
        if number > 0 and not deeply:  # cells do not lie deep in others; but in a wall?
            if deepest >= -deep:
                break
            found = found_contacts(memory, team, x, axis, half, radius, periods, near, dof)
            deeply, top = True, memory[1][TOP]
            continue
        error, e, m = _solved(
            memory, x, axis, radius, found, rows, at_walls, deep, margin, number, arrays, bonds,
            reach, 2 * target, settings, report, team, dof)  # fmt: skip
        failed = error > tolerance and error < np.inf
        if failed and rising and softer < MOST_SOFTER:
            softer *= SOFTER
            continue
        if softer > 1.0 and not failed:  # back towards the α that is wanted
            put(y, kept)
            held, kept_alpha, softer, rising = error, hardness[0] * softer, softer / SOFTER, False
            continue
        if failed and not rising and not given:
            put(kept, y)
            error = held
        if not _noted(report, error, tolerance):
            break
        if error <= tolerance and number == 0 and not given:
            report[ALPHA] = before = kept_alpha if failed else hardness[0]  # of this solve
            most = most_force(y, arrays[5], radius, growth, drag, reach, walls[3], dof)
            hardness[0] = before if failed else following(e, rows, before, target, limits, most)
            if hardness[0] < LAG * before and not failed:  # the force has grown: solve again
                put(y, kept)
                held, kept_alpha, rising = error, before, False
                report[PASSES] -= 1  # it is the same pass
                continue
        report[CLIPPED] = _carried_out(
            memory, x, axis, radius, last, rows[1][:m], walls, margin, number, arrays, dof
        )
        number, softer, rising = number + 1, 1.0, True
        if number < passes:
            give_back(memory, top)
            found, deeply = found_after(
                memory, team, x, axis, radius, periods, near, deep, found, arrays, dof
            )
            top = memory[1][TOP]
        if not deeply and walls[3].shape[0] == 0:
            break


@lean
def _carried_out(memory, x, axis, radius, last, gaps, walls, margin, number, arrays, dof):
    """Carry out the move of a pass. In the first it is bounded about what it has of the last one,
    which it then becomes; but without a push, by the rows' gaps, nothing moves. Returns how many
    cells were cut short."""
    length, least, _, _, _, scale, y, _, about = arrays
    pushed = number == 0 and overlaps(gaps, gaps.shape[0])
    scratch = room(memory, (3, len(dof)), np.float64)
    for i in range(last.shape[0]):
        still_moving(about, i, last, y, scale, pushed, dof)
    bound = margin * (SHORTER if number > LONG_MOVES else 1.0)
    clipped = move_cells(
        x, axis, length, radius, y, scale, about, bound, least, walls, scratch, dof
    )
    if number == 0:
        put(y, last)
    return clipped


@lean
def _solved(memory, x, axis, radius, found, rows, walls, deep, margin, number, arrays, bonds,
            reach, cap, settings, report, team, dof):  # fmt: skip
    """Solve a pass, of which `walls` rows are made: the first for all cells, a later one for those
    that lie deep and those near them. Returns the error, each row's gap after the move, and how
    many rows there are."""
    _, _, half, (_, root), (alpha, low), scale, y, _, _ = arrays
    far, periods = margin * (settings[SOFT] <= 0), settings[PERIODS:]
    some, hops = len(y) * (number > 0), min(HOPS * number, MOST_HOPS)
    numbers, count, mine = deep_cells(memory, found, rows, walls, deep, some, hops)
    if shares(team, x.shape[0], mine[2].shape[0]):
        m = shared_pair_rows(
            memory, team, x, axis, half, radius, periods, scale, mine, walls, rows, far, dof
        )
    else:
        m = pair_rows(memory, x, axis, half, radius, periods, scale, mine, walls, rows, far, dof)
    if reach[0] > 0:
        m = add_bonds(rows, walls, m, x, axis, half, radius, periods, scale, bonds, alpha, dof)
    if reach[1] > 0:
        m = add_wall_bonds(rows, walls, m, x, axis, half, root, scale, bonds, alpha, dof)
    error, e = _minimise_some(
        memory, rows, m, numbers, count, alpha, low, y, cap, settings, report, team, dof
    )
    return error, e, m


@lean
def _noted(report, error, tolerance):
    """Report a pass. Returns whether its move is a number."""
    report[PASSES] += 1
    report[ERROR] = max(report[ERROR], error)
    if not error < np.inf:
        report[STATUS] = NOT_FINITE
    elif error > tolerance:
        report[STATUS] = max(report[STATUS], ITERATION_LIMIT)
    return error < np.inf


@lean
def _largest(values):
    largest = values[0]
    for k in range(values.shape[0]):
        largest = max(largest, values[k])
    return largest


@lean
def _mean(values):
    total = 0.0
    for k in range(values.shape[0]):
        total += values[k]
    return total / values.shape[0]


@lean(entry=True)
def step_colonies(team, memory, taken, which, begin, dt, longest, cells, drags, alphas, given,
                  walls, settings, out, reports, dof):  # fmt: skip
    """Steps of the colonies `which`, each by itself: `kernels.colonies` describes the arguments.
    team: a board of threads that assist, or (0,). given: as in `kernels.bonds`."""
    x, radius, contact_alpha = cells[0], cells[4], cells[7]
    kinds, places, sizes, _, is_soft = walls
    while True:
        give_back(memory, 0)
        b = next_of(which, taken)
        if b < 0:
            return
        first, end, report = begin[b], begin[b + 1], reports[b]
        if first == end:
            continue
        hardness = room(memory, (1,), np.float64)
        hardness[0] = _largest(contact_alpha[first:end])
        if opened(first, end, longest, cells, drags, out, report):
            steps = int(report[SUBSTEPS])
            of = spatial_order(memory, x[first:end], 6.0 * radius[first])
            for i in range(end - first):
                of[i] += first
            own_x, own_axis, last, roots, length, share, own_radius, mu, gamma = taken_out(
                memory, of, steps, dt / steps, cells, drags, walls, dof
            )
            shortest = shortest_of(memory, of, length, own_radius, cells)
            own_alphas = alphas_of(memory, of, dt / steps, alphas)
            drift = drift_of(memory, of, given)
            bonds = bonds_of(memory, of, dt / steps, given, own_x, own_axis, length, drift, dof)
            reach = reach_of(bonds, drift, dof)
            own_settings = copied(memory, settings, settings.shape[0])
            top = memory[1][TOP]
            if steps > 1:
                move_along(own_x, own_axis, drift, -1.0, dof)
            for k in range(steps):
                if settings[DEEP] <= 0 and k + 1 == steps >= MANY_SUBSTEPS:
                    own_settings[DEEP] = -DEEP_AFTER_MANY * settings[DEEP] * _mean(own_radius)
                give_back(memory, top)
                report[ALPHA] = 0.0
                if steps > 1:
                    move_along(own_x, own_axis, drift, 1.0 / steps, dof)
                step_colony(
                    memory, own_x, own_axis, length, share, own_radius, (mu, gamma), shortest, last,
                    hardness, (kinds, places[:, b], sizes[:, b], is_soft, roots), own_alphas,
                    bonds, reach, own_settings, report, team, dof,
                )  # fmt: skip
                if report[STATUS] == NOT_FINITE:
                    break
            if report[STATUS] != NOT_FINITE:
                put_back(of, own_x, own_axis, last, length, out[0], out[1], out[3], out[2], dof)
        closed(first, end, cells, hardness[0], out, report)

"""Uptake of a signal by cells and its transport, solved together: a step for the grids of all
colonies, as `signals.uptake` and `signals.transport_uptake` make it.

A colony's iterations come one after the other, so that its grid stays in the processor's cache.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.transport import exchanged, padding_of
from torchfilm.kernels.transport_solve import SPARE, backward_euler, dot, product

# As in `tools.fixed_point`.
DEPTH, RIDGE, TINY, WORSE = 3, 1e-12, 1e-300, 4.0
# The error of a solve is at most this part of the least half; FINEST: its least relative residual.
HUNGER, FINEST = 1e-4, 1e-14


@kernel
def poisson(mean, cut, weights, tails):
    """As `transport_series.poisson`, of one colony: the probabilities of 0, 1, … events, those of
    more events than that, and how many terms count."""
    count = int(mean + 10 * np.sqrt(mean) + 30)
    total, log_of, log_factorial = 0.0, np.log(mean), 0.0
    for k in range(count):
        log_factorial += np.log(k) if k > 0 else 0.0
        chance = np.exp(k * log_of - mean - log_factorial)
        weights[k] = 0.0 if chance < cut and k > mean else chance
        total += weights[k]
    used, above, all_tails = 0, 0.0, 0.0
    for k in range(count - 1, -1, -1):  # summed from the rarest: small numbers first
        weights[k] /= total
        tails[k] = above
        all_tails += above
        above += weights[k]
        used = max(used, k + 1) if weights[k] > 0 else used
    for k in range(used):
        tails[k] *= mean / all_tails if all_tails > 0 else 1.0
    if not all_tails > 0:  # hardly anything happens
        tails[0] = mean
    return used


@kernel
def put_taking(taking, mean, cells):
    """As `uptake.Eaters.taking`, of the cells of one colony."""
    first, fed, volume, greatest, half, gain, dt = cells
    for i in range(mean.size):
        growth = greatest[first + i] / (half[first + i] + mean[i])
        x = growth * mean[i] * dt
        ratio = np.expm1(x) / x if x > 1e-300 else 1.0
        own = volume[first + i] / gain[first + i] * growth * ratio
        taking[i] = own if fed[first + i] else 0.0


@kernel
def put_losses(loss, taking, node, weight, start, voxel_volume):
    """The rate at which each voxel of one grid loses, 1/h. node, weight: of the colony's cells;
    start: the grid's first voxel."""
    loss[:] = 0.0
    for i in range(taking.size):
        for k in range(node.shape[1]):
            loss[node[i, k] - start] += weight[i, k] * (taking[i] / voxel_volume)


@kernel
def put_read(new, field, node, weight, start):
    """What each cell of one colony finds of its grid."""
    for i in range(new.size):
        total = 0.0
        for k in range(node.shape[1]):
            total += np.float64(weight[i, k]) * field[node[i, k] - start]
        new[i] = total


@kernel
def add_scaled(total, part, values):
    """total += part · values."""
    for i in range(total.size):
        total[i] += part * values[i]


@kernel
def series(u, pad, grid, weights, tails, used, gained, times, end, mean, spare):
    """`Eaten._series` for one grid: from u (padded) to end and mean. gained: q/λ or empty. times:
    λΔt."""
    strides, stay, ups, downs, wrap_to, wrap_from, wraps, _ = grid
    v, new, size = spare[0], spare[1], end.size
    for i in range(size):
        v[pad + i] = u[i]
        end[i], mean[i] = weights[0] * u[i], tails[0] * u[i]
    for n in range(1, used):
        exchanged(v, new, pad, strides, stay, ups, downs)
        for w in range(wrap_to.size):
            new[pad + wrap_to[w]] += wraps[w] * v[pad + wrap_from[w]]
        inner = new[pad : pad + size]  # a sum of two numbers as index costs several times as much
        for i in range(gained.size):
            inner[i] += gained[i]
        add_scaled(end, weights[n], inner)
        add_scaled(mean, tails[n], inner)
        v, new = new, v
    for i in range(size):
        mean[i] /= times


@kernel
def room_for(size, strides, events):
    """What `carry_once` works in, for grids of so many voxels, and the padding. events: the most of
    a series."""
    pad = padding_of(strides)
    terms = int(events + 10 * np.sqrt(events) + 31)
    fields, wider = np.empty((6, size)), np.zeros((2 + SPARE, size + 2 * pad))
    room = (
        fields[0], fields[1], wider[0], fields[2], fields[3], fields[4], fields[5], wider[2:],
        wider[1], np.empty(terms), np.empty(terms),
    )  # fmt: skip
    return room, pad


@kernel
def operator_of(c, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate, symmetric):
    """The operator of one of the grids of a shape, as `carry_once` takes it; they may share it."""
    own = c if stay.shape[0] > 1 else 0
    return (
        strides, stay[own], ups[own], downs[own], wrap_to, wrap_from, wraps[own], rate[own],
        symmetric,
    )  # fmt: skip


@kernel
def with_losses(dt, operator, room, far, settings):
    """λ, with the losses in room; the operator at this λ, which uses `still` of the room; and
    whether it is for backward Euler, as it stays once it is `far`."""
    strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate, _ = operator
    loss, still, mixed, fastest = room[0], room[1], room[8], 0.0
    for i in range(loss.size):
        still[i] = (1 - stay[i]) * rate + loss[i]
        fastest = max(fastest, still[i])
    at = settings[0] * fastest if fastest > 0 else 1.0
    far = far or at * dt > settings[2]
    if far:  # any λ will do; at the greatest loss rate, rounding would hide what others exchange
        at = rate
    scale = rate / at
    for i in range(loss.size):
        still[i] = 1 - still[i] / at
    grid = strides, still, ups * scale, downs * scale, wrap_to, wrap_from, wraps * scale, mixed
    return at, grid, far


@kernel
def carry_once(u, more, dt, pad, operator, room, far, least, settings):
    """One grid over dt hours with the losses in `room`: its end and mean go to room. Whether the
    solve converged, and whether it was one of backward Euler, which it stays once it is `far`.

    u: (voxels,). more: gain, 1/h, or empty. least: of `half`. operator: strides … wraps of one
    colony, its λ, and whether there is no flow.
    """
    _, _, x, r, b, final, mean, spare, _, weights, tails = room
    _, cut, _, tolerance, rounding, most = settings
    at, grid, far = with_losses(dt, operator, room, far, settings)
    times, symmetric = at * dt, operator[8]
    if not far:
        used = poisson(times, cut, weights, tails)
        series(u, pad, grid, weights, tails, used, more / at, times, final, mean, spare)
        return True, far
    # where cells are hungry at little concentration, an error of it counts, too
    size = np.sqrt(dot(b, b))
    within = min(tolerance, HUNGER * least / size) if size > 0 else tolerance
    within = max(within, FINEST)
    good = backward_euler(
        x, b, r, pad, grid, times, within, rounding, symmetric, most, spare, b[:0]
    )
    for i in range(u.size):
        x[pad + i] = max(x[pad + i], 0.0)
    product(x, r, pad, grid, times)
    below = False
    for i in range(u.size):
        if x[pad + i] + b[i] - r[i] < 0:  # where less is left than the residual, leave none
            below = True
            x[pad + i] = max(x[pad + i] + (b[i] - r[i]) * spare[6, pad + i], 0.0)
    if below:
        product(x, r, pad, grid, times)
    for i in range(u.size):
        # with its residual the change is what T makes of x: amount is conserved
        mean[i], final[i] = x[pad + i], max(x[pad + i] + b[i] - r[i], 0.0)
    return good, far


@kernel
def solve_mixed(matrix, right, count):
    """`fixed_point._solve` for one group: the solution in right."""
    for i in range(count):
        matrix[i, i] = matrix[i, i] * (1 + RIDGE) + TINY
    for i in range(count):
        for k in range(i + 1, count):
            part = matrix[k, i] / matrix[i, i]
            for j in range(i, count):
                matrix[k, j] -= part * matrix[i, j]
            right[k] -= part * right[i]
    for i in range(count - 1, -1, -1):
        for j in range(i + 1, count):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]


@kernel
def next_guess(mean, new, memory, changes, matrix, right, half, fed, close, lost, control):
    """One iteration of all cells of a colony, as `tools.fixed_point`: the next mean, in place.
    Whether all were close, and whether none is lost.

    memory: (4, cells), the last value and residual, and the best guess and its value. changes:
    (DEPTH, 2, cells), the last changes of value and residual, in a ring. control: iterations since
    the history began, the least residual squared, and the part of a step that is taken from the
    best guess; it begins as (0, ∞, 1).
    """
    done, near, size = True, True, 0.0
    for i in range(mean.size):
        new[i] = new[i] if fed[i] else mean[i]
        off = abs(new[i] - mean[i]) / (half[i] + max(mean[i], new[i]))
        near = near and off <= lost
        done = done and not off > close  # a NaN stays one
        size += off * off
    if done:
        return done, near
    if not near and not size <= WORSE * control[1]:  # from the best guess again, more carefully
        control[0], control[2] = 0, 0.5 * control[2]
        for i in range(mean.size):
            mean[i] = memory[2, i] + control[2] * (memory[3, i] - memory[2, i])
        return done, near
    if size < control[1]:
        control[1], control[2] = size, min(1.0, 2 * control[2])
        for i in range(mean.size):
            memory[2, i], memory[3, i] = mean[i], new[i]
    age = int(control[0])
    control[0], count = age + 1, min(age, DEPTH)
    if count > 0:
        slot = (age - 1) % DEPTH
        for i in range(mean.size):
            changes[slot, 0, i] = new[i] - memory[0, i]
            changes[slot, 1, i] = new[i] - mean[i] - memory[1, i]
    for a in range(count):
        for b in range(a, count):
            total = 0.0
            for i in range(mean.size):
                weight = 1 / (half[i] + max(mean[i], new[i]))
                total += changes[a, 1, i] * weight * (changes[b, 1, i] * weight)
            matrix[a, b] = matrix[b, a] = total
        right[a] = 0.0
        for i in range(mean.size):
            weight = 1 / (half[i] + max(mean[i], new[i]))
            right[a] += changes[a, 1, i] * weight * ((new[i] - mean[i]) * weight)
    solve_mixed(matrix, right, count)
    for i in range(mean.size):
        memory[0, i], memory[1, i] = new[i], new[i] - mean[i]
        ahead, left = new[i], new[i] - mean[i]
        for a in range(count):
            ahead -= right[a] * changes[a, 0, i]
            left -= right[a] * changes[a, 1, i]
        ahead -= (1 - control[2]) * left
        mean[i] = ahead if ahead > 0 else new[i]
    return done, near


@kernel
def eat_grid(u, more, dt, pad, operator, room, cells, place, found, out, settings):
    """One grid over dt hours. out: (cells,), what they took. The iterations, whether they
    failed, and whether the grid has numbers."""
    first, fed, volume, greatest, half, gain, _ = cells
    node, weight, start, voxel_volume = place
    close, most, rest = settings
    size, last = found.size, first + found.size
    mean, new, taking = found.copy(), np.empty(size), np.empty(size)
    memory, changes = np.zeros((4, size)), np.empty((DEPTH, 2, size))
    control = np.array([0.0, np.inf, 1.0])
    matrix, right = np.empty((DEPTH, DEPTH)), np.empty(DEPTH)
    far, good, near, count, least = False, True, True, 0, np.inf
    for i in range(first, last):
        least = min(least, half[i])
    while True:
        put_taking(taking, mean, cells)
        put_losses(room[0], taking, node, weight, start, voxel_volume)
        before = far
        good, far = carry_once(u, more, dt, pad, operator, room, far, least, rest)
        if far != before:  # another equation: what is known of the first says nothing
            control[0], control[1], control[2] = 0.0, np.inf, 1.0
        put_read(new, room[6], node, weight, start)
        done, near = next_guess(
            mean, new, memory, changes, matrix, right, half[first:last], fed[first:last], close,
            100 * close, control,
        )  # fmt: skip
        count += 1
        if done or count == most or not good:
            break
    for i in range(size):
        k = first + i
        grown = np.expm1(greatest[k] * found[i] / (half[k] + found[i]) * dt)
        out[i] = taking[i] * new[i] * dt if fed[k] else volume[k] / gain[k] * grown
    return count, not (near and good), good


@kernel(entry=True)
def eat(
    begin, end, starts, colonies, ends, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate,
    symmetric, gained, node, weight, fed, volume, greatest, half, gain, found, voxel_volume, dt,
    settings, values, out, amount, iterations, failed,
):  # fmt: skip
    """The grids begin … end of one shape after a step of dt hours, from values to out, (voxels,) of
    all colonies; and what their cells took: amount (N,).

    colonies: of the grids. ends: where the cells of each colony begin, (B + 1,). strides … wraps:
    as `transport.mix` takes them, without uptake, at λ = rate (b or 1,). gained: 1/h, (b or 1 or 0,
    voxels). fed … found: (N,) as `uptake.Eaters` has them, and s at the start. settings: close,
    most iterations, and of the series and the solve: 1.01, cut, most events, tolerance, rounding,
    most.
    """
    size = stay.shape[1]
    room, pad = room_for(size, strides, settings[2][2])
    x, b, u = room[2], room[4], np.empty(size)
    for c in range(begin, end):
        colony, start = colonies[c], starts[c]
        first, last = ends[colony], ends[colony + 1]
        operator = operator_of(
            c, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate, symmetric
        )
        more = gained[c if gained.shape[0] > 1 else 0] if gained.shape[0] > 0 else u[:0]
        for i in range(size):
            u[i] = b[i] = x[pad + i] = values[start + i]
        for i in range(more.size):
            b[i] += dt * more[i]
        cells = first, fed, volume, greatest, half, gain, dt
        place = node[first:last], weight[first:last], start, voxel_volume
        iterations[colony], failed[colony], good = eat_grid(
            u, more, dt, pad, operator, room, cells, place, found[first:last],
            amount[first:last], settings,
        )  # fmt: skip
        for i in range(size):
            out[start + i] = room[5][i] if good else np.nan

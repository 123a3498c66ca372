"""Transport of a signal over a step in which cells give to it and take from it: a step for the
grids of all colonies, as `signals.joint` makes it."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.transport import exchanged
from torchfilm.kernels.transport_solve import backward_euler
from torchfilm.kernels.uptake import (
    DEPTH,
    TINY,
    add_scaled,
    carry_once,
    next_guess,
    operator_of,
    poisson,
    put_read,
    room_for,
    with_losses,
)

# As in `signals.joint`.
EMPTY = 1e15


@kernel
def put_gained(more, gained, c):
    """What one of the grids of a shape gains without cells, of (b or 1 or 0, voxels)."""
    more[:] = 0.0
    if gained.shape[0] > 0:
        own = gained[c if gained.shape[0] > 1 else 0]
        for v in range(more.size):  # (Numba compiles an assignment of arrays with all its messages)
            more[v] = own[v]


@kernel
def put_shares(more, loss, rates, given, guess, fed, node, weight, start, per_voxel, most):
    """Add to a grid what the cells of one colony give to each voxel, conc/h, and put there at which
    rate it loses to them, 1/h, as to `rates` of each cell. per_voxel: 1/(µm³ h). most: of a
    rate."""
    loss[:] = 0.0
    rates[:] = 0.0
    for i in range(given.size):
        if not fed[i]:
            continue
        share = given[i] * per_voxel
        if share >= 0:
            for k in range(node.shape[1]):
                more[node[i, k] - start] += weight[i, k] * share
        else:
            rates[i] = min(-share / max(guess[i], TINY), most)
            for k in range(node.shape[1]):
                loss[node[i, k] - start] += weight[i, k] * rates[i]


@kernel(entry=True)
def move(
    begin, end, starts, colonies, ends, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate,
    symmetric, gained, node, weight, fed, given, guess, found, voxel_volume, dt, finest, settings,
    values, out, at_end, average, taken, far, turned,
):  # fmt: skip
    """The grids begin … end of one shape after dt hours, from values to out, (voxels,) of all
    colonies; and what each cell finds at the end and in the mean, and took: (N,).

    colonies: of the grids. ends: where the cells of each colony begin, (B + 1,). strides … wraps:
    as `transport.mix` takes them, without cells, at λ = rate (b or 1,). gained: 1/h, (b or 1 or 0,
    voxels). fed … found: (N,), whether a cell is in the box, what it gives over the step, the guess
    of the mean, and what it finds at the start. settings: as of `uptake.carry_once`. far: (b,), as
    there, kept. turned: (B,) bool, set where it has changed.
    """
    size = stay.shape[1]
    room, pad = room_for(size, strides, settings[2])
    loss, x, b, final, mean = room[0], room[2], room[4], room[5], room[6]
    u, more = np.empty(size), np.empty(size)
    for c in range(begin, end):
        colony, start = colonies[c], starts[c]
        first, last = ends[colony], ends[colony + 1]
        operator = operator_of(
            c, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate, symmetric
        )
        put_gained(more, gained, c)
        cells = slice(first, last)
        place = node[cells], weight[cells], start
        per_voxel, rates = 1 / (voxel_volume * dt), taken[cells]
        put_shares(
            more, loss, rates, given[cells], guess[cells], fed[cells], *place, per_voxel, EMPTY / dt
        )
        for i in range(size):
            u[i] = x[pad + i] = values[start + i]
            b[i] = u[i] + dt * more[i]
        before = far[c]
        good, far[c] = carry_once(u, more, dt, pad, operator, room, far[c], finest, settings)
        turned[colony] |= far[c] != before
        for i in range(size):
            out[start + i] = final[i] if good else np.nan
        # backward Euler ends at its mean, but for a residual that may exceed what a cell finds
        put_read(at_end[cells], mean if far[c] else final, *place)
        put_read(average[cells], mean, *place)
        for i in range(first, last):
            if not fed[i]:
                at_end[i] = average[i] = found[i]
            elif not good:
                at_end[i] = average[i] = np.nan
            taken[i] *= average[i] * (voxel_volume * dt)


@kernel(entry=True)
def mix(begin, end, ends, width, x, new, memory, changes, control, size, fed, settings,
        turned, iterations, going, far):  # fmt: skip
    """Make the next guess of the colonies begin … end that are `going`, (B,) bool, by Anderson's
    mixing, as `tools.fixed_point`.

    x, new: (N · width,), guesses and what came of them, of a cell side by side; x in place. memory:
    (4, N · width), changes: (DEPTH, 2, N · width), control: (B, 3), as of `uptake.next_guess`.
    size, fed: (N · width,), what is added to x for its scale, and true. settings: close and lost.
    turned: (B,) bool, whose equation has changed; it is cleared.
    """
    close, lost = settings
    matrix, right = np.empty((DEPTH, DEPTH)), np.empty(DEPTH)
    for c in range(begin, end):
        if not going[c]:
            continue
        if turned[c]:  # another equation: what is known of the first says nothing
            control[c, 0], control[c, 1], control[c, 2], turned[c] = 0.0, np.inf, 1.0, False
        mine = slice(ends[c] * width, ends[c + 1] * width)
        done, near = next_guess(
            x[mine], new[mine], memory[:, mine], changes[:, :, mine], matrix, right, size[mine],
            fed[mine], close, lost, control[c],
        )  # fmt: skip
        iterations[c] += 1
        going[c], far[c] = not done, not near


@kernel
def turned_series(u, du, pad, grid, weights, tails, used, gained, dgained, slower, end, mean,
                  spare):  # fmt: skip
    """The tangents of `uptake.series` of one grid, to end and mean: of u, of what is gained, 1/λ,
    and of the losses, 1/λ, `slower`. spare: four rows, 0 in their padding."""
    strides, stay, ups, downs, wrap_to, wrap_from, wraps, _ = grid
    v, new, w, turn, size = spare[0], spare[1], spare[2], spare[3], end.size
    for i in range(size):
        v[pad + i], w[pad + i] = u[i], du[i]
        end[i], mean[i] = weights[0] * du[i], tails[0] * du[i]
    for n in range(1, used):
        exchanged(v, new, pad, strides, stay, ups, downs)
        exchanged(w, turn, pad, strides, stay, ups, downs)
        for k in range(wrap_to.size):
            new[pad + wrap_to[k]] += wraps[k] * v[pad + wrap_from[k]]
            turn[pad + wrap_to[k]] += wraps[k] * w[pad + wrap_from[k]]
        before, after, inner = v[pad : pad + size], new[pad : pad + size], turn[pad : pad + size]
        add_scaled(after, 1.0, gained)
        for i in range(size):
            inner[i] += dgained[i] - slower[i] * before[i]
        add_scaled(end, weights[n], inner)
        add_scaled(mean, tails[n], inner)
        v, new, w, turn = new, v, turn, w


@kernel
def put_turned_shares(dmore, dloss, drates, given, guess, dgiven, dguess, fed, node, weight, start,
                      per_voxel, most):  # fmt: skip
    """The tangents of `put_shares`."""
    dmore[:] = 0.0
    dloss[:] = 0.0
    drates[:] = 0.0
    for i in range(given.size):
        if not fed[i]:
            continue
        share, turn = given[i] * per_voxel, dgiven[i] * per_voxel
        there = max(guess[i], TINY)
        # as `joint._parted` divides what is neither given nor taken
        gift = turn if share > 0 or (share == 0 and guess[i] <= 0) else 0.0
        if share == 0 and guess[i] > 0:
            gift = 0.5 * turn
            drates[i] = -0.5 * turn / there
        elif share < 0 and -share / there < most:
            drates[i] = (share / there * dguess[i] - turn) / there
        for k in range(node.shape[1]):
            dmore[node[i, k] - start] += weight[i, k] * gift
            dloss[node[i, k] - start] += weight[i, k] * drates[i]


@kernel
def turned_euler(u, du, more, dmore, dloss, dt, pad, grid, times, operator, room, settings):
    """The tangents of a step of backward Euler of one grid, to `final` and `mean` of the room.
    Whether both solves converged. settings: as of `uptake.carry_once`."""
    _, _, _, within, rounding, most = settings
    x, r, b, final, mean, spare, symmetric = (
        room[2], room[3], room[4], room[5], room[6], room[7], operator[8],
    )  # fmt: skip
    for i in range(u.size):
        x[pad + i], b[i] = u[i], u[i] + dt * more[i]
    good = backward_euler(
        x, b, r, pad, grid, times, within, rounding, symmetric, most, spare, b[:0]
    )
    for i in range(u.size):
        b[i] = du[i] + dt * (dmore[i] - dloss[i] * x[pad + i])
        x[pad + i] = du[i]
    good &= backward_euler(
        x, b, r, pad, grid, times, within, rounding, symmetric, most, spare, b[:0]
    )
    for i in range(u.size):
        final[i] = mean[i] = x[pad + i]
    return good


@kernel(entry=True)
def move_turned(
    begin, end, starts, colonies, ends, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate,
    symmetric, gained, node, weight, fed, given, guess, dgiven, dguess, average, voxel_volume, dt,
    settings, values, dvalues, far, out, at_end, mean_there, taken,
):  # fmt: skip
    """The tangents of `move`, for those of what cells give, of the guesses and of the values:
    given, guess, average (N,), values and far (b,) as `move` had or left them. Whether all solves
    converged is in the numbers: NaN where not.
    """
    size = stay.shape[1]
    room, pad = room_for(size, strides, settings[2])
    loss, final, mean, weights, tails = room[0], room[5], room[6], room[9], room[10]
    own = np.empty((5, size))
    u, du, more, dmore, dloss = own[0], own[1], own[2], own[3], own[4]
    per_voxel, rates, drates = 1 / (voxel_volume * dt), np.empty(given.size), taken
    for c in range(begin, end):
        start, cells = starts[c], slice(ends[colonies[c]], ends[colonies[c] + 1])
        operator = operator_of(
            c, strides, stay, ups, downs, wrap_to, wrap_from, wraps, rate, symmetric
        )
        put_gained(more, gained, c)
        place = node[cells], weight[cells], start
        put_shares(more, loss, rates[cells], given[cells], guess[cells], fed[cells], *place,
                   per_voxel, EMPTY / dt)  # fmt: skip
        put_turned_shares(
            dmore, dloss, drates[cells], given[cells], guess[cells], dgiven[cells], dguess[cells],
            fed[cells], *place, per_voxel, EMPTY / dt,
        )  # fmt: skip
        for i in range(size):
            u[i], du[i] = values[start + i], dvalues[start + i]
        at, grid, _ = with_losses(dt, operator, room, far[c], settings)
        times, good = at * dt, True
        if far[c]:
            turned = more, dmore, dloss
            good = turned_euler(u, du, *turned, dt, pad, grid, times, operator, room, settings)
        else:
            used = poisson(times, settings[1], weights, tails)
            turned_series(u, du, pad, grid, weights, tails, used, more / at, dmore / at, dloss / at,
                          final, mean, room[7])  # fmt: skip
            for i in range(size):
                mean[i] /= times
        for i in range(size):
            out[start + i] = final[i] if good else np.nan
        put_read(at_end[cells], final, *place)
        put_read(mean_there[cells], mean, *place)
        for i in range(cells.start, cells.stop):
            there = mean_there[i] if good else np.nan
            taken[i] = (drates[i] * average[i] + rates[i] * there) * (voxel_volume * dt)

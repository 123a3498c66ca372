"""Contact problems of many colonies that torch has assembled: their minima, and the adjoint solves.

Rows (H, one, two) are those of `rows`, one colony after the other: cells begin … of a colony, and
its rows at … , whose cells are counted from the first of the colony.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import lean
from torchfilm.kernels.lanes import put_inverse
from torchfilm.kernels.memory import give_back, room
from torchfilm.kernels.rows import rows_of_cells
from torchfilm.kernels.scheme import RAISED
from torchfilm.kernels.solve import cg_step, minimise
from torchfilm.kernels.solve_parts import (
    first_direction,
    keep_pushing,
    next_direction,
    precondition,
    second_cells,
)
from torchfilm.kernels.team import next_of


@lean
def _next(memory, which, taken, begin, at):
    """The first colony that no thread has taken, or −1; its cells, and its rows."""
    give_back(memory, 0)
    b = next_of(which, taken)
    c = max(b, 0)
    return b, begin[c], begin[c + 1], at[c], at[c + 1]


@lean(entry=True)
def minimise_colonies(memory, taken, which, begin, at, rows, gaps, pushed, alpha, low, y, tolerance,
                      caps, limit, after, errors, iterations, alone, dof):  # fmt: skip
    """Minimise the problems of the colonies `which` from y (N, columns), in place: see `solve`.

    gaps, after (R,); pushed: (R,), or (0,) for nothing; alpha, low (N,); caps, errors, iterations
    (B,). alone: an empty board.
    """
    H, one, two = rows
    while True:
        b, first, end, r, last = _next(memory, which, taken, begin, at)
        if b < 0:
            return
        found = minimise(
            memory, H[2 * r : 2 * last], one[r:last], two[r:last], last - r, gaps[r:last],
            pushed[r:last], alpha[first:end], low[first:end], y[first:end], tolerance, caps[b],
            limit, alone, dof,
        )  # fmt: skip
        iterations[b], errors[b] = found[0], found[1]
        for k in range(last - r):
            after[r + k] = found[2][k]


@lean
def _largest(z):
    """The greatest |z|; no number where one is none."""
    largest = 0.0
    for i in range(z.shape[0]):
        for k in range(z.shape[1]):
            size = abs(z[i, k])
            if size != size:
                return size
            largest = max(largest, size)
    return largest


@lean
def _solve(memory, H, one, two, act, alpha, held, g, x, tolerance, limit, dof):
    """x = −(JᵀAJ + α)⁻¹ g, (n, columns), by CG, to a share of the greatest preconditioned residual;
    g becomes the residual. Returns iterations, and the residual that is left over that allowed."""
    n, rows, kind = g.shape[0], act.shape[0], g.dtype
    begin, halves = rows_of_cells(memory, one, two, rows, n)
    two = second_cells(memory, H, one, two, rows)
    on = room(memory, (rows,), np.int32)
    on = on[: keep_pushing(act, range(rows), on)]
    inverse = room(memory, (n, len(dof), len(dof)), kind)
    for i in range(n):
        put_inverse(
            inverse, i, H, halves, act, begin[i], begin[i + 1], alpha[i], RAISED, held[i] > 0, dof
        )
    z, p, t = room(memory, g.shape, kind), room(memory, g.shape, kind), room(memory, (1,), kind)
    rz, count = precondition(inverse, g, z, 0, n, dof), 0
    worst = _largest(z)
    target = tolerance * worst
    first_direction(x, p, z, 0, n)
    while worst > target and worst < np.inf and count < limit:
        new = cg_step(H, one, two, on, alpha, inverse, g, z, p, x, rz, t, dof)
        count, worst = count + 1, _largest(z)
        if t[0] == 0:
            break
        t[0], rz = new / rz, new
        next_direction(p, z, t[0], 0, n)
    return count, worst / target if worst > 0 else worst


@lean(entry=True)
def solve_colonies(memory, taken, which, begin, at, rows, act, alpha, held, g, x, tolerances,
                   limit, left, iterations, dof):  # fmt: skip
    """x = −(JᵀAJ + α)⁻¹ g of the colonies `which`, in the degrees of freedom that are free.

    act (R,): rows that push. held (N,): lengths that are not free. g, x (N, columns); g is lost.
    tolerances (B,); left, iterations (B,): as `_solve` returns them.
    """
    H, one, two = rows
    while True:
        b, first, end, r, last = _next(memory, which, taken, begin, at)
        if b < 0:
            return
        iterations[b], left[b] = _solve(
            memory, H[2 * r : 2 * last], one[r:last], two[r:last], act[r:last], alpha[first:end],
            held[first:end], g[first:end], x[first:end], tolerances[b], limit, dof,
        )  # fmt: skip

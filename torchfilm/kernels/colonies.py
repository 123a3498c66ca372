"""A step of each colony of a batch: what comes before its contacts are solved, and after.

The arguments of both kinds of contacts:

memory: the store and marks of `kernels.memory`. taken: (1,) int64, how many of `which` threads have
taken. which: (K,) int64, the colonies to step, each by the thread that takes it. begin: (B + 1,)
int64; cells of colony b are begin[b] … begin[b + 1] − 1. dt: h. longest: µm that a cell may grow in
a sub-step. cells: position (N, d) float64, axis (N, d), length (N,) after growth, elongation (N,),
radius (N,), the last move (N, D), collapsed steps (N,) int64, α of the last step (N,) and
compression (N,), or (0,) of bilateral contacts. drags: viscosity and length drag, (N,) or (1,) for
all cells, and the factor `drag`, (N,) or (0,). alphas: how α is given (NOT_GIVEN, GIVEN or
OF_STIFFNESS), and values, (N,), (1,) or (0,). walls: kinds (S,), places (S, B, 3), sizes (S, B),
weight or stiffness of each cell (S, N), and which are soft (S,). settings: float64, in the order of
`physics.compiled._kernel_of`. out: arrays for what the cells become: position, axis, length, move,
elongation, collapsed steps, α, compression. reports: (B, REPORT). dof: a tuple as long as there are
columns D: 4 in the plane, 8 in space, where the last one stays 0.
"""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.batch import cells_of
from torchfilm.kernels.compiling import kernel, lean
from torchfilm.kernels.memory import room
from torchfilm.kernels.scheme import (
    BAD_DRAG,
    BAD_LENGTH,
    BURIED,
    COLLAPSED,
    COMPRESSION,
    CONVERGED,
    LONG,
    MANY,
    MOST_SUBSTEPS,
    NOT_FINITE,
    ROUNDING,
    TOO_FAST,
)

# Places in the report of a colony.
ITERATIONS, PASSES, ERROR, CLIPPED, DEEPLY, STATUS, SUBSTEPS, ALPHA = range(8)
REPORT = 8
# How α is given.
NOT_GIVEN, GIVEN, OF_STIFFNESS = range(3)


@lean(inline=True)
def value_of(values, i):
    """The value of cell i, where there may be one for all cells."""
    return values[i if values.shape[0] > 1 else 0]


@lean(inline=True)
def viscosity_of(drags, i):
    viscosity, _, factor = drags
    return value_of(viscosity, i) * factor[i] if factor.shape[0] else value_of(viscosity, i)


@lean
def _finite(columns, i):
    """Whether row i of an (n, D) array is finite."""
    good = True
    for k in range(columns.shape[1]):
        good &= abs(columns[i, k]) < np.inf
    return good


@lean
def substeps(first, end, longest, cells, drags):
    """Sub-steps and status of the colony of the cells first … end − 1: see
    `physics.substeps`."""
    x, axis, length, growth, _, last, _, _, _ = cells
    most, status = 0.0, CONVERGED
    for i in range(first, end):
        good = _finite(x, i) & _finite(axis, i) & _finite(last, i)
        if not (good & (abs(length[i]) < np.inf) & (abs(growth[i]) < np.inf)):
            status = max(status, NOT_FINITE)
        viscosity, length_drag = viscosity_of(drags, i), value_of(drags[1], i)
        of_drags = (viscosity > 0) & (viscosity < np.inf) & (length_drag < np.inf)
        if not (of_drags & (length_drag > 0)):
            status = max(status, BAD_DRAG)
        if -np.inf < length[i] < 0:
            status = max(status, BAD_LENGTH)
        most = max(most, growth[i])
    wanted = math.ceil(most / longest * (1 - ROUNDING)) if status == CONVERGED else 1.0
    if wanted > MOST_SUBSTEPS:
        return 1, TOO_FAST
    return max(int(wanted), 1), status


@lean
def opened(first, end, longest, cells, drags, out, report):
    """Puts the cells, as they were before growth, into `out`, and sub-steps and status into the
    report. Returns whether the colony can be stepped."""
    x, axis, length, growth, _, last, _, _, _ = cells
    new_x, new_axis, new_length, new_last, _, _, _, _ = out
    for i in range(first, end):
        for k in range(x.shape[1]):
            new_x[i, k], new_axis[i, k] = x[i, k], axis[i, k]
        for k in range(last.shape[1]):
            new_last[i, k] = last[i, k]
        new_length[i] = length[i] - growth[i]
    report[SUBSTEPS], report[STATUS] = substeps(first, end, longest, cells, drags)
    return report[STATUS] == CONVERGED


@lean
def taken_out(memory, of, steps, dt, cells, drags, walls, dof):
    """The cells `of`, in this order and in float64, for sub-steps of dt hours: position, axis, last
    move, weights or stiffness · dt of walls (S, n), length before growth, growth in a sub-step,
    radius, viscosity and length drag."""
    x, axis, length, growth, radius, last, _, _, _ = cells
    n, is_soft = of.shape[0], walls[4]
    own_x, own_axis, own_last, own_roots = cells_of(memory, of, x, axis, last, walls[3], dof)
    for w in range(is_soft.shape[0]):
        for i in range(n if is_soft[w] else 0):
            own_roots[w, i] *= dt
    base, share = room(memory, (n,), np.float64), room(memory, (n,), np.float64)
    own_radius = room(memory, (n,), np.float64)
    viscosity, length_drag = room(memory, (n,), np.float64), room(memory, (n,), np.float64)
    for i in range(n):
        base[i], share[i] = length[of[i]] - growth[of[i]], growth[of[i]] / steps
        own_radius[i], viscosity[i] = radius[of[i]], viscosity_of(drags, of[i])
        length_drag[i] = value_of(drags[1], of[i])
    return own_x, own_axis, own_last, own_roots, base, share, own_radius, viscosity, length_drag


@kernel
def alphas_of(memory, of, dt, alphas):
    """α of the cells `of` in sub-steps of dt hours, (n,); (0,) where none is given."""
    kind, given = alphas
    own = room(memory, (0 if kind == NOT_GIVEN else of.shape[0],), given.dtype)
    for i in range(own.shape[0]):
        value = value_of(given, of[i])
        own[i] = 1.0 / (value * dt) if kind == OF_STIFFNESS else value
    return own


@kernel
def shortest_of(memory, of, base, radius, cells):
    """The length, µm, below which pressure takes none of the cells `of`, (n,)."""
    compression, own = cells[8], room(memory, base.shape, np.float64)
    for i in range(of.shape[0]):
        left = COMPRESSION * (base[i] + 2 * radius[i]) - compression[of[i]]
        own[i] = max(base[i] - max(left, 0.0), 0.0)
    return own


@lean
def closed(first, end, cells, alpha, out, report):
    """What a step leaves to the next one: by how much cells have grown and been compressed, α, and
    for how many steps in a row contacts have not held the colony's cells apart."""
    _, _, length, growth, _, _, collapsed, _, compression = cells
    _, _, new_length, _, new_growth, new_collapsed, new_alpha, new_compression = out
    steps = 0
    for i in range(first, end):
        base = length[i] - growth[i]
        new_growth[i] = new_length[i] - base
        steps = max(steps, collapsed[i])
        if compression.shape[0]:
            new_alpha[i] = alpha
            new_compression[i] = max(compression[i] + (base - new_length[i]), 0.0)
    buried = report[DEEPLY] > BURIED * max(end - first, MANY)
    new_collapsed[first:end] = steps + 1 if buried else 0
    if buried and steps + 1 >= LONG and report[STATUS] == CONVERGED:
        report[STATUS] = COLLAPSED

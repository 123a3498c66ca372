"""Divisions: which cells there are then, what they are called, and where they lie."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel


@kernel(entry=True)
def split(due, colony, uid, parent, next_uid):
    """Makes two cells, side by side, of each of N that is due (N,) bool.

    Returns the rows of the M parents; of both daughters in the new batch (2 M,), first daughters
    first; for each new cell the row that it comes from, its uid and its parent, (N + M,); and the
    next uid of each colony. uids are numbered on within each colony.
    """
    n, m = due.shape[0], 0
    for i in range(n):
        m += due[i]
    rows, daughters, source = (
        np.empty(m, np.int64),
        np.empty(2 * m, np.int64),
        np.empty(n + m, np.int64),
    )
    new_uid, new_parent, following = np.empty_like(source), np.empty_like(source), next_uid.copy()
    k = 0
    for i in range(n):
        source[i + k], new_uid[i + k], new_parent[i + k] = i, uid[i], parent[i]
        if due[i]:
            rows[k], daughters[k], daughters[m + k], source[i + k + 1] = i, i + k, i + k + 1, i
            for end in range(2):
                new_uid[i + k + end], new_parent[i + k + end] = following[colony[i]], uid[i]
                following[colony[i]] += 1
            k += 1
    return rows, daughters, source, new_uid, new_parent, following


@kernel(entry=True)
def place_daughters(rows, daughters, length, radius, axis, share, noise, sd, new_length, new_axis,
                    new_position):  # fmt: skip
    """Puts length, axis and position of 2 M daughters (see `split`) into the new batch, in which
    they have those of their parents. All but the position is of one type, as torch would compute.

    length, radius (N,) and axis (N, d) of the batch before; share (M,) of the length that first
    daughters get; noise (2 M, 4), of which a daughter's axis gets sd (2 M,) times the first d; both
    (0, …) for none.
    """
    m, d = rows.shape[0], axis.shape[1]
    half, one = length.dtype.type(0.5), length.dtype.type(1)
    for k in range(2 * m):
        parent, cell = rows[k % m], daughters[k]
        rest, part = length[parent] - (radius[parent] + radius[parent]), share[k % m]
        new_length[cell] = rest * (part if k < m else one - part)
        shift = half * (new_length[cell] - length[parent])
        for c in range(d):
            moved = shift * axis[parent, c]
            new_position[cell, c] += moved if k < m else -moved
        if sd.shape[0] == 0 or not sd[k] > 0:
            continue
        total = one - one
        for c in range(d):
            new_axis[cell, c] = axis[parent, c] + sd[k] * noise[k, c]
            total += new_axis[cell, c] * new_axis[cell, c]
        for c in range(d):
            new_axis[cell, c] *= one / np.sqrt(total)

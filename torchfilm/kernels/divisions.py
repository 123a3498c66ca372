"""Divisions: which cells there are then, and what they are called."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel


@kernel
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

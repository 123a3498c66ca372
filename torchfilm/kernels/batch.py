"""Rows of cells: copied, and those of one colony taken out of a batch and put back."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import lean
from torchfilm.kernels.memory import room, zeros
from torchfilm.kernels.rows import degrees


@lean
def cells_of(memory, of, x, axis, last, roots, dof):
    """x and axis (n, d) in float64, last (n, len(dof)) and roots (S, n) of the cells `of`."""
    D = degrees(dof)
    n, d = of.shape[0], 2 if D == 4 else 3
    own_x, own_axis = room(memory, (n, d), np.float64), room(memory, (n, d), np.float64)
    own_last = zeros(memory, (n, len(dof)), last.dtype)
    own_roots = room(memory, (roots.shape[0], n), np.float64)
    for i in range(n):
        for k in range(d):
            own_x[i, k], own_axis[i, k] = x[of[i], k], axis[of[i], k]
        for k in range(D):
            own_last[i, k] = last[of[i], k]
        for w in range(roots.shape[0]):
            own_roots[w, i] = roots[w, of[i]]
    return own_x, own_axis, own_last, own_roots


@lean
def put_back(of, own_x, own_axis, own_last, own_length, x, axis, last, length, dof):
    """Write what the cells `of` have become into the batch."""
    D = degrees(dof)
    d = 2 if D == 4 else 3
    for i in range(of.shape[0]):
        for k in range(d):
            x[of[i], k], axis[of[i], k] = own_x[i, k], own_axis[i, k]
        for k in range(D):
            last[of[i], k] = own_last[i, k]
        length[of[i]] = own_length[i]


@lean
def put(rows, out):
    """Writes rows (n, D) into out. `out[:] = rows` would take Numba seconds to compile."""
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            out[i, k] = rows[i, k]

"""Sub-steps of colonies, and colonies that cannot be stepped: see `physics.substeps`."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.scheme import (
    BAD_DRAG,
    CONVERGED,
    MOST_SUBSTEPS,
    NOT_FINITE,
    ROUNDING,
    TOO_FAST,
)


@kernel
def _finite(columns, i):
    """Whether row i of an (n, D) array is finite."""
    good = True
    for k in range(columns.shape[1]):
        good &= abs(columns[i, k]) < np.inf
    return good


@kernel
def substeps(owner, position, axis, move, length, elongation, viscosity, length_drag, longest,
             steps, status):  # fmt: skip
    """Puts the number of sub-steps and the status of each colony into steps and status, (B,)."""
    most = np.zeros(steps.shape[0])
    status[:] = CONVERGED
    for i in range(owner.shape[0]):
        b = owner[i]
        good = _finite(position, i) & _finite(axis, i) & _finite(move, i)
        if not (good & (abs(length[i]) < np.inf) & (abs(elongation[i]) < np.inf)):
            status[b] = max(status[b], NOT_FINITE)
        of_drags = (viscosity[i] > 0) & (viscosity[i] < np.inf) & (length_drag[i] < np.inf)
        if not (of_drags & (length_drag[i] > 0)):
            status[b] = BAD_DRAG
        most[b] = max(most[b], elongation[i])
    for b in range(steps.shape[0]):
        steps[b] = 1
        wanted = math.ceil(most[b] / longest * (1 - ROUNDING)) if status[b] == CONVERGED else 1.0
        if wanted > MOST_SUBSTEPS:
            status[b] = TOO_FAST
        else:
            steps[b] = max(wanted, 1)

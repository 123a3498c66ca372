"""The contact solve: minimise ‖D(Jx − g)‖² + α xᵀMx, each colony converged by itself.

| paper                        | here                                                         |
|------------------------------|--------------------------------------------------------------|
| Δx, eq. 2: position, angle,  | `x` = (Δc, Δθ, Δl), (N, 7), or (N, 4) in strict 2-D          |
| length                       |                                                              |
| J Δx + d = ε, eq. 3          | g − Jx = −ε, with gaps g = −d; `ContactProblem.gap_after`    |
| D, below eq. 3               | row weights, already multiplied into `rows` and `gap`        |
| M, eq. 4                     | diagonal: `scale` = M^(−½), (N, D)                           |
| J M⁻¹ Δp + d = ε, eq. 4      | `rows` = D J M^(−½), a `ContactJacobian`; x = M^(−½) y       |
| ‖Dε‖² + α Δpᵀ M⁻¹ Δp → min   | (JᵀJ + α) y = Jᵀ g with the scaled J and g; Δp = M x         |

Where the solve goes beyond the paper:

- Rotational drag differs about the cell's axis. A contact on a centreline exerts no torque about
  that axis, so this direction is never entered, and M stays diagonal.
- Bilateral rows (the paper's least squares) all act: one linear system. Unilateral rows act only
  where g − Jx < 0: semismooth Newton with a line search (`newton`).
- Δl ≥ −growth: projected Newton. A length at its bound leaves the system.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchfilm.physics.adjoint import attach_gradient
from torchfilm.physics.newton import minimise
from torchfilm.physics.problem import ContactProblem, SolveReport

# A gradient through a solve_contacts with a tolerance above this raises a warning.
LOOSE_FOR_GRADIENTS = 1e-4


def solve_contacts(
    problem: ContactProblem, start: Tensor | None, tolerance: float | Tensor, max_iterations: int
) -> tuple[Tensor, SolveReport]:
    """Solve a contact problem for the move x of each cell, (N, D) in µm, rad and µm.

    start: (N, D), an earlier x from which the solve begins, or None for 0. tolerance: one number or
    one per colony, (B,). A colony has converged when its worst preconditioned residual is at most
    `tolerance` times the worst residual at x = 0. max_iterations: of CG, per colony.

    Returns x and the report. The result is differentiable by the adjoint method, which costs one
    more solve with the same operator. Warns with RuntimeWarning if a gradient is required at a
    loose tolerance.
    """
    tolerance = torch.as_tensor(
        tolerance, dtype=problem.scale.dtype, device=problem.scale.device
    ).expand(problem.colonies.size)
    with torch.no_grad():
        end, report = minimise(problem.detached(), start, tolerance, max_iterations)
    tracked = (
        problem.gap,
        problem.rows.row_first,
        problem.rows.row_wall,
        problem.alpha,
        problem.lower,
        problem.scale,
    )
    y = end.y
    if torch.is_grad_enabled() and any(t.requires_grad for t in tracked):
        loosest = float(tolerance.max())
        if loosest > LOOSE_FOR_GRADIENTS:
            warnings.warn(
                f"a gradient is required through contacts that are solved to {loosest:g} only."
                " That is enough for overlaps, but the gradient may even have the wrong sign. Give"
                " Mechanics a tolerance of 1e-6 or less (1e-8 in float64), or run under"
                " torch.no_grad().",
                RuntimeWarning,
                stacklevel=2,
            )
        y = attach_gradient(problem, end, tolerance, max_iterations)
    return y * problem.scale, report

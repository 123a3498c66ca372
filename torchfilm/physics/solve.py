"""The solve of bilateral contacts: minimise ‖D(Jx − g)‖² + α xᵀMx, each colony converged by itself.

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
- Δl ≥ −growth: projected Newton. A length at its bound leaves the system.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.physics.adjoint import attach_gradient
from torchfilm.physics.newton import minimise
from torchfilm.physics.problem import ContactProblem, SolveReport
from torchfilm.tools.warn_once import warn

# Above these tolerances a gradient through contacts raises a warning. One-sided ones are solved to
# an error of their forces; of bilateral ones only the move is bounded, and forces amplify it.
LOOSE_FOR_GRADIENTS, LOOSE_IF_BILATERAL = 1e-5, 1e-6


def solve_contacts(
    problem: ContactProblem,
    start: Tensor | None,
    tolerance: float | Tensor,
    max_iterations: int,
    colony_ids: Tensor | None = None,
) -> tuple[Tensor, SolveReport]:
    """Solve a contact problem for the move x of each cell, (N, D) in µm, rad and µm.

    start: (N, D), an earlier x from which the solve begins, or None for 0. tolerance: one number or
    one per colony, (B,). A colony has converged when its worst preconditioned residual is at most
    `tolerance` times the worst residual at x = 0. max_iterations: of CG, per colony. colony_ids:
    (B,), for messages.

    Returns x and the report. The result is differentiable by the adjoint method, which costs one
    more solve with the same operator. Warns with RuntimeWarning if a gradient is required at a
    loose tolerance.
    """
    tolerance = torch.as_tensor(
        tolerance, dtype=problem.scale.dtype, device=problem.scale.device
    ).expand(problem.colonies.size)
    with torch.no_grad():
        end, report = minimise(problem.detached(), start, tolerance, max_iterations)
    y = end.y
    if torch.is_grad_enabled() and problem.tracked:
        warn_if_loose(float(tolerance.max()), LOOSE_IF_BILATERAL)
        y = attach_gradient(problem, end, tolerance, max_iterations, colony_ids)
    return y * problem.scale, report


def warn_if_loose(tolerance: float, most: float = LOOSE_FOR_GRADIENTS) -> None:
    """Warn of a gradient through contacts that are solved to `tolerance` only, above `most`."""
    if tolerance > most:
        warn(
            f"a gradient is required through contacts that are solved to {tolerance:g} only."
            " That is enough for overlaps, but the gradient may even have the wrong sign. Give"
            f" Mechanics a tolerance of {most:g} or less, or run under"
            " torch.no_grad().",
            category=RuntimeWarning,
        )

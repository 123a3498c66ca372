"""Explicit integrators with equal steps for circuits that are not stiff: Euler and Runge–Kutta.

The Runge–Kutta methods are those of torchdiffeq.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.circuits.rosenbrock import Rates
from torchfilm.tools import checks

METHODS = ("midpoint", "heun2", "heun3", "rk4")


def euler(rates: Rates, u: Tensor, dt: float, steps: int = 1) -> Tensor:
    """Concentrations (N, S) after dt hours in equal steps of Euler's method; order 1.

    rates: as in `rodas3`.
    """
    _check_steps(steps)
    rows = torch.arange(u.shape[0], device=u.device)
    for h in lengths(dt, steps, "euler"):
        u = u + h.item() * rates(u, rows)
    return u


def runge_kutta(rates: Rates, u: Tensor, dt: float, steps: int = 1, method: str = "rk4") -> Tensor:
    """Concentrations (N, S) after dt hours in equal steps.

    method: "midpoint", "heun2" (order 2), "heun3" (3) or "rk4" (4, the ⅜ rule). Only torchdiffeq's
    methods with fixed steps are used. Its adaptive methods share one step over the batch, so a
    stiff cell would change the results of the others.
    """
    _check_steps(steps)
    checks.choice("method", method, METHODS)
    if dt == 0 or u.numel() == 0:
        return u.clone()
    from torchdiffeq import (
        odeint,
    )  # imported where it is used: it takes longer to load than torchfilm itself

    rows = torch.arange(u.shape[0], device=u.device)
    grid = _grid(dt, steps).to(u.device)  # odeint would move it, and warn
    found = odeint(
        lambda t, y: rates(y, rows),
        u,
        grid[[0, -1]],
        method=method,
        options={"grid_constructor": lambda *_: grid},
    )
    return found[-1]


def _grid(dt: float, steps: int) -> Tensor:
    """The times between steps, in float64 on the host: in float32 the last step could be tiny."""
    return torch.linspace(0.0, dt, steps + 1, dtype=torch.float64)


def lengths(dt: float, steps: int, method: str) -> Tensor:
    """The length of each step, (steps,) float64: equal but for rounding."""
    if method == "euler":
        return torch.full((steps,), dt / steps, dtype=torch.float64)
    return _grid(dt, steps).diff()


def _check_steps(steps: int) -> None:
    checks.integer("steps", steps, least=1)

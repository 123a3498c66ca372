"""Explicit integrators with equal steps for circuits that are not stiff: Euler and Runge–Kutta.

The order of operations of the Runge–Kutta methods is that of torchdiffeq, whose own loop reads from
a GPU in each step.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchfilm.circuits.rosenbrock import Rates
from torchfilm.tools import checks


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

    method: "midpoint", "heun2" (order 2), "heun3" (3) or "rk4" (4, the ⅜ rule). Methods that adapt
    their step share it over the batch, so a stiff cell would change the results of the others.
    """
    _check_steps(steps)
    checks.choice("method", method, METHODS)
    if dt == 0 or u.numel() == 0:
        return u.clone()
    rows = torch.arange(u.shape[0], device=u.device)
    for h in lengths(dt, steps, method).tolist():
        u = u + CHANGES[method](lambda at: rates(at, rows), u, h)
    return u


def _midpoint(rates: Callable[[Tensor], Tensor], u: Tensor, h: float) -> Tensor:
    return h * rates(u + rates(u) * (0.5 * h))


def _heun2(rates: Callable[[Tensor], Tensor], u: Tensor, h: float) -> Tensor:
    a = rates(u)
    return h * (a * 0.5 + rates(u + h * a) * 0.5)


def _heun3(rates: Callable[[Tensor], Tensor], u: Tensor, h: float) -> Tensor:
    a = rates(u)
    b = rates(u + h * a * (1 / 3))
    d = rates(u + h * (a * 0.0 + b * (2 / 3)))
    return h * (a * 0.25 + b * 0.0 + d * 0.75)


def _rk4(rates: Callable[[Tensor], Tensor], u: Tensor, h: float) -> Tensor:
    a = rates(u)
    b = rates(u + h * a * (1 / 3))
    d = rates(u + h * (b - a * (1 / 3)))
    e = rates(u + h * (a - b + d))
    return (a + 3 * (b + d) + e) * h * 0.125


# The change of u in a step of h hours. Terms with a factor of 0 stay: they carry on what is not
# finite.
CHANGES = {"midpoint": _midpoint, "heun2": _heun2, "heun3": _heun3, "rk4": _rk4}
METHODS = tuple(CHANGES)


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

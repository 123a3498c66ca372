"""A step of transport: the methods, and the choice between them.

| method           | order in Δt | positive, conserves at any Δt | works for                    |
|------------------|-------------|-------------------------------|------------------------------|
| "exponential"    | exact       | yes                           | no obstacle, uniform flow    |
| "implicit"       | 1           | yes                           | everything                   |
| "crank_nicolson" | 2           | oscillates, goes below 0      | everything; the paper's, for |
|                  |             |                               | comparison                   |
| "euler"          | 1           | yes, by sub-steps             | everything; the reference    |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from torchfilm.signals.transport_exponential import prepare_exponential
from torchfilm.signals.transport_implicit import prepare_implicit
from torchfilm.signals.transport_iterative import prepare_crank_nicolson, prepare_euler
from torchfilm.signals.transport_operator import Operator
from torchfilm.tools import checks


class Stepper(Protocol):
    """A step of fixed length, with its factors computed once."""

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later."""
        ...


METHODS: dict[str, Callable[[Operator, float], Stepper]] = {
    "exponential": prepare_exponential,
    "implicit": prepare_implicit,
    "crank_nicolson": prepare_crank_nicolson,
    "euler": prepare_euler,
}


def choose(operator: Operator) -> str:
    """The suitable method: "exponential" where it is possible, else "implicit"."""
    return "exponential" if operator.separable else "implicit"


def prepare(operator: Operator, dt: float, method: str | None = None) -> Stepper:
    """A step of `dt` hours by `method`; default: the suitable one."""
    if method is not None:
        checks.choice("method", method, tuple(METHODS))
    dt = checks.number("dt", dt, above=0.0, most=math.inf)
    return METHODS[choose(operator) if method is None else method](operator, dt)

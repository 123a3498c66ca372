"""A step of transport: the methods, and the choice between them.

| method           | order in Δt | positive, conserves at any Δt | works for                    |
|------------------|-------------|-------------------------------|------------------------------|
| "exponential"    | exact       | yes                           | no obstacle, uniform flow    |
| "series"         | exact       | yes                           | everything; with too many    |
|                  |             |                               | terms backward Euler, 1      |
| "implicit"       | 1           | yes                           | everything                   |
| "crank_nicolson" | 2           | oscillates, goes below 0      | everything; the paper's, for |
|                  |             |                               | comparison                   |
| "euler"          | 1           | yes, by sub-steps             | everything; the reference    |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from torchfilm.signals.compiled import may_run, may_run_forward
from torchfilm.signals.compiled_transport import (
    CompiledExponential,
    CompiledSeries,
    compiled_exponential,
    compiled_series,
)
from torchfilm.signals.grid import Grid, Shape
from torchfilm.signals.transport_exponential import (
    Exponential,
    check_separable,
    prepare_exponential,
)
from torchfilm.signals.transport_implicit import prepare_implicit
from torchfilm.signals.transport_iterative import prepare_crank_nicolson, prepare_euler
from torchfilm.signals.transport_operator import Operator
from torchfilm.signals.transport_series import Series, prepare_series
from torchfilm.tools import checks, subnormals
from torchfilm.tools.tangents import both, has_tangent, refuse_second, with_tangent


class Stepper(Protocol):
    """A step of fixed length, with its factors computed once."""

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later."""
        ...


METHODS: dict[str, Callable[[Operator, float], Stepper]] = {
    "exponential": prepare_exponential,
    "series": prepare_series,
    "implicit": prepare_implicit,
    "crank_nicolson": prepare_crank_nicolson,
    "euler": prepare_euler,
}

Kernel = CompiledExponential | CompiledSeries
# those that kernels compute, too
COMPILED = {"exponential", "series"}


def choose(operator: Operator) -> str:
    """The suitable method: "exponential" where it is possible, else "series"."""
    return "exponential" if operator.separable else "series"


def check_method(operator: Operator, method: str | None) -> None:
    """Raise InputError for a method that does not exist, or not for this operator."""
    if method is not None:
        checks.choice("method", method, tuple(METHODS))
    if method == "exponential":
        check_separable(operator)


def prepare(
    operator: Operator, dt: float, method: str | None = None, *, compiled: bool = False
) -> Stepper:
    """A step of `dt` hours by `method`; default: the suitable one. compiled: whether kernels may
    compute the gradients of a series."""
    check_method(operator, method)
    dt = checks.number("dt", dt, above=0.0, most=math.inf)
    method = choose(operator) if method is None else method
    if method == "series":
        return prepare_series(operator, dt, compiled=compiled)
    return METHODS[method](operator, dt)


@dataclass(frozen=True, eq=False)
class Carrier:
    """A step of grids of one shape. may_compile: whether kernels may run it; else torch does."""

    stepper: Stepper
    shape: Shape
    may_compile: bool = True

    @cached_property
    def linear(self) -> Kernel | None:
        """The step by kernels without what sources and boundaries add, or None."""
        return None if self.compiled is None else self.compiled.linear()

    @cached_property
    def compiled(self) -> Kernel | None:
        """The step by kernels, or None where there is none."""
        if self.may_compile and isinstance(self.stepper, Exponential):
            return compiled_exponential(self.stepper, self.shape)
        if self.may_compile and isinstance(self.stepper, Series):
            return compiled_series(self.stepper, self.shape)
        return None


def carry(grid: Grid, carriers: Sequence[Carrier], values: Tensor) -> Tensor:
    """Values (voxels,) of all colonies one step later. carriers: one for each of `grid.batches`."""
    kernels = [carrier.compiled for carrier in carriers]
    if None not in kernels and may_run_forward(values):
        value, moved = both(values)
        # the tangent of an affine step is its linear part
        linear = [carrier.linear for carrier in carriers]
        if moved is not None and None not in linear:
            return with_tangent(_run(grid, kernels, value), _run(grid, linear, moved))
    if None not in kernels and may_run(values):
        return _run(grid, kernels, values)
    if None not in kernels and not has_tangent(values):
        adjoints = [kernel.adjoint for kernel in kernels if kernel is not None]
        if None not in adjoints:
            return _Carried.apply(values, grid, kernels, adjoints)
    pairs = zip(carriers, grid.batches, strict=True)
    return grid.join([carrier.stepper.step(batch.of(values)) for carrier, batch in pairs])


class _Carried(torch.autograd.Function):
    """A step by kernels, with the gradient by what it began with: that of an affine step is a step
    of the transposed operator."""

    @staticmethod
    def forward(ctx, values: Tensor, grid: Grid, kernels, adjoints) -> Tensor:
        ctx.given = grid, kernels, adjoints
        return _run(grid, kernels, values)

    @staticmethod
    def backward(ctx, back: Tensor):
        grid, kernels, adjoints = ctx.given
        if not torch.is_grad_enabled():
            value, moved = both(back)
            turned = None if moved is None else _run(grid, adjoints, moved)
            return with_tangent(_run(grid, adjoints, value), turned), None, None, None
        linear = [kernel.linear() for kernel in kernels]
        if None in linear:
            refuse_second("a solve of transport")
        return _Carried.apply(back, grid, adjoints, linear), None, None, None


def _run(grid: Grid, kernels: Sequence[Kernel | None], values: Tensor) -> Tensor:
    """Values (voxels,) of all colonies after the kernel of each of `grid.batches`."""
    out = torch.empty_like(values)
    with subnormals.as_zero():
        for kernel, batch in zip(kernels, grid.batches, strict=True):
            assert kernel is not None
            kernel.step(values, batch.starts.numpy(), out)
    return out

"""Transport by compiled kernels, on the CPU where no gradient by its coefficients is wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.compiled import may_run
from torchfilm.signals.grid import Shape
from torchfilm.signals.mixing import mixing_arrays, packed
from torchfilm.signals.transport_exponential import Exponential
from torchfilm.signals.transport_iterative import MAX_ITERATIONS, ROUNDING, TOLERANCE
from torchfilm.signals.transport_series import Series
from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.threads import Shared


@dataclass(frozen=True, eq=False)
class CompiledExponential:
    """`Exponential` for one shape of grid, in arrays as `kernels.transport.carry` takes them."""

    stepper: Exponential
    shape: Shape
    axes: np.ndarray
    factors: tuple[np.ndarray, ...]
    firsts: tuple[np.ndarray, ...]
    lasts: tuple[np.ndarray, ...]
    gained: np.ndarray

    @cached_property
    def _shared(self) -> Shared:
        return Shared()

    def linear(self) -> CompiledExponential:
        """The step without what sources and boundaries add."""
        return replace(self, gained=np.empty((0, 0), self.gained.dtype))

    @cached_property
    def adjoint(self) -> CompiledExponential | None:
        """What takes gradients of the step's result to those of what it began with."""
        turned = tuple(None if x is None else x.transpose(1, 2) for x in self.stepper.factors)
        return compiled_exponential(Exponential(turned, None), self.shape)

    def step(self, values: Tensor, starts: np.ndarray, out: Tensor) -> None:
        """Put the grids that begin at `starts` of values (voxels,) into out, one step later."""
        from torchfilm.kernels.transport import carry

        source, target = as_array(values, values.dtype), out.numpy()
        self._shared(
            starts.size,
            lambda begin, end: carry(
                begin, end, starts, self.shape, self.axes, self.factors, self.firsts, self.lasts,
                self.gained, source, target,
            ),
        )  # fmt: skip


def compiled_exponential(stepper: Exponential, shape: Shape) -> CompiledExponential | None:
    """The same step compiled, or None where kernels may not run it."""
    given = [x for x in (*stepper.factors, stepper.gained) if x is not None]
    if not may_run(*given):
        return None
    last = max((k for k in range(3) if shape[k] > 1), default=0)
    dtype = given[0].dtype
    factors, firsts, lasts = [], [], []
    for k, factor in enumerate(stepper.factors):
        whole = torch.empty(0, 0, 0, dtype=dtype) if factor is None else factor.detach()
        whole = whole[:, : shape[k], : shape[k]]
        there = whole.transpose(1, 2) > 0
        number = torch.arange(1, there.shape[2] + 1)
        # from the first voxel that gives anything to a voxel, to the last
        ends = torch.where(there, number, 0).amax(2) if there.numel() else number.reshape(0, 0)
        begins = torch.where(there, number, shape[k] + 1)
        begins = begins.amin(2) - 1 if there.numel() else ends
        firsts.append(torch.minimum(begins, ends).numpy())
        lasts.append(ends.numpy())
        factors.append(as_array(whole if k == last else whole.transpose(1, 2), dtype))
    axes = np.array([k for k, f in enumerate(stepper.factors) if f is not None], np.int64)
    gained = torch.empty(0, 0, dtype=dtype) if stepper.gained is None else stepper.gained
    return CompiledExponential(
        stepper, shape, axes, tuple(factors), tuple(firsts), tuple(lasts),
        as_array(gained.flatten(1), dtype),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class CompiledSeries:
    """`Series` for one shape of grid, in arrays as `kernels.transport.mix` takes them; and of the
    colonies that take a solve instead, as `kernels.transport_solve.solve` takes them, or None.
    symmetric: whether there is no flow."""

    stepper: Series
    shape: Shape
    arrays: tuple[np.ndarray, ...]
    solve: tuple[np.ndarray, ...] | None
    symmetric: bool

    @cached_property
    def _mixed(self) -> Shared:
        return Shared()

    @cached_property
    def _solved(self) -> Shared:
        return Shared()

    def linear(self) -> CompiledSeries | None:
        """The step without what sources and boundaries add; None where another method takes the
        long steps."""
        if self.stepper.far is not None:
            return None
        *mixing, gained = self.arrays
        return replace(self, arrays=(*mixing, np.empty((0, gained.shape[1]), gained.dtype)))

    @cached_property
    def adjoint(self) -> CompiledSeriesAdjoint | None:
        """What takes gradients of the step's result to those of what it began with."""
        own = self.stepper
        near = replace(own, mixing=own.mixing.transposed(), gained=None, far=None, solved=None)
        carried = compiled_series(near, self.shape)
        return None if carried is None else CompiledSeriesAdjoint(own, carried)

    def step(self, values: Tensor, starts: np.ndarray, out: Tensor) -> None:
        """Put the grids that begin at `starts` of values (voxels,) into out, one step later."""
        from torchfilm.kernels.transport import mix

        source, target = as_array(values, values.dtype), out.numpy()
        self._mixed(
            starts.size, lambda begin, end: mix(begin, end, starts, *self.arrays, source, target)
        )
        if self.solve is not None:
            from torchfilm.kernels.transport_solve import solve

            numbers = TOLERANCE, ROUNDING, self.symmetric, MAX_ITERATIONS
            given = (*self.arrays[:7], *self.solve, *numbers)
            self._solved(
                starts.size, lambda begin, end: solve(begin, end, starts, *given, source, target)
            )


@dataclass(frozen=True, eq=False)
class CompiledSeriesAdjoint:
    """The transpose of a step's linear part. carried: of the colonies that take the series."""

    stepper: Series
    carried: CompiledSeries

    def linear(self) -> CompiledSeriesAdjoint:
        return self

    def step(self, values: Tensor, starts: np.ndarray, out: Tensor) -> None:
        """As `CompiledSeries.step`."""
        self.carried.step(values, starts, out)
        far, solved = self.stepper.far, self.stepper.solved
        if far is None or solved is None:
            return
        there = far.expand(starts.size)
        size = self.carried.arrays[1].shape[1]
        rows = torch.from_numpy(starts).unsqueeze(1) + torch.arange(size)
        back = torch.where(there.unsqueeze(1), values[rows].double(), 0.0)
        found = solved.pulled(back.view(-1, *self.carried.shape)).flatten(1)
        out[rows[there]] = found[there].to(out.dtype)


def compiled_series(stepper: Series, shape: Shape) -> CompiledSeries | None:
    """The same step compiled, or None where kernels may not run it."""
    given = stepper.mixing.numbers + ([] if stepper.gained is None else [stepper.gained])
    if not may_run(*given):
        return None
    count = max(stepper.weights.shape[1], *(x.shape[0] for x in given))
    terms = torch.as_tensor(stepper.terms).expand(count)
    if stepper.far is not None:
        terms = torch.where(stepper.far, 0, terms)
    gained = _no_gain(shape) if stepper.gained is None else stepper.gained.detach().flatten(1)
    weights = stepper.weights.t().expand(count, -1)
    arrays = (*mixing_arrays(stepper.mixing, shape, count), *packed(weights, terms, gained))
    solve, symmetric = None, True
    if stepper.far is not None and stepper.solved is not None:
        one, operator = stepper.solved, stepper.solved.operator
        symmetric = operator.symmetric
        many = torch.where(stepper.far, stepper.exchanges, 0.0).expand(count)
        more = _no_gain(shape)
        if operator.gain is not None:
            more = (one.dt * operator.gain.detach()).expand(-1, *shape).flatten(1)
        solve = packed(many, more)
    return CompiledSeries(stepper, shape, arrays, solve, symmetric)


def _no_gain(shape: Shape) -> Tensor:
    return torch.zeros(0, shape[0] * shape[1] * shape[2], dtype=torch.float64)

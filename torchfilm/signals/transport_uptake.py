"""Transport of a signal over a step in which cells take it up, as one linear equation.

Each voxel loses to cells at a rate of its own, besides what the operator says:

    du_i/dt = (T u)_i + q_i − loss_i u_i

The step gives u at its end, and the mean of u over its time: what cells take is loss × mean × Δt to
rounding, so nothing is lost between the two. With λ at least the greatest loss rate of a voxel the
series of `transport_series` is exact: x_0 = u, x_(k+1) = P x_k + q/λ, and

    u(Δt) = Σ_k Pr(k events) x_k,     mean = Σ_k Pr(more than k events) x_k / λΔt

for events that come at rate λ. Where a step has more than EVENTS of them, it is one of backward
Euler, and the mean is that at its end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchfilm.signals.compiled_uptake import EVENTS, CompiledUptake, compiled_uptake
from torchfilm.signals.grid import Shape
from torchfilm.signals.mixing import mixing_of, rate_above
from torchfilm.signals.series_sums import sums
from torchfilm.signals.transport_iterative import Unsplit, prepare_backward_euler
from torchfilm.signals.transport_operator import Operator
from torchfilm.signals.transport_series import CUT, poisson
from torchfilm.tools.tangents import both


@dataclass(frozen=True, eq=False)
class UptakeTransport:
    """Transport of a signal that cells take up, on grids of one shape. may_compile: whether kernels
    may run it; else torch does."""

    operator: Operator
    shape: Shape
    may_compile: bool = True

    @cached_property
    def compiled(self) -> CompiledUptake | None:
        """What kernels take, or None where they may not run it."""
        return compiled_uptake(self.operator, self.shape) if self.may_compile else None

    def numbers(self) -> list[Tensor]:
        """What it depends on."""
        own, axes = self.operator, self.operator.axes
        given = [x for x in (own.decay, own.source, own.gain) if x is not None]
        return given + [x for axis in axes for x in (axis.up, axis.down)]

    def step(
        self, u: Tensor, loss: Tensor, dt: float, far: Tensor | None = None,
        given: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """u (b, nx, ny, nz) after dt hours, its mean over them, both float64, and `far`. loss: (b,
        nx, ny, nz) float64, 1/h. given: what cells give, conc/h, of the same shape.

        far: (b,) bool, colonies that take backward Euler though they could take the series. NaN
        where a solve did not converge.
        """
        operator = replace(self.operator, decay=self.operator.decay + loss)
        if given is not None:
            source = operator.source
            operator = replace(operator, source=given if source is None else source + given)
        u = u.double()
        fastest = both(operator.loss.detach())[0].flatten(1).amax(1)
        rate = rate_above(fastest).expand(u.shape[0])
        over = rate * dt > EVENTS
        far = over if far is None else far | over
        if bool(far.all()):
            return *self._euler(operator, dt).step_and_mean(u), far
        rate = torch.where(far, torch.inf, rate)
        end, mean = _series(operator, rate, dt, u, compiled=self.may_compile)
        if bool(far.any()):
            solved, by = self._euler(operator, dt).step_and_mean(u)
            there = far.reshape(-1, 1, 1, 1)
            end, mean = torch.where(there, solved, end), torch.where(there, by, mean)
        return end, mean, far

    def _euler(self, operator: Operator, dt: float) -> Unsplit:
        return prepare_backward_euler(operator, dt, compiled=self.may_compile)


def _series(
    operator: Operator, rate: Tensor, dt: float, u: Tensor, *, compiled: bool
) -> tuple[Tensor, Tensor]:
    """u at the end of dt hours, and its mean. rate: λ, (b,); where it is infinite u stays."""
    size, events = (-1, 1, 1, 1), torch.where(torch.isinf(rate), 0.0, rate * dt)
    cut = torch.finfo(operator.dtype).eps * CUT
    both_weights = (torch.as_tensor(x, device=u.device) for x in poisson(events.cpu().numpy(), cut))
    weights, tails = both_weights
    mixing = mixing_of(operator, rate.reshape(size))
    gain = None if operator.gain is None else operator.gain / rate.reshape(size)
    end, total = sums(mixing, gain, (weights, tails), u, compiled=compiled)
    return end, total / torch.where(events > 0, events, 1.0).reshape(size)

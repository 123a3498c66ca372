"""Transport over a step by repeated application of the operator: one solve of all axes at once, and
explicit Euler.

Backward Euler takes the steps that are too long for the series. It is first order, L-stable and
positive, and a steady state is at rest under it at any step. Crank–Nicolson and explicit Euler are
for comparison. Crank–Nicolson, the paper's method, is second order, but its factor for the shortest
waves tends to −1: on sharp data it oscillates for many steps and goes below zero. Explicit Euler is
first order and positive, with as many sub-steps as that requires.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from torchfilm.signals.compiled_systems import Systems, may_solve
from torchfilm.signals.transport_operator import Operator, apply
from torchfilm.tools.ragged import Groups
from torchfilm.tools.segments import keep, kept
from torchfilm.tools.tangents import both, in_forward_mode, refuse_both, refuse_second, with_tangent
from torchfilm.tools.threads import one_torch_thread

Map = Callable[[Tensor], Tensor]
# The residual allowed, relative to the norm of the right-hand side; and for each exchange of a
# voxel in a step, relative to that of the solution, since these are rounded.
TOLERANCE = 1e-10
ROUNDING = 1e-15
SMALL, LARGER = 1e-100, 2.0**600  # as in `kernels.transport_solve`
MAX_ITERATIONS = 2000


@dataclass(frozen=True, eq=False)
class Euler:
    """u ↦ (I + δT)^m u, in m equal sub-steps δ = Δt/m.

    For each colony m is the least number with δ × the greatest loss rate at most 1. substeps: m, (B
    or 1,) int64. Then every entry of I + δT is ≥ 0 and no amount can grow.
    """

    operator: Operator
    dt: float
    substeps: Tensor

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later."""
        part = self.dt / self.substeps.double()
        for k in range(int(self.substeps.max())):
            now = torch.where(self.substeps > k, part, 0.0).to(u.dtype).reshape(-1, 1, 1, 1)
            u = torch.addcmul(u, now, apply(self.operator, u))
        return u


def prepare_euler(operator: Operator, dt: float) -> Euler:
    """The sub-steps of a step of `dt` hours."""
    worst = operator.loss.detach().flatten(1).amax(1)
    return Euler(operator, dt, torch.ceil(dt * worst).clamp(min=1.0).to(torch.int64))


@dataclass(frozen=True, eq=False)
class Unsplit:
    """u ↦ (I − θΔt T)⁻¹ [(I + (1 − θ)Δt T) u + Δt gain], each colony converged by itself.

    θ: 1 for backward Euler, 1/2 for Crank–Nicolson. The solve uses conjugate gradients, or BiCGStab
    where there is flow, scaled by the diagonal: cells may take from a few voxels a million times
    what is there. compiled: whether kernels may solve.
    """

    operator: Operator
    dt: float
    theta: float
    compiled: bool = False

    @cached_property
    def _systems(self) -> dict[bool, Systems]:
        return {}

    def _solved(
        self, apply: Map, b: Tensor, start: Tensor, *, transposed: bool = False,
        weight: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """The solution of A x = b, or of Aᵀ x = b, which `apply` makes of x, and whether that of
        each colony converged, (B,). Without derivatives."""
        if self.by_kernels:
            return self._by_kernels(b, start, transposed, weight)
        given = self.operator.symmetric, self.rounding, self.inverse, weight
        return krylov(apply, b, start, *given)

    def _by_kernels(
        self, b: Tensor, start: Tensor, transposed: bool, weight: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        if transposed not in self._systems:
            part = self.theta * self.dt
            self._systems[transposed] = Systems.of(self.operator, part, transposed)
        limits = TOLERANCE, ROUNDING, MAX_ITERATIONS
        return self._systems[transposed].solved(b, start, weight, limits)

    def pulled(self, back: Tensor) -> Tensor:
        """A⁻ᵀ back by kernels, (B, nx, ny, nz) float64: the gradient by what a step of backward
        Euler began with. NaN where a solve did not converge."""
        found, good = self._by_kernels(back, torch.zeros_like(back), True, self.inverse)
        return torch.where(good.reshape(-1, 1, 1, 1), found, torch.nan)

    @property
    def by_kernels(self) -> bool:
        return self.compiled and may_solve(self.operator)

    @cached_property
    def inverse(self) -> Tensor:
        """Of the diagonal of I − θΔt T, (B or 1, nx, ny, nz)."""
        return 1 / (1 + self.theta * self.dt * both(self.operator.loss.detach())[0].double())

    @cached_property
    def rounding(self) -> Tensor:
        """Of the residual, relative to the solution, (B or 1, nx, ny, nz)."""
        return ROUNDING / self.inverse

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later; NaN in a colony whose solve did not converge."""
        return self.step_and_mean(u)[0]

    def step_and_mean(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """As `step`; and the field by whose exchange u has changed, to rounding."""
        out, residual, converged = self._solve(u)
        # the exact solution of backward Euler has nothing below 0
        mean = out - residual
        out = out.clamp(min=0.0) if self.theta == 1 else out
        good = converged.reshape(-1, 1, 1, 1)
        out, mean = torch.where(good, out, torch.nan), torch.where(good, mean, torch.nan)
        return out.to(u.dtype), mean.to(u.dtype)

    def _solve(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The solution and what its last correction was, float64, and which colonies converged."""
        wide = u.double()
        linear = lambda x: apply(self.operator, x, gain=False)
        left = lambda x: x - self.theta * self.dt * linear(x)
        right = wide if self.theta == 1 else wide + (1 - self.theta) * self.dt * linear(wide)
        if self.operator.gain is not None:
            right = right + self.dt * self.operator.gain
        if in_forward_mode() and torch.is_grad_enabled():
            refuse_both("a solve of transport", right, left(wide))
        with torch.no_grad():
            bare = lambda x: both(x)[0]
            still = lambda x: bare(left(x))
            x, converged = self._solved(still, bare(right), bare(wide))
            x = x.clamp(min=0.0) if self.theta == 1 else x
            # the change is then what T makes of x, which conserves amount to rounding
            residual = bare(right) - still(x)
            if self.theta == 1:  # where less is left than the residual, leave none
                low = x + residual < 0
                x = torch.where(low, (x + residual * self.inverse).clamp(min=0.0), x)
                residual = bare(right) - still(x)
            # its derivatives are those at x: where next to nothing is left, the correction is as
            # large
            at, x = x, x + residual
            moved = both(right - left(at))[1]
            if moved is not None:  # x' = A⁻¹ (b' − A' x)
                turned, _ = self._solved(still, moved, torch.zeros_like(x))
                return with_tangent(x, turned), residual, converged
        if torch.is_grad_enabled():
            remainder = right - left(at)
            if remainder.requires_grad:
                x = _KrylovAdjoint.apply(remainder, x, left, self)
        return x, residual, converged


class _KrylovAdjoint(torch.autograd.Function):
    """The solution x of A x = b, with the derivative of the equation: dx = A⁻¹ d(b − A x).

    Its input is the remainder b − A x ≈ 0.
    """

    @staticmethod
    def forward(ctx, remainder: Tensor, x: Tensor, left: Map, of: Unsplit) -> Tensor:
        keep(ctx, (left, of))
        return x.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second("a solve of transport", grad)
        (forward, of), _ = kept(ctx)
        left, symmetric = forward, of.operator.symmetric
        if not symmetric and not of.by_kernels:
            with torch.enable_grad():
                at = torch.zeros_like(grad, requires_grad=True)
                value = forward(at)

            def left(x: Tensor) -> Tensor:
                return torch.autograd.grad(value, at, x, retain_graph=True)[0]

        with torch.no_grad(), one_torch_thread():
            first = torch.zeros_like(grad)
            # where next to nothing is left, losses may depend on it a million times as strongly:
            # the residual there is not one of other voxels
            found, converged = of._solved(
                left, grad, first, transposed=not symmetric, weight=of.inverse
            )
        return (torch.where(converged.reshape(-1, 1, 1, 1), found, torch.nan), None, None, None)


def prepare_crank_nicolson(operator: Operator, dt: float) -> Unsplit:
    """A step of `dt` hours."""
    return Unsplit(operator, dt, 0.5)


def prepare_backward_euler(operator: Operator, dt: float, *, compiled: bool = False) -> Unsplit:
    """A step of `dt` hours. compiled: whether kernels may solve."""
    return Unsplit(operator, dt, 1.0, compiled)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """(B, …), (B, …) -> (B, 1, 1, 1)."""
    product = (a * b).reshape(-1, 1)
    # not .sum(1): with several threads its division of long rows depends on their number
    return _rows(a.shape[0], a[0].numel(), str(a.device)).sum(product).reshape(-1, 1, 1, 1)


@lru_cache(maxsize=8)
def _rows(count: int, size: int, device: str) -> Groups:
    """`count` groups of `size` rows each."""
    return Groups(torch.arange(count, device=device).repeat_interleave(size), count, ordered=True)


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(b == 0, 0.0, a / torch.where(b == 0, 1.0, b))


def krylov(
    apply: Map, b: Tensor, start: Tensor, symmetric: bool, rounding: Tensor, inverse: Tensor,
    weight: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The solution of A x = b, (B, nx, ny, nz), in float64, and which converged, (B,) bool: one
    system per colony, each until it does.

    The residual is at most TOLERANCE of b, or its `rounding`, of the shape of b or of one, of x.
    inverse: of the diagonal of A. weight: of each voxel in these norms; by default 1. No gradient.
    """
    most = torch.maximum(b.abs(), start.abs()).amax((1, 2, 3), keepdim=True)
    up = torch.ones_like(most).masked_fill((most > 0) & (most < SMALL), LARGER)
    b, start = b * up, start * up
    norm = lambda x: _dot(x, x) if weight is None else _dot(weight * x, weight * x)
    size = norm(b)
    x = start.clone()
    # restarts from the true residual correct the rounding errors of the recurred one
    for _ in range(3):
        r = b - apply(x)
        target = torch.maximum(TOLERANCE**2 * size, norm(rounding * x))
        going = norm(r) > target
        if not bool(going.any()):
            break
        method = _conjugate_gradients if symmetric else _bicgstab
        x = method(apply, x, r, inverse, going, norm, target)
    r = b - apply(x)
    target = torch.maximum(TOLERANCE**2 * size, norm(rounding * x))
    # a right-hand side of zero has the solution zero; a NaN never converges
    return x / up, (norm(r) <= 100 * target).reshape(-1)


def _conjugate_gradients(
    apply: Map, x: Tensor, r: Tensor, inverse: Tensor, going: Tensor, norm: Map, target: Tensor
) -> Tensor:
    """The solution, from x and its residual r."""
    p = inverse * r
    rz = _dot(p, r)
    for _ in range(MAX_ITERATIONS):
        q = apply(p)
        alpha = torch.where(going, _ratio(rz, _dot(p, q)), 0.0)
        x, r = torch.addcmul(x, alpha, p), torch.addcmul(r, alpha, q, value=-1.0)
        going = going & (norm(r) > target)
        if not bool(going.any()):
            break
        z = inverse * r
        new = _dot(z, r)
        p, rz = torch.addcmul(z, torch.where(going, _ratio(new, rz), 0.0), p), new
    return x


def _bicgstab(
    apply: Map, x: Tensor, r: Tensor, inverse: Tensor, going: Tensor, norm: Map, target: Tensor
) -> Tensor:
    """The same by van der Vorst's stabilised bi-conjugate gradients."""
    shadow, p, rho = r, r, _dot(r, r)
    for _ in range(MAX_ITERATIONS):
        scaled = inverse * p
        v = apply(scaled)
        alpha = torch.where(going, _ratio(rho, _dot(shadow, v)), 0.0)
        x, s = torch.addcmul(x, alpha, scaled), torch.addcmul(r, alpha, v, value=-1.0)
        scaled = inverse * s
        t = apply(scaled)
        omega = torch.where(going, _ratio(_dot(t, s), _dot(t, t)), 0.0)
        x = torch.addcmul(x, omega, scaled)
        r = torch.where(going, torch.addcmul(s, omega, t, value=-1.0), r)
        going = going & (norm(r) > target)
        if not bool(going.any()):
            break
        new = _dot(shadow, r)
        beta = torch.where(going, _ratio(new, rho) * _ratio(alpha, omega), 0.0)
        p, rho = torch.addcmul(r, beta, torch.addcmul(p, omega, v, value=-1.0)), new
        # a breakdown of the method: this colony restarts from its true residual
        going = going & (alpha != 0) & (omega != 0) & (new != 0)
    return x

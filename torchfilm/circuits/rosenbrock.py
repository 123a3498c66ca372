"""Stiff circuits: a Rosenbrock method that steps every cell by itself, with its own step and error
control.

Rodas3 (Sandu et al., Atmos. Environ. 31, 3459, 1997): order 3 with an embedded result of order 2,
L-stable, stiffly accurate, γ = ½. With W = 2/h − J a step from u is

    W k₁ = f(u)                            y₃ = u + 2 k₁
    W k₂ = f(u) + 4 k₁/h
    W k₃ = f(y₃) + (k₁ − k₂)/h             y₄ = y₃ + k₃
    W k₄ = f(y₄) + (k₁ − k₂ − 8/3 k₃)/h    u' = y₄ + k₄,  error ≈ k₄

Every k lies in the range of f, so what f conserves (w · f = 0) is conserved. All of this is done in
float64, whatever the cells' own dtype: where a rate of 1e8/h balances another, 2/h would be lost in
a float32 W and the conserved sum with it, or rounding of rates be magnified by it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from torchfilm.circuits import linear

# du/dt (M, S), conc/h, of the cells `rows` (M,) at concentrations u (M, S); row i of the result
# depends on row i of u only
Rates = Callable[[Tensor, Tensor], Tensor]

DONE, TOO_MANY_STEPS, NOT_FINITE, BELOW_ZERO = 0, 1, 2, 3
STATUS = {
    DONE: "done",
    TOO_MANY_STEPS: "too many steps",
    NOT_FINITE: "a rate is not a finite number",
    BELOW_ZERO: "the rates push a concentration below zero",
}
SAFETY, SHRINK, GROW = 0.9, 0.1, 5.0
LEAST_STEP = 1e-20  # of the whole; a cell that asks for less has failed
# steps with a result that is no number, after which a cell that comes upon them again and again is
# given up
MOST_SICK = 60


@dataclass(frozen=True)
class RosenbrockReport:
    """For each cell, (N,) int64: steps `accepted` and `rejected`, and `status`, one of STATUS; a
    failed cell keeps its last good concentrations."""

    accepted: Tensor
    rejected: Tensor
    status: Tensor


def rosenbrock(
    rates: Rates,
    u: Tensor,
    dt: float,
    *,
    rtol: float = 1e-4,
    atol: float | Tensor = 1e-9,
    max_steps: int = 10_000,
    first_step: float | None = None,
    nonnegative: bool = True,
) -> tuple[Tensor, RosenbrockReport]:
    """Concentrations (N, S) after dt hours: each cell in steps whose error is at most atol + rtol
    |u| in every species.

    rates: plain torch, du/dt (M, S) of the cells `rows` (M,) at float64 concentrations, without a
    time of its own; differentiable in u. atol: in the unit of u, a number or (S,). rtol below four
    units in the last place of u's dtype counts as that. first_step: h, default all of dt at once.
    nonnegative: what starts at or above 0 stays there: the rates are continued linearly below 0,
    and a step that ends there is drawn towards two steps of backward Euler. Gradients of u and of
    whatever `rates` holds pass through the accepted steps, with the steps' sizes held fixed. Raises
    nothing.
    """
    cells, species = u.shape
    start = u.t().to(torch.float64)
    whole = torch.full((cells,), float(dt), dtype=torch.float64, device=u.device)
    if cells == 0 or species == 0 or dt == 0:
        none = torch.zeros(cells, dtype=torch.int64, device=u.device)
        return u.clone(), RosenbrockReport(none, none, none)
    scale = torch.as_tensor(atol, dtype=torch.float64, device=u.device).reshape(-1, 1)
    one = torch.zeros(1, dtype=torch.int64, device=u.device)
    tracked = torch.is_grad_enabled() and (
        u.requires_grad or rates(u.index_select(0, one), one).requires_grad
    )
    method = _Tableau(
        rates, u.dtype, max(rtol, 4 * torch.finfo(u.dtype).eps), scale, nonnegative, tracked
    )
    first = whole if first_step is None else whole.clamp(max=first_step)
    at, report = _advance(method, start, whole, first, max_steps)
    return at.t().to(u.dtype), report


@cache
def _prepare_forward_mode() -> None:
    """Torch compiles its forward derivatives on their first use, by a function that it calls
    deprecated itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        with forward_ad.dual_level():
            forward_ad.make_dual(torch.ones(1), torch.ones(1)).exp()


class _Tableau:
    """One step of the method for some cells; arrays are (S, M) in float64, species first. tracked:
    whether a gradient is wanted."""

    def __init__(
        self,
        rates: Rates,
        dtype: torch.dtype,
        rtol: float,
        atol: Tensor,
        nonnegative: bool,
        tracked: bool,
    ):
        self.rates, self.dtype, self.rtol, self.atol, self.nonnegative, self.tracked = (
            rates,
            dtype,
            rtol,
            atol,
            nonnegative,
            tracked,
        )

    def evaluate(self, u: Tensor, rows: Tensor) -> Tensor:
        return self.rates(u.t(), rows).t().to(torch.float64)

    def linearise(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """f (S, M) and J (S, S, M), J[i, k] = ∂fᵢ/∂uₖ, in one call on S copies of the cells."""
        f, jacobian = self._forward(u, rows) if self.tracked else self._backward(u, rows)
        if not bool(torch.isfinite(jacobian.sum())):
            # the slope of a root at 0 is infinite; any finite one will do, only the error grows,
            # and that is watched
            jacobian = torch.nan_to_num(jacobian, 0.0, 0.0, 0.0)
        return f, jacobian

    def _backward(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """By a backward pass: of the i-th copy only the rate of species i is asked."""
        size, count = u.shape
        with torch.enable_grad():
            copies = u.repeat(1, size).requires_grad_()
            out = self.rates(copies.t(), rows.repeat(size))
            f = out.detach()[:count].t().to(torch.float64)
            slope = None
            if out.requires_grad:
                own = torch.diagonal(out.view(size, count, size), dim1=0, dim2=2)
                (slope,) = torch.autograd.grad(own.sum(), copies, allow_unused=True)
        if slope is None:
            return f, u.new_zeros(size, size, count)
        return f, slope.view(size, size, count).transpose(0, 1).to(torch.float64)

    def _forward(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """By forward derivatives, of the k-th copy along species k. Where a gradient is wanted: a
        backward pass within one that is checkpointed would have every step taken again from the
        start. Elsewhere it is the slower way: products with constants are worked out in Python.
        """
        _prepare_forward_mode()
        size, count = u.shape
        copies = u.repeat(1, size)
        directions = (
            torch.eye(size, dtype=u.dtype, device=u.device)
            .unsqueeze(2)
            .expand(size, size, count)
            .reshape(size, size * count)
        )
        with forward_ad.dual_level():
            out = self.rates(forward_ad.make_dual(copies.t(), directions.t()), rows.repeat(size))
            value, slope = forward_ad.unpack_dual(out)
        f = value[:count].t().to(torch.float64)
        if slope is None:
            return f, u.new_zeros(size, size, count)
        return f, slope.t().to(torch.float64).reshape(size, size, count)

    def step(self, u: Tensor, rows: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The concentrations after h (M,), their error (M,) in units of what is allowed (NaN where
        there is no result), and whether (M,) a species went below zero by more than may be mended.
        """
        f, jacobian = self.linearise(u, rows)
        per_h = 1.0 / h
        matrix = -jacobian
        torch.diagonal(matrix, dim1=0, dim2=1).add_((2.0 * per_h).unsqueeze(1))
        with torch.no_grad():
            lu, sound = linear.factor(
                matrix, 2.0 * per_h + torch.diagonal(jacobian, dim1=0, dim2=1).t().abs()
            )
        low = u.detach().clamp(max=0.0)

        def rate(y: Tensor) -> Tensor:
            if not self.nonnegative or not bool((y < low).any()):
                return self.evaluate(y, rows)
            inside = torch.maximum(y, low)
            return self.evaluate(inside, rows) + linear.multiply(jacobian, y - inside)

        k1 = linear.solve(matrix, lu, f)
        k2 = linear.solve(matrix, lu, f + 4.0 * per_h * k1)
        y = u + 2.0 * k1
        k3 = linear.solve(matrix, lu, rate(y) + per_h * (k1 - k2))
        y = y + k3
        k4 = linear.solve(matrix, lu, rate(y) + per_h * (k1 - k2 - (8.0 / 3.0) * k3))
        new = y + k4
        with torch.no_grad():
            allowed = self.atol + self.rtol * torch.maximum(u.abs(), new.abs())
            error = (k4.abs() / allowed).amax(0)
            error = torch.where(
                sound & (new.abs().amax(0) < torch.finfo(self.dtype).max), error, torch.nan
            )
        broken = torch.zeros_like(sound)
        if self.nonnegative and bool((new < low).any()):
            noise = (
                8
                * torch.finfo(self.dtype).eps
                * (u.abs() + 2 * k1.abs() + k3.abs() + k4.abs()).detach()
            )
            new, change = self._raise(u, k1, new, noise, allowed, rows, matrix, lu, jacobian)
            broken = change > 1.0
        return new, error, broken

    def _raise(
        self,
        u: Tensor,
        k1: Tensor,
        new: Tensor,
        noise: Tensor,
        allowed: Tensor,
        rows: Tensor,
        matrix: Tensor,
        lu: Tensor,
        jacobian: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Results that no longer lie below zero, and by how much (M,) that changed them, in units
        of what is allowed.

        A result that is negative by more than rounding is drawn towards v, two steps of backward
        Euler over h/2 with the same W, which cannot go below zero in a linear circuit: new = v + θ
        (u' − v) with the greatest θ ≤ 1 that does. It lies in the range of f as well, so nothing is
        lost.
        """
        low = u.detach().clamp(max=0.0)
        new = torch.where((new < low) & (new >= low - noise), low, new)
        at = torch.nonzero((new < low).any(0)).squeeze(1)
        change = torch.zeros_like(new[0])
        if at.numel() == 0:
            return new, change
        pick = lambda x: x.index_select(-1, at)
        low, worse, middle = pick(low), pick(new), pick(u + k1)
        inside = torch.maximum(middle, low)
        f = self.evaluate(inside, rows.index_select(0, at)) + linear.multiply(
            pick(jacobian), middle - inside
        )
        safe = middle + linear.solve(pick(matrix), pick(lu), f)
        safe = torch.where((safe < low) & (safe >= low - pick(noise)), low, safe)
        under = worse < low
        share = torch.where(under, (safe - low) / torch.where(under, safe - worse, 1.0), 1.0).amin(
            0
        )
        mended = torch.maximum(safe + share * (worse - safe), low)
        with torch.no_grad():
            moved = ((mended - worse).abs() / pick(allowed)).amax(0)
            # where Euler's result itself is below zero there is nothing to be drawn to
            moved = torch.where((safe >= low).all(0), moved, torch.inf)
        return new.index_copy(1, at, mended), change.index_copy(0, at, moved)


def _advance(
    method: _Tableau, u: Tensor, left: Tensor, h: Tensor, max_steps: int
) -> tuple[Tensor, RosenbrockReport]:
    """All cells over their time `left` (N,); cells that are done leave the batch."""
    count = left.numel()
    rows = torch.arange(count, device=u.device)
    accepted, rejected = torch.zeros_like(rows), torch.zeros_like(rows)
    status = torch.full_like(rows, TOO_MANY_STEPS)
    out: list[tuple[Tensor, Tensor]] = []
    shortest, sick = LEAST_STEP * left, torch.zeros_like(rows)
    for _ in range(max_steps):
        new, error, broken = method.step(u, rows, h)
        good = (error <= 1.0) & ~broken
        ends = good & (h >= left)
        every = bool(ends.all())
        if every and not out:
            return new, RosenbrockReport(accepted + 1, rejected, torch.full_like(rows, DONE))
        accepted.index_add_(0, rows, good.long())
        rejected.index_add_(0, rows, (~good).long())
        u = new if every else _merge(method, u, new, good, rows, h)
        left = torch.where(good, left - h, left)
        # a cube root by exp and log, whose bits do not depend on the batch
        factor = (SAFETY * torch.exp(torch.log(error) / -3.0)).clamp(SHRINK, GROW)
        factor = torch.where(torch.isfinite(error), factor, 0.25)
        factor = torch.where(broken, factor.clamp(max=0.5), factor)
        h = torch.minimum(h * factor, left)
        # no sliver of a last step
        h = torch.where((left - h) < 1e-10 * left, left, h)
        lost = ~good & (h < shortest)
        if bool(error.isnan().any()):
            sick = sick + error.isnan()
            lost |= sick > MOST_SICK
            lost |= ~torch.isfinite(method.evaluate(u.detach(), rows)).all(0)  # no step would help
        failed = torch.where(
            torch.isfinite(error), torch.where(broken, BELOW_ZERO, TOO_MANY_STEPS), NOT_FINITE
        )
        leave = ends | lost
        status = status.index_copy(
            0, rows, torch.where(ends, DONE, torch.where(lost, failed, TOO_MANY_STEPS))
        )
        if bool(leave.any()):
            gone, stay = torch.nonzero(leave).squeeze(1), torch.nonzero(~leave).squeeze(1)
            out.append((rows.index_select(0, gone), u.index_select(1, gone)))
            rows, u = rows.index_select(0, stay), u.index_select(1, stay)
            left, h, shortest, sick = (x.index_select(0, stay) for x in (left, h, shortest, sick))
        if rows.numel() == 0:
            break
    out.append((rows, u))
    order = torch.argsort(torch.cat([r for r, _ in out]))
    return torch.cat([x for _, x in out], 1).index_select(1, order), RosenbrockReport(
        accepted, rejected, status
    )


def _merge(
    method: _Tableau, u: Tensor, new: Tensor, good: Tensor, rows: Tensor, h: Tensor
) -> Tensor:
    """`new` where the step was good, else u."""
    if not new.requires_grad:
        return torch.where(good, new, u)
    # the graph must not hold a step that was not taken: where that is not finite, a zero gradient
    # comes back from it as NaN
    at = torch.nonzero(good).squeeze(1)
    if at.numel() == 0:
        return u
    taken, _, _ = method.step(
        u.index_select(1, at), rows.index_select(0, at), h.index_select(0, at)
    )
    return u.index_copy(1, at, taken)

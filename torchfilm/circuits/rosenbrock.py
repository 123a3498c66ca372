"""Stiff circuits: a Rosenbrock method with a step and an error control for each cell.

The method is Rodas3 (Sandu et al., Atmos. Environ. 31, 3459, 1997): order 3 with an embedded result
of order 2, L-stable, stiffly accurate, γ = ½. With W = 2/h − J a step from u is

    W k₁ = f(u)                            y₃ = u + 2 k₁
    W k₂ = f(u) + 4 k₁/h
    W k₃ = f(y₃) + (k₁ − k₂)/h             y₄ = y₃ + k₃
    W k₄ = f(y₄) + (k₁ − k₂ − 8/3 k₃)/h    u' = y₄ + k₄,  error ≈ k₄

Every k lies in the range of f, so the method conserves what f conserves (w · f = 0).

All arithmetic is float64, whatever the cells' dtype. Where a rate of 1e8/h balances another, a
float32 W would lose 2/h, and with it the conserved sum, or it would magnify the rounding of rates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from torchfilm.circuits import linear
from torchfilm.tools.checks import InputError
from torchfilm.tools.reads import known_rows_where, numbers, reads_are_free, rows_where
from torchfilm.tools.tangents import (
    both,
    forward_mode,
    in_forward_mode,
    outside_checkpoints,
    with_tangent,
)

# rates(u, rows): du/dt (M, S), conc/h, of the cells `rows` (M,) at concentrations u (M, S). Row i
# of the result depends on row i of u only.
Rates = Callable[[Tensor, Tensor], Tensor]

DONE, TOO_MANY_STEPS, NOT_FINITE, BELOW_ZERO = 0, 1, 2, 3
STATUS = {
    DONE: "done",
    TOO_MANY_STEPS: "too many steps",
    NOT_FINITE: "a rate is not a finite number",
    BELOW_ZERO: "the rates push a concentration below zero",
}
SAFETY, SHRINK, GROW = 0.9, 0.1, 5.0
LEAST_STEP = 1e-20  # as a share of dt; a cell that needs a shorter step has failed
MAX_STEPS = 10_000
# The error of a step that leaps over growth, in units of what is allowed: one in which a real
# eigenvalue of J is above 1/(γh), so that the determinant of 1/(γh) − J is negative. The method
# takes such growth for decay, and may miss that a concentration runs away: u' = 10 u² from 0.7
# reaches infinity after 0.14 h, and passed that with an error that was allowed.
LEAP = 1e3
# A cell fails after this many steps with a non-finite result.
MAX_NONFINITE_STEPS = 60


@dataclass(frozen=True)
class RosenbrockReport:
    """What the method did for each cell; every field is (N,) int64.

    accepted, rejected: numbers of steps. status: one of STATUS. A failed cell keeps its last good
    concentrations.
    """

    accepted: Tensor
    rejected: Tensor
    status: Tensor


def rodas3(
    rates: Rates,
    u: Tensor,
    dt: float,
    *,
    rtol: float = 1e-4,
    atol: float | Tensor = 1e-9,
    max_steps: int = MAX_STEPS,
    first_step: float | None = None,
    nonnegative: bool = True,
    free: int = 0,
    slopes: Rates | None = None,
) -> tuple[Tensor, RosenbrockReport]:
    """Concentrations (N, S) after dt hours, and the report; each cell takes its own steps.

    The error of each step is at most atol + rtol |u| in every species.

    rates: du/dt (M, S) of the cells `rows` (M,) at float64 concentrations. It must be plain torch,
    differentiable in u, and not depend on time. atol: in the unit of u, a number or (S,). rtol:
    values below four units in the last place of u's dtype count as four units. first_step: h;
    default dt. nonnegative: a species that starts at or above 0 stays there. The rates are
    continued linearly below 0, and a step that ends below 0 is moved towards two steps of backward
    Euler. free: so many of the last ones may go below 0 all the same: sums of what passes.

    slopes: ∂ rates/∂u, (S, S, M), at u (S, M), differentiable; by default from derivatives of
    `rates` by torch.

    Gradients with respect to u and the tensors in `rates` pass through the accepted steps, with the
    step sizes held fixed. The function raises nothing; failures are in the report.
    """
    cells, species = u.shape
    start = u.t().to(torch.float64)
    whole = torch.full((cells,), float(dt), dtype=torch.float64, device=u.device)
    if cells == 0 or species == 0 or dt == 0:
        none = torch.zeros(cells, dtype=torch.int64, device=u.device)
        return u.clone(), RosenbrockReport(none, none, none)
    # (a number is filled in there, and not copied from the host)
    given = whole.new_full((), atol) if isinstance(atol, (int, float)) else atol
    scale = torch.as_tensor(given, dtype=torch.float64, device=u.device).reshape(-1, 1)
    one = torch.zeros(1, dtype=torch.int64, device=u.device)
    tracked = torch.is_grad_enabled() and (
        u.requires_grad or rates(u.index_select(0, one), one).requires_grad
    )
    method = _Tableau(
        rates, u.dtype, max(rtol, 4 * torch.finfo(u.dtype).eps), scale,
        species - free if nonnegative else 0, tracked, slopes,
    )  # fmt: skip
    first = whole if first_step is None else whole.clamp(max=first_step)
    at, report = _advance(method, start, whole, first, max_steps)
    return at.t().to(u.dtype), report


class _Tableau:
    """One step of the method for some cells; arrays are (S, M) in float64, species first.

    above: how many species may not go below 0, the first ones. tracked: whether a gradient is
    required.
    """

    def __init__(
        self,
        rates: Rates,
        dtype: torch.dtype,
        rtol: float,
        atol: Tensor,
        above: int,
        tracked: bool,
        slopes: Rates | None,
    ):
        self.rates, self.dtype, self.rtol, self.atol = rates, dtype, rtol, atol
        self.above, self.tracked, self.slopes = above, tracked, slopes
        self.forward = True  # while forward derivatives of the rates are not known to fail

    def _least(self, u: Tensor) -> Tensor:
        """What a step from u (S, M) may lead to, (S, M)."""
        low = u.detach().clamp(max=0.0)
        return (
            low
            if self.above == len(u)
            else low.index_fill(0, torch.arange(self.above, len(u), device=u.device), -torch.inf)
        )

    def evaluate(self, u: Tensor, rows: Tensor) -> Tensor:
        """The rates, (S, M)."""
        return self.rates(u.t(), rows).t().to(torch.float64)

    def linearise(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """f (S, M) and J (S, S, M), J[i, k] = ∂fᵢ/∂uₖ: where its formulas are not known, from one
        call with S copies of the cells."""
        if self.slopes is not None:
            f, jacobian = self.evaluate(u, rows), self.slopes(u, rows)
            return f, torch.nan_to_num(jacobian, 0.0, 0.0, 0.0)
        f, jacobian = self._tracked(u, rows) if self.tracked else self._backward(u, rows)
        # the slope of a root at 0 is infinite; any finite value will do, since only the error
        # grows, and the error is controlled
        return f, torch.nan_to_num(jacobian, 0.0, 0.0, 0.0)

    def _tracked(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Where a gradient is required. Functions without forward derivatives leave J without a
        derivative of its own: what it would add is of the size of the step's error."""
        if self.forward:
            try:
                return self._forward(u, rows)
            except NotImplementedError:
                self.forward = False
        return self._backward(u, rows)

    def _backward(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """By a backward pass; the i-th copy gives the gradient of species i's rate."""
        size, count = u.shape
        with torch.enable_grad(), outside_checkpoints():
            copies = u.repeat(1, size).requires_grad_()
            out = self.rates(copies.t(), rows.repeat(size))
            f = with_tangent(*both(out))[:count].t().to(torch.float64)
            slope = None
            if out.requires_grad:
                own = torch.diagonal(out.view(size, count, size), dim1=0, dim2=2)
                (slope,) = torch.autograd.grad(own.sum(), copies, allow_unused=True)
        if slope is None:
            return f, u.new_zeros(size, size, count)
        return f, slope.view(size, size, count).transpose(0, 1).to(torch.float64)

    def _forward(self, u: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """By forward derivatives; the k-th copy gives the derivative along species k.

        Used where a gradient is required: a backward pass inside a checkpointed one would repeat
        every step from the start. Otherwise it is the slower way, since Python computes products
        with constants.
        """
        if in_forward_mode():  # a gradient that the rates take has begun the segment once more
            raise InputError(
                "the rates of a circuit take a gradient themselves, which rollout cannot do again"
                " by the stiff method: give it segment=None, or the circuit method='heun2'."
            )
        size, count = u.shape
        copies = u.repeat(1, size)
        directions = (
            torch.eye(size, dtype=u.dtype, device=u.device)
            .unsqueeze(2)
            .expand(size, size, count)
            .reshape(size, size * count)
        )
        with forward_mode():
            out = self.rates(with_tangent(copies.t(), directions.t()), rows.repeat(size))
            value, slope = forward_ad.unpack_dual(out)
        f = value[:count].t().to(torch.float64)
        if slope is None:
            return f, u.new_zeros(size, size, count)
        return f, slope.t().to(torch.float64).reshape(size, size, count)

    def step(self, u: Tensor, rows: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of length h (M,).

        Returns the concentrations, their error (M,) in units of the allowed error (NaN where there
        is no result), and whether (M,) a species is too far below zero to be corrected.
        """
        f, jacobian = self.linearise(u, rows)
        per_h = 1.0 / h
        matrix = -jacobian
        torch.diagonal(matrix, dim1=0, dim2=1).add_((2.0 * per_h).unsqueeze(1))
        with torch.no_grad():
            lu, sound, leaps = linear.factor(
                matrix, 2.0 * per_h + torch.diagonal(jacobian, dim1=0, dim2=1).t().abs()
            )
        low = self._least(u)

        def rate(y: Tensor) -> Tensor:
            below = y < low
            if not self.above or (reads_are_free(u.device) and not bool(below.any())):
                return self.evaluate(y, rows)
            inside = torch.where(below, low, y)
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
            error = torch.where(leaps & (error < LEAP), LEAP, error)
            error = torch.where(
                sound & (new.abs().amax(0) < torch.finfo(self.dtype).max), error, torch.nan
            )
        broken = torch.zeros_like(sound)
        if self.above:
            noise = (
                8
                * torch.finfo(self.dtype).eps
                * (u.abs() + 2 * k1.abs() + k3.abs() + k4.abs()).detach()
            )
            new, change = self._enforce_nonnegative(
                u, k1, new, noise, allowed, rows, matrix, lu, jacobian
            )
            broken = change > 1.0
        return new, error, broken

    def _enforce_nonnegative(
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
        """Results that are not below zero, and the change (M,), in units of the allowed error.

        A result that is negative by more than rounding is moved towards v, two steps of backward
        Euler over h/2 with the same W, which cannot go below zero in a linear circuit: new = v + θ
        (u' − v) with the greatest θ ≤ 1 that is not below zero. The result lies in the range of f
        as well, so conserved sums are kept.
        """
        low = self._least(u)
        new = torch.where((new < low) & (new >= low - noise), low, new)
        (at,) = rows_where((new < low).any(0))
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
        corrected = torch.maximum(safe + share * (worse - safe), low)
        with torch.no_grad():
            moved = ((corrected - worse).abs() / pick(allowed)).amax(0)
            # where Euler's result is below zero too, there is no valid point to move to
            moved = torch.where((safe >= low).all(0), moved, torch.inf)
        return new.index_copy(1, at, corrected), change.index_copy(0, at, moved)


def _advance(
    method: _Tableau, u: Tensor, left: Tensor, h: Tensor, max_steps: int
) -> tuple[Tensor, RosenbrockReport]:
    """All cells over their remaining time `left` (N,). Finished cells leave the batch."""
    count = left.numel()
    rows = torch.arange(count, device=u.device)
    accepted, rejected = torch.zeros_like(rows), torch.zeros_like(rows)
    status = torch.full_like(rows, TOO_MANY_STEPS)
    out: list[tuple[Tensor, Tensor]] = []
    shortest, nonfinite = LEAST_STEP * left, torch.zeros_like(rows)
    for _ in range(max_steps):
        new, error, broken = method.step(u, rows, h)
        good = (error <= 1.0) & ~broken
        ends = good & (h >= left)
        start, left = h, torch.where(good, left - h, left)
        # a cube root by exp and log, in steps of 1/1024: so their last bits, which differ from
        # library to library, do not matter
        factor = (SAFETY * torch.exp(torch.log(error) / -3.0)).clamp(SHRINK, GROW)
        factor = torch.floor(factor * 1024.0 + 0.5) / 1024.0
        factor = torch.where(torch.isfinite(error), factor, 0.25)
        factor = torch.where(broken, factor.clamp(max=0.5), factor)
        h = torch.minimum(h * factor, left)
        # no tiny last step
        h = torch.where((left - h) < 1e-10 * left, left, h)
        lost = ~good & (h < shortest)
        ended, some_nan, leaving = numbers(ends.sum(), error.isnan().any(), (ends | lost).sum())
        if ended == rows.numel() and not out:
            return new, RosenbrockReport(accepted + 1, rejected, torch.full_like(rows, DONE))
        accepted.index_add_(0, rows, good.long())
        rejected.index_add_(0, rows, (~good).long())
        u = new if ended == rows.numel() else _merge(method, u, new, good, rows, start)
        if some_nan:
            nonfinite = nonfinite + error.isnan()
            lost |= nonfinite > MAX_NONFINITE_STEPS
            known = torch.isfinite(method.evaluate(u.detach(), rows)).all(0)
            lost |= error.isnan() & ~known  # no step can help
            (leaving,) = numbers((ends | lost).sum())
        failed = torch.where(
            torch.isfinite(error), torch.where(broken, BELOW_ZERO, TOO_MANY_STEPS), NOT_FINITE
        )
        leave = ends | lost
        status = status.index_copy(
            0, rows, torch.where(ends, DONE, torch.where(lost, failed, TOO_MANY_STEPS))
        )
        if leaving:
            gone = known_rows_where(leave, leaving)
            stay = known_rows_where(~leave, rows.numel() - leaving)
            out.append((rows.index_select(0, gone), u.index_select(1, gone)))
            rows, u = rows.index_select(0, stay), u.index_select(1, stay)
            left, h, shortest, nonfinite = (
                x.index_select(0, stay) for x in (left, h, shortest, nonfinite)
            )
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
    """`new` where the step was accepted, else u."""
    if not new.requires_grad:
        return torch.where(good, new, u)
    # the graph must not contain rejected steps: where they are not finite, a zero gradient becomes
    # NaN
    at = torch.nonzero(good).squeeze(1)
    if at.numel() in (0, good.numel()):
        return new if at.numel() else u
    taken, _, _ = method.step(
        u.index_select(1, at), rows.index_select(0, at), h.index_select(0, at)
    )
    return u.index_copy(1, at, taken)

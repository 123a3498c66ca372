"""Fixed points x = F(x) of many groups of numbers, each group by itself, and their derivatives.

Anderson's mixing (1965): the next x is the combination of the last DEPTH + 1 values of F that would
leave the least residual if F were linear. For a contraction it needs a few evaluations where simple
iteration needs tens.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilm.tools.ragged import Groups
from torchfilm.tools.segments import keep, kept
from torchfilm.tools.tangents import (
    both,
    in_forward_mode,
    may_be_checkpoint,
    refuse_both,
    refuse_second,
    with_tangent,
)
from torchfilm.tools.threads import one_torch_thread

DEPTH, WORSE = 3, 4.0
# Of the diagonal, added to it: differences may be parallel.
RIDGE = 1e-12
TINY = 1e-300


class FixedPoint(NamedTuple):
    """x: (N, …). iterations: (B,), evaluations of F. failed: (B,) bool, groups that ended far from
    what was asked for."""

    x: Tensor
    iterations: Tensor
    failed: Tensor


@torch.no_grad()
def fixed_point(
    function: Callable[[Tensor], Tensor],
    start: Tensor,
    scale: Callable[[Tensor, Tensor], Tensor],
    groups: Groups,
    close: float,
    most: int,
    positive: bool = False,
    lost: float | None = None,
    turned: Callable[[], Tensor] | None = None,
) -> FixedPoint:
    """x = function(x), from start (N, …) float64, up to |function(x) − x| ≤ close · scale(x,
    function(x)) for all numbers of a group of rows. most: evaluations. positive: whether no x
    may become 0 or less. lost: a group that ends with more than that in place of `close` has
    failed; by default 100 times `close`. turned: tells, after an evaluation, the groups whose
    function has changed, (B,) bool."""
    x, iteration = start, _Iteration(start, groups, positive)
    going = torch.ones(groups.size, dtype=torch.bool, device=x.device)
    iterations = torch.zeros(groups.size, dtype=torch.int64, device=x.device)
    far, lost = torch.zeros_like(x, dtype=torch.bool), 100 * close if lost is None else lost
    for _ in range(most):
        new = function(x)
        residual, size = new - x, scale(x, new)
        iterations += going
        far = ~(residual.abs() <= lost * size)
        # not a NaN, which stays one
        going = going & groups.any(_any(residual.abs() > close * size))
        if not bool(going.any()):
            break
        if turned is not None:
            iteration.forget(turned())
        ahead = iteration.next(x, new, 1 / size, groups.any(_any(far)))
        x = torch.where(iteration.each(going), ahead, x)
    return FixedPoint(x, iterations, groups.any(_any(far)))


class _Iteration:
    """What an iteration knows of each group. A guess that leaves a residual over √WORSE times the
    least one so far is given up: the group begins again from its best guess, by half the part of
    the way that it last took."""

    def __init__(self, start: Tensor, groups: Groups, positive: bool):
        self.groups, self.positive, size = groups, positive, groups.size
        self.wide = (-1, *(1,) * (start.dim() - 1))
        # changes of x + residual, and of the residual; the last of both
        self.earlier: list[tuple[Tensor, Tensor]] = []
        self.last = start, start
        self.best = start, start  # the best guess, and its value
        of_groups = lambda x: torch.full((size,), x, dtype=start.dtype, device=start.device)
        self.least, self.part = of_groups(torch.inf), of_groups(1.0)
        self.fresh = torch.ones(size, dtype=torch.bool, device=start.device)

    def each(self, of_groups: Tensor) -> Tensor:
        """(B,) for the numbers of each group, (N, 1 …)."""
        return of_groups.index_select(0, self.groups.owner).reshape(self.wide)

    def forget(self, turned: Tensor) -> None:
        """Begin again with these groups, (B,) bool."""
        self.least = torch.where(turned, torch.inf, self.least)
        self.part = torch.where(turned, 1.0, self.part)
        self._begin(turned)

    def _begin(self, which: Tensor) -> None:
        """These groups have no history."""
        self.fresh, none = self.fresh | which, self.each(which)
        kept = lambda x: torch.where(none, 0.0, x)
        self.earlier = [(kept(a), kept(b)) for a, b in self.earlier]

    def next(self, x: Tensor, new: Tensor, weight: Tensor, far: Tensor) -> Tensor:
        """The next guess (N, …), after x gave `new`. weight: 1 over the scale. far: (B,) bool,
        groups that may begin again: near the solution roundings may leave more than the least."""
        residual, groups = new - x, self.groups
        square = (residual * weight) ** 2
        square = square if x.dim() == 1 else sum_in_order(square.flatten(1))
        norm = groups.sum(square)
        worse = far & ~(norm <= WORSE * self.least)
        better = norm < self.least
        self.part = torch.where(worse, 0.5 * self.part, self.part)
        self.part = torch.where(better, (2 * self.part).clamp(max=1.0), self.part)
        self.least = torch.where(better, norm, self.least)
        kept = self.each(better)
        self.best = torch.where(kept, x, self.best[0]), torch.where(kept, new, self.best[1])
        fresh = self.each(self.fresh)
        change = [torch.where(fresh, 0.0, x) for x in (new - self.last[0], residual - self.last[1])]
        self.earlier = [*self.earlier, (change[0], change[1])][-DEPTH:]
        self.last = new, residual
        self.fresh = torch.zeros_like(self.fresh)
        off, less = _mixed(self.earlier, residual, weight, groups)
        part = self.each(self.part)
        ahead = new - off - (1 - part) * (residual - less)
        if self.positive:
            ahead = torch.where(ahead > 0, ahead, new)
        self._begin(worse)
        again = self.best[0] + part * (self.best[1] - self.best[0])
        return torch.where(self.each(worse), again, ahead)


def _any(of_numbers: Tensor) -> Tensor:
    """Whether one of each row's is, (N,)."""
    return of_numbers.flatten(1).any(1) if of_numbers.dim() > 1 else of_numbers


def _mixed(
    earlier: list[tuple[Tensor, Tensor]], residual: Tensor, weight: Tensor, groups: Groups
) -> tuple[Tensor, Tensor]:
    """What the combination of earlier changes takes off the value and the residual, (N, …)."""
    count = len(earlier)
    right = [change[1] * weight for change in earlier]
    columns = [right[i] * right[j] for i in range(count) for j in range(i, count)]
    columns += [x * residual * weight for x in right]
    if residual.dim() > 1:
        columns = [sum_in_order(x.flatten(1)) for x in columns]
    sums = groups.sum(torch.stack(columns, 1))
    parts = iter(sums.unbind(1))
    matrix = [[torch.empty(0)] * count for _ in range(count)]
    for i in range(count):
        for j in range(i, count):
            matrix[i][j] = matrix[j][i] = next(parts)
    found = _solve(matrix, list(parts))
    wide = (-1, *(1,) * (residual.dim() - 1))
    of_each = [x.index_select(0, groups.owner).reshape(wide) for x in found]
    off, less = (of_each[0] * change for change in earlier[0])
    for part, (change, shift) in zip(of_each[1:], earlier[1:], strict=True):
        off, less = off + part * change, less + part * shift
    return off, less


def sum_in_order(x: Tensor) -> Tensor:
    """The sum of each row (N, K), in the order of its columns, which fixes its bits."""
    out = x[:, 0]
    for column in x.unbind(1)[1:]:
        out = out + column
    return out


def _solve(matrix: list[list[Tensor]], right: list[Tensor]) -> list[Tensor]:
    """The solutions of symmetric systems, by elimination; each entry is (B,)."""
    count = len(right)
    for i in range(count):
        matrix[i][i] = matrix[i][i] * (1 + RIDGE) + TINY
    for i in range(count):
        for k in range(i + 1, count):
            part = matrix[k][i] / matrix[i][i]
            for j in range(i, count):
                matrix[k][j] = matrix[k][j] - part * matrix[i][j]
            right[k] = right[k] - part * right[i]
    for i in reversed(range(count)):
        for j in range(i + 1, count):
            right[i] = right[i] - matrix[i][j] * right[j]
        right[i] = right[i] / matrix[i][i]
    return right


def with_derivative(
    function: Callable[[Tensor], Tensor], x: Tensor, groups: Groups, close: float, most: int,
    what: str,
) -> Tensor:  # fmt: skip
    """The solution x = F(x), (N, …), with the derivative of this equation by all that the function
    depends on: dx = (1 − F′)⁻¹ dF, solved for in the same way. what: it is, in a message."""
    # a tangent of 0, so that compiled functions with derivatives are those of the solve below
    again = in_forward_mode() or may_be_checkpoint()
    at = x.detach().requires_grad_(not again)
    value = function(with_tangent(x, torch.zeros_like(x)) if in_forward_mode() else at)
    moved = both(value)[1]
    refuse_both(what, value)
    if moved is not None:  # F′ of a tangent, and the tangent of F itself, together
        size = _sizes(moved, groups)
        turned = fixed_point(
            lambda y: _zero_if_none(both(function(with_tangent(x, y)))[1], y), moved,
            lambda y, new: size, groups, close, most,
        )  # fmt: skip
        return with_tangent(x, _nan_where(turned.failed, turned.x, groups))
    change = value - x
    if not change.requires_grad:
        return x
    known = None if again else (at, value)
    return _Adjoint.apply(change, x, function, groups, (close, most, what), known)


class _Adjoint(torch.autograd.Function):
    """x, with the derivative (1 − F′)⁻¹ d(change). Its input is the change F(x) − x ≈ 0 at a
    constant x. known: this x, and F of it with its derivative by x, where the graph of that may be
    used several times; else it is made again."""

    @staticmethod
    def forward(ctx, change: Tensor, x: Tensor, function, groups, settings, known) -> Tensor:
        keep(ctx, (function, groups, settings, known), x)
        return x.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        (function, groups, (close, most, what), known), (x,) = kept(ctx)
        refuse_second(what, grad)
        if known is not None:
            at, value = known
        else:
            with torch.enable_grad():
                at = x.detach().requires_grad_()
                value = function(at)

        def pulled(x: Tensor) -> Tensor:
            back = torch.autograd.grad(value, at, x, retain_graph=True, allow_unused=True)[0]
            return grad + _zero_if_none(back, x)

        size = _sizes(grad, groups)
        with one_torch_thread():
            found = fixed_point(pulled, grad, lambda x, new: size, groups, close, most)
        return _nan_where(found.failed, found.x, groups), None, None, None, None, None


def _nan_where(failed: Tensor, x: Tensor, groups: Groups) -> Tensor:
    there = failed.index_select(0, groups.owner).reshape(-1, *(1,) * (x.dim() - 1))
    return torch.where(there, torch.nan, x)


def _zero_if_none(given: Tensor | None, like: Tensor) -> Tensor:
    return torch.zeros_like(like) if given is None else given


def _sizes(values: Tensor, groups: Groups) -> Tensor:
    """The greatest size of each group, for each of its numbers."""
    rows = values.abs() if values.dim() == 1 else values.abs().flatten(1).amax(1)
    size = groups.max(rows).index_select(0, groups.owner).clamp(min=1e-300)
    return size.reshape(-1, *(1,) * (values.dim() - 1))

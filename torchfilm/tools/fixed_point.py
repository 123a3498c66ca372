"""Fixed points x = F(x) of many groups of numbers, each group by itself.

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

DEPTH = 3
# Of the diagonal, added to it: differences may be parallel.
RIDGE = 1e-12
TINY = 1e-300


class FixedPoint(NamedTuple):
    """x: (N,). iterations: (B,), evaluations of F. failed: (B,) bool, groups that ended with a
    residual over 100 times of what was asked for."""

    x: Tensor
    iterations: Tensor
    failed: Tensor


@torch.no_grad()
def fixed_point(
    function: Callable[[Tensor], Tensor],
    start: Tensor,
    scale: Callable[[Tensor], Tensor],
    groups: Groups,
    close: float,
    most: int,
    positive: bool = False,
) -> FixedPoint:
    """x = function(x), from start (N,) float64, up to |function(x) − x| ≤ close · scale(x) for all
    numbers of a group. most: evaluations. positive: whether no x may become 0 or less."""
    x, owner = start, groups.owner
    going = torch.ones(groups.size, dtype=torch.bool, device=x.device)
    iterations = torch.zeros(groups.size, dtype=torch.int64, device=x.device)
    far = torch.zeros_like(x, dtype=torch.bool)
    earlier: list[tuple[Tensor, Tensor]] = []  # changes of x + residual, and of the residual
    last: tuple[Tensor, Tensor] | None = None
    for _ in range(most):
        new = function(x)
        residual, size = new - x, scale(x)
        iterations += going
        far = ~(residual.abs() <= 100 * close * size)
        going = going & groups.any(residual.abs() > close * size)  # not a NaN, which stays one
        if not bool(going.any()):
            break
        moves = going.index_select(0, owner)
        if last is not None:
            change = new - last[0], residual - last[1]
            earlier = [*earlier, change][-DEPTH:]
        last = new, residual
        ahead = new - _mixed(earlier, residual, 1 / size, groups) if earlier else new
        if positive:
            ahead = torch.where(ahead > 0, ahead, new)
        x = torch.where(moves, ahead, x)
    return FixedPoint(x, iterations, groups.any(far))


def _mixed(
    earlier: list[tuple[Tensor, Tensor]], residual: Tensor, weight: Tensor, groups: Groups
) -> Tensor:
    """What the combination of earlier changes takes off, (N,)."""
    count = len(earlier)
    right = [change[1] * weight for change in earlier]
    columns = [right[i] * right[j] for i in range(count) for j in range(i, count)]
    sums = groups.sum(torch.stack([*columns, *(x * residual * weight for x in right)], 1))
    parts = iter(sums.unbind(1))
    matrix = [[torch.empty(0)] * count for _ in range(count)]
    for i in range(count):
        for j in range(i, count):
            matrix[i][j] = matrix[j][i] = next(parts)
    found = _solve(matrix, list(parts))
    of_each = [x.index_select(0, groups.owner) for x in found]
    out = of_each[0] * earlier[0][0]
    for part, (change, _) in zip(of_each[1:], earlier[1:], strict=True):
        out = out + part * change
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

"""Sums of a series of mixings, and their backward pass: the same series, run backwards.

With x_0 = u and x_(k+1) = P x_k + g these are Σ_k w_k x_k, for each row of weights w. Their
derivatives come from one more series, of Pᵀ. Torch's own graph would hold every operation of the
series, some thousands, and a solve for derivatives goes through it several times.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import reduce

import torch
from torch import Tensor

from torchfilm.signals import compiled_sums
from torchfilm.signals.compiled_sums import may_add_up
from torchfilm.signals.mixing import Mixing
from torchfilm.tools.tangents import has_tangent, in_forward_mode, may_be_checkpoint

# Numbers of all terms up to which a backward pass keeps them, for others that may follow. A longer
# series is gone through once more in a backward pass, and as many as the root of its terms held.
KEPT = 2**20


def sums(
    mixing: Mixing, gain: Tensor | None, rows: Sequence[Tensor], u: Tensor, *,
    compiled: bool = False,
) -> tuple[Tensor, ...]:  # fmt: skip
    """The sum of each row, (b, nx, ny, nz). u: of that shape; gain: g, or None; rows: (terms, b or
    1) each, constants. compiled: whether kernels may do it where gradients are wanted."""
    values = [x for x in (u, gain, *mixing.numbers) if x is not None]
    if in_forward_mode() or not torch.is_grad_enabled() or not any(x.requires_grad for x in values):
        return _by_terms(mixing, gain, rows, u)
    dims = tuple(dim for dim, _, _ in mixing.gains)
    compiled = compiled and may_add_up(u)
    return _Sums.apply(dims, compiled, torch.stack(tuple(rows)), u, gain, *mixing.numbers)


def _by_terms(
    mixing: Mixing, gain: Tensor | None, rows: Sequence[Tensor] | Tensor, u: Tensor
) -> tuple[Tensor, ...]:
    found = [_weighted(row[0], u) for row in rows]
    for k in range(1, len(rows[0])):
        u = _next(mixing, gain, u)
        found = [x + _weighted(row[k], u) for x, row in zip(found, rows, strict=True)]
    return tuple(found)


def _weighted(weight: Tensor, value: Tensor) -> Tensor:
    return weight.reshape(-1, 1, 1, 1) * value


def _next(mixing: Mixing, gain: Tensor | None, u: Tensor) -> Tensor:
    return mixing.of(u) if gain is None else mixing.of(u) + gain


def _backwards(mixing: Mixing, gain: Tensor | None, u: Tensor, count: int) -> Iterator[Tensor]:
    """x_(count − 1), …, x_1, x_0."""
    size = count if count * u.numel() <= KEPT else math.isqrt(count) + 1
    firsts, last = [u], u
    for k in range(1, (count - 1) // size * size + 1):
        last = _next(mixing, gain, last)
        if k % size == 0:
            firsts.append(last)
    while firsts:
        terms = [firsts.pop()]
        for _ in range(min(size, count - len(firsts) * size) - 1):
            terms.append(_next(mixing, gain, terms[-1]))
        yield from reversed(terms)


class _Sums(torch.autograd.Function):
    """As `sums`, where gradients are wanted. rows: (sums, terms, b or 1). sides: of each dimension,
    what a voxel gets from the one below, and from the one above."""

    @staticmethod
    def forward(ctx, dims, compiled, rows: Tensor, u: Tensor, gain: Tensor | None, stay, *sides):
        mixing = _mixing(dims, stay, sides)
        ctx.dims, ctx.compiled, ctx.terms = dims, compiled, None
        ctx.keeps = not may_be_checkpoint()  # or they would be kept where a checkpoint drops all
        ctx.save_for_backward(rows, u, gain, stay, *sides)
        return (compiled_sums.add_up if compiled else _by_terms)(mixing, gain, rows, u)

    @staticmethod
    def backward(ctx, *of_sums: Tensor):
        rows, u, gain, stay, *sides = ctx.saved_tensors
        mixing, wanted = _mixing(ctx.dims, stay, sides), ctx.needs_input_grad[4:]
        if ctx.compiled and not torch.is_grad_enabled() and not has_tangent(*of_sums):
            back, found = compiled_sums.pull(mixing, gain, rows, u, of_sums, wanted)
        else:
            back, found = _pulled(ctx, mixing, gain, rows, u, of_sums, wanted)
        own = [
            None if not some or value is None else value.sum_to_size(x.shape)
            for some, x, value in zip(wanted, (gain, stay, *sides), found, strict=True)
        ]
        return None, None, None, back.sum_to_size(u.shape), *own


def _pulled(
    ctx, mixing: Mixing, gain: Tensor | None, rows: Tensor, u: Tensor, of_sums: Sequence[Tensor],
    wanted: Sequence[bool],
) -> tuple[Tensor, list[Tensor | None]]:  # fmt: skip
    """As `compiled_sums.pull`, by torch."""
    found: list[Tensor | None] = [None] * len(wanted)
    last = rows.shape[1] - 1

    def add(k: int, value: Tensor) -> None:
        before = found[k]
        found[k] = value if before is None else before + value

    pull = lambda k: reduce(torch.add, map(_weighted, rows[:, k], of_sums))
    back, pulled = pull(last), mixing.transposed()
    terms = _terms(ctx, mixing, gain, u, last) if last and any(wanted[1:]) else None
    for k in range(last - 1, -1, -1):
        if wanted[0]:
            add(0, back)
        if terms is not None:
            term = next(terms)
            if wanted[1]:
                add(1, back * term)
            for n, (dim, _, _) in enumerate(mixing.gains):
                for side, shift in ((2 * n, 1), (2 * n + 1, -1)):
                    if wanted[2 + side]:
                        add(2 + side, back * torch.roll(term, shift, dim))
        back = pulled.of(back) + pull(k)
    return back, found


def _terms(ctx, mixing: Mixing, gain: Tensor | None, u: Tensor, count: int) -> Iterator[Tensor]:
    """As `_backwards`; kept where they are few, as several backward passes may follow."""
    for_second_derivatives = torch.is_grad_enabled()
    if for_second_derivatives or not ctx.keeps or count * u.numel() > KEPT:
        return _backwards(mixing, gain, u, count)
    if ctx.terms is None:
        ctx.terms = list(_backwards(mixing, gain, u, count))
    return iter(ctx.terms)


def _mixing(dims: tuple[int, ...], stay: Tensor, sides: Sequence[Tensor]) -> Mixing:
    return Mixing(stay, tuple(zip(dims, sides[::2], sides[1::2], strict=True)))

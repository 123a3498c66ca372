"""Sums of a series of mixings, and their backward pass: the same series, run backwards.

With x_0 = u and x_(k+1) = P x_k + g these are Σ_k w_k x_k and Σ_k t_k x_k, for two rows of weights.
Their derivatives come from one more series, of Pᵀ. Torch's own graph holds every operation of the
series, a few hundred, and a solve for derivatives goes through it several times.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.signals.transport_series import Mixing
from torchfilm.tools.tangents import in_forward_mode


def sums(
    mixing: Mixing, gain: Tensor | None, weights: Tensor, tails: Tensor, u: Tensor
) -> tuple[Tensor, Tensor]:
    """The two sums, (b, nx, ny, nz) each. u: of that shape; gain: g, or None; weights, tails:
    (terms, b), constants."""
    sides = [x for _, *both in mixing.gains for x in both]
    values = [x for x in (u, gain, mixing.stay, *sides) if x is not None]
    if in_forward_mode() or not torch.is_grad_enabled() or not any(x.requires_grad for x in values):
        return _by_terms(mixing, gain, weights, tails, u)
    dims = tuple(dim for dim, _, _ in mixing.gains)
    return _Sums.apply(dims, weights, tails, u, gain, mixing.stay, *sides)


def _by_terms(
    mixing: Mixing, gain: Tensor | None, weights: Tensor, tails: Tensor, u: Tensor
) -> tuple[Tensor, Tensor]:
    size = (-1, 1, 1, 1)
    end, total = weights[0].reshape(size) * u, tails[0].reshape(size) * u
    for weight, tail in zip(weights[1:], tails[1:], strict=True):
        u = _next(mixing, gain, u)
        end, total = end + weight.reshape(size) * u, total + tail.reshape(size) * u
    return end, total


def _next(mixing: Mixing, gain: Tensor | None, u: Tensor) -> Tensor:
    return mixing.of(u) if gain is None else mixing.of(u) + gain


class _Sums(torch.autograd.Function):
    """As `sums`, where gradients are wanted. sides: of each dimension, what a voxel gets from the
    one below, and from the one above."""

    @staticmethod
    def forward(ctx, dims, weights, tails, u: Tensor, gain: Tensor | None, stay, *sides):
        mixing = _mixing(dims, stay, sides)
        ctx.dims, ctx.terms = dims, None
        ctx.save_for_backward(weights, tails, u, gain, stay, *sides)
        return _by_terms(mixing, gain, weights, tails, u)

    @staticmethod
    def backward(ctx, of_end: Tensor, of_total: Tensor):  # type: ignore[override]
        weights, tails, u, gain, stay, *sides = ctx.saved_tensors
        mixing, size = _mixing(ctx.dims, stay, sides), (-1, 1, 1, 1)
        tracked = torch.is_grad_enabled()  # for second derivatives
        terms = None if tracked else ctx.terms
        if terms is None:
            terms = [u]
            for _ in range(len(weights) - 2):
                terms.append(_next(mixing, gain, terms[-1]))
            ctx.terms = None if tracked else terms  # several backward passes may follow
        wanted = ctx.needs_input_grad[4:]
        found: list[Tensor | None] = [None] * len(wanted)

        def add(k: int, value: Tensor) -> None:
            before = found[k]
            found[k] = value if before is None else before + value

        pull = lambda k: weights[k].reshape(size) * of_end + tails[k].reshape(size) * of_total
        back = pull(len(weights) - 1)
        for k in range(len(weights) - 2, -1, -1):
            if wanted[0]:
                add(0, back)
            if wanted[1]:
                add(1, back * terms[k])
            for n, dim in enumerate(ctx.dims):
                for side, shift in ((2 * n, 1), (2 * n + 1, -1)):
                    if wanted[2 + side]:
                        add(2 + side, back * torch.roll(terms[k], shift, dim))
            back = mixing.pulled(back) + pull(k)
        given = (gain, stay, *sides)
        own = [
            None if x is None or value is None else value.sum_to_size(x.shape)
            for x, value in zip(given, found, strict=True)
        ]
        return None, None, None, back.sum_to_size(u.shape), *own


def _mixing(dims: tuple[int, ...], stay: Tensor, sides: object) -> Mixing:
    each = list(sides)  # type: ignore[call-overload]
    return Mixing(stay, tuple(zip(dims, each[::2], each[1::2], strict=True)))

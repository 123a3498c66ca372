"""Transport over a step of a separable operator, exact in time: exp(Δt·T) as a matrix per axis.

On a box with constant coefficients T is a sum of one matrix for each axis, and these commute. Each
exponential is computed with non-negative numbers only (the diagonal is shifted out; scaling and
squaring). The amount that has left the box is one of its entries, so the parts inside and outside
always add up to 1. No entry is negative and no amount is lost, however long the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.transport_operator import Exchange, Operator
from torchfilm.tools import checks

# exp(t(Q + ρ)) with tρ ≤ ½ by its series: the first omitted term is ½¹⁶/16! = 7e-19.
TERMS = 15
# The integral over such a short time by Gauss quadrature: its error is below
# (2·½)¹²·(6!)⁴/(13·(12!)³) = 2e-16 of the integrand.
NODES = 6
# A product's last bits depend on the memory alignment of its matrices, and so on the colonies
# before, unless each matrix begins at a multiple of 64 bytes.
ALIGN = 16


@dataclass(frozen=True, eq=False)
class Exponential:
    """u ↦ exp(Δt T) u + ∫ exp(s T) ds · gain.

    factors: for each axis (B or 1, n, n), with n padded by zeros to a multiple of ALIGN, or None
    where nothing changes. Entry [j, i] is the part of voxel j that is in voxel i afterwards.
    gained: None or (B or 1, nx, ny, nz), concentration.
    """

    factors: tuple[Tensor | None, ...]
    gained: Tensor | None

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later."""
        out = multiply(self.factors, u)
        return out if self.gained is None else out + self.gained


def multiply(factors: tuple[Tensor | None, ...], u: Tensor) -> Tensor:
    """u (B, nx, ny, nz) with each factor applied along its axis.

    Three times the first axis is multiplied and becomes the last, which restores the order of axes.
    """
    colonies = u.shape[0]
    for factor in factors:
        _, n, a, b = u.shape
        turned = u.reshape(colonies, n, a * b)
        if factor is None:
            turned = turned.transpose(1, 2)
        else:
            full = factor.shape[1]
            product = products(
                padded(turned, full, aligned(a * b)).transpose(1, 2),
                factor.expand(colonies, full, full),
            )
            turned = product[:, : a * b, :n]
        u = turned.reshape(colonies, a, b, n)
    return u


def products(a: Tensor, b: Tensor) -> Tensor:
    """The matrix product of each colony, (B, r, k), (B, k, c) -> (B, r, c).

    On CUDA one by one: the library there may pick a method for all at once by their number.
    """
    if a.device.type == "cpu":
        return torch.bmm(a, b)
    return torch.stack([torch.mm(x, y) for x, y in zip(a, b, strict=True)])


def aligned(size: int) -> int:
    """The next multiple of ALIGN."""
    return -(-size // ALIGN) * ALIGN


def padded(x: Tensor, rows: int, columns: int) -> Tensor:
    """x (B, r, c), padded with zeros to (B, rows, columns)."""
    return (
        x
        if x.shape[1:] == (rows, columns)
        else torch.nn.functional.pad(x, (0, columns - x.shape[2], 0, rows - x.shape[1]))
    )


def check_separable(operator: Operator) -> None:
    """Raise InputError for an operator that is not a sum of one for each axis."""
    if not operator.separable:
        why = (
            "there is an obstacle (mask)"
            if operator.mask is not None
            else "the velocity is not uniform"
        )
        raise checks.input_error(
            "method",
            "exponential",
            f"another method, since {why}",
            'Use method="series", or None for the automatic choice.',
        )


def prepare_exponential(operator: Operator, dt: float) -> Exponential:
    """The factors of a step of `dt` hours. Raises InputError if the operator is not separable."""
    check_separable(operator)
    if all(axis.still for axis in operator.axes):
        return _still(operator, dt)
    # decay multiplies the factor of the longest axis, which always exists
    carrier = operator.shape.index(max(operator.shape))
    generators = [
        None if axis.idle and axis.axis != carrier else generator(axis) for axis in operator.axes
    ]
    fastest = [
        None if g is None else g.detach().diagonal(dim1=1, dim2=2).amin(1).neg() for g in generators
    ]
    rate = operator.decay.detach().reshape(-1)
    for most in fastest:
        rate = rate if most is None else rate + most
    # per colony, so that its result does not depend on the others
    doublings = torch.frexp(2 * dt * rate).exponent.clamp(min=0)
    short = dt * torch.exp2(-doublings.to(rate.dtype))

    def factors(time: Tensor) -> list[Tensor | None]:
        return [
            None if g is None or most is None else _short_exponential(g, most, time)
            for g, most in zip(generators, fastest, strict=True)
        ]

    kept = lambda factors, time: _kept(operator, carrier, factors, time)
    gained = None
    if operator.gain is not None:
        gain = operator.gain.expand(max(rate.numel(), operator.gain.shape[0]), *operator.shape)
        places, weights = np.polynomial.legendre.leggauss(NODES)
        for place, weight in zip(places, weights, strict=True):
            at = short * float(0.5 + 0.5 * place)
            part = multiply(kept(factors(at), at), gain) * (
                0.5 * float(weight) * short.reshape(-1, 1, 1, 1)
            )
            gained = part if gained is None else gained + part
    now, time = factors(short), short
    for k in range(int(doublings.max())):
        more = doublings > k
        if gained is not None:
            gained = torch.where(
                more.reshape(-1, 1, 1, 1), gained + multiply(kept(now, time), gained), gained
            )
        now = [
            (
                None
                if f is None
                else torch.where(more.reshape(-1, 1, 1), _normalised(products(f, f)), f)
            )
            for f in now
        ]
        time = torch.where(more, 2 * time, time)
    made = tuple(None if f is None else _rounded(f, operator.dtype) for f in kept(now, time))
    return Exponential(made, None if gained is None else gained.to(operator.dtype))


def _still(operator: Operator, dt: float) -> Exponential:
    """A step in which nothing moves: u ↦ e^(−kΔt) u + (1 − e^(−kΔt))/k · gain."""
    decay = operator.decay
    sizes = operator.shape
    carrier = sizes.index(max(sizes))
    n, full = sizes[carrier], aligned(sizes[carrier])
    one = padded(torch.eye(n, dtype=decay.dtype, device=decay.device)[None], full, full)
    left = torch.exp(-decay * dt).reshape(-1, 1, 1) * one
    factors = [left.to(operator.dtype) if axis == carrier else None for axis in range(len(sizes))]
    gained = None
    if operator.gain is not None:
        some = torch.where(decay > 0, decay, 1.0)
        lasting = torch.where(decay > 0, -torch.expm1(-some * dt) / some, dt)
        gained = (lasting.reshape(-1, 1, 1, 1) * operator.gain).to(operator.dtype)
    return Exponential(tuple(factors), gained)


def _kept(
    operator: Operator, carrier: int, factors: list[Tensor | None], time: Tensor
) -> tuple[Tensor | None, ...]:
    """The parts that stay in the box, with the decay of that time on the axis `carrier`."""
    left = torch.exp(-operator.decay.reshape(-1, 1, 1) * time.reshape(-1, 1, 1))
    inside = [
        None if f is None else padded(f[:, :n, :n], aligned(n), aligned(n))
        for f, n in zip(factors, operator.shape, strict=True)
    ]
    return tuple(left * f if f is not None and k == carrier else f for k, f in enumerate(inside))


def generator(axis: Exchange) -> Tensor:
    """The rate matrix of one axis, (B or 1, m, m), 1/h.

    Entry [j, i] is the rate at which voxel j gives to voxel i; entry [j, n] is the rate to the
    outside. Rows sum to 0; entries beyond n are 0.
    """
    n = axis.size
    up, down = axis.up.reshape(-1, n + 1), axis.down.reshape(-1, n + 1)
    inside = torch.diag_embed(up[:, 1:n], 1) + torch.diag_embed(down[:, 1:n], -1)
    first, last = torch.eye(n, dtype=up.dtype, device=up.device)[[0, -1]]
    leaving = down[:, :1] * first, up[:, n:] * last
    lost = torch.zeros_like(inside[:, :, :1])
    if not axis.periodic:
        lost = (leaving[0] + leaving[1]).unsqueeze(2)
    elif n > 1:
        inside = inside + leaving[0].unsqueeze(2) * last + leaving[1].unsqueeze(2) * first
    given = inside.sum(2) + lost.squeeze(2)
    return padded(
        torch.cat([inside - torch.diag_embed(given), lost], 2), aligned(n + 1), aligned(n + 1)
    )


def _short_exponential(generator: Tensor, fastest: Tensor, time: Tensor) -> Tensor:
    """exp(time · generator) where time · fastest ≤ ½; both (B or 1,)."""
    one = torch.eye(generator.shape[1], dtype=generator.dtype, device=generator.device)
    shifted = (generator + fastest.reshape(-1, 1, 1) * one) * time.reshape(-1, 1, 1)
    out = one.expand(shifted.shape)
    for k in range(TERMS, 0, -1):
        out = one + products(shifted, out) / k
    return _normalised(out)  # this also removes the shift


def _normalised(factor: Tensor) -> Tensor:
    """Rows scaled to a sum of exactly 1, so that rounding does not double with every squaring."""
    return factor / factor.sum(2, keepdim=True)


def _rounded(factor: Tensor, dtype: torch.dtype) -> Tensor:
    """The factor in `dtype`, with two entries of each row corrected to keep the row's sum.

    The corrected entries are the two largest.

    A sum with a rounding error would be wrong at every step in the same direction, and over time
    would show as amount gained or lost.
    """
    if dtype == factor.dtype:
        return factor
    out = torch.where(factor < torch.finfo(dtype).tiny, 0.0, factor).to(dtype)
    order = torch.topk(factor.detach(), min(2, factor.shape[2]), dim=2).indices
    for k in range(order.shape[2]):
        place = order[:, :, k : k + 1]
        off = (factor.detach() - out.detach().double()).sum(2, keepdim=True).to(dtype)
        most = 0.5 * out.detach().gather(2, place)
        out = out.scatter_add(2, place, torch.minimum(torch.maximum(off, -most), most))
    return out

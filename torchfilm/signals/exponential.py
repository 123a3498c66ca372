"""Transport over a step of a separable operator, exact in time: exp(Δt·T) as one dense matrix for
each axis.

On a box with constant coefficients T is a sum of one matrix for each axis, and these commute. The
exponential of each is found with non-negative numbers only (the diagonal is shifted out; scaling
and squaring), among them what has left the box, so that what stays and what has left always add up
to 1: no entry is negative and no amount is lost, however long the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.operator import Exchange, Operator
from torchfilm.tools import checks

# exp(t(Q + ρ)) with tρ ≤ ½ by its series: the first term left out is ½¹⁶/16! = 7e-19.
TERMS = 15
# The integral over such a short time by Gauss's rule: its error is under (2·½)¹²·(6!)⁴/(13·(12!)³)
# = 2e-16 of the integrand.
NODES = 6
# A product's last bits depend on how its matrices lie in memory, and so on the colonies before,
# unless each begins at a whole 64 bytes.
ALIGN = 16


@dataclass(frozen=True, eq=False)
class Exponential:
    """u ↦ exp(Δt T) u + ∫ exp(s T) ds · gain.

    factors: for each axis (B or 1, n, n), n filled up with zeros to a multiple of ALIGN, entry [j,
    i] the part of voxel j that is in voxel i afterwards, or None where nothing changes. gained:
    None or (B or 1, nx, ny, nz), concentration.
    """

    factors: tuple[Tensor | None, ...]
    gained: Tensor | None

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) a step later."""
        out = multiply(self.factors, u)
        return out if self.gained is None else out + self.gained


def multiply(factors: tuple[Tensor | None, ...], u: Tensor) -> Tensor:
    """u (B, nx, ny, nz) with each factor applied along its axis.

    Three times the first axis is multiplied and becomes the last, so that all is back in its place.
    """
    colonies = u.shape[0]
    for factor in factors:
        _, n, a, b = u.shape
        turned = u.reshape(colonies, n, a * b)
        if factor is None:
            turned = turned.transpose(1, 2)
        else:
            full = factor.shape[1]
            product = torch.bmm(
                filled(turned, full, aligned(a * b)).transpose(1, 2),
                factor.expand(colonies, full, full),
            )
            turned = product[:, : a * b, :n]
        u = turned.reshape(colonies, a, b, n)
    return u


def aligned(size: int) -> int:
    return -(-size // ALIGN) * ALIGN


def filled(x: Tensor, rows: int, columns: int) -> Tensor:
    """x (B, r, c) with zeros added up to (B, rows, columns)."""
    return (
        x
        if x.shape[1:] == (rows, columns)
        else torch.nn.functional.pad(x, (0, columns - x.shape[2], 0, rows - x.shape[1]))
    )


def prepare_exponential(operator: Operator, dt: float) -> Exponential:
    """The factors of a step of `dt` hours; raises where the operator is not separable."""
    if not operator.separable:
        why = (
            "there is an obstacle (mask)"
            if operator.mask is not None
            else "the velocity varies from place to place"
        )
        raise checks.input_error(
            "method",
            "exponential",
            f"another one where {why}",
            'Use method="implicit", or None to have it chosen.',
        )
    # decay multiplies the factor of the longest axis, which is always there
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

    def kept(factors: list[Tensor | None], time: Tensor) -> tuple[Tensor | None, ...]:
        """What stays in the box, with the decay of that time."""
        left = torch.exp(-operator.decay.reshape(-1, 1, 1) * time.reshape(-1, 1, 1))
        inside = [
            None if f is None else filled(f[:, :n, :n], aligned(n), aligned(n))
            for f, n in zip(factors, operator.shape, strict=True)
        ]
        return tuple(
            left * f if f is not None and k == carrier else f for k, f in enumerate(inside)
        )

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
            None if f is None else torch.where(more.reshape(-1, 1, 1), _closed(torch.bmm(f, f)), f)
            for f in now
        ]
        time = torch.where(more, 2 * time, time)
    made = tuple(None if f is None else _rounded(f, operator.dtype) for f in kept(now, time))
    return Exponential(made, None if gained is None else gained.to(operator.dtype))


def generator(axis: Exchange) -> Tensor:
    """(B or 1, m, m): entry [j, i] the rate at which voxel j gives to voxel i, 1/h; entry [j, n]
    that to the outside. Rows sum to 0; beyond n are zeros."""
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
    return filled(
        torch.cat([inside - torch.diag_embed(given), lost], 2), aligned(n + 1), aligned(n + 1)
    )


def _short_exponential(generator: Tensor, fastest: Tensor, time: Tensor) -> Tensor:
    """exp(time · generator) where time · fastest ≤ ½; (B or 1,) both."""
    one = torch.eye(generator.shape[1], dtype=generator.dtype, device=generator.device)
    shifted = (generator + fastest.reshape(-1, 1, 1) * one) * time.reshape(-1, 1, 1)
    out = one.expand(shifted.shape)
    for k in range(TERMS, 0, -1):
        out = one + torch.bmm(shifted, out) / k
    return _closed(out)  # which takes the shift out again


def _closed(factor: Tensor) -> Tensor:
    """Rows scaled to a sum of exactly 1, so that rounding does not double with every squaring."""
    return factor / factor.sum(2, keepdim=True)


def _rounded(factor: Tensor, dtype: torch.dtype) -> Tensor:
    """The factor in `dtype`, with the two largest entries of each row mended so that its sum is
    what it was.

    A sum that is off, if only by rounding, is so at every step in the same direction, and in time
    is seen as amount gained or lost.
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

"""Transport over a step by backward Euler along one axis after the other, a tridiagonal solve each.

(I − Δt T_x)(I − Δt T_y)(I − Δt T_z): first order in time, L-stable. A matrix of exchange allows an
elimination in terms of amounts. In the upward sweep each voxel keeps one part and passes the rest
to the next voxel; the downward sweep does the same. Every part is non-negative and the parts add up
to 1. So nothing becomes negative and amount is conserved to rounding at any step and in any
precision. The textbook elimination in float32 would lose digits as KΔt/h² grows. (The idea, no
subtractions, is that of Grassmann, Taksar and Heyman for Markov chains.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.signals.transport_operator import Exchange, Operator, entering


@dataclass(frozen=True, eq=False)
class Share:
    """A part of an amount y: part·y, or y − rest·y if the part is more than half.

    The second form adds up exactly to y with the amount that is passed on. whole: 1 for the second
    form, else 0. part: the part or −rest.
    """

    whole: Tensor
    part: Tensor

    def of(self, y: Tensor) -> Tensor:
        """The part of the amount y."""
        return torch.addcmul(self.whole * y, self.part, y)


@dataclass(frozen=True, eq=False)
class Chain:
    """A factored axis, the axis first: tensors (n − 1 or n, B or 1, …).

    `solve` gives (I − Δt T_axis)⁻¹. up, down: the parts passed from voxel i to i + 1 and from i + 1
    to i. kept, settled: the parts that stay in the upward and downward sweeps. On a periodic axis
    `closure` treats the last voxel, and the chain has only the others.
    """

    up: Tensor
    down: Tensor
    kept: Share
    settled: Share
    closure: PeriodicClosure | None

    def solve(self, b: Tensor) -> Tensor:
        """The solution for b (n, B, …), of the same shape."""
        if self.closure is None:
            return self.settled.of(
                recurrence(self.kept.of(recurrence(b, self.up, False)), self.down, True)
            )
        head, last = b[:-1], b[-1]
        y = recurrence(head, self.up, False)
        last = self.closure.settled.of(weighted_sum(y, self.closure.onward, last))
        head = self.settled.of(recurrence(self.kept.of(y), self.down, True))
        return torch.cat([torch.addcmul(head, self.closure.back, last), last.unsqueeze(0)])


@dataclass(frozen=True, eq=False)
class PeriodicClosure:
    """The last voxel of a periodic axis.

    onward: the part that each other voxel passes to it in the upward sweep, (n − 1, …). settled:
    the part of its content after that sweep that stays. back: the content of each other voxel per
    unit that stays.
    """

    onward: Tensor
    settled: Share
    back: Tensor


@dataclass(frozen=True, eq=False)
class Implicit:
    """u ↦ Π (I − Δt T_axis)⁻¹ (u + Δt source), with the inflow of an axis added before its solve.

    chains: one per axis, or None where nothing happens. entered: None or Δt × the inflow through
    the faces, per axis. source: None or Δt × the source.
    """

    chains: tuple[Chain | None, ...]
    entered: tuple[Tensor | None, ...]
    source: Tensor | None

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) one step later."""
        if self.source is not None:
            u = u + self.source
        for axis, (chain, entered) in enumerate(zip(self.chains, self.entered, strict=True)):
            if chain is not None:
                b = u if entered is None else u + entered
                u = chain.solve(b.movedim(axis + 1, 0).contiguous()).movedim(0, axis + 1)
        return u.contiguous()


def prepare_implicit(operator: Operator, dt: float) -> Implicit:
    """The factors of a step of `dt` hours.

    Decay is divided evenly among the axes with more than one voxel. On one axis a steady field is
    exact; on several its error is of order Δt.
    """
    long = [axis for axis in range(3) if operator.shape[axis] > 1] or [0]
    decay = operator.decay if operator.mask is None else operator.decay * operator.mask
    chains: list[Chain | None] = []
    entered: list[Tensor | None] = []
    for axis in operator.axes:
        busy = axis.axis in long or not axis.idle
        share = decay / len(long) if axis.axis in long else torch.zeros_like(operator.decay)
        chains.append(factor(axis, share, dt, operator.dtype) if busy else None)
        found = entering(axis) if busy else None
        entered.append(None if found is None else (dt * found).to(operator.dtype))
    return Implicit(
        tuple(chains),
        tuple(entered),
        None if operator.source is None else (dt * operator.source).to(operator.dtype),
    )


def factor(axis: Exchange, decay: Tensor, dt: float, dtype: torch.dtype) -> Chain:
    """The parts of one axis's solve, computed in float64 without subtractions.

    R and Q are the rates up and down in a step, relative to a voxel's content: s_i = 1 + decay +
    Q_i s_(i−1)/p_(i−1), p_i = s_i + R_i. In the upward sweep voxel i keeps s_i/p_i; in the downward
    sweep, 1/s_i.
    """
    dim, n = axis.dim, axis.size
    shape = torch.broadcast_shapes(axis.up.narrow(dim, 0, 1).shape, decay.narrow(dim, 0, 1).shape)
    up, down = (
        part.expand(*shape[:dim], n + 1, *shape[dim + 1 :]).movedim(dim, 0) * dt
        for part in (axis.up, axis.down)
    )
    gone = decay.expand(*shape[:dim], n, *shape[dim + 1 :]).movedim(dim, 0) * dt
    rise, fall = up[1:], down[:n]  # R and Q of each voxel
    if axis.own_neighbour:
        rise, fall = torch.zeros_like(rise), torch.zeros_like(fall)
    count = n - 1 if axis.periodic and n > 1 else n
    # an amount that voxel i gives down ends in the chain below (s/p), comes back (R/p), or, on a
    # periodic axis, reaches the last voxel (c/p)
    s: list[Tensor] = []
    p: list[Tensor] = []
    c: list[Tensor] = []
    for i in range(count):
        if i == 0:
            around = fall[0] if count < n else torch.zeros_like(fall[0])
            s.append(1 + gone[0] + (fall[0] - around))
        else:
            around = fall[i] * (c[-1] / p[-1])
            s.append(1 + gone[i] + fall[i] * (s[-1] / p[-1]))
        c.append(around)
        p.append(s[-1] + rise[i] + around)
    held, pivot, aside = torch.stack(s), torch.stack(p), torch.stack(c)
    kept, up_part, around = held / pivot, rise[:count] / pivot, aside / pivot
    down_part, settled = fall[1:count] * kept[:-1] / held[1:], 1 / held
    closure = (
        None
        if count == n
        else _close_periodic(
            kept, up_part, around, down_part, settled, rise[-1], fall[-1], gone[-1], dtype
        )
    )
    keep, hand = _shares(kept[: count - 1], up_part[: count - 1], dtype)
    last, _ = _shares(kept[count - 1 :], up_part[count - 1 :], dtype)
    stay, drop = _shares(settled[1:], down_part, dtype)
    first, _ = _shares(settled[:1], torch.zeros_like(settled[:1]), dtype)
    return Chain(hand, drop, _concatenated(keep, last), _concatenated(first, stay), closure)


def _close_periodic(
    kept: Tensor,
    up: Tensor,
    around: Tensor,
    down: Tensor,
    settled: Tensor,
    rise: Tensor,
    fall: Tensor,
    gone: Tensor,
    dtype: torch.dtype,
) -> PeriodicClosure:
    """The last voxel of a periodic axis, in float64.

    The other voxels' parts are (n − 1, …), the rates of the last voxel (…).
    """
    # the part of a unit released in voxel i that does not return to the last voxel
    stays = recurrence(kept, up[:-1], True)
    held = 1 + gone + rise * stays[0] + fall * kept[-1]
    ends = torch.zeros_like(kept)
    ends = torch.cat([(ends[0] + rise).unsqueeze(0), ends[1:]]) + torch.cat(
        [ends[1:], (ends[-1] + fall).unsqueeze(0)]
    )
    back = settled * recurrence(kept * recurrence(ends, up[:-1], False), down, True)
    onward = torch.cat([around[:-1], (around[-1] + up[-1]).unsqueeze(0)])
    share, _ = _shares((1 / held).unsqueeze(0), torch.zeros_like(held).unsqueeze(0), dtype)
    return PeriodicClosure(onward.to(dtype), Share(share.whole[0], share.part[0]), back.to(dtype))


def _shares(kept: Tensor, handed: Tensor, dtype: torch.dtype) -> tuple[Share, Tensor]:
    """The kept part and the passed part, rounded to `dtype` with their sum unchanged.

    The smaller part is rounded; the larger is the remainder.
    """
    small = kept < 0.5
    left = (kept - kept.to(dtype).to(kept.dtype)) + handed
    passed = torch.where(small & (handed > 0.5), left, handed).to(dtype)
    part = torch.where(small, kept, kept - 1).to(dtype)
    return Share((~small).to(dtype), part), passed


def _concatenated(a: Share, b: Share) -> Share:
    return Share(torch.cat([a.whole, b.whole]), torch.cat([a.part, b.part]))


def recurrence(b: Tensor, part: Tensor, downward: bool) -> Tensor:
    """y_i = b_i + part_(i−1) y_(i−1) along the first dimension, or its reverse.

    Downward it is y_i = b_i + part_i y_(i+1). b: (n, …). part: (n − 1, …), which broadcasts.
    """
    return _Recurrence.apply(b, part, downward)


class _Recurrence(torch.autograd.Function):
    @staticmethod
    def forward(ctx, b: Tensor, part: Tensor, downward: bool) -> Tensor:
        shape = (b.shape[0], *torch.broadcast_shapes(b.shape[1:], part.shape[1:]))
        y = b.expand(shape).clone(memory_format=torch.contiguous_format)
        rows, parts = y.unbind(0), part.unbind(0)
        if downward:
            for i in range(len(rows) - 2, -1, -1):
                rows[i].addcmul_(parts[i], rows[i + 1])
        else:
            for i in range(1, len(rows)):
                rows[i].addcmul_(parts[i - 1], rows[i - 1])
        ctx.downward, ctx.shape = downward, b.shape
        ctx.save_for_backward(y, part)
        ctx.save_for_forward(y, part)
        return y

    @staticmethod
    def backward(ctx, grad: Tensor):
        y, part = ctx.saved_tensors
        adjoint = recurrence(grad, part, not ctx.downward)
        of_part = None
        if ctx.needs_input_grad[1]:
            pairs = (y[1:], adjoint[:-1]) if ctx.downward else (y[:-1], adjoint[1:])
            of_part = (pairs[0] * pairs[1]).sum_to_size(part.shape)
        return adjoint.sum_to_size(ctx.shape), of_part, None

    @staticmethod
    def jvp(ctx, b: Tensor | None, part: Tensor | None, _):
        y, parts = ctx.saved_tensors
        moved = torch.zeros_like(y) if b is None else b.expand(y.shape).clone()
        if part is not None:
            first, last = (moved[:-1], y[1:]) if ctx.downward else (moved[1:], y[:-1])
            first.addcmul_(part.expand(first.shape), last)
        return recurrence(moved, parts, ctx.downward)


def weighted_sum(y: Tensor, part: Tensor, start: Tensor) -> Tensor:
    """start + Σ_i part_i y_i over the first dimension, in order.

    The fixed order makes the result independent of the rest of the batch.
    """
    for row, p in zip(y.unbind(0), part.unbind(0), strict=True):
        start = torch.addcmul(start, p, row)
    return start

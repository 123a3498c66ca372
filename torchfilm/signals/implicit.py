"""Transport over a step by backward Euler, one axis after the other: one tridiagonal solve an axis.

(I − Δt T_x)(I − Δt T_y)(I − Δt T_z): first order in time, L-stable. The elimination is written as
what it is for a matrix of exchange, amounts handed on: sweeping up, each voxel keeps one part and
passes the rest to the next; sweeping down, likewise. Every part is non-negative and the parts add
up to 1, so nothing becomes negative and amount is conserved to rounding at any step and in any
precision, where the textbook elimination in float32 would lose digits as KΔt/h² grows. (The idea is
that of Grassmann, Taksar and Heyman for Markov chains: no subtractions.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.signals.operator import Exchange, Operator, entering


@dataclass(frozen=True, eq=False)
class Share:
    """A part of an amount: part·y, or, where it is more than half of it, y − rest·y, which with
    what is handed on adds up to y.

    whole: 1 where the second form holds, else 0; part: the part or −rest.
    """

    whole: Tensor
    part: Tensor

    def of(self, y: Tensor) -> Tensor:
        return torch.addcmul(self.whole * y, self.part, y)


@dataclass(frozen=True, eq=False)
class Chain:
    """A factored axis, the axis first: tensors (n − 1 or n, B or 1, …). `solve` gives (I − Δt
    T_axis)⁻¹.

    up, down: parts handed from voxel i to i + 1 and from i + 1 to i; kept, settled: the parts that
    stay in the upward and downward sweeps. On a periodic axis the last voxel stands aside: `ring`
    is set, and the chain is of the others.
    """

    up: Tensor
    down: Tensor
    kept: Share
    settled: Share
    ring: Ring | None

    def solve(self, b: Tensor) -> Tensor:
        """b (n, B, …) to u, (n, B, …)."""
        if self.ring is None:
            return self.settled.of(
                recurrence(self.kept.of(recurrence(b, self.up, False)), self.down, True)
            )
        head, last = b[:-1], b[-1]
        y = recurrence(head, self.up, False)
        last = self.ring.settled.of(weighted_sum(y, self.ring.onward, last))
        head = self.settled.of(recurrence(self.kept.of(y), self.down, True))
        return torch.cat([torch.addcmul(head, self.ring.back, last), last.unsqueeze(0)])


@dataclass(frozen=True, eq=False)
class Ring:
    """The last voxel of a periodic axis. onward: the part that each other voxel hands to it in the
    upward sweep, (n − 1, …); settled: the part of what it holds then that stays; back: what is in
    each other voxel for each unit that stays.
    """

    onward: Tensor
    settled: Share
    back: Tensor


@dataclass(frozen=True, eq=False)
class Implicit:
    """u ↦ Π (I − Δt T_axis)⁻¹ (u + Δt source), what enters through an axis's faces added before its
    solve.

    chains: one for each axis, or None where nothing happens; entered: None or Δt × what enters, for
    each axis; source: likewise.
    """

    chains: tuple[Chain | None, ...]
    entered: tuple[Tensor | None, ...]
    source: Tensor | None

    def step(self, u: Tensor) -> Tensor:
        """u (B, nx, ny, nz) a step later."""
        if self.source is not None:
            u = u + self.source
        for axis, (chain, entered) in enumerate(zip(self.chains, self.entered, strict=True)):
            if chain is not None:
                b = u if entered is None else u + entered
                u = chain.solve(b.movedim(axis + 1, 0).contiguous()).movedim(0, axis + 1)
        return u.contiguous()


def prepare_implicit(operator: Operator, dt: float) -> Implicit:
    """The factors of a step of `dt` hours.

    Decay is shared evenly among the axes that have more than one voxel: on one axis a steady field
    is exact, on several its error is of order Δt.
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
    """The parts of one axis's solve, worked out in float64 and without subtractions.

    With R and Q what a voxel gives up and down in a step, over what it holds: s_i = 1 + decay + Q_i
    s_(i−1)/p_(i−1), p_i = s_i + R_i; going up, voxel i keeps s_i/p_i; going down, 1/s_i.
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
    # what voxel i gives down comes, at last, to the chain below (s/p), back (R/p), or, around a
    # ring, to the last voxel (c/p)
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
    ring = (
        None
        if count == n
        else _ring(kept, up_part, around, down_part, settled, rise[-1], fall[-1], gone[-1], dtype)
    )
    keep, hand = _shares(kept[: count - 1], up_part[: count - 1], dtype)
    last, _ = _shares(kept[count - 1 :], up_part[count - 1 :], dtype)
    stay, drop = _shares(settled[1:], down_part, dtype)
    first, _ = _shares(settled[:1], torch.zeros_like(settled[:1]), dtype)
    return Chain(hand, drop, _joined(keep, last), _joined(first, stay), ring)


def _ring(
    kept: Tensor,
    up: Tensor,
    around: Tensor,
    down: Tensor,
    settled: Tensor,
    rise: Tensor,
    fall: Tensor,
    gone: Tensor,
    dtype: torch.dtype,
) -> Ring:
    """The last voxel of a ring; everything float64, the others' parts (n − 1, …) and its own rates
    (…)."""
    # how much of a unit set free in voxel i does not come back to the last voxel
    stays = recurrence(kept, up[:-1], True)
    held = 1 + gone + rise * stays[0] + fall * kept[-1]
    ends = torch.zeros_like(kept)
    ends = torch.cat([(ends[0] + rise).unsqueeze(0), ends[1:]]) + torch.cat(
        [ends[1:], (ends[-1] + fall).unsqueeze(0)]
    )
    back = settled * recurrence(kept * recurrence(ends, up[:-1], False), down, True)
    onward = torch.cat([around[:-1], (around[-1] + up[-1]).unsqueeze(0)])
    share, _ = _shares((1 / held).unsqueeze(0), torch.zeros_like(held).unsqueeze(0), dtype)
    return Ring(onward.to(dtype), Share(share.whole[0], share.part[0]), back.to(dtype))


def _shares(kept: Tensor, handed: Tensor, dtype: torch.dtype) -> tuple[Share, Tensor]:
    """The part kept, and the part handed on, rounded to `dtype` so that together they are what they
    were together before: the smaller is rounded, the larger is what that leaves."""
    small = kept < 0.5
    left = (kept - kept.to(dtype).to(kept.dtype)) + handed
    passed = torch.where(small & (handed > 0.5), left, handed).to(dtype)
    part = torch.where(small, kept, kept - 1).to(dtype)
    return Share((~small).to(dtype), part), passed


def _joined(a: Share, b: Share) -> Share:
    return Share(torch.cat([a.whole, b.whole]), torch.cat([a.part, b.part]))


def recurrence(b: Tensor, part: Tensor, downward: bool) -> Tensor:
    """y_i = b_i + part_(i−1) y_(i−1) along the first dimension, or downward y_i = b_i + part_i
    y_(i+1); b (n, …), part (n − 1, …) that broadcasts."""
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


def weighted_sum(y: Tensor, part: Tensor, start: Tensor) -> Tensor:
    """start + Σ_i part_i y_i over the first dimension, one after the other, so that what stands
    beside does not change the order."""
    for row, p in zip(y.unbind(0), part.unbind(0), strict=True):
        start = torch.addcmul(start, p, row)
    return start

"""What a Function keeps for its backward pass, also in a segment of steps of which a checkpoint
keeps the first state only.

Torch's checkpoint drops the tensors that a Function saves, and gets them from doing the steps once
more. What a Function keeps in other ways it would keep twice. So in a segment such things are kept
in the second run only, under a number that the Function saves as a tensor, until the backward pass
has taken them, or ends.

What a step reads from outside may have changed in between, which would make a wrong gradient. So a
segment keeps a sum of the bits after each step, and compares them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from itertools import count
from typing import Any
from weakref import ref

import torch
from torch import Tensor
from torch.autograd import Variable

MIX = 0x1E3779B97F4A7C15, 0x3F58476D1CE4E5B9  # odd, of well mixed bits
_NOW: ContextVar[tuple[Segment, bool] | None] = ContextVar("segment", default=None)


class Segment:
    """Steps that are done once for their result, and once more for each backward pass."""

    def __init__(self) -> None:
        self._numbers, self._things = count(), dict[int, Any]()
        self._done = False
        self._sums: list[Tensor] = []  # of the bits, after each step of the first run
        self._step = 0

    @contextmanager
    def steps(self) -> Iterator[bool]:
        """Around the steps, each time; whether it is for a backward pass."""
        again, self._done = self._done, True
        outer, self._step = self._step, 0  # rates that take a gradient begin the steps once more
        before, first = _NOW.set((self, again)), next(self._numbers)
        try:
            yield again
        finally:
            _NOW.reset(before)
            self._step = outer
            if again:  # which may not reach all Functions
                made = range(first, next(self._numbers))
                with suppress(RuntimeError):  # outside of a backward pass: who looks at a tensor
                    Variable._execution_engine.queue_callback(lambda: self._drop(made))

    def repeats(self, tensors: Iterable[Tensor]) -> bool:
        """Whether these, at the end of a step, have the same bits as in the first run."""
        sums, k = torch.stack([_sum_of_bits(t) for t in tensors]), self._step
        self._step += 1
        if k == len(self._sums):
            self._sums.append(sums)
            return True
        return torch.equal(sums, self._sums[k])

    def _drop(self, numbers: range) -> None:
        for number in numbers:
            self._things.pop(number, None)

    def put(self, things: Any) -> int:
        number = next(self._numbers)
        self._things[number] = things
        return number

    def take(self, number: int) -> Any:
        return self._things.pop(number)


def _sum_of_bits(tensor: Tensor) -> Tensor:
    """A number that differs if any bit differs, or the order of values: up to chance."""
    flat = tensor.detach().reshape(-1)
    size = flat.element_size()
    whole = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}[size]
    # mixed with its place before the sum: equal numbers would cancel, those of floats above all
    x = flat.view(whole).long() ^ (torch.arange(1, len(flat) + 1, device=flat.device) * MIX[0])
    x = (x ^ (x >> 29)) * MIX[1]
    return (x ^ (x >> 32)).sum()


@contextmanager
def no_segment() -> Iterator[None]:
    """Within it everything is kept, as outside of a segment."""
    before = _NOW.set(None)
    try:
        yield
    finally:
        _NOW.reset(before)


def keep(ctx: Any, things: Any, *tensors: Tensor) -> None:
    """Keep this for the backward pass of a Function, in place of `ctx.save_for_backward`."""
    now, number = _NOW.get(), -1
    ctx.things, ctx.segment = things, None
    if now is not None:
        # weakly, since things may hold a graph, which holds this, and nothing would free them
        ctx.things, ctx.segment = None, ref(now[0])
        number = now[0].put(things) if now[1] else -1
    ctx.save_for_backward(torch.tensor(number), *tensors)


def kept(ctx: Any) -> tuple[Any, tuple[Tensor, ...]]:
    """What `keep` was given, once in a backward pass: things, and tensors."""
    number, *tensors = ctx.saved_tensors
    things = ctx.things
    if ctx.segment is not None:
        segment = ctx.segment()
        assert segment is not None  # the checkpoint holds it as long as there is a graph
        things = segment.take(int(number))
    return things, tuple(tensors)

"""Sums of a series of mixings by kernels, where gradients are wanted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.mixing import Mixing, mixing_arrays
from torchfilm.tools import subnormals
from torchfilm.tools.numba_calls import unavailable
from torchfilm.tools.tangents import no_derivatives
from torchfilm.tools.threads import Shared

# Numbers of all terms of a colony up to which kernels hold them on the way back. Of more they hold
# the root of their number, and go through them once more.
MOST_HELD = 2**24
_added, _pulled = Shared(), Shared()


def may_add_up(u: Tensor) -> bool:
    """Whether kernels may do it, whatever the batch: they add up in another order than torch."""
    return u.device.type == "cpu" and not unavailable()


def add_up(mixing: Mixing, gain: Tensor | None, rows: Tensor, u: Tensor) -> tuple[Tensor, ...]:
    """As `series_sums.sums`; rows: (sums, terms, b or 1)."""
    from torchfilm.kernels.series_sums import add_up as run

    strides, given = _arrays(mixing, u)
    out = torch.empty(len(rows), u.shape[0], u[0].numel(), dtype=torch.float64)
    numbers = _grids(gain, u), rows.contiguous().numpy(), _flat(u), out.numpy()
    with subnormals.as_zero():
        _added(u.shape[0], lambda begin, end: run(begin, end, strides, given, *numbers))
    return tuple(x.view(u.shape) for x in out)


def pull(
    mixing: Mixing, gain: Tensor | None, rows: Tensor, u: Tensor, of_sums: Sequence[Tensor],
    wanted: Sequence[bool],
) -> tuple[Tensor, list[Tensor | None]]:  # fmt: skip
    """The gradient by u, of its shape, and those by the gain, by `stay`, and by what a voxel gets
    from below and above along each axis, of the shape of u, or None where they are not `wanted`."""
    from torchfilm.kernels.series_sums import pull as run

    (strides, given), (_, turned) = _arrays(mixing, u), _arrays(mixing.transposed(), u)
    lengths = np.array([u.shape[dim] for dim, _, _ in mixing.gains], np.int64)
    count, size, axes = u.shape[0], u[0].numel(), len(mixing.gains)
    made = lambda some, *shape: torch.zeros(count if some else 0, *shape, dtype=torch.float64)
    sides = any(wanted[2:])
    out = [made(True, size), made(wanted[0], size), made(wanted[1], size)]
    out.append(made(sides, 2 * axes, size))
    numbers = (
        _grids(gain, u), rows.contiguous().numpy(), _flat(u),
        torch.stack([x.flatten(1) for x in of_sums]).numpy(), _held(rows.shape[1] - 1, size),
        *(x.numpy() for x in out),
    )  # fmt: skip
    with subnormals.as_zero():
        _pulled(
            count, lambda begin, end: run(begin, end, strides, lengths, given, turned, *numbers)
        )
    of_u, *rest, of_sides = out
    found: list[Tensor | None] = [x.view(u.shape) if len(x) else None for x in rest]
    each = of_sides.unbind(1) if sides else [None] * (2 * axes)
    found += [None if x is None else x.reshape(u.shape) for x in each]
    return of_u.view(u.shape), found


def _held(terms: int, size: int) -> int:
    """How many terms are held at once."""
    return max(1, terms if terms * size <= MOST_HELD else math.isqrt(terms) + 1)


def _arrays(mixing: Mixing, u: Tensor) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """The strides, and P as kernels take it."""
    shape: Any = tuple(u.shape[1:])
    with no_derivatives():
        strides, *rest = mixing_arrays(mixing, shape, mixing.colonies)
    return strides, tuple(rest)


def _grids(gain: Tensor | None, u: Tensor) -> Any:
    if gain is None:
        return np.empty((0, u[0].numel()))
    return _flat(gain.expand(-1, *u.shape[1:]))


def _flat(value: Tensor) -> Any:
    return value.detach().flatten(1).contiguous().numpy()

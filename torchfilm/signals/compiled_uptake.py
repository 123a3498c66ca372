"""Transport of a signal together with what cells do to it, by compiled kernels, on the CPU where no
gradient is wanted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals.compiled import may_run
from torchfilm.signals.grid import Grid, GridBatch, Shape
from torchfilm.signals.mixing import ABOVE, mixing_arrays, mixing_of, rate_above
from torchfilm.signals.transport_iterative import MAX_ITERATIONS, ROUNDING, TOLERANCE
from torchfilm.signals.transport_operator import Operator
from torchfilm.signals.transport_series import CUT
from torchfilm.tools import subnormals
from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.tangents import both
from torchfilm.tools.threads import Shared

if TYPE_CHECKING:
    from torchfilm.signals.joint import JointTransport
    from torchfilm.signals.uptake import Eaters

# λΔt up to which a colony takes the series; each iteration of uptake needs all of its terms.
EVENTS = 250.0


@dataclass(frozen=True, eq=False)
class CompiledUptake:
    """An operator in arrays as `kernels.uptake.eat` takes them."""

    mixing: tuple[np.ndarray, ...]
    rate: np.ndarray
    gained: np.ndarray
    symmetric: bool
    cut: float

    @cached_property
    def shared(self) -> Shared:
        return Shared()


def compiled_uptake(operator: Operator, shape: Shape) -> CompiledUptake | None:
    """The operator for kernels, or None where they may not run it."""
    gain = operator.gain
    numbers = [operator.loss, *(x for a in operator.axes for x in (a.up, a.down))]
    if not may_run(*numbers, *([] if gain is None else [gain])):
        return None
    fastest = operator.loss.flatten(1).amax(1)
    rate = rate_above(fastest)
    mixing = mixing_of(operator, rate.reshape(-1, 1, 1, 1))
    count = max(rate.numel(), mixing.colonies)
    none = torch.zeros(0, operator.loss[0].numel(), dtype=torch.float64)
    more = none if gain is None else gain.expand(-1, *shape).flatten(1)
    return CompiledUptake(
        mixing_arrays(mixing, shape, count),
        np.ascontiguousarray(rate.expand(count).numpy()),
        np.ascontiguousarray(more.numpy()),
        operator.symmetric,
        torch.finfo(operator.dtype).eps * CUT,
    )


def eat(
    eaters: Eaters, grid: Grid, kernels: Sequence[CompiledUptake], field: Tensor, found: Tensor,
    close: float, most: int,
) -> tuple[Tensor, ...]:  # fmt: skip
    """As `uptake.solve`, from the same arguments: end, amount, iterations and failed."""
    from torchfilm.kernels.uptake import eat as run

    f64 = torch.float64
    end, amount = torch.empty_like(field), torch.empty_like(found)
    counted = torch.zeros(eaters.groups.size, dtype=torch.int64)
    failed = torch.zeros(eaters.groups.size, dtype=torch.bool)
    of_cells = (eaters.volume, eaters.greatest, eaters.half, eaters.gain, found)
    volume, greatest, half, gain, at_start = (as_array(x, f64) for x in of_cells)
    node, weight = eaters.stencil.arrays
    source = as_array(field, field.dtype)
    # far enough below the last bit of the field; what cells take it does not concern
    tolerance = max(TOLERANCE, torch.finfo(field.dtype).eps / 8)
    with subnormals.as_zero():
        for one, batch in zip(kernels, grid.batches, strict=True):
            numbers = ABOVE, one.cut, EVENTS, tolerance, ROUNDING, MAX_ITERATIONS
            given = (
                batch.starts.numpy(), batch.colonies.numpy(), eaters.groups.ends, *one.mixing,
                one.rate, one.symmetric, one.gained, node, weight, eaters.fed.numpy(), volume,
                greatest, half, gain, at_start, eaters.stencil.voxel_volume, eaters.dt,
                (close, most, numbers),
                source, end.numpy(), amount.numpy(), counted.numpy(), failed.numpy(),
            )  # fmt: skip
            one.shared(batch.starts.numel(), partial(_run, run, given))
    return end, amount, counted, failed


def _run(kernel: Callable[..., object], given: tuple[object, ...], begin: int, end: int) -> None:
    kernel(begin, end, *given)


def move(
    joint: JointTransport, released: Tensor, mean: Tensor, far: list[np.ndarray | None]
) -> tuple[Tensor, ...]:
    """As `JointTransport.moved`, from the same arguments. far: by batch of grids, (b,) bool, which
    took backward Euler before; it is added to."""
    from torchfilm.kernels.joint import move as run

    f64, field = torch.float64, joint.field
    end = torch.empty(field.numel(), dtype=f64)
    at_end, average, taken = (torch.empty(released.shape, dtype=f64) for _ in range(3))
    of_cells = (as_array(x, f64) for x in (released, mean, joint.found))
    numbers = (
        joint.fed.numpy(), *of_cells, joint.stencil.voxel_volume, joint.dt, joint.finest,
        _limits(joint), as_array(field, field.dtype), end.numpy(), at_end.numpy(), average.numpy(),
        taken.numpy(),
    )  # fmt: skip
    with subnormals.as_zero():
        for k, (one, batch) in enumerate(zip(joint.operators, joint.grid.batches, strict=True)):
            # a tensor where torch took the last pass
            far[k] = np.zeros(batch.starts.numel(), bool) if far[k] is None else np.asarray(far[k])
            given = *_grids(joint, one, batch), *numbers, far[k], joint.turned.numpy()
            one.shared(batch.starts.numel(), partial(_run, run, given))
    return end, at_end, average, taken


def move_turned(
    joint: JointTransport, released: Tensor, mean: Tensor, average: Tensor,
    far: list[np.ndarray | None],
) -> tuple[Tensor, ...]:  # fmt: skip
    """The tangents of what `move` gives, where some of the field, of what is found, of what is
    released and of the means carry tangents. average, far: as `move` gave them."""
    from torchfilm.kernels.joint import move_turned as run

    f64 = torch.float64
    field, moves = both(joint.field)
    given, dgiven = both(released)
    guess, dguess = both(mean)
    turned = lambda x, like: as_array(torch.zeros_like(like) if x is None else x, f64)
    end = torch.empty(field.numel(), dtype=f64)
    at_end, there, taken = (torch.empty(given.shape, dtype=f64) for _ in range(3))
    numbers = (
        joint.fed.numpy(), as_array(given, f64), as_array(guess, f64), turned(dgiven, given),
        turned(dguess, guess),
        average.numpy(), joint.stencil.voxel_volume, joint.dt, _limits(joint),
        as_array(field, field.dtype), turned(moves, field),
    )  # fmt: skip
    out = end.numpy(), at_end.numpy(), there.numpy(), taken.numpy()
    with subnormals.as_zero():
        for k, (one, batch) in enumerate(zip(joint.operators, joint.grid.batches, strict=True)):
            arrays = *_grids(joint, one, batch), *numbers, far[k], *out
            one.shared(batch.starts.numel(), partial(_run, run, arrays))
    return end, at_end, there, taken


def _limits(joint: JointTransport) -> tuple[object, ...]:
    """The settings of `kernels.uptake.carry_once`."""
    tolerance = max(TOLERANCE, torch.finfo(joint.field.dtype).eps / 8)
    return ABOVE, joint.operators[0].cut, EVENTS, tolerance, ROUNDING, MAX_ITERATIONS


def _grids(joint: JointTransport, one: CompiledUptake, batch: GridBatch) -> tuple[object, ...]:
    """What kernels take first: the grids of a batch, their operator, and where cells meet them."""
    return (
        batch.starts.numpy(), batch.colonies.numpy(), joint.groups.ends, *one.mixing, one.rate,
        one.symmetric, one.gained, *joint.stencil.arrays,
    )  # fmt: skip

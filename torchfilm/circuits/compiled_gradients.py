"""Gradients through stiff circuits that are compiled: the whole derivative of a step.

What a cell comes to depends on few numbers: its variables at the start, and the values that it
reads. Its derivative by each of them is one tangent. All of them together take less time than
torch's graph of every operation of the step, and less memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled import packed
from torchfilm.circuits.rosenbrock import RosenbrockReport
from torchfilm.tools.tangents import refuse_second

if TYPE_CHECKING:
    from torchfilm.circuits.compiled_stiff import CompiledTangents

# Numbers that a cell may depend on: with more of them torch's graph is as fast in some thousand
# cells. Each of them takes another run of the steps.
MOST_DIRECTIONS = 64
# Cells times directions that are worked on at once, for the sake of memory.
AT_ONCE = 1 << 17

# dt, rtol, atol
Settings = tuple[float, float, float]


def moving(columns: Sequence[str], values: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The values by which a circuit may be differentiated: those of cells and signals always, so
    that one compiled form serves all steps of a run; constants where they require a gradient."""
    always = {n for n in columns if not n.startswith("p.") and values[n].is_floating_point()}
    return tuple(n for n, x in values.items() if x.requires_grad or n in always)


def rodas3(
    compiled: CompiledTangents, values: Mapping[str, Tensor], start: Tensor, settings: Settings
) -> tuple[Tensor, RosenbrockReport]:
    """As `rosenbrock.rodas3`, with gradients by the start (M, V) and by values, (M,) or () by name.
    compiled: with columns only among what moves."""
    names = tuple(n for n in compiled.moving if values[n].requires_grad)
    report = torch.zeros(3, len(start), dtype=torch.int64)
    given = [values[n] for n in names]
    end = _Step.apply(compiled, names, values, settings, report, start, *given)
    return end, RosenbrockReport(*report)


class _Step(torch.autograd.Function):
    """From the start and the values of these names to the end, (M, V)."""

    @staticmethod
    def forward(ctx, compiled, names, values, settings, report, start: Tensor, *given: Tensor):
        of_start = start.shape[1] if ctx.needs_input_grad[5] else 0
        end, slopes, steps = _slopes(compiled, names, values, settings, start, of_start)
        report.copy_(steps)
        ctx.save_for_backward(slopes)
        ctx.of_start, ctx.kinds = of_start, [(x.dtype, x.dim()) for x in given]
        return end

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second("the stiff method of circuits", grad)
        (slopes,) = ctx.saved_tensors
        found = torch.zeros(slopes.shape[:2], dtype=slopes.dtype)
        # in the order of the variables, which fixes the bits
        for slope, above in zip(slopes.unbind(2), grad.to(slopes.dtype).unbind(1), strict=True):
            # a cell that has failed may have infinite ones, of which none is asked for
            found = found + torch.where(above == 0, 0.0, slope * above)
        of_start, own = found.split([ctx.of_start, len(found) - ctx.of_start])
        of_values = [
            (x if dim else x.sum()).to(dtype)
            for x, (dtype, dim) in zip(own, ctx.kinds, strict=True)
        ]
        by_start = of_start.t().to(grad.dtype) if ctx.of_start else None
        return None, None, None, None, None, by_start, *of_values


def _slopes(
    compiled: CompiledTangents, names: Sequence[str], values: Mapping[str, Tensor],
    settings: Settings, start: Tensor, of_start: int,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """The end (M, V); its derivatives (D, M, V), by so many variables at the start and then by the
    values of these names; and the report (3, M)."""
    count, size = start.shape
    still = {n: x.detach() for n, x in values.items()}
    wide = {n: still[n].to(torch.float64).expand(count) for n in compiled.columns}
    columns, numbers = packed(wide, compiled.columns, count), packed(still, compiled.numbers)
    first = start.detach().to(torch.float64)
    turned = [compiled.moving.index(n) for n in names]
    slopes = torch.zeros(of_start + len(turned), count, size, dtype=torch.float64)
    for k in range(of_start):
        slopes[k, :, k] = 1.0
    at, report = first.clone(), torch.zeros(3, count, dtype=torch.int64)
    some = max(AT_ONCE // max(count, 1), 1)
    for low in range(0, len(slopes), some):
        moved = slopes[low : low + some]
        many = len(moved)
        turning = np.zeros((max(len(compiled.moving), 1), many, count))
        for k in range(max(low, of_start), low + many):
            turning[turned[k - of_start], k - low] = 1.0
        ends, reports = first.repeat(many, 1), report.new_zeros(3, many * count)
        compiled.run_steps(
            (ends, moved.view(-1, size), np.tile(columns, many), turning.reshape(-1, many * count)),
            (numbers, np.zeros(1)), settings, start.dtype, reports,
        )  # fmt: skip
        at, report = ends[:count], reports[:, :count]
    return at.to(start.dtype), slopes, report

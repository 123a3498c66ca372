"""Divisions by compiled kernels: the same, to the bit, as `division` has them by torch."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchfilm.distributions import Uniform
from torchfilm.resolver import Resolved
from torchfilm.state import State
from torchfilm.tools.numba_calls import as_array, column_types, in_numpy, kernels_loaded
from torchfilm.tools.random import counters
from torchfilm.tools.tangents import has_tangent, tracked

IDS = ("colony", "uid", "parent", "next_uid", "stream")  # as `kernels.divisions.divide` takes them
MADE = ("uid", "parent", "next_uid", "position", "axis", "length")  # and what it returns
MADE_OF_CELLS = frozenset(MADE)
KEPT = ("colony", "radius")  # what daughters have as their parents, beside the fields
# With what daughters begin: a number, or an even draw: its purpose, low, high.
Drawn = tuple[str, float, float]


def can_divide(state: State, share: Tensor, axis_noise: Resolved) -> bool:
    """Whether kernels may divide cells of this state: no derivative is wanted, and all types are
    known to them."""
    if not kernels_loaded(share) or axis_noise.value is None or axis_noise.types is not None:
        return False
    given = state.cell_columns().values()
    types = column_types()
    return all(x.dtype in types for x in given) and not tracked(*given, share, axis_noise.value)


def evenly_drawn(value: Resolved | None) -> Drawn | None:
    """How a value is drawn, evenly between the same two numbers for all cells; None where it is
    not."""
    if value is None or value.draw is None:
        return None
    kind, part = value.draw.parts[0]
    if kind is not None or isinstance(part, Resolved) or type(part[0]) is not Uniform:
        return None
    low, high = (part[1][name].value for name in Uniform.parameters)
    if any(x is None or x.dim() or x.requires_grad or has_tangent(x) for x in (low, high)):
        return None
    return value.name, float(low), float(high)


def known_number(initial: float, dtype: torch.dtype) -> float | None:
    """A first value as kernels write it into a column of this type; None if that is not certain."""
    if dtype == torch.bool:
        return float(bool(initial))
    number = float(initial)
    exact = dtype.is_floating_point or (number.is_integer() and abs(number) < 2**31)
    return number if exact and number == initial else None


def knows_due(state: State, size: Tensor | None) -> bool:
    """Whether kernels find the cells that are due as torch does: all numbers are of one type."""
    given = [state.length, state.radius]
    if size is not None:
        given += [size, state.fields["division_threshold"]]
    flag = state.fields["divide_flag"].dtype == torch.bool
    return flag and kernels_loaded(state.length) and all(x.dtype == state.dtype for x in given)


def due_rows(state: State, size: Tensor | None, need: float) -> tuple[Tensor | None, int]:
    """The rows (M,) of the cells that divide, None for none, and how many of them are too short:
    see `kernels.divisions.due_rows`. size: (N,), or None where there is no threshold. need: length
    that a cell needs, radii."""
    from torchfilm.kernels import divisions

    fields = state.fields
    none: np.ndarray = np.empty(0, in_numpy(state.dtype))
    real = lambda x: as_array(x, state.dtype)
    criterion = (none, none) if size is None else (real(size), real(fields["division_threshold"]))
    flag = as_array(fields["divide_flag"], torch.bool)
    of_cells = real(state.length), real(state.radius)
    rows, short = divisions.due_rows(flag, *criterion, *of_cells, in_numpy(state.dtype)(need))
    return (torch.from_numpy(rows) if len(rows) else None), short


def divided(
    state: State,
    rows: Tensor,
    share: Tensor,
    noise: Tensor,
    fresh: Mapping[str, float | Drawn],
    caps: float,
) -> tuple[State, Tensor]:
    """The state in which the cells `rows` (M,) are divided, and the rows of their daughters (2 M,),
    first daughters first. share: (M,) or (), of what is conserved. noise: (M,) or (), of the axes.
    fresh: with what daughters begin in some of the fields; in the others with what their parents
    have. caps: what they hold of it, as radii of length."""
    from torchfilm.kernels import divisions

    every = state.cell_columns()
    columns = {n: x.contiguous() for n, x in every.items() if n not in MADE_OF_CELLS}
    total, types = state.cells + rows.numel(), column_types()
    new = {n: torch.empty((total, *x.shape[1:]), dtype=x.dtype) for n, x in columns.items()}
    noise_key = counters(state.seed, state.step, "Division.axis_noise")
    places: list[int] = []
    numbers: list[float] = []
    for name, x in columns.items():
        begin, kind, key, of_range = fresh.get(name), divisions.COPY, noise_key, (0.0, 0.0)
        if isinstance(begin, tuple):
            purpose, low, high = begin
            kind, of_range = divisions.UNIFORM, (low, high)
            key = counters(state.seed, state.step, purpose)
        elif begin is not None:
            kind, of_range = divisions.NUMBER, (begin, 0.0)
        width = math.prod(x.shape[1:])
        places += (x.data_ptr(), new[name].data_ptr(), width, types[x.dtype], kind, *key)
        numbers += of_range
    array = lambda x, dtype=torch.int64: as_array(x, dtype)
    real = lambda x: as_array(x, state.dtype)
    daughters, of_ids, of_cells = divisions.divide(
        array(rows),
        (array(state.position, torch.float64), real(state.axis), real(state.length),
         real(state.radius)),
        tuple(array(getattr(state, n)) for n in IDS),
        real(share.reshape(-1)), real(noise.reshape(-1)), caps,
        np.array(noise_key), np.array(places).reshape(len(new), -1),
        np.array(numbers).reshape(len(new), 2),
    )  # fmt: skip
    found = zip(MADE, map(torch.from_numpy, (*of_ids, *of_cells)), strict=True)
    kept = {n: new.pop(n) for n in KEPT}
    made = state.replace(**dict(found), **kept).with_fields(**new)
    return made, torch.from_numpy(daughters)

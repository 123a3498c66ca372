"""A step of stiff circuits by kernels, from the columns of a state to those of the next: gathered
from where they lie, stepped, and stored where they belong, without torch in between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled import WORTH_A_THREAD
from torchfilm.circuits.compiled_stiff import CompiledCircuit, limits
from torchfilm.circuits.dilution import Start
from torchfilm.tools import checks
from torchfilm.tools.tangents import tracked

if TYPE_CHECKING:
    from torchfilm.circuits.run import CircuitCells


@dataclass(frozen=True, eq=False)
class Changes:
    """What a step makes of N cells, which each circuit fills in for its own: concentrations of the
    species (S, N); amounts given to the pools of each of `signals`, and to its reservoir if there
    is one, conc·µm³ (E, N); steps (N,) int64."""

    species: Tensor
    signals: Sequence[str]
    given: Tensor
    back: Tensor
    steps: Tensor

    @staticmethod
    def of(start: Start, signals: Sequence[str], reservoir: bool, whole: bool) -> Changes:
        """Nothing given so far, no steps. whole: the circuits will fill in all cells."""
        dtype, count = start.half.volume.dtype, len(start.half.volume)
        shape = len(start.fields), count
        species = torch.empty(shape, dtype=dtype)
        if not whole:
            torch.stack(list(start.kept().values()), out=species)
        given = torch.zeros(len(signals), count, dtype=dtype)
        back = torch.zeros_like(given) if reservoir else given[:0]
        return Changes(species, signals, given, back, torch.zeros(count, dtype=torch.int64))


def readings(cells: CircuitCells, start: Start, dt: float) -> dict[str, Tensor] | None:
    """What these cells' compiled circuit reads, by name: columns (N,) and numbers (). None where
    kernels do not step it."""
    compiled = cells.compiled
    if not isinstance(compiled, CompiledCircuit) or cells.by_torch or dt == 0:
        return None
    found = compiled.sources(cells, {"pool": cells.pool, "away": cells.in_reservoir})
    begin = (*start.fields.values(), start.half.before, *(cells.signals[n] for n in cells.given))
    return None if tracked(*begin, *found.values()) else found


def advance(
    cells: CircuitCells, start: Start, values: Mapping[str, Tensor], dt: float, rtol: float,
    atol: float, into: Changes,
) -> np.ndarray:  # fmt: skip
    """The circuit over dt hours in the cells `cells.rows` (M,) from `start`, with these `readings`.
    Returns the status of each, (M,), as `rosenbrock` has it."""
    from torchfilm.kernels.columns import WORDS, gather, store

    compiled, half = cells.compiled, start.half
    assert isinstance(compiled, CompiledCircuit)
    count, size, begin = len(cells.rows), len(compiled.equations.variables), len(start.fields)
    columns = {n: _known(values[n]) for n in compiled.columns}
    found = {f"s.{n}": cells.signals[n] for n in cells.given}
    row = partial(_row, cells=len(half.volume))
    table: list[int] = []
    for k, (name, x) in enumerate([*columns.items(), *found.items()]):
        table += row(name, x, 0, k * count, 1)
    rest, factor = len(table) // WORDS * count, half.before.data_ptr()
    for k, (name, x) in enumerate(start.fields.items()):
        table += row(name, x, factor if name in start.diluted else 0, rest + k, size)
    for k, (name, x) in enumerate(found.items(), begin):
        table += row(name, x, 0, rest + k, size)
    for k in range(begin + len(found), size):  # what a reservoir is given and gives
        table += _row("", None, 0, rest + k, size)
    memory = np.empty(rest + size * count)
    at, rows = memory[rest:].reshape(count, size), cells.rows.numpy()
    each = memory[:rest].reshape(-1, count)  # columns, then signals at the start
    report = np.zeros((3, count), np.int64)
    given = (each, compiled.numbers_of(values), *limits(dt, rtol, atol, half.after.dtype), *report)
    pool = half.volume if cells.pool is None else cells.pool
    ends = (
        at, each[len(columns) :], pool.numpy(), half.after.numpy(), start.diluted_mask,
        np.array([into.signals.index(n) for n in cells.given], np.int64), report,
        into.species.numpy(), into.given.numpy(), into.back.numpy(), into.steps.numpy(),
    )  # fmt: skip
    places, run = np.array(table, np.int64).reshape(-1, WORDS), compiled.module.run

    def work(low: int, high: int) -> None:
        gather(low, high, rows, places, memory)
        run(low, high, at, *given)
        store(low, high, rows, *ends)

    compiled.run(count, WORTH_A_THREAD, work)
    return report[2]


@cache
def _types() -> dict[torch.dtype, int]:
    from torchfilm.kernels import columns

    return {
        torch.float32: columns.FLOAT32, torch.float64: columns.FLOAT64, torch.int64: columns.INT64,
        torch.int32: columns.INT32, torch.bool: columns.BOOL,
    }  # fmt: skip


def _known(x: Tensor) -> Tensor:
    """A column of a type that `gather` knows."""
    return x if x.dtype in _types() else x.double()


def _row(
    name: str, column: Tensor | None, factor: int, begin: int, step: int, cells: int = 0
) -> tuple[int, ...]:
    """A place, as `gather` takes it, of a column (N,) of this name; None: of zeros."""
    if column is None:
        return 0, 0, 0, factor, begin, step
    if column.shape != (cells,):
        shape, wanted = tuple(column.shape), f"({cells},): one number for each cell"
        raise checks.input_error(f"shape of {name}", shape, wanted)
    return column.data_ptr(), column.stride(0), _types()[column.dtype], factor, begin, step

"""A step of stiff circuits by kernels, from the columns of a state to those of the next: gathered
from where they lie, stepped, and stored where they belong, without torch in between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled import packed
from torchfilm.circuits.compiled_stiff import CompiledStiff, limits
from torchfilm.circuits.dilution import Start
from torchfilm.tools import checks
from torchfilm.tools.numba_calls import column_types
from torchfilm.tools.tangents import tracked


@dataclass(frozen=True, eq=False)
class Changes:
    """What a step makes of N cells, which each circuit fills in for its own: concentrations of the
    species (S, N); amounts given to the pools of each of `signals`, and to its reservoir if there
    is one, conc·µm³ (E, N); steps (N,) int64."""

    species: np.ndarray
    signals: Sequence[str]
    given: np.ndarray
    back: np.ndarray
    steps: np.ndarray

    @staticmethod
    def of(start: Start, signals: Sequence[str], reservoir: bool, whole: bool) -> Changes:
        """Nothing given so far, no steps. whole: the circuits will fill in all cells."""
        volume = start.half.volume.numpy()
        count, dtype = len(volume), volume.dtype
        species = np.empty((len(start.fields), count), dtype)
        if not whole:
            torch.stack(list(start.kept().values()), out=torch.from_numpy(species))
        given = np.zeros((len(signals), count), dtype)
        back = np.zeros_like(given) if reservoir else given[:0]
        return Changes(species, signals, given, back, np.zeros(count, np.int64))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What N cells find: the concentration of each signal, (N,) by name; the pool, (N,) µm³, where
    there is a medium; and the ids of their colonies, (N,)."""

    signals: Mapping[str, Tensor]
    pool: Tensor | None
    colony_id: Tensor


class KernelStep:
    """A stiff circuit in the cells of one type, stepped by kernels.

    exchanged: the signals that it gives and takes. constants: what its names have in every state,
    one number, (), or one for each colony by its id, (B,). Their places are found once, and those
    of all else in every step.
    """

    def __init__(
        self, compiled: CompiledStiff, exchanged: Sequence[str], constants: Mapping[str, Tensor]
    ):
        self.compiled, self.exchanged = compiled, tuple(exchanged)
        known = dict(constants) | {f"own.{n}": x for n, x in compiled.constants.items()}
        read = [*compiled.columns, *compiled.numbers]
        self.constants = {n: known[n] for n in read if n in known}
        self.changing = tuple(n for n in read if n not in known)
        # how many colonies there are values for; 0: for any number
        self.colonies = min((len(x) for x in self.constants.values() if x.dim()), default=0)
        fixed = all(n in known for n in compiled.numbers)
        self._numbers = packed(known, compiled.numbers) if fixed else None

    def may_run(self, start: Start, *read: Tensor) -> bool:
        """Whether no derivative is wanted."""
        constants = self.constants.values()
        return not tracked(*start.fields.values(), start.half.before, *read, *constants)

    def __call__(
        self, rows: Tensor, start: Start, found: Mapping[str, Tensor], around: Surroundings,
        dt: float, rtol: float, atol: float, into: Changes,
    ) -> np.ndarray:  # fmt: skip
        """The circuit over dt hours in the cells `rows` (M,) from `start`. found: what is
        `changing`, by name: columns (N,) and numbers (). Returns the status of each cell, (M,), as
        `rosenbrock` has it."""
        from torchfilm.kernels.columns import gather, store

        compiled, half, count = self.compiled, start.half, len(rows)
        size = len(compiled.equations.variables)
        signals = {f"s.{n}": around.signals[n] for n in self.exchanged}
        places, rest = self._places(start, found, around.colony_id, signals, count)
        numbers = self._numbers
        if numbers is None:
            numbers = packed({**self.constants, **found}, compiled.numbers)
        memory = np.empty(rest + size * count)
        at = memory[rest:].reshape(count, size)
        each = memory[:rest].reshape(-1, count)  # columns, then signals at the start
        report = np.zeros((3, count), np.int64)
        given = (each, numbers, *limits(dt, rtol, atol, half.after.dtype), *report)
        pool = half.volume if around.pool is None else around.pool
        ends = (
            at, each[len(compiled.columns) :], pool.numpy(), half.after.numpy(), start.diluted_mask,
            np.array([into.signals.index(n) for n in self.exchanged], np.int64), report,
            into.species, into.given, into.back, into.steps,
        )  # fmt: skip
        of_cells, run = rows.numpy(), compiled.module.run

        def work(low: int, high: int) -> None:
            gather(low, high, of_cells, places, memory)
            run(low, high, at, *given)
            store(low, high, of_cells, *ends)

        compiled.run(count, work)
        return report[2]

    def _places(
        self, start: Start, found: Mapping[str, Tensor], colony_id: Tensor,
        signals: Mapping[str, Tensor], count: int,
    ) -> tuple[np.ndarray, int]:  # fmt: skip
        """Where `gather` finds what, and how many numbers stand before the variables."""
        compiled, constants = self.compiled, self.constants
        size, begin, cells = len(compiled.equations.variables), len(start.fields), len(colony_id)
        table: list[tuple[int, ...]] = []
        for k, name in enumerate(compiled.columns):
            x = constants.get(name)
            if x is None:
                table.append(_row(name, found[name], 0, k * count, 1, cells))
            else:  # one number, or one for each colony
                by = x.dim() and x.stride(0)
                index = colony_id.data_ptr() if x.dim() else 0
                table.append((x.data_ptr(), by, column_types()[x.dtype], 0, k * count, 1, index))
        rest = (len(compiled.columns) + len(signals)) * count
        for k, (name, x) in enumerate(signals.items(), len(compiled.columns)):
            table.append(_row(name, x, 0, k * count, 1, cells))
        factor = start.half.before.data_ptr()
        for k, (name, x) in enumerate(start.fields.items()):
            by = factor if name in start.diluted else 0
            table.append(_row(name, x, by, rest + k, size, cells))
        for k, (name, x) in enumerate(signals.items(), begin):
            table.append(_row(name, x, 0, rest + k, size, cells))
        for k in range(begin + len(signals), size):  # what a reservoir is given and gives
            table.append((0, 0, 0, 0, rest + k, size, 0))
        return np.array(table, np.int64), rest


def known(x: Tensor) -> Tensor:
    """A column of a type that `gather` knows."""
    return x if x.dtype in column_types() else x.double()


def _row(
    name: str, column: Tensor, factor: int, begin: int, step: int, cells: int
) -> tuple[int, ...]:
    """A place, as `gather` takes it, of a column (N,) of this name."""
    if column.shape != (cells,):
        shape, wanted = tuple(column.shape), f"({cells},): one number for each cell"
        raise checks.input_error(f"shape of {name}", shape, wanted)
    return column.data_ptr(), column.stride(0), column_types()[column.dtype], factor, begin, step, 0

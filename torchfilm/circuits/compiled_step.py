"""A step of stiff circuits by kernels, from the columns of a state to those of the next: gathered
from where they lie, stepped, and stored where they belong, without torch in between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.compiled import packed
from torchfilm.circuits.compiled_stiff import CompiledStiff, limits
from torchfilm.circuits.dilution import Start
from torchfilm.tools import checks
from torchfilm.tools.numba_calls import column_types, in_numpy
from torchfilm.tools.tangents import tracked
from torchfilm.tools.threads import Loop


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
        count, dtype = start.half.volume.shape[0], np.dtype(in_numpy(start.half.volume.dtype))
        species = np.empty((len(start.fields), count), dtype)
        if not whole:
            torch.stack(list(start.kept().values()), out=torch.from_numpy(species))
        given = np.zeros((len(signals), count), dtype)
        back = np.zeros_like(given) if reservoir else given[:0]
        return Changes(species, signals, given, back, np.zeros(count, np.int64))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What N cells start with and find, as all circuits of a step read it: the concentration of
    each signal, (N,) by name; the pool, (N,) µm³, where there is a medium; the colonies' ids,
    (B,), and the colony of each cell, (N,)."""

    start: Start
    signals: Mapping[str, Tensor]
    pool: Tensor | None
    colony_id: Tensor
    colony: Tensor

    @cached_property
    def own_colony_id(self) -> np.ndarray:
        """(N,)."""
        return self.colony_id.numpy()[self.colony.numpy()]

    @cached_property
    def highest(self) -> int:
        """Of the colonies' ids."""
        return int(self.colony_id.max())

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """For `store`: the pool, and by which growth multiplies concentrations, (N,) each."""
        half = self.start.half
        return (half.volume if self.pool is None else self.pool).numpy(), half.after.numpy()

    @cached_property
    def cells(self) -> int:
        return self.start.half.before.shape[0]

    @cached_property
    def species(self) -> np.ndarray:
        """Where `gather` finds the species, (S, WORDS)."""
        start, factor = self.start, self.start.half.before.data_ptr()
        each, own = start.fields.items(), start.diluted
        return _table([_row(n, x, self.cells, factor if n in own else 0) for n, x in each])

    def at(self, signals: Sequence[str]) -> np.ndarray:
        """Where it finds these signals, (E, WORDS)."""
        return _table([_row(f"s.{n}", self.signals[n], self.cells) for n in signals])


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

    @cached_property
    def _places(self) -> np.ndarray:
        """The places of `gather`, with those of the constants: of the columns, of the signals, and
        of the variables; those that a reservoir is given and gives begin as 0."""
        from torchfilm.kernels.columns import WORDS

        columns, size = self.compiled.columns, len(self.compiled.equations.variables)
        places = np.zeros((len(columns) + len(self.exchanged) + size, WORDS), np.int64)
        for k, name in enumerate(columns):
            x = self.constants.get(name)
            if x is not None:
                by = x.stride(0) if x.dim() else 0
                places[k] = x.data_ptr(), by, column_types()[x.dtype], 0, 0
        return places

    @cached_property
    def _by_colony(self) -> list[int]:
        """Which columns have one number for each colony."""
        return [
            k
            for k, n in enumerate(self.compiled.columns)
            if n in self.constants and self.constants[n].dim()
        ]

    @cached_property
    def _by_cell(self) -> list[tuple[int, str]]:
        """Which columns change, and their names."""
        return [(k, n) for k, n in enumerate(self.compiled.columns) if n not in self.constants]

    def may_run(self, *read: Tensor) -> bool:
        """Whether no derivative is wanted by what it reads, or by its constants."""
        return not tracked(*read, *self.constants.values())

    def loop(
        self, rows: Tensor, found: Mapping[str, Tensor], around: Surroundings, dt: float,
        rtol: float, atol: float, into: Changes,
    ) -> tuple[Loop, np.ndarray]:  # fmt: skip
        """What takes the circuit over dt hours in the cells `rows` (M,), ascending; and the status
        of each of them, (M,), as `rosenbrock` has it, when it is done. found: what is `changing`,
        by name: columns (N,) and numbers ()."""
        from torchfilm.kernels.columns import gather, store

        compiled, start, of_cells = self.compiled, around.start, rows.numpy()
        count, size = len(of_cells), len(compiled.equations.variables)
        places, numbers = self._places_of(found, around), self._numbers
        if numbers is None:
            numbers = packed({**self.constants, **found}, compiled.numbers)
        first = len(places) - size  # columns, then signals at the start
        memory = np.empty(len(places) * count)
        each, at = memory[: first * count].reshape(-1, count), memory[first * count :]
        at, columns = at.reshape(count, size), len(compiled.columns)
        report = np.zeros((3, count), np.int64)
        given = (at, each, numbers, *limits(dt, rtol, atol, start.half.after.dtype), *report)
        ends = (
            at, each[columns:], *around.arrays, _mask(tuple(start.fields), tuple(start.diluted)),
            _indices(tuple(into.signals), self.exchanged), report, into.species, into.given,
            into.back, into.steps,
        )  # fmt: skip
        cells, run = around.cells, compiled.module.run

        def part(low: int, high: int) -> None:
            gather(low, high, of_cells, places, first, memory)
            run(low, high, *given)
            store(low, high, of_cells, *ends)

        def work(low: int, high: int) -> None:
            whole = low == 0 and high == cells
            part(*((0, count) if whole else np.searchsorted(of_cells, (low, high)).tolist()))

        compiled.compile(part)
        return Loop(work), report[2]

    def _places_of(self, found: Mapping[str, Tensor], around: Surroundings) -> np.ndarray:
        """Where `gather` finds what, (K, WORDS)."""
        places, species, signals = self._places.copy(), around.species, around.at(self.exchanged)
        begin = len(self.compiled.columns)
        if self._by_colony:
            places[self._by_colony, -1] = around.own_colony_id.ctypes.data
        for k, name in self._by_cell:
            places[k] = _row(name, found[name], around.cells)
        for x in (signals, species, signals):
            places[begin : begin + len(x)] = x
            begin += len(x)
        return places


def known(x: Tensor) -> Tensor:
    """A column of a type that `gather` knows."""
    return x if x.dtype in column_types() else x.double()


def _row(name: str, column: Tensor, cells: int, factor: int = 0) -> tuple[int, ...]:
    """A place, as `gather` takes it, of a column (N,) of this name."""
    if column.shape != (cells,):
        shape, wanted = tuple(column.shape), f"({cells},): one number for each cell"
        raise checks.input_error(f"shape of {name}", shape, wanted)
    by = 1 if column.is_contiguous() else column.stride(0)
    return column.data_ptr(), by, column_types()[column.dtype], factor, 0


def _table(rows: Sequence[tuple[int, ...]]) -> np.ndarray:
    from torchfilm.kernels.columns import WORDS

    return np.array(rows, np.int64).reshape(-1, WORDS)


@lru_cache(64)
def _mask(names: tuple[str, ...], chosen: tuple[str, ...]) -> np.ndarray:
    """Which names are among the chosen ones, bool."""
    return np.array([n in chosen for n in names], bool)


@lru_cache(64)
def _indices(names: tuple[str, ...], chosen: tuple[str, ...]) -> np.ndarray:
    """Where the chosen names stand among all, int64."""
    return np.array([names.index(n) for n in chosen], np.int64)

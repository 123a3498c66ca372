"""Many frames of a results file at once: to read a small one takes as long as a large one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.io.layout import AT_CELLS
from torchfilm.io.parameters import last_steps
from torchfilm.io.reading import dataset_names, read_dataset
from torchfilm.tools.checks import InputError

if TYPE_CHECKING:
    from torchfilm.io.results import Results

MOST_ROWS = 1 << 18  # of the file that are read together, with those between the frames


def spans(results: Results, frames: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """The first row of the cells of each frame, and its number of cells, (K,) each. Raises
    InputError for a frame that the file does not hold whole."""
    low, high = min(frames), max(frames) + 1
    own = np.asarray(frames) - low
    first = read_dataset(results.file, "frames/first_row", slice(low, high))[own]
    counts = read_dataset(results.file, "frames/counts", slice(low, high))[own]
    sizes, rows = counts.sum(1), len(results.file["cells/uid"])
    wrong = (counts < 0).any(1) | (sizes < 0) | (sizes > rows) | (first < 0)
    wrong |= first > rows - sizes  # a sum could exceed the range of numbers
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        raise InputError(f"{results.path} is damaged: frame {frames[k]} has {sizes[k]} cells.")
    return first, sizes


def blocks(results: Results, frames: Sequence[int]) -> Iterator[Block]:
    """The frames in parts, in order: of each the rows lie near each other, and the parameters of
    colonies are the same."""
    if not len(frames):
        return
    first, sizes = spans(results, frames)
    steps = results.steps
    stretch = np.searchsorted(last_steps(results.file), [steps[k] for k in frames])
    begin, low, high = 0, first[0], first[0] + sizes[0]
    part = lambda end: Block(results, frames[begin:end], first[begin:end], sizes[begin:end])
    for k in range(1, len(frames)):
        low, high = min(low, first[k]), max(high, first[k] + sizes[k])
        if high - low > MOST_ROWS or stretch[k] != stretch[k - 1]:
            yield part(k)
            begin, low, high = k, first[k], first[k] + sizes[k]
    yield part(len(frames))


class Block:
    """The cells of some frames, one after the other. frames (K,); which (N,): of them each cell is
    in. first, sizes: the `spans` of the frames."""

    def __init__(
        self, results: Results, frames: Sequence[int], first: np.ndarray, sizes: np.ndarray
    ):
        self.results, self.frames = results, np.asarray(frames)
        self.which = np.repeat(np.arange(len(frames)), sizes)
        within = np.arange(len(self.which)) - np.repeat(sizes.cumsum() - sizes, sizes)
        self._low, self._high = int(first.min()), int((first + sizes).max())
        self._rows = first[self.which] + within - self._low

    def cells(self) -> dict[str, np.ndarray]:
        """As `Results.frame` has them."""
        return self._columns("cells")

    def signals(self) -> dict[str, np.ndarray]:
        """As `Results.signals_at_cells` has them."""
        return self._columns(AT_CELLS)

    def colony_fields(self, place: np.ndarray) -> dict[str, np.ndarray]:
        """The fields per colony, of the colonies at the places (N,) of the cells."""
        group, low, high = "frames/colony", int(self.frames.min()), int(self.frames.max()) + 1
        frame = self.frames[self.which] - low
        return {
            name: read_dataset(self.results.file, f"{group}/{name}", slice(low, high))[frame, place]
            for name in dataset_names(self.results.file, group)
        }

    def _columns(self, group: str) -> dict[str, np.ndarray]:
        rows = slice(self._low, self._high)
        return {
            name: read_dataset(self.results.file, f"{group}/{name}", rows)[self._rows]
            for name in dataset_names(self.results.file, group)
        }

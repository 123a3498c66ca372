"""A progress bar of a run."""

from __future__ import annotations

import math
from typing import Any

from torchfilm.tools import checks

FORM = "{desc} |{bar}| {percentage:3.0f}% {elapsed}<{remaining}{postfix}"


class ProgressBar:
    """Shows how far a run is: doublings of the smallest colony on the way to `cells`, or hours to
    `until`."""

    def __init__(self, label: str, state: Any, cells: int | None, until: float | None):
        try:
            from tqdm.auto import tqdm
        except ImportError as error:
            raise checks.InputError(
                'a progress bar needs tqdm: pip install "torchfilm[app]", or leave progress out.'
            ) from error
        self.cells, self.until = cells, until
        total = math.log2(cells) if cells is not None else float(until or 0)
        self.bar = tqdm(total=total, bar_format=FORM, desc=label, mininterval=0.3)
        self(state)

    def __call__(self, state: Any) -> None:
        self.bar.update(self._done(state) - self.bar.n)
        self.bar.set_postfix_str(f"{state.cells} cells, t = {state.time:.2f} h", refresh=False)

    def _done(self, state: Any) -> float:
        if self.cells is None:
            return min(state.time, self.bar.total)
        smallest = int(state.counts[state.counts > 0].min()) if state.cells else self.cells
        return min(math.log2(max(1, smallest)), self.bar.total)

    def close(self) -> None:
        self.bar.close()


def progress_bar(label: str, state: Any, cells: int | None, until: float | None) -> ProgressBar:
    """A bar for a run that begins at `state`. Needs tqdm (the `app` extra)."""
    return ProgressBar(label, state, cells, until)

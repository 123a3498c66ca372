"""Progress bars: of a run, and of anything that counts. They need tqdm (the `app` extra)."""

from __future__ import annotations

import io
import math
import sys
import time
from html import escape
from typing import TYPE_CHECKING, Any

from torchfilm.tools import checks
from torchfilm.tools.displays import Output, in_notebook

if TYPE_CHECKING:
    from tqdm import tqdm

FORM = "{desc} |{bar}| {percentage:3.0f}% {elapsed}<{remaining}{postfix}"
SECONDS = 0.1  # between two looks at a run; the bar itself is drawn every 0.3 s
LINES = 30.0  # seconds between two lines where stderr is a file, as of a job on a cluster


def wanted(progress: bool | None) -> bool:
    """Whether a bar is shown: True, always; False, never; None, in a notebook and on a terminal."""
    if not (progress is None or isinstance(progress, bool)):
        rule = "True, False, or None, which shows a bar in a notebook and on a terminal"
        raise checks.input_error("progress", progress, rule)
    if progress is None:
        return in_notebook() or (sys.stderr is not None and sys.stderr.isatty())
    return progress


def bar(total: float, label: str, form: str = FORM) -> tqdm:
    """A bar of tqdm: on stderr in a script, in a file a line now and then, as HTML below a cell in
    a notebook. form: as tqdm's `bar_format`. Raises InputError where tqdm is missing."""
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise checks.InputError(
            f"a progress bar needs tqdm: {checks.install('app')}, or give progress=False."
        ) from error
    if in_notebook():
        kind = _notebook_bar(tqdm)
    else:
        kind = tqdm if sys.stderr is not None and sys.stderr.isatty() else _lines(tqdm)
    return kind(total=total, bar_format=form, desc=label, mininterval=0.3)


def _notebook_bar(tqdm: Any) -> Any:
    """The class of bars in a notebook. They need no widgets, and a saved notebook keeps the last
    state of each."""

    class NotebookBar(tqdm):
        def __init__(self, **options: Any):
            self.output = Output()
            # tqdm also ends a line of its own, which nobody should see
            super().__init__(**options, ncols=79, file=io.StringIO())

        def display(self, msg: str | None = None, pos: int | None = None) -> bool:
            # tqdm closes a bar with an empty message
            words = str(self) if msg is None else msg
            if not words:
                return True
            before, _, after = words.rpartition("|")
            value = min(self.n, self.total)
            html = (
                '<div style="font-family:monospace;white-space:pre-wrap">'
                f'{escape(before.split("|")[0])} <progress max="{self.total:g}" value="{value:g}"'
                f' style="vertical-align:middle"></progress>{escape(after)}</div>'
            )
            self.output.show({"text/html": html, "text/plain": words})
            return True

        def clear(self, *args: Any, **options: Any) -> None:
            pass

        def moveto(self, n: int) -> None:
            pass

    return NotebookBar


def _lines(tqdm: Any) -> Any:
    """The class of bars in a file, where a bar cannot be drawn over the last one."""

    class Lines(tqdm):
        def __init__(self, **options: Any):
            self.written, self.last = -math.inf, ""
            super().__init__(**options, ncols=100, file=io.StringIO())

        def display(self, msg: str | None = None, pos: int | None = None) -> bool:
            now = time.perf_counter()
            if msg is None and now - self.written >= LINES:
                self.written = now
                self._write()
            return True

        def close(self) -> None:
            if not self.disable:  # of a bar that is open
                self._write()
            super().close()

        def _write(self) -> None:
            words = str(self)
            if sys.stderr is not None and words != self.last:
                print(words, file=sys.stderr, flush=True)
            self.last = words

        def clear(self, *args: Any, **options: Any) -> None:
            pass

    return Lines


class RunBar:
    """Shows how far a run is: doublings of the smallest colony on the way to `cells`, or hours to
    `until`; with cells, time and speed. It looks at a state now and then, and at the last one."""

    def __init__(self, label: str, state: Any, cells: int | None, until: float | None):
        self.cells, self.until = cells, until
        total = math.log2(cells) if cells is not None else float(until or 0)
        self.bar = bar(total, label)
        self.state, self.first, self.begun = state, state.step, time.perf_counter()
        self.looked = -math.inf
        self(state)

    def __call__(self, state: Any) -> None:
        self.state, now = state, time.perf_counter()
        if now - self.looked >= SECONDS:
            self.looked = now
            self._look(now)

    def _look(self, now: float) -> None:
        state, seconds = self.state, max(now - self.begun, 1e-9)
        words = f"{state.cells} cells, t = {state.time:.2f} h"
        if state.step > self.first:
            words += f", {(state.step - self.first) / seconds:.0f} steps/s"
        self.bar.set_postfix_str(words, refresh=False)
        self.bar.update(self._done(state) - self.bar.n)

    def _done(self, state: Any) -> float:
        if self.cells is None:
            return min(state.time, self.bar.total)
        smallest = int(state.counts[state.counts > 0].min()) if state.cells else self.cells
        return min(math.log2(max(1, smallest)), self.bar.total)

    def close(self) -> None:
        """Show the last state."""
        self._look(time.perf_counter())
        self.bar.close()
        self.state = None

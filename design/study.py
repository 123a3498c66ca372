"""A study: every evaluation of a search. A search resumes from its file with the same results as if
it had never stopped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import torchfilm as tf
from design.data_file import Stamp, stamp
from design.entries import Entry
from design.history import history_of, write_csv
from design.parameters import show_value
from design.reasons import tally
from design.study_file import StudyData, read_study, write_study
from design.study_refusal import refusal
from torchfilm import checks, displays

# the designs that are grown first, by which a study goes on that stopped within them
START_POINTS = "start points"


@dataclass(eq=False, repr=False)
class Study:
    """The evaluations of a search, and the file that keeps them, if any.

    about: what the losses depend on, as plain data; names: of the parameters; streams: of the
    replicates; entries: the batches of the search; finals: its best designs on fresh seeds.
    """

    about: dict[str, Any]
    names: tuple[str, ...]
    streams: tuple[int, ...]
    path: Path | None = None
    entries: list[Entry] = field(default_factory=list)
    finals: list[Entry] = field(default_factory=list)
    # of its file, as it was read or written last
    _stamp: Stamp | None = field(default=None, compare=False, repr=False)

    @property
    def searched(self) -> float:
        """Colonies that the search itself has simulated; one of another size counts as its share
        of the full size."""
        return sum(e.colonies for e in self.entries)

    @property
    def colonies(self) -> float:
        """Colonies simulated so far, with those of the finals."""
        return self.searched + sum(e.colonies for e in self.finals)

    @property
    def seconds(self) -> float:
        """That the colonies took to grow."""
        return sum(e.seconds for e in (*self.entries, *self.finals))

    @property
    def time(self) -> str:
        """How long it took, in words; to choose designs, too, where that took a second or more."""
        choosing = sum(e.choosing for e in self.entries)
        more = f", and {choosing:.0f} s to choose designs" if choosing >= 1 else ""
        return f"{self.seconds:.0f} s{more}"

    @property
    def failed(self) -> int:
        """Colonies that failed, with those of the finals."""
        return sum(len(e.reasons) for e in (*self.entries, *self.finals))

    def full(self) -> list[Entry]:
        """The batches at full size with all replicates. Only their losses are comparable."""
        return [e for e in self.entries if self.is_full(e)]

    def full_goals(self) -> list[tuple[Entry, np.ndarray]]:
        """The batches at full size with all replicates, and the losses of their goals (n, G)."""
        return [(e, e.goals) for e in self.full() if e.goals is not None]

    def is_full(self, entry: Entry) -> bool:
        """Whether a batch was grown to full size with all replicates."""
        return entry.size == 1.0 and entry.replicates == len(self.streams)

    def best(self) -> tuple[np.ndarray, float, np.ndarray] | None:
        """Point (D,), loss and losses (R,) of the best design that was grown to full size, the
        first of equal ones. None before there is one."""
        full = self.full()
        if not full:
            return None
        entry = min(full, key=lambda e: float(e.loss.min()))
        row = int(entry.loss.argmin())
        return entry.points[row], float(entry.loss[row]), entry.losses[row]

    def first(self) -> np.ndarray | None:
        """Point (D,) of the first design, at whatever size it was grown. None before there is
        one."""
        return self.entries[0].points[0] if self.entries else None

    def scored(self, point: np.ndarray) -> np.ndarray | None:
        """Losses (R,) of a design (D,); None for one that was not grown to full size."""
        for entry in self.full():
            for k in np.flatnonzero((entry.points == point).all(1)):
                return entry.losses[k]
        return None

    def table(self, most: int = 20) -> str:
        """The best designs that were grown to full size, the first of equal ones first: loss, its
        spread between replicates, cells, and the values of the parameters. most: rows."""
        text, more = self._rows(most)
        return displays.Text("\n".join(displays.aligned(text) + ([more] if more else [])))

    def history(self, path: str | Path | None = None) -> dict[str, list[Any]]:
        """Every design that was grown, in order, as columns by name, for pandas or a plot: a row
        for each design of each batch, `finals` true of those on fresh seeds.

        size: share of the full size; replicates, and the first of their seeds; colonies: that it
        cost; loss, and that of each replicate, `loss_0` …, NaN beyond; goals, `goal_0` …; how many
        replicates failed, and why; cells, a mean; the parameters, those whose name is a column
        already as "parameter NAME". A design that was grown with derivatives has a row for these,
        too. path: of a new CSV file to write.
        """
        found = history_of(self.names, self.entries, self.finals)
        if path is not None:
            write_csv(path, found)
        return found

    def _rows(self, most: int) -> tuple[list[list[str]], str]:
        """The rows of the table, its head first, and a line that says how many are left out."""
        rows = [
            (float(e.loss[k]), e.losses[k], e.cells[k], e.values[k])
            for e in self.full()
            for k in range(len(e.loss))
        ]
        rows.sort(key=lambda row: row[0])
        text = [["loss", "sd", "cells", *self.names]]
        for loss, losses, cells, values in rows[: max(most, 0)]:
            spread = f"{losses.std(ddof=1):.2g}" if len(losses) > 1 else ""
            shown = [show_value(values[name]) for name in self.names]
            text.append([f"{loss:.4f}", spread, f"{cells.mean():.0f}", *shown])
        hidden = len(rows) - (len(text) - 1)
        return text, f"and {hidden} more" if hidden else ""

    def __repr__(self) -> str:
        found = self.best()
        best = "no full-size colony yet" if found is None else f"best loss {found[1]:.4g}"
        return f"Study({self.about['scene']}, {self.colonies:.0f} colonies, {best})"

    def _repr_html_(self) -> str:
        (head, *rows), more = self._rows(5)
        return displays.card(
            "Study",
            displays.pairs(self._facts()),
            displays.table(rows, head) if rows else "",
            displays.lines(more),
        )

    @property
    def info(self) -> str:
        """What was searched, how far it has come, and what it found: a line for each."""
        return displays.Text("\n".join(f"{name:<11} {words}" for name, words in self._facts()))

    def _facts(self) -> list[tuple[str, str]]:
        about, found = self.about, self.best()
        end = [f"{about[n]} {unit}" for n, unit in (("cells", "cells"), ("until", "h")) if about[n]]
        failed = self.failed
        designs = sum(len(e.points) for e in self.entries)
        fresh = sum(e.colonies for e in self.finals)
        grown = f"{self.colonies:.0f} colonies of {designs} designs in {self.time}"
        facts = [
            ("scene", f"{about['scene']}, to {' or '.join(end)}, seed {about['seed']}"),
            ("target", about["target"]),
            ("method", about["method"]),
            *(("parameter", text) for text in about["parameters"]),
            ("grown", grown + (f", {fresh:.0f} of them on fresh seeds" if fresh else "")),
        ]
        if failed:
            reason, times = self.failures()[0]
            facts.append(("failed", f"{failed} colonies; {times} of them: {reason}"))
        if found is not None:
            facts.append(("best loss", f"{found[1]:.4f} in the search"))
        return facts

    def failures(self) -> list[tuple[str, int]]:
        """The reasons of failures and how many colonies each has, as `tally` counts them."""
        entries = (*self.entries, *self.finals)
        return tally(reason for entry in entries for reason in entry.reasons.values())

    def convergence(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """After each batch: colonies simulated, seconds spent and the lowest loss so far (NaN
        before there is one), (K,) each."""
        colonies = np.cumsum([e.colonies for e in self.entries])
        seconds = np.cumsum([e.seconds for e in self.entries])
        lowest = [e.loss.min() if self.is_full(e) else np.inf for e in self.entries]
        best = np.minimum.accumulate(lowest) if lowest else np.empty(0)
        return colonies, seconds, np.where(np.isfinite(best), best, np.nan)

    def add(self, entry: Entry, *, replace: bool = False) -> None:
        """Add a batch, in place of the last one or behind it, and write the file. Raises
        SimulationError where that fails."""
        self.entries[len(self.entries) - replace :] = [entry]
        self._write()

    def add_final(self, entry: Entry) -> None:
        """Add a batch of the finals, and write the file. Raises SimulationError where that
        fails."""
        self.finals.append(entry)
        self._write()

    def _write(self) -> None:
        if self.path is not None:
            data = StudyData(self.about, self.streams, self.entries, self.finals)
            self._stamp = write_study(self.path, data, self._stamp)

    @classmethod
    def new(
        cls, path: Path | None, about: dict[str, Any], names: Sequence[str],
        streams: Sequence[int], known: Entry | None = None,
    ) -> Study:  # fmt: skip
        """A study without evaluations but those that are known, which will be kept at a path, if
        one is given. Raises InputError where there is no such folder."""
        if path is not None and not path.parent.is_dir():
            raise checks.input_error(
                "study", str(path), "in a folder that exists", f"Make {path.parent} first."
            )
        return cls(about, tuple(names), tuple(streams), path, [] if known is None else [known])

    def check(self, about: Mapping[str, Any]) -> None:
        """Raises InputError where this is the study of another search than `about` tells of."""
        names = [n for n in {**about, **self.about} if n != START_POINTS]  # as "start" describes
        differ = [n for n in names if about.get(n) != self.about.get(n)]
        if differ:
            assert self.path is not None
            raise tf.InputError(refusal(self.path, differ, self.about, about))

    @classmethod
    def read(cls, path: str | Path) -> Study:
        """The study in a file. Raises InputError where the file cannot be read."""
        path = checks.file_path("study", path)
        before = stamp(path)
        data = read_study(path)
        names = tuple(data.about["names"])
        parts = data.streams, path, data.entries, data.finals
        return cls(data.about, names, *parts, before)

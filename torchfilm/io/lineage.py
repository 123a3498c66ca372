"""The lineage of a run as a tree: who descends from whom, when each was born and how it ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from torchfilm.io.layout import LINEAGE, LINEAGE_LATER, LINEAGE_NUMBERS
from torchfilm.io.newick import newick, with_ancestors
from torchfilm.io.reading import blaming_file, committed, read_dataset
from torchfilm.io.table import Tables, data_frame, needed
from torchfilm.io.tracks import LOST, Tracks, challenge_tracks, table_tracks
from torchfilm.state import FATES
from torchfilm.tools import checks, tables
from torchfilm.tools.checks import InputError

if TYPE_CHECKING:
    from torchfilm.io.results import Results

COLUMNS = (
    "colony", "cell", "parent", "sister", "founder", "generation", "pole_age", "born", "ended",
    "fate", "birth_length", "end_length", "cell_type",
)  # fmt: skip
RELATIONS = ("mother", "sister", "cousin")


def _column(file: h5py.File, name: str, count: int) -> np.ndarray:
    """The first rows of a table's column; NaN, or −1, where an older file does not have it."""
    column = name.split("/")[-1]
    with blaming_file(file, name):
        lacks = column in LINEAGE_LATER and bool(file) and name not in file
    if lacks:
        return np.full(count, np.nan if column in LINEAGE_NUMBERS else -1)
    return read_dataset(file, name, slice(count))


class Lineage:
    """Every cell of a recorded run, or of a movie (`from_table`, `from_ctc`), as arrays (N,), and
    as a tree.

    colony: id of its colony · cell: its uid, unique within the colony · parent: uid, −1 for
    founders and cells that came from outside · sister: uid of the other daughter of its mother, −1
    where the file has none · generation: divisions since the first of its line in the file ·
    pole_age: divisions since the older of its poles was formed, as far as the file goes back (−1 of
    movies, which do not tell it): 1 is the least of a daughter, and the mother of a dead-end
    channel has her generation · born: h; the founders' is the start of the run, of cells from
    outside when they came, and that of cells which a run found in the middle of another is not
    known, NaN · ended: h, NaN while it lives · fate: "alive", "divided", "removed", "left",
    "lysed", "eroded", "sloughed" or "failed", of a movie also "lost" · birth_length, end_length: of
    the centreline, µm, when it was born and ended; NaN where that hour is NaN, and in files of
    earlier versions but for founders · cell_type: when it ended, or in the last frame while it
    lives; −1 in a scene without types, and of ends in files of earlier versions · founder: uid of
    the first of its line in the file. first_seen, last_seen: h, of its first and last frame, of a
    run when it was born and ended. interval: h, between the frames of a movie; 0 of a run, whose
    births and ends are noted at every step.

    Cells are named by uid, and in a run of several colonies by `colony`, an id, too. `course` reads
    the file, which must be open. Raises InputError for cells and colonies that it does not have.
    """

    def __init__(
        self,
        colony: np.ndarray,
        cell: np.ndarray,
        parent: np.ndarray,
        *,
        source: str | Path,
        begin: float,
        now: float,
        known: Sequence[int],
        results: Results | None = None,
    ):
        """Cells (N,), mothers before daughters, of which nothing else is known. source: for
        messages; begin, now: h, of the first and last frame; known: the ids of all colonies."""
        self._results, self._path, self._known = results, source, list(known)
        self.begin, self.now, self.interval = begin, now, 0.0
        self.colony, self.cell, self.parent = colony, cell, parent
        self.born, self.ended, self.birth_length, self.end_length = (
            np.full(len(cell), np.nan) for _ in range(4)
        )
        self.fate = np.full(len(cell), "alive", dtype="<U8")
        self.cell_type = np.full(len(cell), -1)
        self.first_seen, self.last_seen = np.full(len(cell), begin), np.full(len(cell), now)
        self._order = np.argsort(_pair(colony, cell))
        self._keys = _pair(colony, cell)[self._order]

    @staticmethod
    def of_results(results: Results) -> Lineage:
        """That of a results file."""
        file, size, first = results.file, committed(results.file), results.frame(0)
        births, ends = (
            {n: _column(file, f"lineage/{t}/{n}", size[t]) for n in LINEAGE[t]}
            for t in ("births", "ends")
        )
        steps, times = results.steps, results.times
        last = size["frames"] - 1
        made = Lineage(
            np.concatenate([results.colony_id[first["colony"]], births["colony_id"]]),
            np.concatenate([first["uid"], births["uid"]]),
            np.concatenate([first["parent"], births["parent"]]),
            source=results.path, begin=float(times[0]), now=float(times[last]),
            known=results.colony_id.tolist(), results=results,
        )  # fmt: skip
        founded = np.where((first["parent"] < 0) & (steps[0] == 0), times[0], np.nan)
        then = lambda t: np.interp(t["step"], steps, times)  # all that earlier versions have
        hours = lambda t: np.where(np.isnan(t["time"]), then(t), t["time"])
        made.born = np.concatenate([founded, hours(births)])
        made.first_seen = np.where(np.isnan(made.born), made.begin, made.born)
        lengths = np.where(np.isnan(founded), np.nan, first["length"])
        made.birth_length = np.concatenate([lengths, births["length"]])
        at = made.rows(ends["colony_id"], ends["uid"])
        made.ended[at] = hours(ends)
        if not np.isin(ends["fate"], np.arange(len(FATES))).all():
            raise InputError(
                f"{results.path} is damaged: it has ends of no known fate. Use another copy of it."
            )
        made.last_seen[at] = made.ended[at]
        made.fate[at], made.end_length[at] = np.asarray(FATES)[ends["fate"]], ends["length"]
        living = results.frame(last)
        if "cell_type" in living:
            alive = made.rows(results.colony_id[living["colony"]], living["uid"])
            made.cell_type[alive] = living["cell_type"]
        made.cell_type[at] = ends["cell_type"]
        return made

    @staticmethod
    @checks.known_keywords
    def from_table(
        table: str | Path | Mapping[str, Any],
        *,
        pixel_size: float | None = None,
        length_unit: str | None = None,
        time_unit: str | None = None,
        columns: Mapping[str, str] | None = None,
        width: float | None = None,
        join: bool = False,
        end: float | None = None,
    ) -> Lineage:
        """Cells of a movie: a row for each cell in each frame, of a CSV file or of columns by name.

        Columns: cell, a number; parent, that of the cell from which it descends, −1, 0 (where no
        cell is 0) or nothing where none is known; time; length, which may be missing; colony, a
        number for each movie. columns: their names where they differ. Units stand in the names, as
        in time_min and length_um, or in the arguments. width: µm, where lengths are those of whole
        cells so wide: it is taken off them. join: a track and its only daughter are one cell, of
        the first's number, as where tracking lost a cell for some frames; but not where it is
        shorter than three quarters of what it was, since then it has divided.

        A cell is born in its first frame, if its parent is known, and divides as the first of its
        daughters begins. Without any it is "alive" in the last frame of its colony, and else
        "lost", in its own. end: h, to which all movies went on, also where no cell was left. Raises
        InputError for what is no number, parents that are no cells or begin no earlier than their
        daughters, and two rows of a cell at one time.
        """
        units = tables.Units(pixel_size, length_unit, None, time_unit)
        return Lineage._of_tracks(table_tracks(table, columns or {}, units, width, join, end))

    @staticmethod
    @checks.known_keywords
    def from_ctc(
        path: str | Path, *, interval: float, join: bool = False, end: float | None = None
    ) -> Lineage:
        """Cells in a file of tracks of the Cell Tracking Challenge, such as man_track.txt, without
        their lengths. interval: h between frames. Else as `from_table`."""
        return Lineage._of_tracks(challenge_tracks(path, interval, join, end))

    @staticmethod
    def _of_tracks(tracks: Tracks) -> Lineage:
        made = Lineage(
            tracks.colony, tracks.cell, tracks.parent, source=tracks.source,
            begin=float(tracks.first.min()), now=float(tracks.end.max()),
            known=np.unique(tracks.colony).tolist(),
        )  # fmt: skip
        made.first_seen, made.last_seen = tracks.first, tracks.last
        made.interval = tracks.interval
        known = tracks.parent >= 0
        made.born = np.where(known, tracks.first, np.nan)
        made.birth_length = np.where(known, tracks.birth_length, np.nan)
        mothers = made._mothers
        ended = np.full(len(made), np.inf)
        np.minimum.at(ended, mothers[known], tracks.first[known])
        divided, lost = np.isfinite(ended), tracks.last < tracks.end
        made.ended = np.where(divided, ended, np.where(lost, tracks.last, np.nan))
        made.fate = np.where(divided, "divided", np.where(lost, LOST, "alive")).astype("<U8")
        made.end_length = np.where(divided | lost, tracks.end_length, np.nan)
        return made

    def __len__(self) -> int:
        return len(self.cell)

    def __repr__(self) -> str:
        colonies = len(np.unique(self.colony))
        return f"Lineage({len(self)} cells in {colonies} colonies, {self.now:g} h)"

    def to_pandas(self) -> Any:
        """A pandas.DataFrame with one row per cell and the columns above."""
        return data_frame({name: getattr(self, name) for name in COLUMNS})

    def ancestors(self, cell: int, colony: int | None = None) -> list[int]:
        """The cell's mother, her mother, and so on to the founder, or to the first cell that the
        file has."""
        row, found = self._row(cell, colony), []
        while (mother := self._mothers[row]) >= 0:
            row = int(mother)
            found.append(int(self.cell[row]))
        return found

    def descendants(self, cell: int, colony: int | None = None) -> list[int]:
        """The cell's daughters, then their daughters, and so on."""
        generation, found = [self._row(cell, colony)], []
        while generation:
            generation = [d for row in generation for d in self._daughters.get(row, ())]
            found += generation
        return self.cell[found].tolist() if found else []

    @cached_property
    def founder(self) -> np.ndarray:
        root = np.where(self._mothers < 0, np.arange(len(self)), self._mothers)
        while not np.array_equal(above := root[root], root):  # twice as far up each time
            root = above
        return self.cell[root]

    @cached_property
    def generation(self) -> np.ndarray:
        found, at = np.zeros(len(self), np.int64), self._mothers
        while (later := at >= 0).any():
            found += later
            at = np.where(later, self._mothers[at], -1)
        return found

    @cached_property
    def sister(self) -> np.ndarray:
        return np.where(self._sisters < 0, -1, self.cell[self._sisters])

    @cached_property
    def pole_age(self) -> np.ndarray:
        if self._results is None:
            return np.full(len(self), -1)
        # the daughter with the lower number keeps the end against its mother's axis, the other one
        # the end along it
        ages, lower = np.zeros((2, len(self)), np.int64), self.cell < self.sister
        for generation in range(1, int(self.generation.max(initial=0)) + 1):
            rows = np.flatnonzero(self.generation == generation)
            kept = np.where(lower[rows], 0, 1)
            ages[kept, rows] = ages[kept, self._mothers[rows]] + 1
        return ages.max(0)

    def pairs(self, relation: str) -> np.ndarray:
        """The rows of related cells, (P, 2), each pair once: "mother" and her daughter, "sister"s,
        or first "cousin"s. As in `table.iloc[pairs[:, 0]]`."""
        checks.choice("relation", relation, RELATIONS)
        every = np.arange(len(self))
        if relation == "mother":
            daughters = every[self._mothers >= 0]
            return np.stack([self._mothers[daughters], daughters], 1)
        first = every[self._sisters > every]
        sisters = np.stack([first, self._sisters[first]], 1)
        if relation == "sister":
            return sisters
        of = np.full((len(self), 2), -1)  # the daughters of each cell
        for k in range(2):
            daughters = sisters[self._mothers[sisters[:, k]] >= 0, k]
            of[self._mothers[daughters], k] = daughters
        both = [
            np.stack([of[sisters[:, 0], i], of[sisters[:, 1], j]], 1)
            for i in (0, 1)
            for j in (0, 1)
        ]
        found = np.concatenate(both)
        return found[(found >= 0).all(1)]

    def clone_sizes(
        self, colony: int | None = None, *, time: float | None = None
    ) -> dict[int, int]:
        """How many living cells descend from each founder of a colony, by its uid; 0 for a line
        that has died out. time: h, by default that of the last frame; what was added or removed
        by hand at that hour counts as done, after its frame."""
        when = self.now
        if time is not None:
            when = checks.number("clone_sizes(time)", time, least=self.begin, most=self.now)
        mine = self.colony == self.colony_of_run(colony)
        # a mother ends when her daughters are born; what has an unknown end is gone; a lost cell is
        # there in its last frame
        ends = (self.ended > when) | ((self.fate == LOST) & (self.ended == when))
        there = (self.first_seen <= when) & ((self.fate == "alive") | ends)
        alive = self.founder[mine & there]
        return {int(f): int((alive == f).sum()) for f in np.unique(self.founder[mine])}

    @cached_property
    def living_descendants(self) -> np.ndarray:
        """How many living cells descend from each cell, itself among them, (N,) in the rows of the
        table: of mutations at a cell's birth, this is how many cells carry them."""
        found = (self.fate == "alive").astype(np.int64)
        for generation in range(int(self.generation.max(initial=0)), 0, -1):
            rows = np.flatnonzero(self.generation == generation)
            np.add.at(found, self._mothers[rows], found[rows])
        return found

    def common_ancestor(self, cells: Sequence[int], colony: int | None = None) -> int | None:
        """The youngest cell from which all of these descend, or that is one of them and the
        ancestor of the others; None where they have different founders. The time at which their
        lines part is its `ended`."""
        given = [int(c) for c in np.asarray(cells).reshape(-1)]
        if not given:
            raise checks.input_error("cells", cells, "the numbers of one cell or more")
        lines = [[cell, *self.ancestors(cell, colony)] for cell in given]
        shared = set(lines[0]).intersection(*lines[1:])
        return next((cell for cell in lines[0] if cell in shared), None)

    def course(self, cell: int, colony: int | None = None) -> dict[str, np.ndarray]:
        """The values of the cell and of its ancestors over time: the columns of `Results.table`,
        one row per frame since its founder."""
        colony = self.colony_of_run(colony)
        line = [int(cell), *self.ancestors(cell, colony)]
        if self._results is None:
            raise InputError(f"{self._path} is no results file: take the rows of the cells {line}.")
        frames = committed(self._results.file)["frames"]
        keep = lambda ids, uid: (ids == colony) & np.isin(uid, line)
        return Tables(self._results, self, internals=False)(range(frames), keep)

    def to_newick(self, colony: int | None = None, *, alive: bool = False) -> str:
        """The trees of one colony, or of all, in Newick format: a line for each founder. Nodes are
        named colony0.cell5; the length of a branch is how long the cell lived, h. A cell that was
        there before the file counts from its first frame. alive: only living cells and their
        ancestors."""
        checks.choice("alive", alive, (True, False))
        living = self.fate == "alive"
        kept = with_ancestors(living, self._mothers) if alive else np.ones(len(self), bool)
        roots = [row for row in self._roots(colony) if kept[row]]
        lived = np.where(np.isnan(self.ended), self.last_seen, self.ended) - self.first_seen
        name = lambda row: "colony{}.cell{}".format(*self._node(row))
        below = {row: [d for d in of if kept[d]] for row, of in self._daughters.items()}
        return "".join(f"{newick(row, below, lived, name)};\n" for row in roots)

    def to_networkx(self, colony: int | None = None) -> Any:
        """The trees of one colony, or of all, as a networkx.DiGraph from mother to daughter. Nodes
        are (colony, cell), with the table's columns as attributes."""
        graph = needed("networkx", "tables").DiGraph()
        for row in self._of(colony):
            about = {name: getattr(self, name)[row].item() for name in COLUMNS}
            graph.add_node(self._node(row), **about)
            if self._mothers[row] >= 0:
                graph.add_edge(self._node(self._mothers[row]), self._node(row))
        return graph

    # --- rows ----------------------------------------------------------------------------

    def rows(self, colony: np.ndarray, cell: np.ndarray) -> np.ndarray:
        """The rows of the cells (M,) of a frame, of the colonies with these ids (M,). Raises
        InputError where the file lacks one."""
        wanted = _pair(colony, cell)
        at = np.searchsorted(self._keys, wanted).clip(max=len(self._keys) - 1)
        if len(wanted) and not (len(self._keys) and (self._keys[at] == wanted).all()):
            raise InputError(
                f"{self._path} is damaged: its frames have cells that its lineage lacks."
                " Use another copy of it."
            )
        return self._order[at]

    @cached_property
    def _mothers(self) -> np.ndarray:
        """(N,) the row of each cell's mother, −1 where the file does not have her."""
        wanted = _pair(self.colony, self.parent)
        at = np.searchsorted(self._keys, wanted).clip(max=len(self._keys) - 1)
        known = (self.parent >= 0) & (self._keys[at] == wanted)
        found = np.where(known, self._order[at], -1)
        if (found >= np.arange(len(found))).any():
            raise InputError(f"{self._path} is damaged: a cell descends from a later one.")
        return found

    @cached_property
    def _sisters(self) -> np.ndarray:
        """(N,) the row of the other daughter of each cell's mother, −1 where the file has none."""
        found = np.full(len(self), -1)
        known = np.flatnonzero(self.parent >= 0)
        mother = _pair(self.colony, self.parent)[known]
        order = np.argsort(mother, kind="stable")
        rows, mother = known[order], mother[order]
        same = np.flatnonzero(mother[1:] == mother[:-1])
        found[rows[same]], found[rows[same + 1]] = rows[same + 1], rows[same]
        return found

    @cached_property
    def _daughters(self) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for row, mother in enumerate(self._mothers.tolist()):
            if mother >= 0:
                found.setdefault(mother, []).append(row)
        return found

    def colony_of_run(self, colony: int | None) -> int:
        """The id of a colony of the run; without one, of its only colony. Raises InputError where
        there are several."""
        known = self._known
        if colony is None and len(known) == 1:
            return known[0]
        listed = ", ".join(map(str, known))
        if colony is None:
            raise InputError(
                f"{self._path} has the colonies {listed}: say which, with colony=… (--colonies on"
                " the command line). Cells are numbered within their colony."
            )
        if isinstance(colony, bool) or colony not in known:
            raise checks.input_error("colony", colony, f"one of the run's colonies: {listed}")
        return int(colony)

    def _row(self, cell: int, colony: int | None) -> int:
        key = np.asarray([self.colony_of_run(colony)]), np.asarray([cell])
        if isinstance(cell, bool) or not isinstance(cell, (int, np.integer)):
            raise checks.input_error("cell", cell, "the number of a cell, as in the table")
        at = int(np.searchsorted(self._keys, _pair(*key)[0]))
        if at == len(self._keys) or self._keys[at] != _pair(*key)[0]:
            own = self.cell[self.colony == key[0]]
            rule = f"a cell of colony {int(key[0][0])}" + (
                f": {own.min()} to {own.max()}" if len(own) else ", which has none"
            )
            raise checks.input_error("cell", int(cell), rule)
        return int(self._order[at])

    def _of(self, colony: int | None) -> list[int]:
        """The rows of one colony, or of all."""
        if colony is None:
            return list(range(len(self)))
        return np.flatnonzero(self.colony == self.colony_of_run(colony)).tolist()

    def _roots(self, colony: int | None) -> list[int]:
        return [row for row in self._of(colony) if self._mothers[row] < 0]

    def _node(self, row: int) -> tuple[int, int]:
        return int(self.colony[row]), int(self.cell[row])


def _pair(colony: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """One integer key for each (colony, cell)."""
    return np.asarray(colony).astype(np.int64) << 40 | np.asarray(cell).astype(np.int64)

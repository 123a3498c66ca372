"""What a time course shows of one run: its colonies by condition, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.conditions import condition_names
from torchfilm.pictures.figures import choose_colonies
from torchfilm.pictures.frames import VOLUME, RecordedFrames
from torchfilm.pictures.place_and_time import Columns, known_quantities, unit_at_cells
from torchfilm.tools import checks

BAND = (10.0, 90.0)  # percentiles
BIOVOLUME = "biovolume"
ALL = -1  # the kind of cells that are not told apart
Seen = Mapping[tuple[int, int], np.ndarray]


@dataclass(frozen=True, eq=False)
class RunCourse:
    """times: h, (F,) of the frames. named: the condition of each colony that is drawn, by its
    place. frames: of each what is `_seen`. failed: (F, places) where the colony has failed before.
    units: of the quantities. title: of the picture. several: whether the run has several
    colonies."""

    times: np.ndarray
    named: Mapping[int, str]
    frames: Sequence[Seen]
    failed: np.ndarray
    units: Mapping[str, str]
    type_names: Sequence[str]
    title: str
    several: bool

    @property
    def places(self) -> list[int]:
        return list(self.named)

    @property
    def kinds(self) -> set[int]:
        """The kinds of cells that there are."""
        return {kind for one in self.frames for _, kind in one}

    def values(self, lines: Sequence[tuple[int, int]]) -> np.ndarray:
        """Of cells of some places and kinds, (F, lines, 1 + quantities, 3): see `_seen`. Numbers of
        cells are NaN where there are none."""
        none = np.full((1 + len(self.units), 3), np.nan)
        seen = np.stack([[one.get(line, none) for line in lines] for one in self.frames])
        seen[:, :, 0][seen[:, :, 0] == 0] = np.nan
        return seen


def run_course(
    results: Results,
    name: str,
    quantities: Sequence[str],
    by: str | None,
    conditions: str | Sequence[str] | Mapping[int, str] | None,
    colonies: Sequence[int] | None,
    most: int,
) -> RunCourse:
    """That of a file. name: of the run, "" of the only one. The others: see `time_course`."""
    if len(results) < 2:
        raise checks.InputError(f"a time course needs two frames, and {results.path} has one")
    frames = RecordedFrames(results, range(len(results)))
    names = condition_names(results, conditions, name)
    places, more = _places(frames, names, colonies, most)
    each = known_quantities(results, *(VOLUME if q == BIOVOLUME else q for q in quantities), by=by)
    return RunCourse(
        times=results.times,
        named={place: names[place] for place in places},
        frames=[_seen(cells, known, places, by, quantities) for cells, known in each],
        failed=_failed(results, places),
        units={q: "µm³" if q == BIOVOLUME else unit_at_cells(results, q) for q in quantities},
        type_names=frames[0].type_names,
        title=f"{frames.title}{more}",
        several=len(results.colony_id) > 1,
    )


def _places(
    frames: RecordedFrames, names: Mapping[int, str], colonies: Sequence[int] | None, most: int
) -> tuple[list[int], str]:
    """The places of the colonies to draw, and a note for the title if some are omitted. names: of
    conditions, by place; most: of these at most so many, by default."""
    checks.integer("most", most, least=1)
    ids = frames.results.colony_id
    found, more = choose_colonies(frames.shown(False), ids, colonies, len(ids))
    places = [p for p in found if p in names]
    if not places:
        rule = "names of colonies that are drawn and have cells"
        raise checks.input_error("conditions", list(names.values()), rule)
    each = list(dict.fromkeys(names[p] for p in places))
    if colonies is not None or len(each) <= most:
        return places, more
    kind = "colonies" if len(each) == len(places) else "conditions"
    note = f"first {most} of {len(each)} {kind}"
    return [p for p in places if names[p] in each[:most]], f" ({note}{more and ', ' + more[2:-1]})"


def _failed(results: Results, places: Sequence[int]) -> np.ndarray:
    """(frames, places) where the colony has failed before."""
    counts = results.counts[:, places]
    if counts[-1].all():
        return np.zeros(counts.shape, bool)
    tree = results.lineage()
    failed = np.isin(results.colony_id[list(places)], tree.colony[tree.fate == "failed"])
    living = np.logical_or.accumulate(counts[::-1] > 0)[::-1]  # then or later
    return failed & ~living


def _seen(
    cells: Columns, known: Columns, places: Sequence[int], by: str | None, names: Sequence[str]
) -> dict[tuple[int, int], np.ndarray]:
    """Of the cells of each place and kind their number, three times, and of each quantity the mean,
    and the ends of the band, (1 + quantities, 3), or three times the sum; NaN without cells."""
    kind = np.full(len(cells["uid"]), ALL) if by is None else known[by]
    if kind.dtype.kind not in "iub":
        raise checks.input_error("by", by, "a field of whole numbers, such as 'cell_type'")
    out = {}
    for one in [ALL] if by is None else np.unique(kind).tolist():
        for place in places:
            mine = (cells["colony"] == place) & (kind == one)
            found = np.full((1 + len(names), 3), np.nan)
            found[0] = mine.sum()
            for row, name in enumerate(names):
                values = known[VOLUME if name == BIOVOLUME else name][mine].astype(float)
                if name == BIOVOLUME and len(values):
                    found[1 + row] = values.sum()
                elif len(values):
                    found[1 + row] = values.mean(), *np.percentile(values, BAND)
            out[place, one] = found
    return out

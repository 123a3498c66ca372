"""Cell cycles, from the division that makes a cell to its own: of simulated colonies and of tracked
cells alike, and their statistics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf

FEWEST = 3  # complete cycles of a colony, for statistics of them
EVENT = 7  # numbers of a division in a note, after the time
BITS = 40  # of a uid, beside the place of its colony
CAPS = 4.0 / 3.0  # the caps of a rod have the volume of a length of so many radii
STEADY = 1e-9  # relative variation that rounding can cause
ROUNDING = 1e-6  # of an interval, by which the time of a step may be off
DRAWN = 200  # colonies whose cycles are drawn again

GROUPS = {
    "generation time": ("generation_time_h", "generation_time_cv"),
    "birth length": ("birth_length_um", "birth_length_cv"),
    "division length": ("division_length_um", "division_length_cv"),
    "added length": ("added_length_um", "added_length_cv", "added_length_slope"),
    "growth": ("growth_per_h", "growth_cv"),
    "sisters": ("generation_time_sisters",),
    "mothers": ("generation_time_mothers",),
    "lengths of mothers": ("birth_length_mothers", "growth_mothers"),
}
OF_LENGTHS = ("birth length", "division length", "added length", "growth")


@dataclass(frozen=True)
class CycleStatistics:
    """Which statistics of cell cycles are compared.

    lengths: whether the lengths of cells are known. sisters, mothers, mothers_lengths: whether
    cells are compared with theirs. interval: h between frames, in which simulated cells are seen,
    too. omitted: groups that are left out.
    """

    lengths: bool
    sisters: bool
    mothers: bool
    mothers_lengths: bool
    interval: float = 0.0
    omitted: tuple[str, ...] = ()
    species: ClassVar[tuple[str, ...]] = ()
    ages: ClassVar[bool] = False
    positions: ClassVar[bool] = False

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The names of the statistics, (K,) in all, by what they are about."""
        left_out = {
            *self.omitted,
            *(() if self.lengths else OF_LENGTHS),
            *(() if self.sisters else ("sisters",)),
            *(() if self.mothers else ("mothers",)),
            *(() if self.mothers_lengths else ("lengths of mothers",)),
        }
        return {group: names for group, names in GROUPS.items() if group not in left_out}

    @property
    def names(self) -> tuple[str, ...]:
        """Of all statistics, (K,)."""
        return tuple(name for names in self.groups.values() for name in names)

    def of(self, cycles: CellCycles, colonies: int) -> np.ndarray:
        """The statistics of each of some colonies, (C, K); NaN of those with fewer than 3 complete
        cycles."""
        each = cycles.tables(colonies)
        nothing = np.full(len(self.names), np.nan)
        return np.array([self.of_rows(own) if len(own) >= FEWEST else nothing for own in each])

    @property
    def kinds(self) -> dict[str, tuple[str, ...]]:
        """Each statistic as a group of its own: they differ in their units."""
        return {name: (name,) for name in self.names}

    def of_rows(self, rows: np.ndarray) -> np.ndarray:
        """The statistics of the cycles of one colony, (K,), from rows (M, 8) of
        `CellCycles.tables`; of several such, (…, K) from (…, M, 8)."""
        each = np.ascontiguousarray(np.moveaxis(rows, -1, 0))
        columns = dict(zip(COLUMNS, each, strict=True))
        return np.stack([MEASURES[name](columns) for name in self.names], -1)

    def resampled_spread(self, rows: np.ndarray) -> np.ndarray:
        """The standard deviation of each statistic (K,) when the cycles of one colony are drawn
        again with replacement."""
        count = len(rows)
        drawn = np.random.default_rng(0).integers(count, size=(DRAWN, count))
        return np.nanstd(self.of_rows(rows[drawn]), axis=0)


# of a cycle, its mother's and its sister's; NaN where these are not known
COLUMNS = (
    "time", "birth", "division", "growth", "mother time", "mother birth", "mother growth",
    "sister time",
)  # fmt: skip
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class CellCycles:
    """Complete cell cycles, of cells that were born and divided: (M,) each, colony by colony.

    colony: its place. mother, sister: the rows of hers, −1 where they are not complete, or not
    known. time: h, from birth to division. birth, division: lengths of the centreline, µm, NaN
    where they are not known. radius: µm.
    """

    colony: np.ndarray
    mother: np.ndarray
    sister: np.ndarray
    time: np.ndarray
    birth: np.ndarray
    division: np.ndarray
    radius: np.ndarray

    def tables(self, colonies: int) -> list[np.ndarray]:
        """The `COLUMNS` of the cycles of each colony, (M, 8)."""
        caps = CAPS * self.radius
        ratio = (self.division + caps) / (self.birth + caps)
        rate = np.log(ratio) / np.where(self.time > 0, self.time, np.nan)
        of_mother = lambda values: np.where(self.mother < 0, np.nan, values[self.mother])
        of_sister = np.where(self.sister < 0, np.nan, self.time[self.sister])
        own = (self.time, self.birth, self.division, rate)
        columns = (*own, *map(of_mother, (self.time, self.birth, rate)), of_sister)
        return np.split(np.stack(columns, 1), np.searchsorted(self.colony, range(1, colonies)))

    @staticmethod
    def of_lineage(lineage: tf.Lineage, radius: float) -> CellCycles:
        """Those of tracked cells, or of a run. A cell is born when her mother divides, which may be
        before it is seen. Between frames cells are not seen: they are born and divide half an
        interval, on average, before they are seen to, and grow until then as they do between their
        own first and last frame."""
        mothers, sisters = lineage.pairs("mother").T, lineage.pairs("sister").T
        begin = np.full(len(lineage), np.nan)
        begin[mothers[1]] = lineage.ended[mothers[0]]
        rows = np.flatnonzero(np.isfinite(begin) & (lineage.fate == "divided"))
        colony = np.unique(lineage.colony, return_inverse=True)[1][rows]
        order = np.argsort(colony, kind="stable")
        rows, colony, begin = rows[order], colony[order], begin[rows[order]]
        end, first, last = lineage.ended[rows], lineage.first_seen[rows], lineage.last_seen[rows]
        birth, division = lineage.birth_length[rows], lineage.end_length[rows]
        if lineage.interval:
            caps, half = CAPS * radius, 0.5 * lineage.interval
            seen = np.where(last - first > 1e-9, last - first, np.nan)
            rate = np.log((division + caps) / (birth + caps)) / seen
            birth = (birth + caps) * np.exp(-rate * (first - begin + half)) - caps
            division = (division + caps) * np.exp(rate * (end - half - last)) - caps
        place, mother, sister = np.full((3, len(lineage)), -1)
        place[rows] = np.arange(len(rows))
        mother[mothers[1]] = place[mothers[0]]
        sister[sisters[0]], sister[sisters[1]] = place[sisters[1]], place[sisters[0]]
        widths = np.full(len(rows), radius)
        return CellCycles(colony, mother[rows], sister[rows], end - begin, birth, division, widths)

    @staticmethod
    def of_notes(history: Tensor, interval: float = 0.0) -> CellCycles:
        """Those of simulated colonies, from the `division_note`s of all steps, (T, B, 1 + 7M), as
        frames show them that are `interval` hours apart, the first as the colony begins."""
        notes = history.detach().cpu().double().numpy().transpose(1, 0, 2)
        events = notes[:, :, 1:].reshape(*notes.shape[:2], -1, EVENT)
        colony, step, _ = there = np.nonzero(events[..., 0] > 0)
        of = events[there]
        mother = _key(colony, of[:, 0] - 1.0)
        time, length = notes[colony, step, 0], of[:, 1]
        daughters = np.concatenate([_key(colony, of[:, 3]), _key(colony, of[:, 4])])
        # of each daughter the event of her birth and her sister; of each mother her cycle
        events_of, other = np.tile(np.arange(len(of)), 2), np.roll(daughters, len(of))
        order = np.argsort(daughters)
        at = _places(daughters[order], mother)
        complete = np.flatnonzero(at >= 0)
        at = order[at[complete]]
        event, length_at_birth = events_of[at], np.concatenate([of[:, 5], of[:, 6]])[at]
        cycle = np.argsort(mother[complete])
        found = lambda keys: _taken(cycle, _places(mother[complete][cycle], keys))
        ends = _seen(
            time[event],
            time[complete],
            length_at_birth,
            length[complete],
            of[complete, 2],
            interval,
        )
        sisters = found(other[at])
        return CellCycles(colony[complete], found(mother[event]), sisters, *ends, of[complete, 2])


def _seen(
    begin: np.ndarray, end: np.ndarray, birth: np.ndarray, division: np.ndarray,
    radius: np.ndarray, interval: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """How long cycles take, and lengths at birth and division, as frames show them and `of_lineage`
    takes them. NaN of what no frame shows: of a cell that is in one frame no growth, and so no
    length, of one that is in none nothing."""
    if not interval:
        return end - begin, birth, division
    # h until the next frame
    late = lambda time: np.ceil(time / interval - ROUNDING) * interval - time
    caps, half = CAPS * radius, 0.5 * interval
    span = np.where(end > begin, end - begin, np.nan)
    rate = np.log((division + caps) / (birth + caps)) / span
    time = end + late(end) - begin - late(begin)
    frames = np.round(time / interval)
    moved = lambda length, by: (length + caps) * np.exp(rate * by) - caps
    lengths = (moved(birth, late(begin) - half), moved(division, late(end) - half))
    birth, division = (np.where(frames > 1, x, np.nan) for x in lengths)
    return np.where(frames > 0, time, np.nan), birth, division


def _places(ordered: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Where each key is among ordered ones; −1 where it is not."""
    if not len(ordered):
        return np.full(len(keys), -1)
    at = np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)
    return np.where(ordered[at] == keys, at, -1)


def _taken(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The values at some places; −1 at the place −1."""
    return np.where(at < 0, -1, values[at]) if len(values) else at


def _key(colony: np.ndarray, uid: np.ndarray) -> np.ndarray:
    return (colony << BITS) + uid.astype(np.int64)


@torch.no_grad()
def division_note(state: tf.State) -> Tensor:
    """The time, and the divisions of the last step, (B, 1 + 7M) float64: of each the uid of the
    mother + 1, her length and radius, and the uids and lengths of both daughters; 0 beyond those of
    a colony."""
    time = torch.full((state.colonies, 1), state.time, dtype=torch.float64, device=state.device)
    owners, rows = [], []
    for births in state.births:
        before = births.before
        mother = [getattr(before, name)[births.rows] for name in ("uid", "length", "radius")]
        mother[0] = mother[0] + 1
        owners.append(before.colony_id[before.colony[births.rows]])
        columns = (*mother, *births.uid.chunk(2), *births.length.chunk(2))
        rows.append(torch.stack([c.double() for c in columns], 1))
    if not rows:
        return time
    # colonies that have left since are not looked for
    owner, row = torch.cat(owners), torch.cat(rows)
    ids, order = state.colony_id.sort()
    at = torch.searchsorted(ids, owner).clamp(max=len(ids) - 1)
    here = ids[at] == owner
    place, row = order[at[here]], row[here]
    place, sequence = place.sort(stable=True)
    counts = torch.bincount(place, minlength=state.colonies)
    within = torch.arange(len(place), device=place.device) - (counts.cumsum(0) - counts)[place]
    found = time.new_zeros(state.colonies, int(counts.max()), EVENT)
    found[place, within] = row[sequence]
    return torch.cat([time, found.flatten(1)], 1)


def _known(*columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which cycles have all of these values, (…, M), and how many do, (…,); NaN for fewer than
    two."""
    both = np.logical_and.reduce([np.isfinite(x) for x in columns])
    count = both.sum(-1).astype(float)
    return both, np.where(count > 1, count, np.nan)


def _average(values: np.ndarray) -> np.ndarray:
    """The mean of the known ones, (…, M) -> (…,)."""
    known, count = _known(values)
    return np.where(known, values, 0.0).sum(-1) / count


def _deviations(*columns: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """From the means of those cycles that have all of these values, 0 in others; and how many have
    them."""
    both, count = _known(*columns)
    out = []
    for x in columns:
        own = np.where(both, x, 0.0)
        apart = np.where(both, own - (own.sum(-1) / count)[..., None], 0.0)
        # no more than rounding is nothing
        least = STEADY * np.abs(own).max(-1, initial=0.0)
        steady = (apart * apart).sum(-1) <= count * least * least
        out.append(np.where(steady[..., None], 0.0, apart))
    return out, count


def _variation(values: np.ndarray) -> np.ndarray:
    """The coefficient of variation of a sample (divided by its number less one)."""
    (apart,), count = _deviations(values)
    mean = _average(values)
    return np.sqrt((apart * apart).sum(-1) / (count - 1.0)) / np.where(mean == 0.0, np.nan, mean)


def _correlation(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """0 where one does not vary; NaN of fewer than 3 pairs."""
    (of_x, of_y), count = _deviations(x, y)
    squares = (of_x * of_x).sum(-1) * (of_y * of_y).sum(-1)
    found = (of_x * of_y).sum(-1) / np.sqrt(np.where(squares > 0, squares, 1.0))
    return np.where(count >= FEWEST, found, np.nan)


def _slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of y on x; 0 where x does not vary, NaN of fewer than 3 pairs."""
    (of_x, of_y), count = _deviations(x, y)
    square = (of_x * of_x).sum(-1)
    found = (of_x * of_y).sum(-1) / np.where(square > 0, square, 1.0)
    return np.where(count >= FEWEST, found, np.nan)


MEASURES: dict[str, Callable[[Columns], np.ndarray]] = {
    "generation_time_h": lambda c: _average(c["time"]),
    "generation_time_cv": lambda c: _variation(c["time"]),
    "birth_length_um": lambda c: _average(c["birth"]),
    "birth_length_cv": lambda c: _variation(c["birth"]),
    "division_length_um": lambda c: _average(c["division"]),
    "division_length_cv": lambda c: _variation(c["division"]),
    "added_length_um": lambda c: _average(c["division"] - c["birth"]),
    "added_length_cv": lambda c: _variation(c["division"] - c["birth"]),
    "added_length_slope": lambda c: _slope(c["birth"], c["division"] - c["birth"]),
    "growth_per_h": lambda c: _average(c["growth"]),
    "growth_cv": lambda c: _variation(c["growth"]),
    "generation_time_sisters": lambda c: _correlation(c["time"], c["sister time"]),
    "generation_time_mothers": lambda c: _correlation(c["time"], c["mother time"]),
    "birth_length_mothers": lambda c: _correlation(c["birth"], c["mother birth"]),
    "growth_mothers": lambda c: _correlation(c["growth"], c["mother growth"]),
}

"""The finals of a search: its best designs on fresh seeds.

The lowest of many losses is low partly by luck. So the last part of the budget goes to the best
designs on seeds that the search has not used: half of them drop out after each round, and the
seeds of the others double (successive halving; Karnin, Koren and Somekh, ICML 2013). The winner of
these is lucky on them, too, so that its loss and band come from other seeds, of a last check.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from design.entries import Entry
from design.loss_bands import HOLDS, LEAST, is_mean, loss_band, seeds_to_hold
from design.objective import Objective
from design.parameters import Choice
from design.pareto import nondominated, spread
from design.study import Study
from design.task import Task
from torchfilm import checks

FIRST_STREAM = 1_000_000  # beyond the streams of searches and robustness checks
CHECK_STREAM = 2_000_000  # of the check of the winner
SOUND_STREAM = 3_000_000  # of what shows whether seeds matter
STAGES = SOUND_STREAM, CHECK_STREAM, FIRST_STREAM
CHECK = 1 / 3  # of the colonies of finals with several designs
MOST_SHARE = 0.9  # of a budget
ALIKE = 0.02  # designs that are nearer in every coordinate count as one
SOUNDED = 2  # designs, and fresh seeds of each, that show whether seeds matter
ALIKE_LOSSES = 1e-9  # losses that differ by less, relative to the greater, are one
TESTED = 3  # designs of a batch that may hold it


@dataclass(frozen=True, kw_only=True)
class Finals(metaclass=checks.KnownKeywords):
    """How the best designs of a search are tested on fresh seeds.

    share: of the budget that the test takes, at most 0.9. most: finalists, of a front twice as
    many; fewer where the budget is small. sizes: of the colonies, as shares of the full size, such
    as (1, 2): each seed is grown at each size, and its loss is the worst of them. Raises InputError
    for values that are not allowed.
    """

    share: float = 0.2
    most: int = 8
    sizes: Sequence[float] = (1.0,)

    def __post_init__(self) -> None:
        checks.number("Finals.share", self.share, above=0.0, most=MOST_SHARE)
        object.__setattr__(self, "most", checks.integer("Finals.most", self.most, least=1))
        sizes = checks.vector("Finals.sizes", self.sizes)
        if not sizes or min(sizes) <= 0 or len(set(sizes)) < len(sizes):
            raise checks.input_error(
                "Finals.sizes", self.sizes, "different shares of the full size, such as (1, 2)"
            )
        object.__setattr__(self, "sizes", tuple(sizes))

    def rounds(self, budget: float) -> list[tuple[int, int]]:
        """The finalists of each round and their fresh seeds so far, for a search of `budget`
        colonies; [] where its share is too small for one design."""
        count = self.most
        while count:
            counts = [count]
            while counts[-1] // 2 >= 2:
                counts.append(counts[-1] // 2)
            colonies = self._rows(budget) * (1 if count == 1 else 1 - CHECK)
            seeds = int(colonies / sum(c * 2**r for r, c in enumerate(counts)) + 1e-9)
            if seeds >= LEAST:
                return [(c, seeds * (2 ** (r + 1) - 1)) for r, c in enumerate(counts)]
            count //= 2
        return []

    def check_seeds(self, budget: float) -> int:
        """Fresh seeds of the check of the winner, which no round has used; 0 where one finalist has
        won by the seeds of the search alone."""
        several = any(count > 1 for count, _ in self.rounds(budget))
        return int(CHECK * self._rows(budget) + 1e-9) if several else 0

    def _rows(self, budget: float) -> float:
        """Designs, each on one seed at all sizes, that the share of a budget allows."""
        return self.share * budget / sum(self.sizes)

    def can_hold(self, task: Task, budget: float) -> bool:
        """Whether the budget has the seeds on which a design may hold a loss: those that a quantile
        takes beyond the usual ones come from the share of the finals."""
        seeds = seeds_to_hold(task)[-1]
        fits = seeds * sum(self.sizes) + task.replicates <= budget
        return fits and (seeds <= HOLDS[-1] or seeds <= self._rows(budget))

    def colonies(self, budget: float, certain: bool = False) -> float:
        """Colonies of the finals of a search of `budget` colonies. certain: seeds make no
        difference."""
        if certain:
            return LEAST * sum(self.sizes)
        total, before = self.check_seeds(budget), 0
        for count, seeds in self.rounds(budget):
            total, before = total + count * (seeds - before), seeds
        return total * sum(self.sizes)


@dataclass(frozen=True, eq=False)
class FreshLosses:
    """A design on fresh seeds: losses (S,) of each, the worst of its sizes; loss: what they reduce
    to; band: where that lies with a probability of 90 %, unless the design was `chosen` by these
    losses: among others, or since it holds a wanted loss."""

    losses: np.ndarray
    loss: float
    band: tuple[float, float]
    chosen: bool = False


def fresh_losses(
    task: Task, study: Study, sizes: Sequence[float], point: np.ndarray
) -> FreshLosses | None:
    """Of a design (D,), those of the check where it was checked, else those of the finals; None
    before it was grown on LEAST seeds at all sizes."""
    checked = _fresh(task, study, sizes, point, CHECK_STREAM)
    return checked or _fresh(task, study, sizes, point, FIRST_STREAM)


def _fresh(
    task: Task, study: Study, sizes: Sequence[float], point: np.ndarray, first: int
) -> FreshLosses | None:
    """Of the seeds from `first` on."""
    losses = worst_of_sizes([_tested(study, point, size, first=first) for size in sizes])
    if len(losses) < LEAST:
        return None
    chosen = first == FIRST_STREAM and (len(_known(study)) > 1 or _was_to_hold(study, point))
    return FreshLosses(
        losses, float(task.reduced(losses[None])[0]), loss_band(task, losses), chosen
    )


def _was_to_hold(study: Study, point: np.ndarray) -> bool:
    """Whether a few seeds decided that a design (D,) was grown on those that hold a loss."""
    part = tuple(range(FIRST_STREAM + HOLDS[0], FIRST_STREAM + HOLDS[1]))
    return any(e.streams == part and (e.points == point).all(1).any() for e in study.finals)


def fresh_goals(study: Study, sizes: Sequence[float]) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (F, D) of the designs on which the last finals ended, and their goals on each fresh
    seed (F, S, G), the worst of all sizes. None before there are any."""
    last = [e for e in study.finals if e.size in sizes and e.each_goals is not None][-1:]
    seeds = max((e.streams[-1] + 1 - FIRST_STREAM for e in last), default=0)
    points = _known(study)
    found = [
        (p, worst_of_sizes([_tested(study, p, size, "each_goals") for size in sizes]))
        for p in points
    ]
    whole = [(p, goals[:seeds]) for p, goals in found if len(goals) >= seeds]
    if seeds < LEAST or not whole:
        return None
    return np.array([p for p, _ in whole]), np.array([goals for _, goals in whole])


def worst_of_sizes(each: Sequence[np.ndarray]) -> np.ndarray:
    """Of each seed that all sizes have, (S,) or (S, G)."""
    seeds = min(len(x) for x in each)
    return np.asarray(np.max([x[:seeds] for x in each], axis=0))


def _tested(
    study: Study, point: np.ndarray, size: float, name: str = "losses", first: int = FIRST_STREAM
) -> np.ndarray:
    """The losses of a design (D,) on the fresh seeds from `first` on at a size, (S,); or its
    "each_goals", (S, G)."""
    found = [
        getattr(e, name)[k]
        for e in study.finals
        if e.size == size and getattr(e, name) is not None
        if _stage(e) == first
        for k in np.flatnonzero((e.points == point).all(1))
    ]
    return np.concatenate(found) if found else np.empty(0)


def _stage(entry: Entry) -> int:
    """To which part of the finals a batch belongs, by its first seed."""
    return next(first for first in STAGES if entry.streams[0] >= first)


def _known(study: Study) -> list[np.ndarray]:
    """The designs that were grown on fresh seeds, (D,) each."""
    finals = [e for e in study.finals if _stage(e) != SOUND_STREAM]
    return list({p.tobytes(): p for e in finals for p in e.points}.values())


def is_certain(task: Task, study: Study) -> bool:
    """Whether seeds make no difference to losses: neither to those of designs that were sounded,
    nor to those of any design that the search grew on several."""
    sounded = [x for e in study.finals if _stage(e) == SOUND_STREAM for x in e.losses]
    searched = [x for e in study.full() if e.replicates > 1 for x in e.losses]
    sound = lambda each: [x for x in each if not (x == task.target.failed).any()]
    alike = all(np.ptp(x) <= ALIKE_LOSSES * np.abs(x).max() for x in sound(sounded + searched))
    return alike and len({float(x[0]) for x in sound(sounded)}) >= SOUNDED


def winner(task: Task, study: Study, sizes: Sequence[float]) -> np.ndarray | None:
    """The point (D,) of the design whose band ends lowest: few seeds make a wide band of a mean.
    But few seeds make a low quantile. So elsewhere a design must also be as good as those with
    fewer seeds on the seeds of these. None before a design was grown on fresh seeds."""
    found = ((_fresh(task, study, sizes, p, FIRST_STREAM), p) for p in _known(study))
    known = [(fresh, p) for fresh, p in found if fresh is not None]
    # where every colony fails, a narrow band says nothing; few seeds set no end to a quantile
    ends = lambda x: (
        bool((x[0].losses == task.target.failed).all()), x[0].band[1], x[0].loss,
    )  # fmt: skip
    if not known or is_mean(task):
        return min(known, key=ends)[1] if known else None
    out: tuple[FreshLosses, np.ndarray] | None = None
    for seeds in sorted({len(fresh.losses) for fresh, _ in known}):
        group = [x for x in known if len(x[0].losses) == seeds]
        if out is not None:
            first, most = len(out[0].losses), out[0].loss
            group = [x for x in group if task.reduced(x[0].losses[None, :first])[0] <= most]
        out = min(group, key=ends) if group else out
    return None if out is None else out[1]


@dataclass(frozen=True, eq=False)
class FinalsRun:
    """The finals of one run of a search.

    budget: colonies of the whole search, under each condition; executor, work_items: as in
    `Objective.evaluate`; deadline: of the clock, s, after which no design is tested for its loss.
    What is chosen depends on the study and the budget alone, and what the
    study holds is not grown again. So a stopped run goes on where it was.
    """

    finals: Finals
    task: Task
    study: Study
    budget: float
    executor: Executor | None = None
    work_items: int = 1
    deadline: float = math.inf

    def run(self) -> None:
        """Play all rounds that the budget allows. Several goals have one round, of a front."""
        if self.task.goals:
            self._front()
            return
        if is_certain(self.task, self.study):
            self._grow(self._finalists()[:1], LEAST)
            return
        chosen, wanted = self._finalists(), self.finals.check_seeds(self.budget)
        for count, seeds in self.finals.rounds(self.budget):
            chosen = self._grow(chosen[:count], seeds, kept=wanted * sum(self.finals.sizes))
            chosen = sorted(chosen, key=partial(self._loss, seeds))
        best = winner(self.task, self.study, self.finals.sizes)
        if best is not None and wanted:
            # an earlier run with a smaller budget has spent a part on other designs
            while wanted > LEAST and not self._affords(self._cost(best, wanted, CHECK_STREAM)):
                wanted -= 1
            self._grow([best], wanted, CHECK_STREAM)

    def sound(self) -> bool:
        """Whether seeds make no difference, so that the finals need hardly any colonies: the best
        designs so far are grown on a few fresh ones, where that may save some."""
        saved = self.finals.colonies(self.budget) - self.finals.colonies(self.budget, certain=True)
        done = any(_stage(e) == SOUND_STREAM for e in self.study.finals)
        best = self._finalists()[:SOUNDED]
        if not done and len(best) == SOUNDED and saved > SOUNDED**2 and len(self.finals.sizes) == 1:
            self._grow(best, SOUNDED, SOUND_STREAM)
        return is_certain(self.task, self.study)

    def holds(self, wanted: float) -> bool:
        """Whether one of the best designs, of all and of the last batch, holds a loss on fresh
        seeds: its band ends there. A few seeds decide whether it is tested on more."""
        if not self.finals.can_hold(self.task, self.budget):
            return False
        full, last = self.study.full(), self.study.entries[-1:]
        points: dict[bytes, np.ndarray] = {}
        for entries in (full, [e for e in full if e is last[0]]):
            rows = [(float(e.loss[k]), e.points[k]) for e in entries for k in range(len(e.loss))]
            best = sorted(rows, key=lambda row: row[0])[:TESTED]
            points |= {p.tobytes(): p for loss, p in best if loss <= wanted}
        return any(self._holds(point, wanted) for point in points.values())

    def _holds(self, point: np.ndarray, wanted: float) -> bool:
        for seeds in seeds_to_hold(self.task):
            if time.monotonic() >= self.deadline:
                return False
            if not self._grow([point], seeds) or self._loss(seeds, point) > wanted:
                return False
        found = _fresh(self.task, self.study, self.finals.sizes, point, FIRST_STREAM)
        return found is not None and found.band[1] <= wanted

    def _front(self) -> None:
        """Grow designs from all parts of the front, as many as LEAST seeds of each allow."""
        full = self.study.full_goals()
        if not full:
            return
        points = np.concatenate([e.points for e, _ in full])
        goals = np.concatenate([found for _, found in full])
        front = nondominated(goals)
        room = self.finals.colonies(self.budget) / sum(self.finals.sizes)
        for count in range(min(len(front), 2 * self.finals.most), 0, -1):
            chosen = [points[k] for k in front[spread(goals[front], count)]]
            seeds = int(room / count + 1e-9)
            # an earlier run with a smaller budget has spent a part on other designs
            while seeds >= LEAST and not self._affords(sum(self._cost(p, seeds) for p in chosen)):
                seeds -= 1
            if seeds >= LEAST:
                self._grow(chosen, seeds)
                return

    def _finalists(self) -> list[np.ndarray]:
        """The best designs of the search, no two of them alike."""
        full = self.study.full()
        rows = [(float(e.loss[k]), e.points[k]) for e in full for k in range(len(e.loss))]
        space = self.task.space
        # options of a choice are as different as can be, however many there are
        apart = [
            min(ALIKE, 0.5 / p.levels) if isinstance(p, Choice) else ALIKE for p in space.parameters
        ]
        out: list[np.ndarray] = []
        places: list[np.ndarray] = []
        for _, point in sorted(rows, key=lambda row: row[0]):
            # several points may stand for one design: that of its values
            place = space.point(space.values(point))
            if all((np.abs(place - other) >= apart).any() for other in places):
                out.append(point)
                places.append(place)
                if len(out) == self.finals.most:
                    break
        return out

    def _grow(
        self, points: Sequence[np.ndarray], seeds: int, first: int = FIRST_STREAM, kept: float = 0.0
    ) -> list[np.ndarray]:
        """Grow designs on as many of the fresh seeds from `first` on as they lack, the best first,
        while the budget lasts, less the colonies that are `kept`. Returns those that have been
        grown on all."""
        lacking: dict[tuple[float, int], list[np.ndarray]] = {}
        done, spent = [], 0.0
        for point in points:
            cost = self._cost(point, seeds, first)
            if cost and not self._affords(spent + cost + kept):
                break
            spent += cost
            done.append(point)
            for size in self.finals.sizes:
                n = len(_tested(self.study, point, size, first=first))
                if n < seeds:
                    lacking.setdefault((size, n), []).append(point)
        for (size, known_seeds), group in lacking.items():
            self._add(np.array(group), size, range(first + known_seeds, first + seeds))
        return done

    def _cost(self, point: np.ndarray, seeds: int, first: int = FIRST_STREAM) -> float:
        """Colonies of a design that are lacking to as many fresh seeds."""
        sizes = self.finals.sizes
        known = {size: len(_tested(self.study, point, size, first=first)) for size in sizes}
        return sum(size * max(0, seeds - n) for size, n in known.items())

    def _affords(self, cost: float) -> bool:
        return self.study.colonies / self.task.conditions + cost <= self.budget + 1e-9

    def _add(self, points: np.ndarray, size: float, seeds: range) -> None:
        objective = Objective(self.task if size == 1.0 else self.task.resized(size))
        streams = tuple(seeds)
        found = objective.evaluate(
            points, streams=streams, executor=self.executor, work_items=self.work_items
        )
        self.study.add_final(found.entry(streams, size=size))

    def _loss(self, seeds: int, point: np.ndarray) -> float:
        """On the first fresh seeds, the worst of all sizes."""
        each = worst_of_sizes([_tested(self.study, point, size) for size in self.finals.sizes])
        return float(self.task.reduced(each[None, :seeds])[0])

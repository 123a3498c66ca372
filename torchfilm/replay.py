"""Grow once, replay for all: where nothing that a design changes acts back on growth or motion, the
cells' courses are simulated once, and circuits and signals of any number of designs run on them.

    course = tf.GrowthRecording(scene, streams=range(4))          # grows only as far as it is asked
    replay = tf.Replay(designs, course)                   # `designs`: the same scene with other circuits, one value per colony
    state = replay.seed(256, streams=torch.arange(4).repeat(64))
    state = replay.step(state)                            # as designs.step(state, dt) would, without growth and mechanics
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import BUILT_IN
from torchfilm.scene import Scene, parameters
from torchfilm.state import CELL, PER_CELL, Births, State
from torchfilm.tools import checks
from torchfilm.tools.hashing import digest
from torchfilm.tools.ragged import expand_ranges, offsets

FIRST = -1  # the part of what happens before all effects


@dataclass(frozen=True)
class Split:
    """Which of a scene's effects, by their places in `scene.listed`, move, grow, divide or remove
    cells or drive what does (`growth`); the others only follow. `obstacle`: why the followers
    cannot be run alone, or "" if they can."""

    growth: tuple[int, ...]
    obstacle: str = ""


def split(scene: Scene) -> Split:
    """Which effects of a scene grow the colonies and which only follow, by what they declare to
    read and write.

    Rules are the user's own Python, and what they read and write is known from one trial only: a
    scene with rules is not split.
    """
    everything = tuple(range(len(scene.listed)))
    rules = [e.title for e in scene.listed if e.writes_anything]
    if rules:
        return Split(everything, f"{rules[0]} may read and write anything")
    scene.unchecked(1)  # circuits are tried, so that what they read and write is known
    reads: list[set[str]] = [set() for _ in everything]
    writes: list[set[str]] = [set() for _ in everything]
    wide: dict[int, str] = {}
    for place, part in zip(scene.places, scene.effects, strict=True):
        reads[place] |= {*part.reads(), *part.needs()}
        # what is declared has a first value, and whoever reads that needs it
        writes[place] |= {*part.writes(), *(f.name for f in part.declares(scene.dim))}
        for f in part.declares(scene.dim):
            if f.scope != CELL:
                wide[place] = f.name
    growth = {k for k in everything if writes[k] & set(BUILT_IN)}
    while True:
        wanted = set().union(*(reads[k] for k in growth))
        more = {k for k in everything if writes[k] & wanted} - growth
        if not more:
            break
        growth |= more
    obstacle = "every effect acts on growth or motion" if len(growth) == len(everything) else ""
    for place, name in wide.items():
        if place in growth:
            obstacle = (
                f"{scene.listed[place].title} acts on growth or motion by {name!r}, which is no"
                " quantity of cells"
            )
    if scene.founders.colony is not None:
        obstacle = "its first cells name their colonies, so that these do not start alike"
    return Split(tuple(sorted(growth)), obstacle or _held(scene, sorted(growth)))


def _held(scene: Scene, growth: Iterable[int]) -> str:
    """What among the parameters of growth a recorded course cannot carry, or ""."""
    for path, tensor in (found for k in growth for found in parameters(scene.listed[k])):
        if tensor.dim() == 1:
            return f"{path} differs between colonies and acts on their growth"
        if tensor.requires_grad:
            return f"{path} wants a gradient, which recorded growth does not carry"
    return ""


@dataclass(frozen=True)
class Change:
    """What an effect changed in one step of a course, for its R colonies side by side.

    part: which of the course's effects, or FIRST. counts, next_uid (R,) after it. source: place of
    each cell among its colony's cells before it (N,), or None if these stay. values: what changed,
    by name, (N, …). births: (R,) their number, and the places of first and second daughters within
    their colony, (M,) each; None without.
    """

    part: int
    counts: Tensor
    next_uid: Tensor
    source: Tensor | None
    values: dict[str, Tensor]
    births: tuple[Tensor, Tensor, Tensor] | None


@dataclass(frozen=True)
class GrowthRecordingReport:
    """`status` (B,): 1 where the growth of a colony failed, and `words` by place in the batch."""

    status: Tensor
    words: dict[int, str]
    hint = "Growth and mechanics failed in the recorded course, as they would in a run of their own"

    def reason(self, place: int) -> str:
        return self.words[place]


class GrowthRecording:
    """The growth and motion of some colonies of a scene, without what only follows: grown step by
    step as far as it is asked, and kept.

    scene: any design of it; streams: courses of random numbers, one colony each; seed, dt (h, by
    default the scene's), dtype and device as in `scene.seed` and `simulate`. cells: a colony that
    has as many is not grown on, and is empty from the next step; None: all go on. `GrowthRecording.nbytes`
    tells what it holds. Raises InputError where growth depends on what would only follow.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        streams: Iterable[int],
        seed: int = 0,
        dt: float | None = None,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
        cells: int | None = None,
    ):
        self.scene = GrowthRecording.scene_of(scene)
        self.dt = scene.dt if dt is None else checks.number("dt", dt, above=0.0)
        self.streams, self.cells = tuple(streams), cells
        if len(set(self.streams)) != len(self.streams):
            raise checks.input_error("streams", self.streams, "different whole numbers")
        self.state = self.scene.seed(
            len(self.streams), seed=seed, streams=self.streams, dtype=dtype, device=device
        )
        self.steps: list[list[Change]] = []
        self.failed: dict[int, tuple[int, str]] = {}

    @staticmethod
    def obstacle(scene: Scene) -> str:
        """Why the growth of a scene cannot be kept for all its designs, or "" if it can."""
        return split(scene).obstacle

    @staticmethod
    def scene_of(scene: Scene) -> Scene:
        """The scene without what only follows. Raises InputError where its growth cannot be
        kept."""
        parts = split(scene)
        if parts.obstacle:
            raise checks.InputError(
                f"the growth of this scene cannot be kept for other designs: {parts.obstacle}. Run"
                " the scene itself."
            )
        return Scene(
            *(scene.listed[k] for k in parts.growth),
            name=scene.name,
            dt=scene.dt,
            founders=scene.founders,
        )

    @staticmethod
    def made_of(scene: Scene) -> str:
        """A word that is the same for scenes that grow alike, and for no others. Raises InputError
        where the growth cannot be kept."""
        return _made_of(GrowthRecording.scene_of(scene))

    @property
    def nbytes(self) -> int:
        """Bytes that the kept steps take."""
        return sum(
            x.nbytes
            for step in self.steps
            for c in step
            for x in (c.counts, c.source, *(c.births or ()), *c.values.values())
            if x is not None
        )

    @torch.no_grad()
    def changes(self, step: int) -> list[Change]:
        """What each effect changed in the step after `step` steps; grown now if it has not been."""
        while len(self.steps) <= step:
            self._advance()
        return self.steps[step]

    def _advance(self) -> None:
        state = self.state.replace(births=(), ended=(), reports={})
        noted: list[Change] = []
        full = torch.tensor([s in self.failed for s in self.streams], device=state.device)
        if self.cells is not None and self.steps:
            full = full | (state.counts >= self.cells)
        full = full & (state.counts > 0)
        if bool(full.any()):  # or the quick would fill the memory while the slow are waited for
            kept = state.remove(full.index_select(0, state.colony), "left").replace(ended=())
            noted.append(_change(FIRST, state, kept))
            state = kept
        for part, effect in enumerate(self.scene.effects):
            after = effect.step(state, self.dt)
            if after is not state:
                noted.append(_change(part, state, after))
            state = after
        for report in state.reports.values():
            for place in torch.nonzero(report.status).squeeze(1).tolist():
                self.failed.setdefault(self.streams[place], (state.step, report.reason(place)))
        self.steps.append(noted)
        # counted as `Scene.step` counts
        self.state = state.replace(step=state.step + 1, time=(state.step + 1) * self.dt)


def _change(part: int, before: State, after: State) -> Change:
    """The difference between two states."""
    source = None
    if after.uid is not before.uid:
        source = _sources(before, after)
    values = {}
    for name in (*PER_CELL[1:], *(n for n, f in after.declared.items() if f.scope == CELL)):
        old, new = getattr(before, name), getattr(after, name)
        if new is old or (source is not None and torch.equal(new, old.index_select(0, source))):
            continue
        values[name] = new
    births = None
    if len(after.births) > len(before.births) + 1:
        raise checks.SimulationError(
            "an effect divided cells more than once in one step: such growth cannot be kept for"
            " other designs. Give replay=False."
        )
    if len(after.births) > len(before.births):
        made = after.births[-1]
        start = offsets(after.counts)[:-1]
        owner = after.colony.index_select(0, made.first)
        first, second = (rows - start.index_select(0, owner) for rows in (made.first, made.second))
        births = (torch.bincount(owner, minlength=after.colonies), first, second)
    within = (
        None
        if source is None
        else source - offsets(before.counts)[:-1].index_select(0, after.colony)
    )
    return Change(part, after.counts, after.next_uid, within, values, births)


def _sources(before: State, after: State) -> Tensor:
    """The row that each cell had before, or its parent had, (N,)."""
    key = lambda colony, uid: colony << 40 | uid
    old, order = torch.sort(key(before.colony, before.uid))
    mine, parents = key(after.colony, after.uid), key(after.colony, after.parent.clamp(min=0))
    at = torch.searchsorted(old, mine).clamp(max=max(0, old.numel() - 1))
    was_there = old.index_select(0, at) == mine
    above = torch.searchsorted(old, parents).clamp(max=max(0, old.numel() - 1))
    if bool((~was_there & (old.index_select(0, above) != parents)).any()):
        raise checks.SimulationError(
            "cells came in that no cell of their colony gave birth to: such growth cannot be kept"
            " for other designs. Give replay=False."
        )
    return order.index_select(0, torch.where(was_there, at, above))


class Replay:
    """Designs of a scene on the course of their colonies: `seed` and `step` as those of the scene,
    and the same outcome, without growth and mechanics.

    scene: with the course's own growth, and whatever follows, one value or one per colony. What
    cells ended as is not told (`state.ended` stays empty).
    """

    def __init__(self, scene: Scene, course: GrowthRecording):
        self.scene, self.course, self.dt = scene, course, course.dt
        grown = GrowthRecording.scene_of(scene)
        if _made_of(grown) != _made_of(course.scene):
            raise checks.InputError(
                f"this scene does not grow as the course did: {', '.join(grown.listing())} and its"
                f" founders, instead of {', '.join(course.scene.listing())}. Make a GrowthRecording of this"
                " scene."
            )
        device = course.state.device
        self.streams, self.order = torch.sort(torch.tensor(course.streams, device=device))
        kept = {id(effect) for effect in grown.listed}
        # each effect with its number among those of the course, or None if it only follows
        numbers = iter(range(len(grown.effects)))
        self.parts = [
            (part, next(numbers) if id(scene.listed[k]) in kept else None)
            for k, part in zip(scene.places, scene.effects, strict=True)
        ]
        self.own = [
            f.name
            for part, number in self.parts
            if number is None
            for f in part.declares(scene.dim)
        ]

    def seed(self, colonies: int, *, streams: Sequence[int] | Tensor) -> State:
        """The first state of `colonies` colonies that follow these streams of the course, (B,)."""
        first = self.course.state
        state = self.scene.seed(
            colonies, seed=first.seed, streams=streams, dtype=first.dtype, device=first.device
        )
        strange = sorted(set(state.stream.tolist()) - set(self.course.streams))
        if strange:
            raise checks.input_error(
                "streams", strange[0], f"of the course: {', '.join(map(str, self.course.streams))}"
            )
        return state

    def step(self, state: State) -> State:
        """The state one step later."""
        number = state.step
        place = self.order.index_select(0, torch.searchsorted(self.streams, state.stream))
        changes = {change.part: change for change in self.course.changes(number)}
        state = state.replace(births=(), ended=(), reports={})
        if FIRST in changes:
            state = self._apply(state, changes[FIRST], place)
        for effect, part in self.parts:
            if part is None:
                state = effect.step(state, self.dt)
            elif part in changes:
                state = self._apply(state, changes[part], place)
        if any(step == number for step, _ in self.course.failed.values()):
            state = self._with_failures(state, number)
        return state.replace(step=number + 1, time=(number + 1) * self.dt)

    def _apply(self, state: State, change: Change, place: Tensor) -> State:
        """The state after a change of the course, whose colonies at `place` (B,) ours follow."""
        counts = change.counts.index_select(0, place)
        owner, rows = expand_ranges(offsets(change.counts)[:-1].index_select(0, place), counts)
        taken = {
            name: value.index_select(0, rows)
            for name, value in change.values.items()
            if name not in self.own
        }
        old = state
        if change.source is not None:
            source = change.source.index_select(0, rows) + offsets(state.counts)[:-1].index_select(
                0, owner
            )
            state = state.take(source).replace(next_uid=change.next_uid.index_select(0, place))
        state = state.replace(**{n: taken.pop(n) for n in PER_CELL if n in taken})
        if change.births is None:
            return state.with_fields(**taken)
        number, firsts, seconds = change.births
        mine, at = expand_ranges(
            offsets(number)[:-1].index_select(0, place), number.index_select(0, place)
        )
        start = offsets(counts)[:-1].index_select(0, mine)
        first, second = firsts.index_select(0, at) + start, seconds.index_select(0, at) + start
        daughters = torch.cat([first, second])
        parents = old.take(source.index_select(0, first))
        state = state.replace(
            births=(
                *state.births,
                Births(first, second, state.uid.index_select(0, daughters), parents),
            )
        )
        # as where cells divide: what starts anew does so from the parents' values of all that does
        return state.reset_at_division(daughters, self.own).with_fields(**taken)

    def _with_failures(self, state: State, number: int) -> State:
        """The state with a report of what failed in the course in this step."""
        streams = state.stream.tolist()
        words = {
            k: self.course.failed[s][1]
            for k, s in enumerate(streams)
            if s in self.course.failed and self.course.failed[s][0] == number
        }
        if not words:
            return state
        status = torch.zeros(state.colonies, dtype=torch.int64, device=state.device)
        status[list(words)] = 1
        return state.replace(
            reports={**state.reports, "course": GrowthRecordingReport(status, words)}
        )


def _made_of(scene: Scene) -> str:
    """What the growth of a scene depends on."""
    return digest(scene.listed, scene.founders, scene.dim)

"""Grow once, replay for all: where nothing that a design changes acts back on growth or motion,
growth is recorded once, and the circuits and signals of any number of designs run on the record.

    recording = tf.GrowthRecording(scene, streams=range(4))     # grows only as far as it is read
    model = designs.bind(colonies=256, streams=torch.arange(4).repeat(64))
    replay = tf.Replay(model, recording)    # designs: the scene, circuits with one value per colony
    state = replay.step(model.start())      # as model.step would, without growth and mechanics

Both are views of a model: `model.recorded` are the effects that grow the colonies,
`model.following` the others.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.binding import bind
from torchfilm.cpu_parts import OnCpu
from torchfilm.loop import advance
from torchfilm.model import Model, advanced
from torchfilm.scene import Scene
from torchfilm.state import CELL, PER_CELL, Births, State
from torchfilm.tools import checks
from torchfilm.tools.hot_reload import unchanged
from torchfilm.tools.ragged import expand_ranges, offsets
from torchfilm.tools.reads import reads_are_free
from torchfilm.tools.threads import after_fork, one_torch_thread
from torchfilm.tools.warn_once import once
from torchfilm.turns import Part

FIRST = -1  # the part of what happens before all effects


@dataclass(frozen=True)
class RecordedChange:
    """What an effect changed in one recorded step, for its R colonies side by side.

    part: which of the recorded effects, or FIRST. counts, next_uid (R,) after it. source: place of
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
class RecordingReport:
    """`status` (B,): 1 where the growth of a colony failed, and `words` by place in the batch."""

    status: Tensor
    words: dict[int, str]
    hint = "Growth and mechanics failed in the recording, as they would in a run of their own"

    def reason(self, place: int) -> str:
        return self.words[place]


class GrowthRecording(metaclass=checks.KnownKeywords):
    """The growth and motion of some colonies of a scene, without the effects that only follow:
    grown step by step as far as it is read, and kept.

    scene: any design of it; streams: of random numbers, one colony each; seed, dt (h, by default
    the scene's), dtype and device as in `Scene.bind`. cells: a colony that has as many is grown no
    further, and is empty from the next step; None: all continue. `nbytes` is the memory that it
    takes. Raises InputError where growth depends on what would only follow. Threads may share it; a
    step that an exception has interrupted is done again by whoever reads on.
    """

    @once()  # it binds the scene twice
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
        design = scene.bind(seed=seed, dtype=dtype, device=device, per_colony=True)
        _check_replayable(design)
        self.fingerprint = design.growth_fingerprint
        self.grown_by = _listing(design)
        self.dt = scene.dt if dt is None else checks.number("dt", dt, above=0.0)
        design.check_step(self.dt)
        if cells is not None:
            cells = checks.integer("cells", cells, least=2)
        self.streams, self.cells = tuple(streams), cells
        if len(set(self.streams)) != len(self.streams):
            raise checks.input_error("streams", self.streams, "different integers")
        self.model = bind(
            scene,
            len(self.streams),
            seed=seed,
            streams=self.streams,
            dtype=dtype,
            device=device,
            only=design.recorded,
        )
        self.state = self.model.start()
        self.steps: list[list[RecordedChange]] = []
        self.counts: list[Tensor] = []  # of cells (R,) as each step began
        self.failed: dict[int, tuple[int, str]] = {}
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Bytes that the recorded steps take."""
        parts = (
            x
            for step in self.steps
            for c in step
            for x in (c.counts, c.source, *(c.births or ()), *c.values.values())
        )
        return sum(x.nbytes for x in (*parts, *self.counts) if x is not None)

    @torch.no_grad()
    def changes(self, step: int) -> list[RecordedChange]:
        """What each effect changed in the step after `step` steps; grown now if it has not been."""
        with self._lock:
            while len(self.steps) <= step:
                self.state = next(advance(self._step, self.state))
            return self.steps[step]

    def _step(self, state: State) -> State:
        """The state one step later; what each effect changed is kept. The same step may be done
        again, with the same result."""
        self.counts[state.step :] = [state.counts]
        state = self.model.opened(state, self.dt)
        noted: list[RecordedChange] = []
        failed = {s: (at, why) for s, (at, why) in self.failed.items() if at < state.step}
        full = torch.tensor([s in failed for s in self.streams], device=state.device)
        if self.cells is not None and state.step > 0:
            full = full | (state.counts >= self.cells)
        full = full & (state.counts > 0)
        if bool(full.any()):  # or the quick would fill the memory while the slow are waited for
            kept = state.remove(full.index_select(0, state.colony), "left").replace(ended=())
            noted.append(_change(FIRST, state, kept))
            state = kept
        for part, effect in enumerate(self.model.step_parts):
            after = effect.run_step(state, self.dt)
            if after is not state:
                noted.append(_change(part, state, after))
            state = after
        for report in state.reports.values():
            for place in torch.nonzero(report.status).squeeze(1).tolist():
                failed.setdefault(self.streams[place], (state.step, report.reason(place)))
        self.failed = failed
        self.steps[state.step :] = [noted]
        return advanced(state, self.dt)


def _listing(model: Model) -> list[str]:
    """The effects that grow the colonies, with their parameters."""
    listing = model.scene.listing()
    return [listing[k] for k in model.recorded]


def _check_replayable(model: Model) -> None:
    if model.why_not_replayable:
        raise checks.InputError(
            "the growth of this scene cannot be recorded for other designs:"
            f" {model.why_not_replayable}. Run the scene itself."
        )


def _check_alike(model: Model, recorded: Model) -> None:
    """Raise InputError where a run of the model would draw other random numbers or round in another
    way than the recording."""
    mine, other = (
        f"seed {m.seed}, {m.batch.dtype} on {m.batch.device.type}" for m in (model, recorded)
    )
    if mine != other:
        raise checks.input_error(
            "model",
            mine,
            f"{other}, as the recording is",
            "Give scene.bind(…) and GrowthRecording the same seed, dtype and device.",
        )


def _change(part: int, before: State, after: State) -> RecordedChange:
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
            "an effect divided cells more than once in one step: such growth cannot be recorded for"
            " other designs. Give replay=False."
        )
    if len(after.births) > len(before.births):
        made = after.births[-1]
        start = after.groups.begin[:-1]
        owner = after.colony.index_select(0, made.first)
        first, second = (rows - start.index_select(0, owner) for rows in (made.first, made.second))
        births = (torch.bincount(owner, minlength=after.colonies), first, second)
    within = (
        None if source is None else source - before.groups.begin[:-1].index_select(0, after.colony)
    )
    return RecordedChange(part, after.counts, after.next_uid, within, values, births)


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
            "cells came in that no cell of their colony gave birth to: such growth cannot be"
            " recorded for other designs. Give replay=False."
        )
    return order.index_select(0, torch.where(was_there, at, above))


class Replay(metaclass=checks.KnownKeywords):
    """A model of designs on recorded growth: `step` as the model's, with the same result, without
    growth and mechanics.

    model: its streams are among the recording's. `state.ended` is not populated. `step` raises
    InputError for a state to which cells were added or from which cells were removed (of these, on
    a GPU, it does not know).
    """

    def __init__(self, model: Model, recording: GrowthRecording):
        self.model, self.recording, self.dt = model, recording, recording.dt
        _check_replayable(model)
        if model.growth_fingerprint != recording.fingerprint:
            mine = ", ".join(_listing(model))
            raise checks.InputError(
                f"this scene does not grow as the recording did: {mine} and its founders, instead"
                f" of {', '.join(recording.grown_by)}. Make a GrowthRecording of this scene."
            )
        _check_alike(model, recording.model)
        device = recording.state.device
        self.streams, self.order = torch.sort(torch.tensor(recording.streams, device=device))
        # each effect with its number among the recorded ones, or None if it only follows
        numbers = iter(range(len(recording.model.step_parts)))
        self.parts = [
            (e, next(numbers) if e.place in model.recorded else None) for e in model.step_parts
        ]
        # fields of those that only follow; what a recorded effect declares as well is recorded
        recorded = {f.name for e in recording.model.effects for f in e.declares()}
        following = [e for e in model.effects if e.place not in model.recorded]
        self.own = [f.name for e in following for f in e.declares() if f.name not in recorded]
        # what growth uses: no effect that only follows may change it
        self.fixed = (*PER_CELL, *sorted(recorded))

    def start(self) -> State:
        """The first state of the model, whose colonies follow streams of the recording."""
        state = self.model.start()
        self._check_streams(state)
        return state

    def _check_streams(self, state: State) -> None:
        strange = sorted(set(state.stream.tolist()) - set(self.recording.streams))
        if strange:
            listed = ", ".join(map(str, self.recording.streams))
            raise checks.input_error("streams", strange[0], f"of the recording: {listed}")

    @one_torch_thread()
    def step(self, state: State) -> State:
        """The state one step later."""
        after_fork()
        number = state.step
        if number == 0:
            self._check_streams(state)
        place = self.order.index_select(0, torch.searchsorted(self.streams, state.stream))
        followed = _Followed(place)
        changes = {change.part: change for change in self.recording.changes(number)}
        if any(a.step == number for a in state.arrived):
            raise _other_cells("cells were added to the state", "without them")
        grown = self.recording.counts[number].index_select(0, place)
        if reads_are_free(state.device) and not torch.equal(state.counts, grown):
            at = int((state.counts != grown).nonzero()[0])
            change = f"colony {int(state.colony_id[at])} has {int(state.counts[at])} cells"
            raise _other_cells(change, f"with {int(grown[at])} after {number} steps")
        state = self.model.opened(state, self.dt)
        if FIRST in changes:
            state = self._apply(state, changes[FIRST], followed)
        for effect, part in self.parts:
            if part is None:
                state = self._follow(effect, state)
            elif part in changes:
                state = self._apply(state, changes[part], followed)
        if any(step == number for step, _ in self.recording.failed.values()):
            state = self._with_failures(state, number)
        return advanced(state, self.dt)

    def _follow(self, effect: Part | OnCpu, state: State) -> State:
        """The state after an effect that only follows. Raises TypeError where it changes what
        growth uses, and so should not have been left out of the recording."""
        after = effect.run_step(state, self.dt)
        for name in self.fixed:
            new, old = getattr(after, name), getattr(state, name)
            if new is not old and not (new.shape == old.shape and unchanged(new, old)):
                raise TypeError(
                    f"{effect.title} changed {name!r}, which its `writes` does not name: so growth"
                    " was recorded without it. Name it there."
                )
        return after

    def _apply(self, state: State, change: RecordedChange, followed: _Followed) -> State:
        """The state after a recorded change of the colonies that ours follow."""
        place, unit, times = followed.place, followed.unit, followed.times
        owner, rows = followed.cells(change.counts)
        taken = {
            n: _tiled(value.index_select(0, rows), times)
            for n, value in change.values.items()
            if n not in self.own
        }
        shape = {n: taken.pop(n) for n in PER_CELL if n in taken}
        old = state
        if change.source is None:
            state = state.replace(**shape)
        else:
            before = offsets(state.counts[: len(unit)])
            within = change.source.index_select(0, rows) + before.index_select(0, owner)
            first_cell = torch.arange(times, device=place.device).unsqueeze(1) * before[-1]
            source = (first_cell + within).reshape(-1)
            state = state.take(source, **shape)
            state = state.replace(next_uid=change.next_uid.index_select(0, place))
        if change.births is None:
            return state.with_fields(**taken)
        number, firsts, seconds = change.births
        begin = offsets(number)[:-1].index_select(0, place)
        mine, at = expand_ranges(begin, number.index_select(0, place))
        start = state.groups.begin[:-1].index_select(0, mine)
        first, second = firsts.index_select(0, at) + start, seconds.index_select(0, at) + start
        daughters = torch.cat([first, second])
        parents = source.index_select(0, first)
        uid, length = (x.index_select(0, daughters) for x in (state.uid, state.length))
        births = Births(first, second, uid, length, old, parents)
        state = state.replace(births=(*state.births, births))
        # as where cells divide: what starts again does so from the parents' values of all that does
        return state.reset_at_division(daughters, self.own).with_fields(**taken)

    def _with_failures(self, state: State, number: int) -> State:
        """The state with a report of what failed in the recording in this step."""
        failed, words = self.recording.failed, {}
        for k, stream in enumerate(state.stream.tolist()):
            if stream in failed and failed[stream][0] == number:
                words[k] = failed[stream][1]
        if not words:
            return state
        status = torch.zeros(state.colonies, dtype=torch.int64, device=state.device)
        status[list(words)] = 1
        return state.replace(reports={**state.reports, "recording": RecordingReport(status, words)})


class _Followed:
    """Which recorded colonies ours follow in a step: `place` (B,), which is `unit` so many
    times."""

    def __init__(self, place: Tensor):
        self.place = place
        self.unit, self.times = _repeated(place)
        self._counts: Tensor | None = None

    def cells(self, counts: Tensor) -> tuple[Tensor, Tensor]:
        """The colony within `unit` of each of its cells, and their rows in the recording, which has
        `counts` (recorded,) cells a colony; changes without divisions between them share these."""
        if self._counts is not counts:
            begin = offsets(counts)[:-1].index_select(0, self.unit)
            self._cells = expand_ranges(begin, counts.index_select(0, self.unit))
            self._counts = counts
        return self._cells


def _other_cells(change: str, recorded: str) -> checks.InputError:
    return checks.InputError(
        f"{change}, but growth was recorded {recorded}. Step the model itself:"
        " replay.model.step(state)."
    )


def _repeated(place: Tensor) -> tuple[Tensor, int]:
    """The numbers whose repetition `place` (B,) is, and how often they stand in it. The designs of
    a search follow the same streams, whose cells then need to be looked up once."""
    again = torch.nonzero(place[1:] == place[0])
    period = int(again[0]) + 1 if len(again) else len(place)
    if len(place) % period or not torch.equal(place[period:], place[:-period]):
        period = len(place)
    return place[:period], len(place) // period


def _tiled(value: Tensor, times: int) -> Tensor:
    """(N, …) that many times, one after the other."""
    return value if times == 1 else value.repeat(times, *[1] * (value.dim() - 1))

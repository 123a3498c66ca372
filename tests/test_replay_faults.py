"""Recordings and replays where something goes wrong, and where effects share fields."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from test_replay import lit, same, stepped

import torchfilm as tf
from design import growth_cache
from torchfilm.effects.bound_mechanics import BoundMechanics
from torchfilm.state import CELL_TYPE

THREE = tf.Cells(
    np.array([[0.0, 0.0], [0.0, 3.0], [0.0, 6.0]]),
    np.array([[1.0, 0.0]] * 3),
    2.0,
    0.5,
    cell_type=[0, 1, 0],
)


def follow(u, s, p, cell):
    return {"q": p.k - u.q}


def double(u, s, p, cell):
    return {"q": 2 * p.k - u.q}


def replayed(scene, steps, streams=(0, 1)):
    """The states of a replay and of the full run of the same colonies."""
    model = scene.bind(len(streams), streams=list(streams))
    replay = tf.Replay(model, tf.GrowthRecording(scene, streams=streams))
    return stepped(replay, replay.start(), steps), stepped(model, model.start(), steps)


# --- exceptions and threads ---------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupted_step_is_done_again(error, monkeypatch):
    usual, calls = BoundMechanics.step, []

    def fails_once(self, state, dt):
        calls.append(state.step)
        if len(calls) == 12:
            raise error
        return usual(self, state, dt)

    recording, whole = (tf.GrowthRecording(lit(), streams=(0, 1)) for _ in range(2))
    monkeypatch.setattr(BoundMechanics, "step", fails_once)
    with pytest.raises(error):
        recording.changes(19)
    recording.changes(19)
    whole.changes(19)
    assert len(recording.steps) == 20 and recording.nbytes == whole.nbytes
    same(recording.state, whole.state)


def test_a_step_done_again_after_a_failure_drops_no_colony_early():
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(added=0.2),
        tf.Circuit(follow, species=("q",), k=1.0),
        founders=tf.Cells.single(2, length=0.3),
    )
    recording = tf.GrowthRecording(scene, streams=(0,))
    while not recording.failed:
        before = recording.state
        recording.changes(len(recording.steps))
    after, steps, failed = recording.state, recording.steps[-1], recording.failed
    recording.state = before  # as if interrupted after the step, before its state was kept
    same(recording._step(before), after)
    assert recording.failed == failed and len(recording.steps) == after.step
    assert [c.part for c in recording.steps[-1]] == [c.part for c in steps]


def test_threads_share_a_recording():
    recording, whole = (tf.GrowthRecording(lit(), streams=(0, 1)) for _ in range(2))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: recording.changes(30), range(4)))
    whole.changes(30)
    assert all(changes is found[0] for changes in found) and len(recording.steps) == 31
    same(recording.state, whole.state)


def test_threads_that_ask_at_once_are_given_one_recording():
    growth_cache._kept.clear()
    scene = lit()
    with ThreadPoolExecutor(4) as pool:
        find = lambda _: growth_cache.find_or_record(
            ("threads",), (0,), None, lambda: tf.GrowthRecording(scene, streams=(0,))
        )
        found = list(pool.map(find, range(8)))
    assert len(growth_cache._kept) == 1 and len(set(map(id, found))) == 1
    growth_cache._kept.clear()


# --- what a recording serves --------------------------------------------------------------------


@pytest.mark.parametrize(
    "options", [{"seed": 9}, {"dtype": torch.float64}, {"seed": 9, "dtype": torch.float64}], ids=str
)
def test_a_model_of_another_seed_or_dtype_is_refused(options):
    recording = tf.GrowthRecording(lit(), streams=(0, 1))
    with pytest.raises(tf.InputError, match=r"must be seed 0, torch\.float32 on cpu") as error:
        tf.Replay(lit().bind(2, **options), recording)
    assert all(str(value) in str(error.value) for value in options.values())


def test_a_step_too_long_for_growth_is_refused():
    with pytest.raises(tf.InputError, match=r"dt = 1 h is too long for Growth\.rate = 1/h"):
        tf.GrowthRecording(lit(), streams=(0,), dt=1.0)


def test_a_replay_has_its_own_models_values_also_in_a_state_of_another():
    first, second = (lit(make=tf.Uniform(low, low + 1)) for low in (1.0, 10.0))
    model, recording = second.bind(2), tf.GrowthRecording(first, streams=(0, 1))
    state = stepped(tf.Replay(first.bind(2), recording), first.bind(2).start(), 5)
    found, full = stepped(tf.Replay(model, recording), state, 60), stepped(model, state, 60)
    assert full.cells > 4
    same(found, full)


# --- fields that growth and its followers share -------------------------------------------------


@dataclass(frozen=True)
class Differentiates(tf.Effect):
    """Cells longer than 2.2 µm become of type 1, and longer."""

    stage, title = 35, "differentiates"

    def declares(self, dim):
        return (CELL_TYPE,)

    def reads(self):
        return ("length",)

    def writes(self):
        return ("cell_type", "length")

    def step(self, state, dt, values):
        kind = (state.length > 2.2).to(torch.int64)
        return state.with_fields(cell_type=kind).replace(length=state.length * (1 + 1e-3 * kind))


def test_a_field_that_growth_changes_and_a_circuit_declares_is_replayed():
    growth = (tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2))
    circuit = tf.Circuit({0: lambda u, s, p, cell: {"q": -u.q}, 1: follow}, species=("q",), k=1.0)
    scene = tf.Scene(*growth, Differentiates(), circuit)
    assert scene.bind().following == (4,)
    found, full = replayed(scene, 60)
    assert float(full.q.max()) > 0.1 and bool(full.parent.ge(0).all())
    same(found, full)


@dataclass(frozen=True)
class Marks(tf.Effect):
    """Writes a field that it does not read; `moves`: and cells' lengths."""

    moves: bool
    value: float

    stage = 35

    @property
    def title(self):
        return f"marks {self.value:g}"

    def declares(self, dim):
        return (tf.Field("mark", "written by two"),)

    def reads(self):
        return ("length",)

    def writes(self):
        return ("mark", "length") if self.moves else ("mark",)

    def step(self, state, dt, values):
        state = state.with_fields(mark=self.value * state.length)
        return state.replace(length=state.length * 1.001) if self.moves else state


def test_who_writes_a_field_that_growth_writes_is_recorded_too():
    growth = (tf.Growth(rate=1.0), tf.Division(length=3.5))
    circuit = tf.Circuit(follow, species=("q",), k=1.0)
    scene = tf.Scene(*growth, Marks(True, 1.0), Marks(False, 2.0), circuit)
    assert scene.bind().following == (4,)
    same(*replayed(scene, 40))


BY_TYPE = {
    "growth": {"growth": {0: 1.0, 1: 0.5}},
    "division": {"division": {0: 3.5, 1: 2.5}},
    "circuit parameter": {"growth": {0: 1.0, 1: 0.5}, "k": {0: 1.0, 1: 2.0}, "rates": follow},
}


@pytest.mark.parametrize("name", BY_TYPE)
def test_growth_by_type_is_replayed_for_a_circuit_by_type(name):
    given = {"growth": 1.0, "division": 3.5, "k": 1.0, "rates": {0: follow, 1: double}}
    given |= BY_TYPE[name]
    scene = tf.Scene(
        tf.Growth(rate=given["growth"]),
        tf.Division(length=given["division"]),
        tf.Mechanics(dim=2),
        tf.Circuit(given["rates"], species=("q",), k=given["k"]),
        founders=THREE,
    )
    model = scene.bind(1)
    assert (model.why_not_replayable, model.following) == ("", (3,))
    same(*replayed(scene, 20))
    found, full = replayed(scene, 40)
    assert full.cells > 6
    same(found, full)


@dataclass(frozen=True, eq=False)
class Shrinking(tf.Effect):
    """A user's effect that changes lengths, and may not say so."""

    says: bool = True

    stage = 55
    title = "shrinking"

    def writes(self):
        return ("length",) if self.says else ()

    def step(self, state, dt, values):
        return state.replace(length=state.length * 0.9)


def test_an_effect_that_changes_growth_and_does_not_say_so_is_found():
    """It would have counted as one that only follows, and its changes been lost."""
    told, untold = (lit().replace(*lit().effects, Shrinking(says=s)) for s in (True, False))
    replayed_end, full_end = replayed(told, 8)
    same(replayed_end, full_end)
    with pytest.raises(tf.InputError, match=r"Shrinking\.step changed 'length'.*writes"):
        replayed(untold, 8)


@pytest.mark.parametrize("chosen", [None, [1, 0]])
def test_cells_that_were_removed_between_steps_are_noticed(chosen):
    """Their colony is named; other colonies of the recording, or fewer, may be followed."""
    model = lit().bind(2, streams=[0, 1])
    replay = tf.Replay(model, tf.GrowthRecording(lit(), streams=(0, 1)))
    state = stepped(replay, replay.start(), 40)
    state = state if chosen is None else state.select(chosen)
    replay.step(state)
    row = int(torch.nonzero(state.colony_id.index_select(0, state.colony) == 1)[0])
    gone = torch.arange(state.cells) == row
    cells = int(state.counts[0 if chosen else 1])
    said = rf"colony 1 has {cells - 1} cells, .* recorded with {cells} after 40 steps.*model\.step"
    with pytest.raises(tf.InputError, match=said):
        replay.step(state.remove(gone, "removed"))

"""Grow once, replay for all: a replay is the full run, bit for bit, and is refused where designs
act on growth."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.state import PER_CELL

DT = 0.025


def reporter(u, s, p, cell):
    return {"gfp": p.make * cell.volume - u.gfp}


def lit(make=1.0, rate=1.0, **options):
    return tf.Scene(
        tf.Growth(rate=rate),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(reporter, species=("gfp",), make=make, **options),
    )


class Designs:
    """Designs of a scene on recorded growth: `start` binds them to some colonies."""

    def __init__(self, scene: tf.Scene, recording: tf.GrowthRecording):
        self.scene, self.recording = scene, recording
        self.replay = tf.Replay(self._bind(None, None), recording)

    def start(self, colonies: int, streams) -> tf.State:
        self.replay = tf.Replay(self._bind(colonies, streams), self.recording)
        return self.replay.start()

    def _bind(self, colonies: int | None, streams) -> tf.Model:
        first = self.recording.state
        return self.scene.bind(
            colonies, seed=first.seed, streams=streams, dtype=first.dtype, device=first.device
        )

    def step(self, state: tf.State) -> tf.State:
        return self.replay.step(state)


def stepped(scene, state, steps):
    for _ in range(steps):
        state = step(scene, state, DT) if isinstance(scene, tf.Scene) else scene.step(state)
    return state


def same(one, other):
    assert one.step == other.step and one.time == other.time
    for name in (*PER_CELL, "next_uid", "stream", *other.fields):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


DESIGNS = {
    "boundary detector": lambda v: tf.scenes.boundary_detector(k3=v, diffusion=10 * v, width=16.0),
    "quorum sensing": lambda v: tf.scenes.quorum_sensing(k3=v),
    "switch, molecule by molecule": lambda v: tf.scenes.toggle_switch(strength=10 * v),
    "amounts shared": lambda v: lit(v, daughters="amount"),
}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", DESIGNS)
def test_a_replay_is_the_full_run(name, dtype):
    values, streams = (
        torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64).repeat_interleave(2),
        torch.tensor([7, 3] * 3),
    )
    scene = DESIGNS[name](values)
    full = stepped(scene, scene.bind(6, seed=5, streams=streams, dtype=dtype).start(), 130)
    recording = tf.GrowthRecording(DESIGNS[name](1.0), streams=(3, 7), seed=5, dtype=dtype)
    replay = Designs(scene, recording)
    found = stepped(replay, replay.start(6, streams=streams), 130)
    assert found.cells > 6 * 6
    same(found, full)


def test_colonies_may_leave_a_replay_and_go_on_alike():
    scene, streams = lit(torch.tensor([1.0, 2.0, 3.0])), [0, 1, 0]
    replay = Designs(scene, tf.GrowthRecording(lit(), streams=(0, 1)))
    whole = stepped(replay, replay.start(3, streams=streams), 80)
    part = stepped(replay, replay.start(3, streams=streams), 50).select([2, 1])
    same(stepped(replay, part, 30), whole.select([2, 1]))


def test_colonies_of_one_stream_differ_by_their_parameters_only():
    scene = lit(torch.tensor([1.0, 1.0, 2.0]))
    state = stepped(scene, scene.bind(3, streams=[4, 4, 4]).start(), 60)
    first, second, third = (state.select([k]) for k in range(3))
    for name in ("uid", "position", "length", "gfp"):
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert torch.equal(first.position, third.position) and not torch.equal(first.gfp, third.gfp)
    alone = lit(1.0)
    apart = stepped(alone, alone.bind(5).start(), 60).select([4])
    assert torch.equal(apart.position, first.position)


def test_a_recording_grows_as_far_as_it_is_read_and_no_further():
    recording = tf.GrowthRecording(lit(), streams=(0,))
    recording.changes(9)
    assert len(recording.steps) == 10
    recording.changes(4)
    assert len(recording.steps) == 10 and recording.nbytes > 0


@pytest.mark.parametrize(
    "scene, follows, why",
    [
        (tf.scenes.boundary_detector(), ("circuit", "transport"), ""),
        (tf.scenes.toggle_switch(), ("circuit",), ""),
        (tf.scenes.microcolony(), (), "every effect acts on growth or motion"),
        (tf.scenes.nutrient_limited(), (), "transport acts on growth or motion by 'out.nutrient'"),
        (tf.scenes.random_partition(), (), "rules may read and write anything"),
    ],
)
def test_what_follows_is_found_from_what_is_declared(scene, follows, why):
    model = scene.bind()
    assert tuple(scene.effects[k].title for k in model.following) == follows or why
    assert sorted((*model.recorded, *model.following)) == list(range(len(scene.effects)))
    found = model.why_not_replayable
    assert found.startswith(why) and bool(found) == bool(why)


def test_a_design_that_acts_on_growth_is_refused():
    with pytest.raises(
        tf.InputError, match=r"Growth\.rate differs between colonies and acts on their growth"
    ):
        tf.GrowthRecording(lit(rate=torch.tensor([1.0, 2.0])), streams=(0, 1))
    with pytest.raises(tf.InputError, match="rules may read and write anything"):
        tf.GrowthRecording(tf.scenes.random_partition(), streams=(0,))
    recording = tf.GrowthRecording(lit(), streams=(0,))
    with pytest.raises(tf.InputError, match="does not grow as the recording did: Growth\\(rate=2"):
        Designs(lit(rate=2.0), recording)
    with pytest.raises(
        tf.InputError, match="streams = 1 is not allowed: it must be of the recording: 0"
    ):
        Designs(lit(), recording).start(2, streams=[0, 1])


def test_other_founders_are_another_growth():
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.5)
    other = tf.Scene(*lit().effects, founders=founders)
    with pytest.raises(tf.InputError, match="does not grow as the recording did"):
        Designs(other, tf.GrowthRecording(lit(), streams=(0,)))


def test_what_fails_in_the_recording_fails_in_every_replay():
    # a cell due to divide by volume while shorter than its two new caps
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(added=0.2),
        tf.Circuit(reporter, species=("gfp",), make=1.0),
        founders=tf.Cells.single(2, length=0.3),
    )
    replay = Designs(scene, tf.GrowthRecording(scene, streams=(0, 1)))
    state = replay.start(3, streams=[1, 0, 1])
    while not tf.failures(state):
        state = replay.step(state)
    found = tf.failures(state)
    assert sorted({f.place for f in found}) == [0, 1, 2]
    assert "due to divide" in found[0].reason


@pytest.mark.parametrize("streams", [[0], [0, -1], [0.5, 1.0], [0, 2**32], [True, False]])
def test_streams_are_whole_numbers_one_a_colony(streams):
    with pytest.raises(tf.InputError, match="streams"):
        lit().bind(2, streams=streams).start()


def test_streams_are_kept_in_results(tmp_path):
    scene, path = lit(torch.tensor([1.0, 2.0])), tmp_path / "r.h5"
    state = deque(
        tf.simulate(scene, scene.bind(2, streams=[9, 9]).start(), until=1.0, record=path), maxlen=1
    ).pop()
    with tf.Results(path) as results:
        again = results.state(scene)
    assert again.stream.tolist() == [9, 9]
    same(again, state)
    with pytest.raises(tf.InputError, match="streams"):
        list(
            tf.simulate(
                scene,
                state.replace(stream=torch.tensor([9, 8])),
                until=1.1,
                record=tf.Recorder(path, scene, append=True),
            )
        )


@dataclass(frozen=True)
class Measured(tf.Effect):
    """Notes each cell's length after growth and before contacts push."""

    stage, title = 35, "measured"

    def declares(self, dim):
        return (tf.Field("longest", "length before contacts push", "µm"),)

    def reads(self):
        return ("length",)

    def writes(self):
        return ("longest",)

    def step(self, state, dt, values):
        return state.with_fields(longest=state.length)


def test_an_effect_between_growth_and_mechanics_sees_the_state_between():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2), Measured())
    replay = Designs(scene, tf.GrowthRecording(scene, streams=(0,)))
    full, found = (
        stepped(scene, scene.bind(1).start(), 120),
        stepped(replay, replay.start(1, streams=[0]), 120),
    )
    assert not torch.equal(full.longest, full.length)  # contacts held some back
    same(found, full)


def test_what_founders_bring_keeps_the_rule_of_its_circuit_at_division():
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"gfp": [3.0]})
    scene = tf.Scene(*lit(torch.tensor([1.0, 2.0]), daughters="amount").effects, founders=founders)
    replay = Designs(scene, tf.GrowthRecording(scene, streams=(0,)))
    same(
        stepped(replay, replay.start(2, streams=[0, 0]), 90),
        stepped(scene, scene.bind(2, streams=[0, 0]).start(), 90),
    )


@dataclass(frozen=True)
class Started(tf.Effect):
    """A field with a first value of its own, at birth or at the start; listed, it does nothing
    else."""

    name: str
    initial: Callable
    at_division: str = "copy"

    stage, title = 30, "started"

    def declares(self, dim):
        return (
            tf.Field(self.name, "set once", initial=self.initial, at_division=self.at_division),
        )

    def step(self, state, dt, values):
        return state


def twice(state, rows, values):
    return torch.full((rows.numel(),), 2.0, dtype=state.dtype)


def four_times(state, rows, values):
    return torch.full((rows.numel(),), 4.0, dtype=state.dtype)


def rate_at_birth(state, rows, values):
    return state.growth_rate.index_select(0, rows)


def test_what_growth_reads_belongs_to_it_also_where_nothing_writes_it():
    scene = tf.Scene(*lit(torch.tensor([1.0, 2.0])).effects, Started("drag", twice))
    replay = Designs(scene, tf.GrowthRecording(scene, streams=(0,)))
    full = stepped(scene, scene.bind(2, streams=[0, 0]).start(), 110)
    same(stepped(replay, replay.start(2, streams=[0, 0]), 110), full)
    assert not torch.equal(
        full.position,
        stepped(
            lit(torch.tensor([1.0, 2.0])),
            lit(torch.tensor([1.0, 2.0])).bind(2, streams=[0, 0]).start(),
            110,
        ).position,
    )


def test_growth_is_identified_by_what_its_functions_do():
    recording = tf.GrowthRecording(tf.Scene(*lit().effects, Started("drag", twice)), streams=(0,))
    Designs(tf.Scene(*lit().effects, Started("drag", twice)), recording)
    with pytest.raises(tf.InputError, match="does not grow as the recording did"):
        Designs(tf.Scene(*lit().effects, Started("drag", four_times)), recording)


def test_daughters_fields_start_from_what_they_see_where_cells_divide():
    """A field that starts again from another that does, growth_rate drawn at birth: it sees the
    parent's, as in the full run."""
    circuit = tf.Circuit(reporter, species=("gfp",), make=torch.tensor([1.0, 2.0]))
    scene = tf.Scene(
        tf.Growth(rate=tf.Uniform(0.5, 1.5)),
        tf.Division(length=3.5),
        circuit,
        Started("born_rate", rate_at_birth, "reset"),
    )
    replay = Designs(scene, tf.GrowthRecording(scene, streams=(0,)))
    full = stepped(scene, scene.bind(2, streams=[0, 0]).start(), 110)
    assert full.cells > 8 and not torch.equal(full.born_rate, full.growth_rate)
    same(stepped(replay, replay.start(2, streams=[0, 0]), 110), full)


def test_effects_of_one_stage_act_in_the_order_in_which_they_are_listed():
    class Early(Measured):
        stage = 30

    early = dataclass(frozen=True)(Early)()
    scene = tf.Scene(
        early,
        tf.Growth(rate=1.0),
        tf.Division(length=3.5),
        tf.Circuit(reporter, species=("gfp",), make=1.0),
    )
    replay = Designs(scene, tf.GrowthRecording(scene, streams=(0,)))
    full = stepped(scene, scene.bind(1).start(), 20)
    assert float(full.longest.max()) < float(full.length.max())
    same(stepped(replay, replay.start(1, streams=[0]), 20), full)


@pytest.mark.parametrize(
    "scene, why",
    [
        (lambda: lit(rate=torch.tensor(1.0, requires_grad=True)), "a derivative by"),
        (
            lambda: tf.Scene(
                *lit().effects,
                founders=tf.Cells([[0.0, 0.0], [1.0, 0.0]], [[1.0, 0.0]] * 2, colony=[0, 1]),
            ),
            "its first cells name their colonies",
        ),
    ],
)
def test_more_that_cannot_be_kept(scene, why):
    assert why in scene().bind().why_not_replayable
    with pytest.raises(tf.InputError, match=why):
        tf.GrowthRecording(scene(), streams=(0,))


@pytest.mark.parametrize("segment", [1, 3, None])
def test_rollout_follows_a_replay_with_its_gradient(segment):
    """The same bits and the same gradient as step by step, from the first state and from a later
    one."""
    make = torch.tensor([1.0, 2.0], requires_grad=True)
    recording = tf.GrowthRecording(lit(), streams=[4, 1], dt=0.1)
    designs = Designs(lit(make=make), recording)
    start = designs.start(2, [1, 4])
    plain = stepped(designs, start, 20)
    half = tf.rollout(designs.replay, until=0.7, segment=segment)
    end = tf.rollout(designs.replay, half, until=2.0, segment=segment)
    assert (end.step, end.cells) == (20, plain.cells) and end.cells > 2
    assert torch.equal(end.gfp, plain.gfp)
    slopes = [torch.autograd.grad(s.gfp.sum(), make)[0] for s in (end, plain)]
    torch.testing.assert_close(slopes[0], slopes[1])
    assert bool((slopes[0] > 0).all())
    with pytest.raises(tf.InputError, match=r"dt = 0.05 .* 0.1 h, as in the recording"):
        tf.rollout(designs.replay, until=1.0, dt=0.05)


@pytest.mark.parametrize("cells", [-1, 0, 1, 2.5, "a"])
def test_cells_of_a_recording_are_a_whole_number(cells):
    with pytest.raises(tf.InputError, match=r"^cells = "):
        tf.GrowthRecording(DESIGNS["amounts shared"](1.0), streams=(0,), cells=cells)


@dataclass(frozen=True, eq=False)
class Controlled(tf.Effect):
    """Growth rates by a network."""

    net: torch.nn.Module
    stage, title = 15, "controlled"

    def reads(self):
        return ["length"]

    def writes(self):
        return ["growth_rate"]

    def step(self, state, dt, values):
        rate = torch.nn.functional.softplus(self.net(state.length[:, None])[:, 0])
        return state.with_fields(growth_rate=rate)


def test_growth_by_a_network_counts_with_its_weights():
    torch.manual_seed(0)
    nets = [torch.nn.Linear(1, 1).requires_grad_(False) for _ in range(2)]
    made = lambda net: lit().replace(Controlled(net), tf.Growth(), *lit().effects[1:])
    one, two = map(made, nets)
    assert one == made(nets[0]) and one != two
    recording = tf.GrowthRecording(one, streams=[0])
    assert tf.rollout(tf.Replay(one.bind(), recording), until=0.5).cells > 0
    with pytest.raises(tf.InputError, match="does not grow as the recording did"):
        tf.Replay(two.bind(), recording)
    nets[0].weight += 1.0
    with pytest.raises(tf.InputError, match="does not grow as the recording did"):
        tf.Replay(one.bind(), recording)
    nets[1].requires_grad_(True)
    with pytest.raises(tf.InputError, match=r"a tensor that controlled uses.*requires_grad_"):
        tf.GrowthRecording(two, streams=[0])

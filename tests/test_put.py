"""Colonies put in the place of others: they go on as where they came from, and the others as if
nothing had happened."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import step
from mock_cuda import pretended_cuda  # noqa: F401
from test_devices import columns

import torchfilm as tf

RATES = [1.0, 1.3, 1.6]


def scene_of(*more: tf.Effect) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=RATES), tf.Division(length=tf.Uniform(3.0, 3.5)), tf.Mechanics(dim=2),
        *more, dt=0.05, dim=2,
    )  # fmt: skip


def signalling() -> tf.Scene:
    circuit = tf.Circuit(
        lambda u, s, p, cell: ({"m": 1.0 - u.m}, {"a": cell.volume * (0.1 - s.a)}), species=("m",)
    )
    medium = tf.Medium(a=tf.Signal(100.0), box=((-6, -6), (6, 6)), spacing=2.0, depth=1.0,
                       outside="grow")  # fmt: skip
    return scene_of(circuit, medium)


def reservoirs() -> tf.Scene:
    """A field for each colony: what the reservoir has taken."""
    circuit = tf.Circuit(lambda u, s, p, cell: ({"m": -u.m}, {"a": 0.1 * cell.volume}),
                         species=("m",))  # fmt: skip
    medium = tf.Medium(a=tf.Signal(100.0), box=((-4, -4), (4, 4)), spacing=2.0, depth=1.0,
                       outside="reservoir")  # fmt: skip
    return scene_of(circuit, medium)


def run(scene: tf.Scene, state: tf.State, steps: int) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, scene.dt)
    assert not tf.failures(state)
    return state


def check_same(one: tf.State, other: tf.State) -> None:
    assert one.colony_id.tolist() == other.colony_id.tolist()
    assert one.next_uid.tolist() == other.next_uid.tolist()
    right = columns(other)
    for name, value in columns(one).items():
        assert torch.equal(value, right[name]), name


@pytest.mark.parametrize("make", [scene_of, signalling, reservoirs])
@torch.no_grad()
def test_a_colony_that_is_put_goes_on_as_where_it_was(make):
    scene = make()
    model = scene.bind(3, seed=1)
    grown = run(scene, model.start(), 30)
    # the same colony alone, at the time of the batch
    fresh = scene.bind(3, seed=9).start().replace(step=grown.step, time=grown.time, seed=1)
    mixed = grown.put([1], fresh, taken=[1])
    assert mixed.counts.tolist() == [*grown.counts[:1].tolist(), 1, *grown.counts[2:].tolist()]
    after = run(scene, mixed, 30)
    check_same(after.select([0, 2]), run(scene, grown, 30).select([0, 2]))
    check_same(after.select([1]), run(scene, fresh, 30).select([1]))
    assert int(after.counts[1]) > 1


@torch.no_grad()
def test_copies_go_on_by_the_random_numbers_and_parameters_of_their_places():
    scene = signalling()
    grown = run(scene, scene.bind(3, seed=1).start(), 30)
    copies = grown.put([0, 1, 2], grown, taken=[2, 2, 2])
    assert copies.colony_id.tolist() == copies.stream.tolist() == [0, 1, 2]
    a, b, c = (copies.select([k]) for k in range(3))
    assert torch.equal(a.position, c.position) and torch.equal(a.uid, b.uid)
    assert torch.equal(a.signals["a"], c.signals["a"])
    # a growth rate is a column of the cells; daughters draw thresholds of their own
    after = run(scene, copies, 40)
    a, b, c = (after.select([k]) for k in range(3))
    assert not torch.equal(a.division_threshold, b.division_threshold)
    check_same(c, run(scene, grown, 40).select([2]))


def test_places_may_be_tensors_ranges_and_few_of_many():
    scene = scene_of()
    model = scene.bind(3, seed=1)
    with torch.no_grad():
        grown = run(scene, model.start(), 30)
    for places in (torch.tensor([2, 0]), range(2, -1, -2), [2, 0]):
        made = grown.put(places, model.start(seed=4), taken=[2, 0])
        assert made.counts.tolist() == [1, int(grown.counts[1]), 1]
    whole = grown.put([0, 1, 2], model.start(seed=4))
    assert whole.counts.tolist() == [1, 1, 1] and whole.step == grown.step == 30
    assert whole.seed == 1 and (whole.time, whole.births, whole.reports) == (grown.time, (), {})
    assert not torch.equal(whole.division_threshold, model.start().division_threshold)
    assert torch.equal(model.start(seed=1).division_threshold, model.start().division_threshold)


def test_what_does_not_fit_is_refused():
    scene = scene_of()
    state, named = scene.bind(3).start(), signalling().bind(3).start()
    double = scene.bind(3, dtype=torch.float64).start()
    for error, given in (
        (r"colonies = \[0, 0\].*different places", lambda: state.put([0, 0], state)),
        (r"colonies = \[3\].*places from 0 to 2", lambda: state.put([3], state)),
        (r"other = 'of 3 colonies'.*1 colony, one for each.*taken=", lambda: state.put([1], state)),
        (r"taken = \[0, 1\].*1 place, one", lambda: state.put([1], state, taken=[0, 1])),
        (r"taken = \[4\].*places from 0 to 2", lambda: state.put([1], state, taken=[4])),
        (r"other = 3 is not allowed.*a State", lambda: state.put([1], 3)),
        (r"other.dtype = torch.float64", lambda: state.put([0], double, taken=[0])),
        (r"has the field 'circuit_volume', the other", lambda: named.put([0], state, taken=[0])),
    ):  # fmt: skip
        with pytest.raises(tf.InputError, match=error):
            given()
    other = tf.Medium(a=tf.Signal(100.0), box=((-6, -6), (6, 6)), spacing=3.0, depth=1.0,
                      outside="grow")  # fmt: skip
    effects = [other if isinstance(e, tf.Medium) else e for e in signalling().effects]
    strange = signalling().replace(*effects).bind(3).start()
    with pytest.raises(tf.InputError, match=r"spacing, periodic axes and height = \(\(3.0, 3.0"):
        signalling().bind(3).start().put([0], strange, taken=[0])


def test_colonies_of_another_space_are_not_put():
    cells = tf.Cells([[1.0, 1.0]], [1.0, 0.0])

    def first(periodic, faces, height):
        medium = tf.Medium(
            a=tf.Signal(1.0), box=((0, 0), (20, 20)), spacing=5.0, height=height, boundary=faces
        )
        mechanics = tf.Mechanics(dim=2, periodic=periodic)
        return tf.Scene(mechanics, medium, founders=cells).bind(2).start()

    closed, wraps = tf.BoundaryConditions(), tf.BoundaryConditions(y=tf.Periodic())
    state = first(None, closed, 0.0)
    assert state.put([0], first(None, closed, 0.0), taken=[1]).cells == 2
    for other in (first(None, wraps, 0.0), first(None, closed, 0.25)):
        with pytest.raises(tf.InputError, match="spacing, periodic axes and height"):
            state.put([0], other, taken=[1])
    with pytest.raises(tf.InputError, match=r"other\.space"):
        first({"y": (0, 20)}, wraps, 0.0).put([0], first(None, wraps, 0.0), taken=[1])


def test_a_detached_state_keeps_nothing_of_the_step_before():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0), dt=0.1, dim=2)
    states = tf.simulate(scene, until=1.0)
    state = next(s for s in states if s.births)
    state = state.replace(reports={"mine": state})
    cut = state.detach()
    assert state.ended and (cut.births, cut.ended, dict(cut.reports)) == ((), (), {})
    moved = state.to("cpu")
    assert (moved.births, moved.ended, dict(moved.reports)) == ((), (), {})


def test_derivatives_pass_and_detach_cuts_them():
    rate = torch.tensor([1.0, 1.3, 1.6], dtype=torch.float64, requires_grad=True)
    scene = tf.Scene(tf.Growth(rate=rate, law="length"), dim=2, dt=0.1)
    model = scene.bind(3, dtype=torch.float64)
    grown = run(scene, model.start(), 5)
    mixed = grown.put([0, 1], grown, taken=[2, 1])
    (slope,) = torch.autograd.grad(mixed.length.sum(), rate, retain_graph=True)
    length = 0.5 * grown.length.detach()
    assert torch.allclose(slope, torch.stack([0 * length[0], length[1], 2 * length[2]]))
    cut = grown.detach()
    assert grown.length.requires_grad and not cut.length.requires_grad
    assert torch.equal(cut.length, grown.length) and cut.step == 5
    assert not run(scene, cut, 1).length.requires_grad  # growth rates are columns, too


def test_colonies_are_put_on_a_gpu(pretended_cuda):  # noqa: F811
    scene = signalling()
    model = scene.bind(3, device="cuda")
    with torch.no_grad():
        grown = run(scene, model.start(), 20)
        made = run(scene, grown.put([1], model.start(seed=2), taken=[1]), 5)
    assert all(x.device.type == "cuda" for x in columns(made).values())
    with pytest.raises(tf.InputError, match=r"other.device = device\(type='cpu'\)"):
        grown.put([1], scene.bind(3).start(), taken=[1])


def test_a_backward_pass_may_be_cut_off_many_times():
    """Windows with divisions: the column of growth rates is set again after each."""
    rate = torch.tensor([1.0, 1.3], dtype=torch.float64, requires_grad=True)
    scene = tf.Scene(tf.Growth(rate=rate), tf.Division(length=2.4), dim=2, dt=0.1)
    state, slopes = scene.bind(2, dtype=torch.float64).start(), []
    for _ in range(4):
        state = run(scene, state, 4)
        (slope,) = torch.autograd.grad(state.length.sum(), rate)
        slopes.append(slope)
        state = state.detach().with_fields(growth_rate=rate[state.colony_id][state.colony])
    assert state.cells > 8 and all(float(x.min()) > 0 for x in slopes)


def test_nothing_is_put_where_no_colony_is_done():
    state = scene_of().bind(3).start()
    assert state.put([], state, taken=[]) is state
    assert state.put(torch.zeros(0, dtype=torch.int64), state, taken=[]) is state


def test_first_states_take_seeds_of_numpy():
    model = scene_of().bind(3)
    for kind in (np.int32, np.int64, np.uint64):
        made = model.start(seed=kind(3))
        assert made.seed == 3 and torch.equal(
            made.division_threshold, model.start(seed=3).division_threshold
        )
        assert run(scene_of(), made, 1).step == 1


def test_a_grid_that_stays_the_same_is_kept():
    """With what is worked out for it."""
    scene = reservoirs()
    with torch.no_grad():
        grown = run(scene, scene.bind(3).start(), 3)
    assert grown.put([1], grown, taken=[0]).layout is grown.layout


def test_a_recording_refuses_colonies_of_another_course(tmp_path):
    scene = scene_of()
    model, path = scene.bind(3, seed=1), tmp_path / "run.h5"
    states = tf.simulate(scene, colonies=3, seed=1, until=3.0, record=path)
    with pytest.raises(
        tf.InputError, match=r"colony 1 has other cells at step \d+ than a step ago"
    ):
        for state in states:
            if state.step == 40:
                states.send(state.put([1], model.start(seed=4), taken=[1]))
    with tf.Results(path) as results:
        last = results.state(scene)
    assert last.step == 40 and int(last.counts[1]) > 1  # not that of the course that was put
    younger = last.put([1], model.start(seed=4), taken=[1])
    strange = last.replace(uid=last.uid + 900 * (last.colony == 1))
    for mixed in (younger, strange):
        with pytest.raises(tf.InputError, match="with other cells"):
            [*tf.simulate(scene, mixed, until=3.0, record=tf.Recorder(path, scene, append=True))]
    *_, end = tf.simulate(scene, last, until=3.0, record=tf.Recorder(path, scene, append=True))
    assert end.time == pytest.approx(3.0)

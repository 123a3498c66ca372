"""A recording while someone takes cells or colonies out between the steps, and after a write that
failed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.io import recorder as recording
from torchfilm.io.layout import write_rows

FIELDS = {"mark": 0.0}


def scene_of(**variables) -> tf.Scene:
    return tf.Scene(
        tf.Rules(lambda cells: None, variables=variables or FIELDS),
        tf.Growth(rate=tf.Uniform(0.8, 1.2)), tf.Division(length=tf.Uniform(3.0, 4.0)),
        dim=2, dt=0.05,
    )  # fmt: skip


def stored(path, scene, *, until=3.0, state=None, send=None, at=40, **options) -> tf.State:
    """A recorded run; what `send` makes of its state at a step is what goes on."""
    recorder = tf.Recorder(path, scene, **options)
    given = {"colonies": 3, "seed": 1} if state is None else {}
    states = tf.simulate(scene, state, until=until, record=recorder, **given)
    for state in states:
        if send is not None and state.step == at:
            states.send(send(state))
    return state


def odd(state):
    return state.remove(state.uid % 2 == 1, "removed")


def check_lineage(path, end: tf.State) -> None:
    """Who is alive by the lineage is who is there in the last frame, each cell once."""
    with tf.Results(path) as results:
        tree = results.lineage()
    pairs = list(zip(tree.colony.tolist(), tree.cell.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    alive = {pair for pair, fate in zip(pairs, tree.fate, strict=True) if fate == "alive"}
    assert alive == set(zip(end.own_colony_id.tolist(), end.uid.tolist(), strict=True))
    for k in range(3):
        assert sum(tree.clone_sizes(k).values()) == int(end.counts[k])


@pytest.mark.parametrize("at", [40, 43])
def test_cells_that_are_removed_by_hand_have_an_end(tmp_path, at):
    """At a recorded step, of every tenth, and between two."""
    path, scene, sent = tmp_path / "run.h5", scene_of(), []
    end = stored(path, scene, send=lambda s: (sent.append(s), odd(s))[1], at=at)
    check_lineage(path, end)
    (before,) = sent
    gone = before.uid % 2 == 1
    with tf.Results(path) as results:
        tree = results.lineage()
    rows = tree.rows(before.own_colony_id[gone].numpy(), before.uid[gone].numpy())
    assert len(rows) > 3 and set(tree.fate[rows]) == {"removed"}
    assert np.allclose(tree.ended[rows], before.time)
    assert np.allclose(tree.end_length[rows], before.length[gone].numpy())


def test_cells_that_are_removed_before_a_run_resumes_have_an_end(tmp_path):
    path, scene = tmp_path / "run.h5", scene_of()
    stored(path, scene, until=2.0)
    with tf.Results(path) as results:
        last = results.state(scene)
    end = stored(path, scene, state=odd(last), append=True)
    check_lineage(path, end)
    with tf.Results(path) as results:
        tree = results.lineage()
    gone = last.uid % 2 == 1
    rows = tree.rows(last.own_colony_id[gone].numpy(), last.uid[gone].numpy())
    assert len(rows) > 3 and set(tree.fate[rows]) == {"removed"}
    assert np.allclose(tree.ended[rows], 2.0)
    assert np.allclose(tree.end_length[rows], last.length[gone].numpy())


def test_cells_that_are_removed_before_a_resume_are_of_their_own_colony(tmp_path):
    """Also where ids of colonies are not their places."""
    path = tmp_path / "run.h5"
    cells = tf.Cells([[0.0, 0.0], [9.0, 0.0]] * 3, [1.0, 0.0], 2.0, colony=[0, 0, 1, 1, 2, 2])
    scene = tf.Scene(tf.Growth(rate=0.1), founders=cells, dim=2, dt=0.1)
    tf.simulate(scene, scene.bind().start().select([2, 1]), until=0.2, record=path).last()
    with tf.Results(path) as results:
        state = results.state(scene)
    state = state.remove((state.own_colony_id == 2) & (state.uid == 1), "removed")
    tf.simulate(scene, state, until=0.4, record=tf.Recorder(path, scene, append=True)).last()
    with tf.Results(path) as results:
        tree = results.lineage()
    gone = tree.fate == "removed"
    assert list(zip(tree.colony[gone], tree.cell[gone], strict=True)) == [(2, 1)]
    assert set(tree.fate[~gone]) == {"alive"} and len(tree) == 4


def test_types_of_cells_that_are_removed_by_hand_are_kept(tmp_path):
    path = tmp_path / "run.h5"
    scene = tf.Scene(
        tf.Growth(rate=1.0), founders=tf.inoculum(4, 9.0, types={0: 2, 3: 2}), dim=2, dt=0.1
    )
    third = lambda s: s.remove(s.cell_type == 3, "removed")
    for begin, options in ((None, {}), ("last", {"append": True})):
        state = None
        if begin:
            with tf.Results(path) as results:
                state = third(results.state(scene))
        recorder = tf.Recorder(path, scene, **options)
        until = 1.0 if state is None else 2.0
        *_, end = tf.simulate(scene, state, until=until, record=recorder)
    assert end.cells == 2
    with tf.Results(path) as results:
        tree = results.lineage()
    assert sorted(zip(tree.cell_type.tolist(), tree.fate.tolist(), strict=True)) == [
        (0, "alive"), (0, "alive"), (3, "removed"), (3, "removed"),
    ]  # fmt: skip


@pytest.mark.parametrize("places", [[0, 1], [2, 1, 0]])
def test_other_colonies_are_refused_and_the_file_stays_whole(tmp_path, places):
    path, scene = tmp_path / "run.h5", scene_of()
    with pytest.raises(tf.InputError, match=r"has the colonies .* at step 41, and had 0, 1, 2"):
        stored(path, scene, send=lambda s: s.select(places))
    whole = tmp_path / "whole.h5"
    stored(whole, scene)
    with tf.Results(path) as results, tf.Results(whole) as other:
        assert results.steps.tolist() == other.steps.tolist()[: len(results)] and len(results) == 5
        assert np.array_equal(results.counts, other.counts[:5])
        for k in range(5):
            a, b = results.frame(k), other.frame(k)
            assert all(np.array_equal(a[name], b[name]) for name in b)


def test_rows_of_another_shape_are_not_written(tmp_path):
    import h5py

    with h5py.File(tmp_path / "one.h5", "w") as file:
        table = file.create_dataset("counts", data=np.ones((2, 3)), maxshape=(None, None))
        for shape in ((1, 2), (1, 4), (1,)):
            with pytest.raises(ValueError, match=r"/counts has rows of the shape \(3,\)"):
                write_rows(table, 2, np.zeros(shape))
        assert np.array_equal(table[...], np.ones((2, 3)))


def test_a_recorder_that_failed_for_lack_of_room_goes_on_without_doubles(tmp_path, monkeypatch):
    path, scene = tmp_path / "run.h5", scene_of()
    stored(path, scene, until=1.0)
    recorder = tf.Recorder(path, scene, append=True)
    with tf.Results(path) as results:
        last = results.state(scene)
    looks, free = [], recording.free_bytes
    monkeypatch.setattr(
        recording, "free_bytes",
        lambda *a: 0 if (looks.append(a), len(looks) > 2)[1] else free(*a),
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match="Frames up to step 40 are safe"):
        list(tf.simulate(scene, last, until=3.0, record=recorder))
    monkeypatch.setattr(recording, "free_bytes", free)
    with tf.Results(path) as results:
        last = results.state(scene)
    assert last.step == 40
    *_, end = tf.simulate(scene, last, until=3.0, record=recorder)
    check_lineage(path, end)
    with tf.Results(path) as results:
        assert np.array_equal(results.counts[-1], end.counts.numpy())


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"other": 0.0}, "lacks the field 'mark'"),
        ({"mark": 0.0, "more": 1.0}, "has the field 'more'"),
    ],
)
def test_a_state_with_other_fields_does_not_resume_a_file(tmp_path, fields, words):
    path, scene = tmp_path / "run.h5", scene_of()
    stored(path, scene, until=1.0)
    with tf.Results(path) as results:
        last, before = results.state(scene), path.read_bytes()
    other = scene_of(**fields)
    made = other.bind(3, seed=1).start()
    fresh = {n: torch.full_like(last.mark, x) for n, x in fields.items()}
    kept = {n: x for n, x in last.fields.items() if n in made.fields}
    state = last.replace(fields={**kept, **fresh}, declared=made.declared)
    recorder = tf.Recorder(path, other, append=True, changed=True)
    with pytest.raises(tf.InputError, match=words):
        list(tf.simulate(other, state, until=1.5, record=recorder))
    assert path.read_bytes() == before


def test_a_run_that_resumes_at_another_pace_says_so(tmp_path):
    path, scene = tmp_path / "run.h5", scene_of()
    stored(path, scene, until=1.0)
    with tf.Results(path) as results:
        last = results.state(scene)
    stored(path, scene, state=last, until=2.0, append=True, every=5)
    with tf.Results(path) as results:
        assert int(results.attributes["every"]) == 5
        assert results.steps.tolist() == [0, 10, 20, 25, 30, 35, 40]


def test_a_state_without_a_signal_does_not_resume_a_file_that_has_it(tmp_path):
    path = tmp_path / "run.h5"
    media = {n: tf.Signal(diffusion=10.0, initial=1.0) for n in ("a", "b")}
    about = {"box": ((-8, -8), (8, 8)), "spacing": 4.0}
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Medium(**about, **media), dim=2, dt=0.1)
    list(tf.simulate(scene, until=0.2, record=path))
    with tf.Results(path) as results:
        last, before = results.state(scene), path.read_bytes()
    other = tf.Scene(tf.Growth(rate=1.0), tf.Medium(**about, a=media["a"]), dim=2, dt=0.1)
    without = lambda x: {n: v for n, v in x.items() if n != "out.b"}
    state = last.replace(fields=without(last.fields), declared=without(last.declared))
    recorder = tf.Recorder(path, other, append=True, changed=True)
    with pytest.raises(tf.InputError, match="lacks the field 'b'"):
        list(tf.simulate(other, state, until=0.4, record=recorder))
    assert path.read_bytes() == before


def test_a_file_that_goes_on_keeps_its_interval(tmp_path):
    path, scene = tmp_path / "run.h5", scene_of()
    stored(path, scene, until=0.4, every=4)
    for until, every in ((1.0, None), (1.2, 2)):
        with tf.Results(path) as results:
            last = results.state(scene)
        more = {} if every is None else {"every": every}
        stored(path, scene, state=last, until=until, append=True, **more)
    with tf.Results(path) as results:
        assert results.steps.tolist() == [0, 4, 8, 12, 16, 20, 22, 24]


def test_what_is_no_state_is_not_sent():
    run = tf.simulate(scene_of(), until=1.0, colonies=1)
    first = scene_of().bind().start()
    with pytest.raises(tf.InputError, match="before the first state of the run"):
        run.send(first)
    now = next(run)
    with pytest.raises(tf.InputError, match=r"send\(state\) = .*a tf.State"):
        run.send((now, 1))
    assert run.send(now).step == 2

"""Results files: a run goes on from any frame bit for bit, also after a kill."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
import torch
from recorded import DT, UNTIL, assert_same_file, assert_same_state, make_scene, record

import torchfilm as tf
from torchfilm.io.identity import check_same_scene


@pytest.mark.parametrize("frame", [0, 3, 8])
def test_a_run_from_any_frame_is_the_run_itself(whole, frame):
    path, states = whole
    scene = make_scene()
    with tf.Results(path) as results:
        state = results.state(scene, frame)
    last = list(tf.simulate(scene, state, until=UNTIL))[-1]
    assert_same_state(last, states[-1])
    assert all(
        torch.equal(
            getattr(last.reports["mechanics"], n), getattr(states[-1].reports["mechanics"], n)
        )
        for n in ("iterations", "residual")
    )


def test_a_run_of_given_streams_goes_on_with_these(tmp_path):
    """And not with the colonies' numbers, which are the streams by default."""
    path, scene = tmp_path / "run.h5", make_scene()
    first = scene.bind(2, seed=11, streams=[7, 3]).start()
    *_, wanted = tf.simulate(scene, first, until=UNTIL)
    record(scene, first, path, until=1.05)
    with tf.Results(path) as results:
        state = results.state(scene)
    assert state.stream.tolist() == [7, 3]
    *_, last = tf.simulate(scene, state, until=UNTIL)
    assert_same_state(last, wanted)


@pytest.mark.parametrize("stop", [1.05, 1.3], ids=["on a frame", "between frames"])
def test_resume_bit_for_bit(tmp_path, whole, stop):
    """Stopped and resumed, the file holds what the uninterrupted run's file holds, and the lineage
    is the same."""
    path, scene = tmp_path / "run.h5", make_scene()
    record(scene, scene.bind(3, seed=11).start(), path, until=stop)
    scene = make_scene()
    with tf.Results(path) as results:
        state = results.state(scene)
    states = record(scene, state, path, append=True)
    assert_same_state(states[-1], whole[1][-1])
    assert_same_file(whole[0], path)
    assert not [p for p in tmp_path.iterdir() if p != path], "something was left lying about"


def founded(colony: list[int]) -> tf.Cells:
    return tf.Cells([[0.0, 0.0]] * len(colony), [1.0, 0.0], colony=colony)


@pytest.mark.parametrize(
    ("rate", "founders"),
    [([1.0, 1.1, 1.2, 1.3], None), (1.0, founded([0, 1, 2, 3]))],
    ids=["rates", "founders"],
)
def test_selected_colonies_can_be_read(tmp_path, rate, founders):
    """Also where the scene is for more colonies than the file has."""
    scene = tf.Scene(tf.Growth(rate=rate), founders=founders, dim=2)
    first = scene.bind().start().select([2, 0])
    *_, last = tf.simulate(scene, first, until=0.5, record=tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        assert_same_state(results.state(scene), last)


def test_every_step_can_be_resumed_from(tmp_path):
    scene = make_scene()
    record(scene, scene.bind(3, seed=11).start(), tmp_path / "run.h5", until=2.0, every=1)
    with tf.Results(tmp_path / "run.h5") as results:
        for k in range(len(results)):
            scene.bind(state=results.state(scene, k))


def test_a_state_with_a_cell_that_is_due_can_be_resumed_from(tmp_path):
    """Cells from a micrograph may exceed the thresholds drawn for them."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.0, 4.0)), dim=2)
    start = scene.bind(8, cells=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 3.5)).start()
    assert (start.length >= start.division_threshold).any()
    states = record(scene, start, tmp_path / "run.h5", until=0.2, every=1)
    with tf.Results(tmp_path / "run.h5") as results:
        again = results.state(scene, 0)
    assert_same_state(list(tf.simulate(scene, again, until=0.2))[-1], states[-1])
    assert states[-1].cells > start.cells


def test_a_run_from_given_cells_can_be_resumed_where_the_founders_could_not_stand(tmp_path):
    """The wall is at x = 5 and the default founder at 0: only the given cells matter, and they are
    on the right side."""

    def scene_of():
        return tf.Scene(
            tf.Growth(rate=1.0),
            tf.Division(length=3.5),
            tf.Mechanics(dim=2, walls=[tf.Plane(x=5.0, facing="+x")]),
            dt=DT,
        )

    path, scene = tmp_path / "run.h5", scene_of()
    states = record(
        scene,
        scene.bind(2, cells=tf.Cells([[8.0, 0.0]], [[1.0, 0.0]], extra={"gfp": [0.5]})).start(),
        path,
        until=1.0,
    )
    with tf.Results(path) as results:
        assert_same_state(results.state(scene_of()), states[-1])


def test_a_colony_that_has_sunk_into_a_soft_wall_can_be_resumed(tmp_path):
    """A soft wall yields, so a centre may come to lie behind its surface: physics, and no wall
    inside out."""
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(
            walls=[tf.Plane(z=-0.5, facing="+z", stiffness=0.5), tf.Plane(z=0.5, facing="-z")]
        ),
        dt=DT,
    )
    states = record(scene, scene.bind().start(), tmp_path / "run.h5", until=0.5)
    sunk = states[-1].replace(
        position=states[-1].position - torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64)
    )
    assert len(list(tf.simulate(scene, sunk, until=sunk.time + 2 * DT))) == 2


def test_another_scene_is_refused(whole, tmp_path):
    with tf.Results(whole[0]) as results:
        with pytest.raises(tf.InputError, match="2-D"):
            results.state(tf.Scene(tf.Growth(rate=1.0), tf.Mechanics()))
        with pytest.raises(tf.InputError, match=r"it lacks .*birth_length"):
            results.state(
                tf.Scene(tf.Growth(rate=1.0), tf.Division(added=1.0), tf.Mechanics(dim=2))
            )


def test_of_another_scene_only_what_differs_is_named():
    """A circuit has a text of some hundred letters."""

    def scene(leak, high, *more):
        made = tf.Circuit(
            lambda u, s, p, cell: {"gfp": p.make - p.leak * u.gfp},
            species="gfp", initial={"gfp": tf.Uniform(0.0, 2.0)}, make=3.0, leak=leak, **dict(more),
        )  # fmt: skip
        return tf.Scene(tf.Division(length=tf.Uniform(3.0, high)), made, dim=2)

    def said(there, here):
        with pytest.raises(tf.InputError) as caught:
            check_same_scene({"effects": json.dumps(there.listing())}, "run.h5", here)
        return str(caught.value).removeprefix("run.h5 is of another scene: ").partition(". If")[0]

    first = scene(0.5, 4.0)
    assert said(first, scene(0.6, 4.0)) == "Circuit: 'leak: 0.5' there, 'leak: 0.6' in this scene"
    assert said(first, scene(0.5, 4.5)).startswith("Division: 'high=4.0' there, 'high=4.5' in")
    assert said(first, scene(0.5, 4.0, ("steps", 2))) == (
        "Circuit: nothing there, 'steps=2' in this scene"
    )
    courses = [scene(tf.Schedule({0: 0.5, 2: x}), 4.0) for x in (0.6, 0.7)]
    assert said(*courses).endswith("values={0.0: 0.5, 2.0: 0.7' in this scene")
    added = tf.Scene(*first.effects, tf.Growth(rate=1.0), dim=2)
    assert said(first, added) == "this scene has 'Growth(rate=1.0)'"


def ruled(factor: float) -> tf.Scene:
    def update(cells):
        cells.growth_rate = factor * cells.length

    return tf.Scene(tf.Rules(update), tf.Growth(), tf.Division(length=3.0), dt=DT)


def test_a_function_that_was_edited_is_another_scene(tmp_path):
    """The listing calls both `Rules(update=update)`."""
    path = tmp_path / "run.h5"
    first, edited = ruled(0.5), ruled(0.6)
    assert first.listing() == edited.listing()
    record(first, first.bind(2).start(), path, until=2 * DT)
    with tf.Results(path) as results:
        state = results.state(ruled(0.5))
        with pytest.raises(
            tf.InputError, match=r"a function of its effects was edited.*resume --changed"
        ):
            results.state(edited)
        assert results.state(edited, changed=True).step == state.step
    with pytest.raises(
        tf.InputError, match=r"a function of its effects was edited.*Recorder\(…, changed=True\)"
    ):
        record(edited, state, path, append=True)
    with tf.Results(path) as results:
        results.check_alike(first)
        assert len(results) == 2
    recorder = tf.Recorder(path, edited, append=True, changed=True)
    *_, last = tf.simulate(edited, state, until=4 * DT, record=recorder)
    with tf.Results(path) as results:
        results.check_alike(edited)
        assert results.times[-1] == last.time
        with pytest.raises(tf.InputError, match=r"frame = 'a' .*whole number"):
            results.frame("a")


def test_a_rule_that_keeps_a_diary_is_not_taken_for_edited(tmp_path):
    """What it holds on to grows as it runs; that of the file is from before."""
    path, diary = tmp_path / "run.h5", []

    def update(cells):
        cells.growth_rate = 1.0
        diary.append(len(cells.uid))

    scene = tf.Scene(tf.Rules(update), tf.Growth(), tf.Division(length=3.0), dt=DT)
    last = record(scene, scene.bind(2).start(), path, until=2 * DT)[-1]
    assert len(diary) > 1
    record(scene, last, path, until=4 * DT, append=True)
    with tf.Results(path) as results:
        assert results.state(scene).step == 4


def test_going_on_by_other_settings_is_reported_in_the_file(tmp_path):
    path, base = tmp_path / "run.h5", tf.scenes.microcolony()
    last = record(base, base.bind(2).start(), path, until=2 * base.dt)[-1]
    finer = tf.Settings(tolerance=0.01).apply(base)
    for _ in tf.simulate(
        finer, last, until=4 * base.dt, record=tf.Recorder(path, finer, append=True, changed=True)
    ):
        pass
    with tf.Results(path) as results:
        again = tf.Settings.named(results.accuracy, str(path)).apply(
            tf.scenes.build(*results.recipe)
        )
        assert results.state(again).step == 4


def test_a_file_of_another_python_is_not_refused_for_its_code(tmp_path):
    """Versions of Python compile one function in two ways."""
    path = tmp_path / "run.h5"
    record(ruled(0.5), ruled(0.5).bind(2).start(), path, until=2 * DT)
    with h5py.File(path, "r+") as file:
        file.attrs["code"] = json.dumps(["3.99", *json.loads(file.attrs["code"])[1:2], "another"])
    with tf.Results(path) as results:
        assert results.state(ruled(0.5)).step == 2


def test_appending_from_another_moment_is_refused_and_harms_nothing(whole, tmp_path):
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    with tf.Results(path) as results:
        early = results.state(scene, 2)
    with pytest.raises(tf.InputError, match="last frame"):
        record(scene, early, path, append=True)
    assert_same_file(whole[0], path)


def test_frames_are_counted_from_the_first_one(tmp_path):
    scene, path = make_scene(), tmp_path / "run.h5"
    *_, state = tf.simulate(scene, scene.bind(1, seed=2).start(), until=3 * DT)
    record(scene, state, path, until=12 * DT)
    with tf.Results(path) as results:
        assert results.steps.tolist() == [3, 10, 12]


def test_a_state_of_another_run_is_not_appended(whole, tmp_path):
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    with tf.Results(path) as results:
        last = results.state(scene)
    other = last.replace(stream=last.stream + 5)
    with pytest.raises(tf.InputError, match=r"streams\) .* of .*, as .* is"):
        record(scene, other, path, until=UNTIL + DT, append=True)
    with pytest.raises(tf.InputError, match="with other cells"):
        later = last.replace(next_uid=last.next_uid + 1)
        record(scene, later, path, until=UNTIL + DT, append=True)
    assert_same_file(whole[0], path)


def test_numbers_of_a_ready_scene_come_back_as_its_recipe(tmp_path):
    for given in (1.0, [1.0, 0.5], torch.tensor([1.0, 0.5]), np.array([1.0, 0.5])):
        scene = tf.scenes.microcolony(rate=given)
        path = tmp_path / f"{type(given).__name__}.h5"
        states = record(scene, scene.bind(2).start(), path, until=0.2, every=1)
        with tf.Results(path) as results:
            name, parameters = results.recipe
            again = tf.scenes.build(name, parameters)
            state = results.state(again, 0)
        assert_same_state([state, *tf.simulate(again, state, until=0.2)][-1], states[-1])


WRITE = """
import sys, torchfilm as tf
from recorded import make_scene
scene = make_scene()
recorder = tf.Recorder(sys.argv[1], scene, every=1)
for _ in tf.simulate(scene, colonies=3, seed=11, until=3.0, record=recorder):
    pass
"""


@pytest.mark.slow
@pytest.mark.parametrize("attempt", range(3))
def test_killed_at_any_moment_the_file_opens_and_the_run_resumes(tmp_path, every_step, attempt):
    """kill −9 at a moment drawn at random: no frame that was finished is lost, and the resumed run
    ends as if nothing had happened."""
    path = tmp_path / "run.h5"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.path.dirname(__file__)}
    child = subprocess.Popen([sys.executable, "-c", WRITE, str(path)], env=environment)
    try:
        seen = 0
        for _ in range(30_000):  # ten minutes: other work may hold the machine
            time.sleep(0.02)
            assert child.poll() is None, "the run ended by itself before it could be killed"
            try:
                with tf.Results(path) as results:
                    seen = len(results)
                break
            except tf.InputError:
                continue  # not there yet
        time.sleep(random.uniform(0.0, 0.5))
    finally:
        if child.poll() is None:
            child.send_signal(signal.SIGKILL)
        child.wait()
    assert child.returncode == -signal.SIGKILL, (
        "the run was over before it was killed: nothing tested"
    )
    scene = make_scene()
    with tf.Results(path) as results:
        assert len(results) >= max(1, seen)
        assert results.steps.tolist() == list(range(len(results)))
        state = results.state(scene)
    assert_same_state(state, every_step[1][state.step])
    states = record(scene, state, path, every=1, append=True)
    assert_same_state(states[-1], every_step[1][-1])
    assert_same_file(every_step[0], path)


def test_a_ready_scene_with_other_effects_has_no_recipe(tmp_path):
    """What its function was given no longer says what is simulated."""
    base = tf.scenes.microcolony(rate=1.0)
    slower = base.replace(tf.Growth(rate=0.5), *base.effects[1:])
    assert base.recipe[1]["rate"] == 1.0 and slower.recipe is None
    assert base.replace(dt=0.01).recipe == base.recipe


def controlled(net) -> tf.Scene:
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"a": net(u.a[:, None])[:, 0] - u.a}, species="a", method="heun2"
    )
    return tf.Scene(tf.Growth(rate=1.0), circuit, dim=2, dt=DT)


def weighed(value: float) -> torch.nn.Module:
    net = torch.nn.Sequential(torch.nn.Linear(1, 1), torch.nn.Softplus())
    with torch.no_grad():
        for x in net.parameters():
            x.fill_(value)
    return net


def test_other_weights_are_another_scene_and_training_is_no_edit(tmp_path):
    """The weights that count are those of the run, not those when the scene was made."""
    path, net = tmp_path / "run.h5", weighed(0.1)
    scene = controlled(net)
    with torch.no_grad():
        net[0].weight.fill_(0.5)
    last = record(scene, scene.bind(2).start(), path, until=2 * DT)[-1]
    same = weighed(0.1)
    same.load_state_dict(net.state_dict())
    with tf.Results(path) as results:
        assert results.state(controlled(same)).step == results.state(scene).step == 2
        with pytest.raises(tf.InputError, match=r"the weights of a network that its effects use"):
            results.state(controlled(weighed(0.1)))
        assert results.state(controlled(weighed(0.1)), changed=True).step == 2
    with torch.no_grad():
        net[0].weight.fill_(0.6)
    with pytest.raises(tf.InputError, match="the weights of a network that its effects use"):
        record(scene, last, path, until=4 * DT, append=True)
    with h5py.File(path, "r+") as file:  # as an earlier version wrote it
        file.attrs["code"] = json.dumps(json.loads(file.attrs["code"])[:3])
    with tf.Results(path) as results:
        assert results.state(scene).step == 2


def test_a_frame_is_measured_without_its_scene(whole):
    """All that the file holds is there, and a run goes on from it."""
    path, states = whole
    with tf.Results(path) as results:
        bare, full = results.state(frame=3), results.state(make_scene(), 3)
    assert_same_state(bare, full)
    assert (bare.time, bare.step, bare.seed) == (full.time, full.step, full.seed)
    assert torch.equal(tf.measure.colony_radius(bare), tf.measure.colony_radius(full))
    *_, last = tf.simulate(make_scene(), bare, until=UNTIL)
    assert_same_state(last, states[-1])


def test_a_frame_with_a_medium_and_one_in_a_periodic_space(tmp_path):
    signals = {"a": tf.Signal(20.0, initial=lambda x: x[:, 0] ** 2), "b": tf.Signal(2.0)}
    box = {"box": [[-10.0, -12.0], [10.0, 12.0]], "spacing": 2.0, "height": 0.5, "depth": 1.0}
    faces = tf.BoundaryConditions(x=tf.Periodic())
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Medium(**signals, **box, boundary=faces),
        tf.Mechanics(dim=2, periodic={"x": (-10.0, 10.0)}),
    )  # fmt: skip
    tf.simulate(scene, until=3.0, colonies=2, record=tmp_path / "run.h5").last()
    with tf.Results(tmp_path / "run.h5") as results:
        bare, full = results.state(), results.state(scene)
        with pytest.raises(tf.InputError, match=r"scene = 3 .* results\.state\(frame=…\)"):
            results.state(3)
    assert bare.space.faces == full.space.faces
    assert torch.equal(bare.position_3d, full.position_3d)
    assert bare.layout.periodic == full.layout.periodic == (True, False, False)
    assert torch.equal(bare.layout.grid.origin, full.layout.grid.origin)
    assert all(torch.equal(bare.signals[n], full.signals[n]) for n in "ab")
    assert torch.equal(tf.measure.overlaps(bare).worst, tf.measure.overlaps(full).worst)
    assert float(tf.measure.overlaps(bare).worst.max()) > 0.0

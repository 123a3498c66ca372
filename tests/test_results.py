"""Results files: round trip, tables, lineage, reading while writing, kills, resuming, and every way a file can be bad."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass

import h5py
import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.effect import Effect
from torchfilm.state import PER_CELL

UNTIL, DT, EVERY = 3.0, 0.05, 7


def removing(cells):
    cells.mark = cells.mark + cells.random()
    cells.remove_flag = (cells.uid == 3) & (cells.time > 2.0)


def make_scene() -> tf.Scene:
    """Divisions at random, a rule with draws of its own, and removals: everything that a restart must carry on."""
    return tf.Scene(
        tf.Rules(removing, variables={"mark": 0.0}), tf.Growth(rate=tf.Uniform(0.8, 1.2)), tf.Division(length=tf.Uniform(3.0, 4.0)),
        tf.Mechanics(dim=2), dt=DT,
    )  # fmt: skip


def record(scene: tf.Scene, state: tf.State, path, until: float = UNTIL, **options) -> list[tf.State]:
    """All states of a run, the first included."""
    recorder = tf.Recorder(path, scene, **{"every": EVERY, **options})
    return [state, *tf.simulate(scene, state, until=until, record=recorder)]


def assert_same_state(a: tf.State, b: tf.State) -> None:
    """Every array equal bit for bit, and of one type."""
    for name in (*PER_CELL, "colony_id", "next_uid"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype and torch.equal(x, y), name
    assert set(a.fields) == set(b.fields)
    for name, x in a.fields.items():
        assert x.dtype == b.fields[name].dtype and torch.equal(x, b.fields[name]), name
    assert (a.step, a.time, a.seed) == (b.step, b.time, b.seed)


def assert_same_file(path, other, frames: list[int] | None = None) -> None:
    """The same frames (all, or those of the given steps in the first) and the same lineage."""
    with tf.Results(path) as a, tf.Results(other) as b:
        steps = b.steps.tolist()
        for k, step in enumerate(a.steps.tolist()):
            if frames is None or step in frames:
                j = steps.index(step)
                x, y = a.frame(k), b.frame(j)
                assert set(x) == set(y) and a.times[k] == b.times[j]
                for name in x:
                    assert x[name].dtype == y[name].dtype and np.array_equal(x[name], y[name]), (step, name)
        for name, x in a.lineage().items():
            assert np.array_equal(x, b.lineage()[name]), name


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of three colonies that nothing interrupted: (path, its states)."""
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    scene = make_scene()
    return path, record(scene, scene.seed(3, seed=11), path)


# --- round trip -----------------------------------------------------------------------------------------------------------


def test_every_seventh_step_and_the_last_are_there(whole):
    path, states = whole
    with tf.Results(path) as results:
        assert len(results) == 10
        assert results.steps.tolist() == [0, 7, 14, 21, 28, 35, 42, 49, 56, 60]
        assert results.times.tolist() == [states[k].time for k in results.steps]
        assert results.times[-1] == pytest.approx(UNTIL, rel=1e-12)
        assert np.array_equal(results.counts, [states[k].counts.tolist() for k in results.steps])
        assert results.colony_id.tolist() == [0, 1, 2]


def test_frames_are_the_states(whole):
    path, states = whole
    with tf.Results(path) as results:
        for k, step in enumerate(results.steps):
            frame, state = results.frame(k), states[step]
            assert set(frame) == {*PER_CELL, *state.fields}
            for name, value in frame.items():
                assert np.array_equal(value, getattr(state, name).numpy()), name
        assert np.array_equal(results.frame()["uid"], results.frame(9)["uid"])
        assert np.array_equal(results.frame(-10)["uid"], results.frame(0)["uid"])


@pytest.mark.parametrize("frame", [10, -11])
def test_a_frame_that_is_not_there_is_told(whole, frame):
    with tf.Results(whole[0]) as results, pytest.raises(tf.InputError, match="10 frames"):
        results.frame(frame)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_states_come_back_whole(tmp_path, dtype):
    scene = make_scene()
    states = record(scene, scene.seed(2, dtype=dtype), tmp_path / "run.h5", until=1.0)
    with tf.Results(tmp_path / "run.h5") as results:
        for k, step in enumerate(results.steps):
            assert_same_state(results.state(make_scene(), k), states[step])


def test_what_a_file_says_of_itself(whole):
    with tf.Results(whole[0]) as results:
        a = results.attributes
    assert (a["seed"], a["dim"], a["dtype"], a["dt"], a["every"]) == (11, 2, "float32", DT, EVERY)
    assert a["torchfilm"] == tf.__version__ and a["torch"] == str(torch.__version__)
    assert "Division(length=Uniform(low=3.0, high=4.0))" in a["scene"]


def test_the_step_that_was_used_is_the_step_that_is_told(tmp_path):
    """`simulate(dt=…)` may differ from the scene's own step: a resumed run must know."""
    scene = make_scene()
    for _ in tf.simulate(scene, scene.seed(), until=0.4, dt=0.1, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.attributes["dt"] == 0.1


def test_a_file_holds_numbers_and_text_only(whole):
    """Data only: nothing pickled, nothing that is run when the file is read."""

    def look(name, item):
        for attribute, value in item.attrs.items():
            assert isinstance(value, (str, int, float, np.integer, np.floating)), (name, attribute)
        if isinstance(item, h5py.Dataset):
            assert item.dtype.kind in "iufb", (name, item.dtype)

    with h5py.File(whole[0]) as file:
        look("/", file)
        file.visititems(look)
        assert all(b"cbuiltins" not in str(v).encode() for v in file.attrs.values())
        assert file["cells/position"].compression == "gzip" and file["cells/position"].chunks is not None


def test_the_table_has_a_row_for_each_cell(whole):
    path, states = whole
    with tf.Results(path) as results:
        table = results.table()
        last = results.table(-1)
        total = int(results.counts.sum())
    assert {len(v) for v in table.values()} == {total}
    for name in ("frame", "time", "colony", "uid", "parent", "x", "y", "axis_x", "axis_y", "length", "radius", "growth_rate", "mark"):
        assert name in table, name
    assert "z" not in table and all(v.ndim == 1 for v in table.values())
    assert np.array_equal(np.unique(table["frame"]), np.arange(10))
    assert np.array_equal(last["x"], states[-1].position[:, 0].numpy()) and np.array_equal(last["colony"], states[-1].colony.numpy())
    assert (last["time"] == states[-1].time).all()


def test_colonies_of_a_selection_keep_their_ids(tmp_path):
    scene = make_scene()
    record(scene, scene.seed(4).select([3, 1]), tmp_path / "run.h5", until=1.0)
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.colony_id.tolist() == [3, 1]
        assert set(results.table()["colony"].tolist()) == {1, 3}
        assert set(results.lineage()["colony"].tolist()) == {1, 3}
        state = results.state(make_scene())
    assert state.colony_id.tolist() == [3, 1]


# --- lineage --------------------------------------------------------------------------------------------------------------


def test_lineage_is_consistent(whole):
    path, states = whole
    with tf.Results(path) as results:
        found = results.lineage()
    keys = list(zip(found["colony"].tolist(), found["uid"].tolist(), strict=True))
    assert len(set(keys)) == len(keys)
    row = {key: k for k, key in enumerate(keys)}
    for k, (colony, _) in enumerate(keys):
        parent = int(found["parent"][k])
        if parent == -1:
            assert found["born"][k] == 0
            continue
        p = row[(colony, parent)]
        assert found["fate"][p] == "divided" and found["ended"][p] == found["born"][k], "a daughter is born when its parent ends"
        assert found["born"][p] < found["born"][k]
    ended = found["ended"] >= 0
    assert (found["ended"][ended] >= found["born"][ended]).all()
    assert ((found["fate"] == "alive") == ~ended).all()
    assert set(found["fate"]) == {"alive", "divided", "removed"}
    daughters = np.bincount([row[(c, int(p))] for (c, _), p in zip(keys, found["parent"], strict=True) if p >= 0], minlength=len(keys))
    assert (daughters == np.where(found["fate"] == "divided", 2, 0)).all()
    for state in states:  # who is alive at each step is who has been born and has not ended
        alive = (found["born"] <= state.step) & ((found["ended"] < 0) | (found["ended"] > state.step))
        assert sorted(np.array(keys)[alive].tolist()) == sorted([list(k) for k in zip(state.colony.tolist(), state.uid.tolist(), strict=True)])


def test_lineage_of_a_run_that_starts_in_the_middle_of_another(tmp_path):
    """The state of a run's last step still carries that step's births; a new file must not count them again."""
    scene = make_scene()
    state = scene.seed(2, seed=1)
    while not state.births:
        state = scene.step(state, DT)
    record(scene, state, tmp_path / "run.h5", until=state.time + 1.0)
    with tf.Results(tmp_path / "run.h5") as results:
        found, first = results.lineage(), results.frame(0)
    keys = list(zip(found["colony"].tolist(), found["uid"].tolist(), strict=True))
    assert len(set(keys)) == len(keys), "a cell is listed twice"
    assert (found["born"] >= state.step).all()
    begun = set(zip(first["colony"].tolist(), first["uid"].tolist(), strict=True))
    for key, parent in zip(keys, found["parent"].tolist(), strict=True):
        assert key in begun or (key[0], parent) in keys
    with tf.Results(tmp_path / "run.h5") as results:
        last = results.frame()
    alive = [k for k, fate in zip(keys, found["fate"], strict=True) if fate == "alive"]
    assert sorted(alive) == sorted(zip(last["colony"].tolist(), last["uid"].tolist(), strict=True))


# --- reading while it grows -----------------------------------------------------------------------------------------------

READ = """
import sys, torchfilm as tf
with tf.Results(sys.argv[1]) as results:
    print(len(results), int(results.counts[-1].sum()), len(results.frame()["uid"]), len(results.lineage()["uid"]))
"""


def python(code: str, *arguments: object, **options) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment, check=False, **options)


@pytest.mark.slow
def test_reading_while_the_writer_is_open(tmp_path):
    """From this process, from an open reader that refreshes, and from another process."""
    path = tmp_path / "run.h5"
    scene = make_scene()
    run = tf.simulate(scene, scene.seed(2), until=2.0, record=tf.Recorder(path, scene, every=5))
    for _ in range(10):
        state = next(run)
    with tf.Results(path) as results:
        assert results.steps.tolist() == [0, 5, 10]
        assert np.array_equal(results.frame()["position"], state.position.numpy())
        before = results.frame(1)["position"]
        for _ in range(20):
            state = next(run)
        results.refresh()
        assert results.steps.tolist() == [0, 5, 10, 15, 20, 25, 30]
        assert np.array_equal(results.frame()["position"], state.position.numpy())
        assert np.array_equal(results.frame(1)["position"], before)
        assert len(results.lineage()["uid"]) >= state.cells
    other = python(READ, path)
    assert other.returncode == 0, other.stderr
    assert other.stdout.split()[:3] == ["7", str(state.cells), str(state.cells)]
    assert list(run)[-1].step == 40, "the writer goes on"
    with tf.Results(path) as results:
        assert results.steps[-1] == 40


@dataclass(frozen=True)
class Plate(Effect):
    """A quantity of the colony, counting steps."""

    stage = 60
    title = "plate"

    def declares(self, dim):
        return (tf.Field("plate", "per colony", scope="colony", shape=(2,)),)

    def step(self, state, dt):
        return state.with_fields(plate=state.plate + 1)


def test_fields_of_colonies_are_recorded_and_come_back(tmp_path):
    path, scene = tmp_path / "run.h5", tf.Scene(tf.Growth(rate=1.0), Plate())
    run = tf.simulate(scene, scene.seed(3), until=0.5, dt=0.1, record=tf.Recorder(path, scene, every=1))
    next(run)
    with tf.Results(path) as results:
        assert results.state(scene).plate.tolist() == [[1.0, 1.0]] * 3
        next(run)
        results.refresh()
        assert results.state(scene).plate.tolist() == [[2.0, 2.0]] * 3
    list(run)
    with tf.Results(path) as results:
        assert results.state(scene).plate.tolist() == [[5.0, 5.0]] * 3
        assert results.state(scene, 1).plate.tolist() == [[1.0, 1.0]] * 3


# --- restart --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", [0, 3, 8])
def test_a_run_from_any_frame_is_the_run_itself(whole, frame):
    path, states = whole
    scene = make_scene()
    with tf.Results(path) as results:
        state = results.state(scene, frame)
    last = list(tf.simulate(scene, state, until=UNTIL))[-1]
    assert_same_state(last, states[-1])
    assert all(torch.equal(getattr(last.reports["mechanics"], n), getattr(states[-1].reports["mechanics"], n)) for n in ("iterations", "residual"))


@pytest.mark.parametrize("stop", [1.05, 1.3], ids=["on a frame", "between frames"])
def test_resume_bit_for_bit(tmp_path, whole, stop):
    """Stopped and resumed, the file holds what the uninterrupted run's file holds, and the lineage is the same."""
    path, scene = tmp_path / "run.h5", make_scene()
    record(scene, scene.seed(3, seed=11), path, until=stop)
    scene = make_scene()
    with tf.Results(path) as results:
        state = results.state(scene)
    states = record(scene, state, path, append=True)
    assert_same_state(states[-1], whole[1][-1])
    assert_same_file(whole[0], path)
    assert not [p for p in tmp_path.iterdir() if p != path], "something was left lying about"


def test_every_step_can_be_resumed_from(tmp_path):
    """Also those in which a cell is due to divide but has not done so yet."""
    scene = make_scene()
    record(scene, scene.seed(3, seed=11), tmp_path / "run.h5", until=2.0, every=1)
    with tf.Results(tmp_path / "run.h5") as results:
        due = 0
        for k in range(len(results)):
            state = results.state(scene, k)
            due += bool((state.length >= state.division_threshold).any())
            scene.check(state)
        assert due > 0, "the run has no such step; the test would prove nothing"


def test_a_run_from_given_cells_can_be_resumed_where_the_founders_could_not_stand(tmp_path):
    """The wall is at x = 5 and the default founder at 0: only the given cells matter, and they are on the right side."""

    def scene_of():
        return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2, walls=[tf.Plane(x=5.0, facing="+x")]), dt=DT)

    path, scene = tmp_path / "run.h5", scene_of()
    states = record(scene, scene.seed(2, cells=tf.Cells([[8.0, 0.0]], [[1.0, 0.0]], extra={"gfp": [0.5]})), path, until=1.0)
    with tf.Results(path) as results:
        assert_same_state(results.state(scene_of()), states[-1])


def test_a_colony_that_has_sunk_into_a_soft_wall_can_be_resumed(tmp_path):
    """A soft wall yields, so a centre may come to lie behind its surface: physics, and no wall inside out."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(walls=[tf.Plane(z=-0.5, facing="+z", stiffness=0.5), tf.Plane(z=0.5, facing="-z")]), dt=DT)
    states = record(scene, scene.seed(), tmp_path / "run.h5", until=0.5)
    sunk = states[-1].replace(position=states[-1].position - torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64))
    assert len(list(tf.simulate(scene, sunk, until=sunk.time + 2 * DT))) == 2


def test_another_scene_is_refused(whole, tmp_path):
    with tf.Results(whole[0]) as results:
        with pytest.raises(tf.InputError, match="2-D"):
            results.state(tf.Scene(tf.Growth(rate=1.0), tf.Mechanics()))
        with pytest.raises(tf.InputError, match=r"birth_length.*another scene"):
            results.state(tf.Scene(tf.Growth(rate=1.0), tf.Division(added=1.0), tf.Mechanics(dim=2)))


def test_appending_from_another_moment_is_refused_and_harms_nothing(whole, tmp_path):
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    with tf.Results(path) as results:
        early = results.state(scene, 2)
    with pytest.raises(tf.InputError, match="last frame"):
        record(scene, early, path, append=True)
    assert_same_file(whole[0], path)


def test_numbers_of_a_ready_scene_come_back_as_its_recipe(tmp_path):
    for given in (1.0, [1.0, 0.5], torch.tensor([1.0, 0.5]), np.array([1.0, 0.5])):
        scene = tf.scenes.microcolony(rate=given)
        path = tmp_path / f"{type(given).__name__}.h5"
        states = record(scene, scene.seed(2), path, until=0.2, every=1)
        with tf.Results(path) as results:
            name, parameters = results.recipe
            again = tf.scenes.build(name, parameters)
            state = results.state(again, 0)
        assert_same_state([state, *tf.simulate(again, state, until=0.2)][-1], states[-1])


WRITE = """
import sys, torchfilm as tf
from test_results import make_scene
scene = make_scene()
for _ in tf.simulate(scene, scene.seed(3, seed=11), until=3.0, record=tf.Recorder(sys.argv[1], scene, every=1)):
    pass
"""


@pytest.fixture(scope="module")
def every_step(tmp_path_factory):
    path = tmp_path_factory.mktemp("every") / "run.h5"
    scene = make_scene()
    return path, record(scene, scene.seed(3, seed=11), path, every=1)


@pytest.mark.slow
@pytest.mark.parametrize("attempt", range(3))
def test_killed_at_any_moment_the_file_opens_and_the_run_resumes(tmp_path, every_step, attempt):
    """kill −9 at a moment drawn at random: no frame that was finished is lost, and the resumed run ends as if nothing had happened."""
    path = tmp_path / "run.h5"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.path.dirname(__file__)}
    child = subprocess.Popen([sys.executable, "-c", WRITE, str(path)], env=environment)
    try:
        seen = 0
        for _ in range(600):
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
    assert child.returncode == -signal.SIGKILL, "the run was over before it was killed: nothing tested"
    scene = make_scene()
    with tf.Results(path) as results:
        assert len(results) >= max(1, seen)
        assert results.steps.tolist() == list(range(len(results)))
        state = results.state(scene)
    assert_same_state(state, every_step[1][state.step])
    states = record(scene, state, path, every=1, append=True)
    assert_same_state(states[-1], every_step[1][-1])
    assert_same_file(every_step[0], path)


# --- bad files ------------------------------------------------------------------------------------------------------------


READ_ALL = """
import sys, torchfilm as tf
for path in sys.argv[1:]:
    try:
        with tf.Results(path) as results:
            for k in range(len(results)):
                results.frame(k)
            results.table()
            results.lineage()
        found = "read to the end"
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
    print(path, found.replace(chr(10), " "), sep="|", flush=True)
"""


def told(data: bytes, shares: list[float], folder) -> dict[str, str]:
    """What a reader says of files cut after these shares of their bytes. In a process of its own, because it may never come back."""
    paths = [folder / f"cut{int(1000 * share)}.h5" for share in shares]
    for path, share in zip(paths, shares, strict=True):
        path.write_bytes(data[: int(share * len(data))])
    command = [sys.executable, "-c", READ_ALL, *map(str, paths)]
    try:
        out = subprocess.run(command, capture_output=True, text=True, timeout=15, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False).stdout
    except subprocess.TimeoutExpired as expired:
        out = (expired.stdout or b"").decode()
    found = dict(line.split("|", 1) for line in out.splitlines())
    return {path.name: found.get(str(path), "still trying after 15 s") for path in paths}


SHARES = [0.0, 0.001, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99]


@pytest.mark.slow
def test_a_truncated_file_is_told(whole, tmp_path):
    """Cut anywhere, a file says so: no crash with something unreadable, no endless wait, no half of the data."""
    found = told(whole[0].read_bytes(), SHARES, tmp_path)
    assert not {name: said for name, said in found.items() if not (said.startswith("InputError") and name in said)}


@pytest.mark.slow
def test_a_truncated_file_left_by_a_kill_is_told(tmp_path):
    """As above for a file that its writer never closed, as it is while a run goes on, copied in part."""
    path, scene = tmp_path / "open.h5", make_scene()
    run = tf.simulate(scene, scene.seed(3, seed=11), until=UNTIL, record=tf.Recorder(path, scene, every=1))
    for _ in range(50):
        next(run)
    data = path.read_bytes()
    run.close()
    found = told(data, SHARES, tmp_path)
    assert not {name: said for name, said in found.items() if not (said.startswith("InputError") and name in said)}


def test_a_foreign_hdf5_file_is_told(tmp_path):
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["x"] = [1.0, 2.0]
    with pytest.raises(tf.InputError, match=r"foreign\.h5 is not a torchfilm results file"):
        tf.Results(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "torchfilm results"
    with pytest.raises(tf.InputError, match=r"foreign\.h5"):
        tf.Results(path)


def test_a_text_file_and_no_file_are_told(tmp_path):
    path = tmp_path / "text.h5"
    path.write_text("cells, frames and other words\n" * 100)
    with pytest.raises(tf.InputError, match=r"text\.h5.*not a results file"):
        tf.Results(path)
    with pytest.raises(tf.InputError, match=r"missing\.h5.*No such file"):
        tf.Results(tmp_path / "missing.h5")
    with pytest.raises(tf.InputError):
        tf.Results(tmp_path)


def test_a_file_of_a_newer_format_is_told(whole, tmp_path):
    path = tmp_path / "new.h5"
    shutil.copy(whole[0], path)
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 99
    with pytest.raises(tf.InputError, match=r"99.*Update"):
        tf.Results(path)


def test_a_file_with_no_finished_frame_is_told(whole, tmp_path):
    path = tmp_path / "empty.h5"
    shutil.copy(whole[0], path)
    with h5py.File(path, "r+") as file:
        file["frames/step"].resize(0, axis=0)
    with pytest.raises(tf.InputError, match="no finished frame"):
        tf.Results(path)


# --- bad places to write --------------------------------------------------------------------------------------------------


def test_an_existing_file_is_not_overwritten_unasked(whole, tmp_path):
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    with pytest.raises(tf.InputError, match="overwrite"):
        tf.Recorder(path, scene)
    with pytest.raises(tf.InputError, match="overwrite"):
        tf.simulate(scene, scene.seed(), until=1.0, record=path)
    assert_same_file(whole[0], path)
    record(scene, scene.seed(), path, until=0.1, overwrite=True)
    with tf.Results(path) as results:
        assert results.steps.tolist() == [0, 2]


def test_a_run_that_cannot_start_leaves_the_old_file_alone(whole, tmp_path):
    """Overwriting begins with the first frame: a scene that is refused before must not cost the old results."""
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    recorder = tf.Recorder(path, scene, overwrite=True)
    with pytest.raises(tf.InputError):
        list(tf.simulate(scene, scene.seed(), until=-1.0, record=recorder))
    assert_same_file(whole[0], path)


def test_bad_places_and_intervals_are_told(tmp_path):
    scene = make_scene()
    with pytest.raises(tf.InputError, match="folder that exists"):
        tf.Recorder(tmp_path / "nowhere" / "run.h5", scene)
    with pytest.raises(tf.InputError, match="No such file"):
        tf.Recorder(tmp_path / "run.h5", scene, append=True)
    with pytest.raises(tf.InputError):
        tf.Recorder(tmp_path, scene)
    for every in (0, -1, 1.5, True, None):
        with pytest.raises(tf.InputError, match="every"):
            tf.Recorder(tmp_path / "run.h5", scene, every=every)


def test_a_folder_in_the_place_of_the_file_is_told(tmp_path):
    with pytest.raises(tf.InputError, match=r"folder\.h5"):
        scene = make_scene()
        (tmp_path / "folder.h5").mkdir()
        record(scene, scene.seed(), tmp_path / "folder.h5", until=0.1, overwrite=True)


def test_a_full_disk_is_told_and_loses_no_frame(tmp_path, monkeypatch, every_step):
    """Writing fails with ENOSPC from the 20th frame on; after that there is room again."""
    path, scene = tmp_path / "run.h5", make_scene()
    real, full = h5py.Dataset.__setitem__, []

    def write(self, key, value):
        if full:
            raise OSError(28, "No space left on device")
        return real(self, key, value)

    monkeypatch.setattr(h5py.Dataset, "__setitem__", write)
    run = tf.simulate(scene, scene.seed(3, seed=11), until=UNTIL, record=tf.Recorder(path, scene, every=1))
    for _ in range(20):
        next(run)
    full.append(True)
    with pytest.raises(tf.SimulationError, match=r"run\.h5.*No space left.*step 20") as caught:
        next(run)
    assert "\n" not in str(caught.value)
    full.clear()
    with tf.Results(path) as results:
        assert results.steps.tolist() == list(range(21))
        state = results.state(scene)
    record(scene, state, path, every=1, append=True)
    assert_same_file(every_step[0], path)


@pytest.mark.parametrize("column", ["cells/uid", "lineage/births/uid", "frames/first_row", "frames/counts", "frames/time", "frames/step"])
@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["disk", "Ctrl-C"])
def test_a_frame_broken_off_at_any_column_is_no_frame(tmp_path, monkeypatch, every_step, column, failure):
    """Writing breaks off once, somewhere in the 20th frame: no frame may hold half of it, and what is resumed is whole."""
    path, scene = tmp_path / "run.h5", make_scene()
    real, armed = h5py.Dataset.__setitem__, []

    def write(self, key, value):
        if armed and self.name == f"/{column}":
            armed.clear()
            raise failure
        return real(self, key, value)

    monkeypatch.setattr(h5py.Dataset, "__setitem__", write)
    run = tf.simulate(scene, scene.seed(3, seed=11), until=UNTIL, record=tf.Recorder(path, scene, every=1))
    state = None
    while state is None or state.step < 19:
        state = next(run)
    while not scene.step(state, DT).births:  # a step with births, so that lineage is written too
        state = next(run)
    armed.append(True)
    with pytest.raises((tf.SimulationError, KeyboardInterrupt)):
        next(run)
    assert not armed, "nothing was broken off"
    with tf.Results(path) as results:
        assert results.steps.tolist() == list(range(len(results))) and len(results) >= state.step + 1
        resumed = results.state(scene)
    record(scene, resumed, path, every=1, append=True)
    assert_same_file(every_step[0], path)


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (120_000, 120_000))
import torchfilm as tf
from test_results import make_scene
scene = make_scene()
try:
    for _ in tf.simulate(scene, scene.seed(3, seed=11), until=3.0, record=tf.Recorder(sys.argv[1], scene, every=1)):
        pass
except tf.SimulationError as error:
    print(error)
    sys.exit(7)
"""


@pytest.mark.slow
def test_a_file_that_can_really_grow_no_further(tmp_path, every_step):
    """The system refuses to write beyond 120 kB: HDF5's own caches are involved, unlike above."""
    path = tmp_path / "run.h5"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path)], capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.path.dirname(__file__)},
    )  # fmt: skip
    assert done.returncode == 7, (done.returncode, done.stdout, done.stderr[-2000:])
    assert "run.h5" in done.stdout
    scene = make_scene()
    with tf.Results(path) as results:
        assert len(results) >= 1
        state = results.state(scene)
    assert f"step {state.step}" in done.stdout, "the message tells which frames are safe"
    assert_same_state(state, every_step[1][state.step])
    record(scene, state, path, every=1, append=True)
    assert_same_file(every_step[0], path)


SMALL_DISK = """
import os, shutil, subprocess, sys
import torchfilm as tf
from test_results import make_scene
disk, out = sys.argv[1:]
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", disk], check=True)
path, scene, done = os.path.join(disk, "run.h5"), make_scene(), 0
try:
    for state in tf.simulate(scene, scene.seed(3, seed=11), until=3.0, record=tf.Recorder(path, scene, every=1)):
        done = state.step
    print("the run ended as if nothing had happened")
except tf.SimulationError as error:
    print("told" if "run.h5" in str(error) else error)
with tf.Results(path) as results:
    whole = results.steps.tolist() == list(range(len(results))) and 1 <= len(results) <= done + 2
    print("frames whole" if whole else f"frames {results.steps}")
subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
with tf.Results(path) as results:
    state = results.state(scene)
for _ in tf.simulate(scene, state, until=3.0, record=tf.Recorder(path, scene, every=1, append=True)):
    pass
shutil.copy(path, out)
print("resumed")
"""


@pytest.mark.slow
def test_a_disk_that_is_really_full(tmp_path, every_step):
    """A disk of 200 kB of its own, where the system lets us make one: what fails there is the writing of HDF5's caches, which is late
    and easily missed. The run must stop and say so, the frames before must be whole, and with more room it must go on.
    """
    private = ["unshare", "-Urm"]
    trial = [*private, "sh", "-c", f"mount -t tmpfs -o size=200k tmpfs {tmp_path}"]
    if shutil.which("unshare") is None or subprocess.run(trial, capture_output=True, check=False).returncode:
        pytest.skip("this system does not let us make a small disk")
    (tmp_path / "disk").mkdir()
    done = subprocess.run(
        [*private, sys.executable, "-c", SMALL_DISK, str(tmp_path / "disk"), str(tmp_path / "run.h5")],
        capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.path.dirname(__file__)},
    )  # fmt: skip
    assert done.stdout.splitlines() == ["told", "frames whole", "resumed"], (done.returncode, done.stdout, done.stderr[-1000:])
    assert_same_file(every_step[0], tmp_path / "run.h5")


def test_observers_and_the_recorder_may_be_used_by_hand(tmp_path):
    """A Recorder is an observer: called with states, closed at the end."""
    scene = make_scene()
    recorder, state = tf.Recorder(tmp_path / "run.h5", scene, every=2), scene.seed()
    recorder(state)
    for _ in range(5):
        state = scene.step(state, DT)
        recorder(state)
    recorder.close()
    recorder.close()
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.steps.tolist() == [0, 2, 4, 5]


def test_a_run_that_is_given_up_is_closed_and_complete(tmp_path):
    """Leaving the loop early writes the last state."""
    scene = make_scene()
    for state in tf.simulate(scene, scene.seed(), until=1.0, record=tf.Recorder(tmp_path / "run.h5", scene, every=10)):
        if state.step == 13:
            break
    del state
    import gc

    gc.collect()
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.steps.tolist() == [0, 10, 13]


def test_colonies_without_cells_are_recorded(tmp_path):
    cells = tf.Cells([[0.0, 0.0]], [1.0, 0.0], colony=[1])

    def update(cells):
        cells.remove_flag = cells.time > 0.1

    scene = tf.Scene(tf.Rules(update), tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=cells, dt=DT)
    states = record(scene, scene.seed(3), tmp_path / "run.h5", until=0.5, every=1)
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.counts[0].tolist() == [0, 1, 0] and results.counts[-1].tolist() == [0, 0, 0]
        assert_same_state(results.state(scene), states[-1])
        assert len(results.table()["uid"]) == int(results.counts.sum())
        assert len(results.table(-1)["uid"]) == 0


def test_recipe_of_a_scene_of_ones_own_is_none(whole):
    with tf.Results(whole[0]) as results:
        assert results.recipe is None and json.loads(results.attributes["recipe"]) is None

"""Results files: round trip, and reading while writing."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import textwrap
from dataclasses import dataclass

import h5py
import numpy as np
import pytest
import torch
from helpers import step
from recorded import DT, EVERY, UNTIL, assert_same_state, make_scene, record

import torchfilm as tf
from torchfilm.effect import Effect
from torchfilm.state import PER_CELL

INDEX_ENTRY = 64  # bytes for a chunk of a dataset, in the index of its chunks, at most

# --- round trip -----------------------------------------------------------------------------------


def test_every_seventh_step_and_the_last_are_there(whole):
    path, states = whole
    with tf.Results(path) as results:
        assert len(results) == 10
        assert results.steps.tolist() == [0, 7, 14, 21, 28, 35, 42, 49, 56, 60]
        assert results.times.tolist() == [states[k].time for k in results.steps]
        assert results.times[-1] == pytest.approx(UNTIL, rel=1e-12)
        assert np.array_equal(results.counts, [states[k].counts.tolist() for k in results.steps])
        assert results.colony_id.tolist() == [0, 1, 2]


def test_another_process_gets_a_file_of_its_own(whole):
    path, _ = whole
    with tf.Results(path) as results:
        sent = pickle.dumps(results)
        with pickle.loads(sent) as other:
            assert other.file is not results.file and other.times.tolist() == [*results.times]
        assert len(results) == 10  # closing the other leaves it open


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
def test_a_frame_that_is_not_there_is_reported(whole, frame):
    with tf.Results(whole[0]) as results, pytest.raises(tf.InputError, match="10 frames"):
        results.frame(frame)


def test_a_frame_goes_by_its_number_and_not_by_its_time(whole):
    with tf.Results(whole[0]) as results:
        for read in (results.frame, results.cells, results.table, results.state):
            with pytest.raises(tf.InputError, match=r"no parameter 'time'.*results\.times"):
                read(time=1.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_states_come_back_whole(tmp_path, dtype):
    scene = make_scene()
    states = record(scene, scene.bind(2, dtype=dtype).start(), tmp_path / "run.h5", until=1.0)
    with tf.Results(tmp_path / "run.h5") as results:
        for k, step in enumerate(results.steps):
            assert_same_state(results.state(make_scene(), k), states[step])


def test_what_a_file_says_of_itself(whole):
    with tf.Results(whole[0]) as results:
        a = results.attributes
    assert (a["seed"], a["dim"], a["dtype"], a["dt"], a["every"]) == (11, 2, "float32", DT, EVERY)
    assert a["torchfilm"] == tf.__version__ and a["torch"] == str(torch.__version__)
    assert "Division(length=Uniform(low=3.0, high=4.0))" in a["scene"]


def test_the_step_that_was_used_is_the_step_that_is_reported(tmp_path):
    """`simulate(dt=…)` may differ from the scene's own step: a resumed run must know."""
    scene = make_scene()
    for _ in tf.simulate(
        scene, scene.bind().start(), until=0.4, dt=0.1, record=tmp_path / "run.h5"
    ):
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
        assert (
            file["cells/position"].compression == "gzip"
            and file["cells/position"].chunks is not None
        )


def test_a_file_is_as_large_as_its_data(tmp_path):
    """No chunk is left behind when it is written again: the space beside the data is for names,
    attributes and indices, and grows with a frame by an index entry of each dataset."""

    def beside(every):
        path, scene = tmp_path / f"{every}.h5", tf.scenes.quorum_sensing(size=24.0)
        state = scene.bind(3, seed=2).start()
        record(scene, state, path, until=1.0, every=every)
        data = []

        def add(_, item):
            if isinstance(item, h5py.Dataset):
                data.append(item.id.get_storage_size())

        with h5py.File(path) as file:
            file.visititems(add)
            return os.path.getsize(path) - sum(data), len(file["frames/step"]), len(data)

    few, frames, tables = beside(10)
    many, more, _ = beside(1)
    assert more > 5 * frames
    assert many - few < INDEX_ENTRY * tables * (more - frames), (few, many)


def test_each_frame_begins_with_a_chunk_and_the_rows_between_are_blank(whole):
    with h5py.File(whole[0]) as file:
        uid, position = file["cells/uid"], file["cells/position"][:]
        first, counts = file["frames/first_row"][:], file["frames/counts"][:].sum(1)
        assert not (first % uid.chunks[0]).any() and (np.diff(first) >= counts[:-1]).all()
        held = np.zeros(len(uid), bool)
        for a, n in zip(first, counts, strict=True):
            held[a : a + n] = True
        assert (~held).any() and (uid[:][~held] == -1).all() and (uid[:][held] >= 0).all()
        assert np.isnan(position[~held]).all() and np.isfinite(position[held]).all()


def test_colonies_of_a_selection_keep_their_ids(tmp_path):
    scene = make_scene()
    record(scene, scene.bind(4).start().select([3, 1]), tmp_path / "run.h5", until=1.0)
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.colony_id.tolist() == [3, 1]
        assert set(results.table()["colony"].tolist()) == {1, 3}
        assert set(results.lineage().colony.tolist()) == {1, 3}
        state = results.state(make_scene())
    assert state.colony_id.tolist() == [3, 1]


# --- reading while it grows -----------------------------------------------------------------------


READ = """
import sys, torchfilm as tf
with tf.Results(sys.argv[1]) as results:
    sizes = len(results.frame()["uid"]), len(results.lineage())
    print(len(results), int(results.counts[-1].sum()), *sizes)
"""


def python(code: str, *arguments: object, **options) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=600,
        env=environment,
        check=False,
        **options,
    )


@pytest.mark.slow
def test_reading_while_the_writer_is_open(tmp_path):
    """From this process, from an open reader that refreshes, and from another process."""
    path = tmp_path / "run.h5"
    scene = make_scene()
    run = tf.simulate(
        scene, scene.bind(2).start(), until=2.0, record=tf.Recorder(path, scene, every=5)
    )
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
        assert len(results.lineage()) >= state.cells
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

    def writes(self):
        return ("plate",)

    def step(self, state, dt, values):
        return state.with_fields(plate=state.plate + 1)


def test_fields_of_colonies_are_recorded_and_come_back(tmp_path):
    path, scene = tmp_path / "run.h5", tf.Scene(tf.Growth(rate=1.0), Plate())
    run = tf.simulate(
        scene, scene.bind(3).start(), until=0.5, dt=0.1, record=tf.Recorder(path, scene, every=1)
    )
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


def test_observers_and_the_recorder_may_be_used_by_hand(tmp_path):
    """A Recorder is an observer: called with states, closed at the end."""
    scene = make_scene()
    recorder, state = tf.Recorder(tmp_path / "run.h5", scene, every=2), scene.bind().start()
    recorder(state)
    for _ in range(5):
        state = step(scene, state, DT)
        recorder(state)
    recorder.close()
    recorder.close()
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.steps.tolist() == [0, 2, 4, 5]


def test_a_run_that_is_given_up_is_closed_and_complete(tmp_path):
    """Leaving the loop early writes the last state."""
    scene = make_scene()
    for state in tf.simulate(
        scene,
        scene.bind().start(),
        until=1.0,
        record=tf.Recorder(tmp_path / "run.h5", scene, every=10),
    ):
        if state.step == 13:
            break
    del state
    import gc

    gc.collect()
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.steps.tolist() == [0, 10, 13]


@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
def test_colonies_without_cells_are_recorded(tmp_path):
    cells = tf.Cells([[0.0, 0.0]], [1.0, 0.0], colony=[1])

    def update(cells):
        cells.remove_flag = cells.time > 0.1

    scene = tf.Scene(
        tf.Rules(update), tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=cells, dt=DT
    )
    states = record(scene, scene.bind(3).start(), tmp_path / "run.h5", until=0.5, every=1)
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.counts[0].tolist() == [0, 1, 0] and results.counts[-1].tolist() == [0, 0, 0]
        assert_same_state(results.state(scene), states[-1])
        assert len(results.table()["cell"]) == int(results.counts.sum())
        assert len(results.table(-1)["cell"]) == 0


def test_recipe_of_a_scene_of_ones_own_is_none(whole):
    with tf.Results(whole[0]) as results:
        assert results.recipe is None and json.loads(results.attributes["recipe"]) is None


@pytest.mark.parametrize("since", ["the end", "before it"])
def test_a_reader_sees_what_a_resumption_adds(tmp_path, since):
    """Of a finished run, opened when it was, or while it was written; beside it others read the
    file, and it goes on."""
    path, scene = tmp_path / "run.h5", make_scene()
    run = tf.simulate(
        scene, scene.bind(2, seed=1).start(), until=1.0, record=tf.Recorder(path, scene, every=5)
    )
    for _ in range(12):
        next(run)
    live = tf.Results(path) if since == "before it" else None
    for _ in run:
        pass
    with live or tf.Results(path) as results, tf.Results(path) as other:
        results.refresh()
        before = len(results)
        assert before == len(other) and results.times[-1] == pytest.approx(1.0)
        if live is None:
            with h5py.File(path, "r") as file:
                assert len(file["frames/step"]) == before
        record(scene, other.state(scene), path, until=2.0, append=True)
        results.refresh()
        assert len(results) > before and results.times[-1] == pytest.approx(2.0)


def test_a_reader_survives_a_file_that_is_away_for_a_moment(tmp_path):
    path, scene = tmp_path / "run.h5", make_scene()
    record(scene, scene.bind(2, seed=1).start(), path, until=0.5)
    with tf.Results(path) as results:
        path.rename(tmp_path / "away.h5")
        with pytest.raises(tf.InputError, match="No such file"):
            results.refresh()
        assert len(results.frame()["uid"]) > 0
        (tmp_path / "away.h5").rename(path)
        results.refresh()
        assert len(results.frame()["uid"]) > 0


def test_a_frame_of_results_gives_cells(tmp_path):
    """In space too, with the recorded axes, levels and types; `fields` picks from the levels."""
    grown = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=3),
        tf.Circuit(lambda u, s, p, cell: {"gfp": 2.0 - u.gfp}, species="gfp", initial={"gfp": 1.0}),
        founders=tf.Cells([[0.0, 0.0, 0.0]], [1.0, 2.0, 2.0]),
    )
    *_, state = tf.simulate(grown.bind(2), cells=5, record=tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        cells, some = results.cells(), results.cells(0, fields=["growth_rate"])
        with pytest.raises(tf.InputError, match=r"fields = 'gpf'.*gfp"):
            results.cells(fields=["gpf"])
    assert set(cells.extra) == {"gfp"}
    assert set(some.extra) == {"growth_rate"}
    again = grown.bind(cells=cells).start()
    for name in ("colony", "position", "axis", "length", "radius"):
        assert torch.allclose(getattr(again, name), getattr(state, name)), name
    assert torch.equal(again.fields["gfp"], state.fields["gfp"])

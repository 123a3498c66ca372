"""Overwriting results: the old file stays whole until the new one holds a frame, whoever reads or
writes it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import h5py
import pytest
from recorded import DT, UNTIL, assert_same_file, make_scene, record

import torchfilm as tf
from torchfilm.io import recorder, replacing

READER = """
import sys
import torchfilm as tf
with tf.Results(sys.argv[1]) as results:
    for _ in sys.stdin:
        print(len(results), results.steps.tolist()[-1], len(results.frame()["uid"]), flush=True)
        results.refresh()
"""

# Writes the first frame, and dies before the new file takes its place.
KILLED = """
import os, sys
sys.path.insert(0, sys.argv[2])
from recorded import make_scene, record
from torchfilm.io import replacing
replacing.put_in_place = lambda *_: os._exit(9)
scene = make_scene()
record(scene, scene.bind(3, seed=11).start(), sys.argv[1], overwrite=True)
"""

# Holds the lock of HDF5 on a file, as a process that writes other data than results does.
WRITER = """
import sys
import h5py
with h5py.File(sys.argv[1], "r+"):
    print("open", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def old(whole, tmp_path):
    path = tmp_path / "run.h5"
    shutil.copy(whole[0], path)
    return path


@pytest.fixture
def process():
    """Start Python code in another process, with pipes."""
    started = []

    def start(code: str, *arguments: object) -> subprocess.Popen:
        started.append(
            subprocess.Popen(
                [sys.executable, "-c", code, *map(str, arguments)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        return started[-1]

    yield start
    for one in started:
        one.kill()
        one.communicate()


def ask(reader: subprocess.Popen) -> list[int]:
    reader.stdin.write("\n")
    reader.stdin.flush()
    return list(map(int, reader.stdout.readline().split()))


def only(path) -> None:
    assert [p.name for p in path.parent.iterdir()] == [path.name], "a file was left behind"


def test_a_reader_in_another_process_keeps_the_old_file_and_then_finds_the_new_one(old, process):
    with tf.Results(old) as results:
        before = [len(results), int(results.steps[-1]), len(results.frame()["uid"])]
    reader, scene = process(READER, old), make_scene()
    assert ask(reader) == before
    run = tf.simulate(
        scene,
        scene.bind(3, seed=5).start(),
        until=0.5,
        record=tf.Recorder(old, scene, overwrite=True),
    )
    next(run)
    assert ask(reader) == before, "the first refresh came before the run"
    assert ask(reader)[:2] == [1, 0], "the new run has one frame so far"
    last = list(run)[-1]
    ask(reader)
    assert ask(reader) == [2, last.step, last.cells]
    only(old)


def test_a_reader_of_this_process_follows_too(old):
    scene = make_scene()
    with tf.Results(old) as results:
        frames = len(results)
        states = record(scene, scene.bind(3, seed=5).start(), old, until=0.5, overwrite=True)
        assert len(results) == frames
        results.refresh()
        assert results.steps[-1] == states[-1].step and len(results) == 3


def test_resuming_beside_a_reader_in_another_process(tmp_path, whole, process):
    path, scene = tmp_path / "run.h5", make_scene()
    record(scene, scene.bind(3, seed=11).start(), path, until=1.3)
    reader = process(READER, path)
    begun = ask(reader)
    with tf.Results(path) as results:
        state = results.state(scene)
    record(scene, state, path, append=True)
    assert_same_file(whole[0], path)
    assert ask(reader) == begun, "the first refresh came before the run"
    assert ask(reader)[0] > begun[0]
    only(path)


@pytest.mark.parametrize("column", ["cells/uid", "frames/step"])
@pytest.mark.parametrize(
    "failure", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["disk", "Ctrl-C"]
)
def test_a_run_that_fails_before_its_first_frame_leaves_the_old_file(
    old, whole, monkeypatch, column, failure
):
    scene, real = make_scene(), recorder.write_rows

    def write(table, at, value):
        if table.name == f"/{column}":
            raise failure
        return real(table, at, value)

    with monkeypatch.context() as broken:
        broken.setattr(recorder, "write_rows", write)
        with pytest.raises((tf.SimulationError, KeyboardInterrupt)) as caught:
            record(scene, scene.bind().start(), old, overwrite=True)
    if isinstance(failure, OSError):
        assert "No frame was written" in str(caught.value)
    assert_same_file(whole[0], old)
    only(old)


def test_a_run_that_fails_before_its_first_frame_leaves_no_file(tmp_path, monkeypatch):
    scene = make_scene()
    monkeypatch.setattr(replacing, "put_in_place", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        record(scene, scene.bind().start(), tmp_path / "run.h5", until=0.1)
    assert list(tmp_path.iterdir()) == []


def test_a_run_killed_before_its_first_frame_leaves_the_old_file_and_blocks_no_other(
    old, whole, process
):
    assert process(KILLED, old, os.path.dirname(__file__)).wait(60) == 9
    assert_same_file(whole[0], old)
    assert replacing.replacement_of(old).exists(), (
        "the kill came too early; the test would prove nothing"
    )
    scene = make_scene()
    record(scene, scene.bind(3, seed=11).start(), old, overwrite=True)
    assert_same_file(whole[0], old)
    only(old)


@pytest.mark.parametrize("left", [b"", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\nhalf a file"])
def test_a_broken_file_of_an_earlier_run_is_no_hindrance(tmp_path, left):
    path, scene = tmp_path / "run.h5", make_scene()
    replacing.replacement_of(path).write_bytes(left)
    record(scene, scene.bind().start(), path, until=0.1)
    with tf.Results(path) as results:
        assert results.steps.tolist() == [0, 2]
    only(path)


def test_another_file_in_the_place_of_the_new_one_is_kept(old, whole):
    scene = make_scene()
    with h5py.File(replacing.replacement_of(old), "w") as file:
        file.attrs["format"] = "a study"
    with pytest.raises(tf.InputError, match=r"run\.h5\.new.*another kind of file"):
        record(scene, scene.bind().start(), old, overwrite=True)
    assert_same_file(whole[0], old)


def test_a_file_that_another_process_writes_is_not_replaced(old, whole, process):
    writer = process(WRITER, old)
    assert writer.stdout.readline() == "open\n"
    with pytest.raises(tf.InputError, match=r"run\.h5.*no other process writes.*another path"):
        tf.Recorder(old, make_scene(), overwrite=True)
    writer.communicate("\n")
    assert_same_file(whole[0], old)


@pytest.mark.parametrize("how", ["replaced", "deleted"])
def test_a_run_whose_file_goes_away_stops(tmp_path, how):
    """Its frames would be lost without a word."""
    path, scene = tmp_path / "run.h5", make_scene()
    run = tf.simulate(
        scene, scene.bind(3).start(), until=UNTIL, record=tf.Recorder(path, scene, every=1)
    )
    next(run)
    if how == "replaced":
        record(scene, scene.bind(3, seed=5).start(), path, until=DT, overwrite=True)
    else:
        path.unlink()
    with pytest.raises(tf.SimulationError, match=r"run\.h5 was deleted or replaced.*step 1"):
        next(run)
    assert path.exists() == (how == "replaced")


def test_the_file_behind_a_link_is_replaced_and_the_link_stays(old, tmp_path):
    (tmp_path / "here").mkdir()
    link, scene = tmp_path / "here" / "link.h5", make_scene()
    link.symlink_to(old)
    old.chmod(0o640)
    record(scene, scene.bind().start(), link, until=0.1, overwrite=True)
    assert link.is_symlink() and old.stat().st_mode & 0o777 == 0o640
    with tf.Results(old) as results:
        assert results.steps.tolist() == [0, 2]


def test_where_an_open_file_cannot_be_renamed(old, whole, monkeypatch):
    """As on Windows: the file is closed, renamed and opened again."""
    monkeypatch.setattr(replacing, "RENAMES_OPEN_FILES", False)
    scene = make_scene()
    record(scene, scene.bind(3, seed=11).start(), old, overwrite=True)
    assert_same_file(whole[0], old)
    only(old)


def test_whoever_has_the_file_open_is_asked_to_close_it(old, monkeypatch):
    """Windows does not replace it then; it may be this process that has not closed its results."""

    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(replacing, "RENAMES_OPEN_FILES", False)
    monkeypatch.setattr(replacing.os, "replace", refuse)
    scene = make_scene()
    with pytest.raises(tf.InputError, match=r"run\.h5.*nothing has open.*results\.close\(\)"):
        record(scene, scene.bind(3).start(), old, overwrite=True)


def test_a_place_where_hdf5_cannot_create_a_file_is_named(tmp_path, monkeypatch):
    def locked(*_, **__):
        raise OSError(95, "unable to lock file")

    scene = make_scene()
    recorder = tf.Recorder(tmp_path / "run.h5", scene)
    monkeypatch.setattr(replacing.h5py, "File", locked)
    with pytest.raises(tf.InputError, match=r"run\.h5.*unable to lock.*HDF5_USE_FILE_LOCKING"):
        recorder(scene.bind().start())


def test_a_run_without_a_step_replaces_nothing(old):
    """As where a cell of a notebook is run again."""
    scene, before = make_scene(), old.read_bytes()
    last = tf.simulate(scene, until=UNTIL, colonies=2).last()
    again = tf.Recorder(old, scene, overwrite=True)
    with pytest.raises(tf.InputError, match=r"overwrite=True.*run\.h5.*of a run with a step"):
        tf.simulate(scene, last, until=UNTIL, record=again)
    assert old.read_bytes() == before
    new = old.with_name("new.h5")  # a file of one frame is fine where there was none
    assert tf.simulate(scene, last, until=UNTIL, record=str(new)).last() is last
    assert len(tf.Results(new)) == 1

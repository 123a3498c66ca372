"""What batch jobs on a cluster meet: full disks, two processes at one path, terminals without µ,
colonies that fail."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import pytest
import torch
from commands import shell

import design
import torchfilm as tf
from torchfilm.io import layout, room
from torchfilm.tools import whole_files

Usage = namedtuple("Usage", "total used free")


def full(monkeypatch, free: int) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage(10**9, 10**9 - free, free))


@pytest.fixture
def results(tmp_path) -> Path:
    for _ in tf.simulate(tf.scenes.quorum_sensing(), until=0.1, record=tmp_path / "a.h5"):
        pass
    return tmp_path / "a.h5"


def test_resume_needs_room_for_a_copy(results, monkeypatch):
    """Said before a byte is written: a disk that fills while HDF5 writes may end the process."""
    scene = tf.scenes.quorum_sensing()
    with tf.Results(results) as kept:
        state = kept.state(scene)
    before = results.read_bytes()
    full(monkeypatch, len(before))
    recorder = tf.Recorder(results, scene, append=True)
    with pytest.raises(tf.SimulationError, match=r"no room to resume .*The file is whole"):
        for _ in tf.simulate(scene, state=state, until=0.2, record=recorder):
            pass
    assert [*results.parent.iterdir()] == [results] and results.read_bytes() == before


def test_the_room_for_a_frame_is_told_without_a_copy(results, monkeypatch):
    """Of what lies on a GPU, which a copy of all columns would wait for."""
    scene = tf.scenes.quorum_sensing()
    with tf.Results(results) as kept:
        state = kept.state(scene)
    columns = (layout.cell_columns, layout.voxel_columns, layout.colony_columns)
    written = sum(v.nbytes for of in (*columns, layout.found_columns) for v in of(state).values())
    monkeypatch.setattr(torch.Tensor, "cpu", None)
    assert 0 <= layout.frame_bytes(state) - written < 1000  # counts and grids


def test_an_export_stops_while_its_file_can_be_closed(results, monkeypatch):
    with tf.Results(results) as kept:
        full(monkeypatch, room.SPARE_BYTES + 1000)
        with pytest.raises(tf.SimulationError, match=r"no room to write .*x\.vtkhdf"):
            kept.to_vtkhdf(results.parent / "x.vtkhdf")
    assert [*results.parent.iterdir()] == [results]


def test_a_circuit_in_the_c_locale(tmp_path):
    """Where Python opens text as ASCII: the code that is made for a circuit has other letters."""
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = shell("explain", "boundary_detector", folder=tmp_path, environment=plain)
    assert done.returncode == 0, done.stderr


def test_a_study_on_a_full_disk(tmp_path, monkeypatch):
    target = design.Stripe("yfp", at=6.0, width=4.0)
    space = [design.Parameter("k1", 0.1, 10.0, log=True)]
    search = design.Search(tf.scenes.boundary_detector, space, target, cells=3, replicates=1)
    full(monkeypatch, 1000)
    with pytest.raises(tf.SimulationError, match=r"no room to write .*Free some space"):
        search.run(colonies=8, study=tmp_path / "a.study.h5")
    assert not [*tmp_path.iterdir()]


def test_why_a_file_was_not_written():
    said = {
        "Another process": [BlockingIOError(11, "x"), OSError("unable to lock file")],
        "out of memory": [MemoryError(), RuntimeError("memory allocation failed for chunk")],
        "disk full": [OSError(28, "No space left on device")],
    }
    for words, errors in said.items():
        assert all(words in whole_files.why_not_written(e) for e in errors)


HOLD = """
import sys
import torchfilm as tf

recorder = tf.Recorder("a.h5", tf.scenes.microcolony(), overwrite=True)
put = tf.io.replacing.put_in_place

def held(*given):
    print("held", flush=True)
    sys.stdin.readline()
    return put(*given)

tf.io.replacing.put_in_place = held
for _ in tf.simulate(tf.scenes.microcolony(), until=0.05, record=recorder):
    pass
"""


def test_who_begins_first_at_a_path_keeps_it(tmp_path):
    """The other says that a process writes there, and touches nothing of the first's."""
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    first = subprocess.Popen(
        [sys.executable, "-c", HOLD], cwd=tmp_path, env=env, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert first.stdout is not None and first.stdout.readline() == "held\n"
    scene = tf.scenes.microcolony()
    with pytest.raises(tf.InputError, match=r"a\.h5' is not allowed.*no other process writes"):
        for _ in tf.simulate(scene, until=0.05, record=tmp_path / "a.h5"):
            pass
    first.communicate("go\n")
    assert first.returncode == 0
    with tf.Results(tmp_path / "a.h5") as kept:
        assert len(kept) == 2 and [*tmp_path.iterdir()] == [tmp_path / "a.h5"]


def test_a_file_that_comes_to_the_path_meanwhile_is_kept(tmp_path, monkeypatch):
    """Another process may put its file in place between the check and the new file."""
    path, create = tmp_path / "a.h5", tf.io.replacing.create_file

    def late(beside: Path):
        path.write_text("theirs")
        return create(beside)

    monkeypatch.setattr("torchfilm.io.replacing.create_file", late)
    with pytest.raises(tf.InputError, match="no file yet"):
        for _ in tf.simulate(tf.scenes.microcolony(), until=0.05, record=path):
            pass
    assert path.read_text() == "theirs" and [*tmp_path.iterdir()] == [path]


FAILING = """
import torchfilm as tf

def scene(speed=(1.0, 1.0)):
    def runaway(u, s, p, cell):
        return {"a": p.speed * u.a * u.a}

    circuit = tf.Circuit(runaway, species="a", initial={"a": 1.0}, speed=list(speed))
    return tf.Scene(tf.Growth(), tf.Mechanics(dim=2), circuit)
"""


@pytest.mark.slow
def test_a_failed_colony_may_be_dropped(tmp_path):
    (tmp_path / "mine.py").write_text(FAILING)
    given = "mine.py", "--set", "speed=0.01,5.0", "--until", 0.5, "--no-picture"
    ended = shell("run", *given, "--out", "a.h5", folder=tmp_path)
    assert ended.returncode == 1 and "--on-failure drop continues" in ended.stderr
    went_on = shell("run", *given, "--out", "b.h5", "--on-failure", "drop", folder=tmp_path)
    assert went_on.returncode == 0, went_on.stderr
    with tf.Results(tmp_path / "b.h5") as kept:
        assert kept.times[-1] == pytest.approx(0.5) and kept.counts[-1].tolist() == [1, 0]


@pytest.mark.slow
def test_a_terminal_without_greek_letters(tmp_path):
    given = "microcolony", "--until", 0.1, "--no-picture"
    done = shell("run", *given, folder=tmp_path, environment={"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0 and re.search(r"overlap +mean [\d.]+ \?m", done.stdout), done.stderr
